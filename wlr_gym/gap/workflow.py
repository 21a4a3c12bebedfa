"""The whole workflow, step by step: intake, split, calibrate, search, validate; see docs/gap.md."""

from __future__ import annotations

import itertools
import math
import time
from collections.abc import Callable, Container, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from threadpoolctl import threadpool_limits

from wlr_gym.base.errors import InputError, check_number, unknown_name
from wlr_gym.base.paths import as_path
from wlr_gym.base.provenance import provenance
from wlr_gym.gap.analysis import (
    BAD_DATA,
    EFFECT_FOUND,
    FAILS_CROSS_VALIDATION,
    NOT_EXCITED,
    NOTHING_MISSING,
    UNKNOWN,
    Analysis,
    Calibrated,
    Equivalent,
    Evidence,
    FoundEffect,
    IntakeFinding,
    ParameterEstimate,
    Threshold,
)
from wlr_gym.gap.estimation import (
    estimates,
    fit,
    half_widths,
    mean_of_runs,
    mean_squares,
    nominal_model,
    replay,
    widened,
)
from wlr_gym.gap.problem import Candidate, Problem
from wlr_gym.gap.report.recommendation import recommend, relations, separating_run
from wlr_gym.gap.selection.hypotheses import INSISTENT, equivalents, selection_frequency
from wlr_gym.gap.selection.screening import Score, chance, detectable
from wlr_gym.gap.selection.search import SearchResult, evidence_of, refuted_evidence, search_effects
from wlr_gym.gap.validation.data_split import informative_split, named_split
from wlr_gym.gap.validation.held_out import compare_models, confirmed, most_in, most_left, noise_floor
from wlr_gym.gap.validation.localisation import informative_traces, localise
from wlr_gym.gap.validation.residual_tests import adequacy_of, turning
from wlr_gym.physics.effects import Patch, Source, load_patch

#: Told of the present stage and of the share of the whole work that is done.
Tell = Callable[[str, float], None]

#: Stages and the share of the work that is done when they begin (measured on eight runs of 20 s). Their names are keys of
#: ``seconds`` in the result file.
STAGES = {"reading": 0.0, "choosing runs": 0.02, "calibrating": 0.1, "naming": 0.35, "proving": 0.85, "drawing": 0.97}
#: Scatter of the runs, over what their rows predict, that is assumed until a fit has estimated it.
SCATTER = 5.0
#: Sums of several threads round otherwise, and a fit may end elsewhere.
_one_thread = threadpool_limits.wrap(limits=1, user_api="blas")
#: Share of the effects that must be visible within their plausible range for "nothing missing" to mean anything.
LEAST_VISIBLE = 0.5
#: Noise floors up to which an error is no sign that something is missing: 98 % of the robots without an effect leave less
#: (blind test).
HARDLY_MORE_THAN_NOISE = 2.0


@_one_thread
def analyse(
    data: str | Path,
    out: str | Path | None = None,
    *,
    known: Source = None,
    rig: str | Path | None = None,
    robot: str | Path | None = None,
    backend: str = "gibbs_appell",
    heldout: Sequence[str] = (),
    threads: int = 1,
    tell: Tell = lambda stage, share: None,
) -> Analysis:
    """Find what the model of a robot lacks, from measured runs.

    Args:
        data: folder of runs in the measured-run format (with ``rig``: recordings of the rig).
        out: where result, patch, pictures and report are written; None = nowhere.
        known: effects that are known already.
        rig: None = the robot; ``pendulum`` = one servo that swings a pendulum; a Python file = a system of one's own
            (:mod:`wlr_gym.gap.rig.own`).
        robot: file or config name; None = the one the runs' meta data name, else the nominal one.
        backend: simulator.
        heldout: names of the runs to hold out; empty = chosen by how informative the other runs are.
        threads: worker threads; the result does not depend on it.
        tell: called with progress.

    Raises:
        InputError: data that cannot be read, a run twice, a run, rig or backend that does not exist, a folder that the results
            cannot go into; the last before the work begins.
    """
    check_number("threads", threads, least=1)
    if out is not None:
        from wlr_gym.gap.report.page import check_folder

        check_folder(as_path(out))
    tell("reading", STAGES["reading"])
    load, open_runs = system_of(rig, backend, threads, robot)
    known = load(known)
    problem, findings = open_runs(data, known)
    first = {finding.run: finding for finding in reversed(findings) if finding.fatal and finding.run}
    for finding in (one for one in findings if first.get(one.run) is one):
        tell(f"left out {finding.place}: {finding.said}", STAGES["reading"])
    for finding in findings:
        if finding.fatal and finding.run in heldout:
            raise InputError(f"--heldout {finding.run}: the run cannot be used: {finding.place}: {finding.said}")
    if problem is None:
        done = Analysis(str(data), BAD_DATA, "", tuple(findings), provenance=provenance())
    else:
        _refuse_copies(problem, data)
        done = analyse_problem(problem, str(data), findings, heldout=heldout, tell=tell, known=known)
    if named := named_robot(data, rig, robot):
        done = replace(done, provenance={**done.provenance, "robot": named})
    if out is not None:
        from wlr_gym.gap.report.page import save_analysis

        tell("drawing", STAGES["drawing"])
        save_analysis(done, as_path(out))
    return done


def _refuse_copies(problem: Problem, data: str | Path) -> None:
    """A run under two names would count twice, and could be fitted and held out."""
    readings = [(name, problem.times(k), problem.measured(k)) for k, name in enumerate(problem.runs)]
    for (one, *own), (two, *others) in itertools.combinations(readings, 2):
        if all(np.array_equal(*pair, equal_nan=True) for pair in zip(own, others, strict=True)):
            raise InputError(f"{data}: {one} and {two} are the same run, reading by reading; keep one of them")


@_one_thread
def analyse_problem(
    problem: Problem,
    data: str,
    findings: Sequence[IntakeFinding] = (),
    *,
    heldout: Sequence[str] = (),
    known: Source = None,
    tell: Tell = lambda stage, share: None,
) -> Analysis:
    """Analyse a problem that is open already; see :func:`analyse`."""
    clock = _Clock(tell)
    clock.start("choosing runs")
    # columns: of the runs to fit, where they had to be simulated for the choice
    fitted, held_out, columns = (*named_split(problem.runs, heldout), None) if heldout else informative_split(problem)
    clock.start("calibrating")
    start, scatter = nominal_model(problem), SCATTER * problem.tempering
    calibrated = widened(fit(start, fitted, scatter=scatter, columns=columns, tell=clock.detail))
    clock.start("naming")

    def find(excluded: Container[str] = ()) -> SearchResult:
        return search_effects(calibrated, clock.detail, columns, excluded)

    search = confirmed(find(), held_out, find)
    base, final, rounds = search.calibrated, search.fit, search.rounds
    clock.start("proving")
    models = (start, base.model, final.model)
    floor = noise_floor(final.model, held_out)
    gap, run_gaps, channel_gaps = compare_models(models, fitted, held_out, floor)
    error, worst = most_left(gap.fit_after, run_gaps)
    nameless = not final.model.effects and error > problem.misfit * gap.noise_floor
    every = range(len(problem.runs))
    features = problem.features(base.model.setting, every)
    # mean squares that a complete model leaves: the final one, or sensors alone where that cannot be complete
    complete = mean_of_runs(mean_squares(final.residuals, problem.cap))
    complete = np.where(np.isfinite(complete), 1.0, np.nan) if nameless else complete
    places, maps = localise(base, complete, final.noise, [features[k] for k in fitted])
    adequacy = adequacy_of(final)
    (left,) = replay([final.model], every)
    turned = turning(left, features)  # few runs turn far, and held-out ones may be those
    # without name or formula: what goes with a joint's turning, else what the worst signal tells of
    nowhere: tuple[FoundEffect, ...] = ()
    if turned is not None:
        nowhere = (FoundEffect(UNKNOWN, (turned.joint,), {}, turned.confidence, math.nan),)
    elif nameless:
        worst_signal = most_in(channel_gaps) if worst else places[0].name
        (place,) = (signal.place for signal in problem.signals if signal.name == worst_signal)
        nowhere = (FoundEffect(UNKNOWN, (place,), {}, 1.0, math.nan),)
    effects = _effects(search) or nowhere
    kept = {candidate.label for candidate, _ in final.model.effects}
    groups = _equivalent(problem, search)
    evidence = [one for number, look in enumerate(rounds, 1) for one in evidence_of(number, look, kept)]
    evidence += map(refuted_evidence, search.refuted)
    verdict = _verdict(rounds[-1].scores, effects, evidence, error / gap.noise_floor)
    clock.stop()
    return Analysis(
        data=data,
        verdict=verdict,
        summary="",
        intake=tuple(findings),
        fit_runs=tuple(problem.runs[k] for k in fitted),
        heldout_runs=tuple(problem.runs[k] for k in held_out),
        effects=effects,
        equivalent=groups,
        calibration={
            quantity.name: Calibrated(quantity.nominal, float(value), quantity.unit, quantity.sigma, float(half))
            for quantity, value, half in zip(problem.quantities, final.model.quantities, half_widths(final), strict=False)
        },
        evidence=tuple(evidence),
        thresholds=tuple(
            Threshold(k, look.threshold, chance(look.by_chance), look.probabilities[1]) for k, look in enumerate(rounds, 1)
        ),
        localisation=places,
        relations=relations(rounds[0].scores),
        heat_maps=maps,
        traces=informative_traces(models, held_out, places),
        gap=gap,
        run_gaps=run_gaps,
        channel_gaps=channel_gaps,
        detectable=detectable(rounds[-1].scores, rounds[-1].threshold),
        recommendations=recommend(rounds[-1], groups, verdict, problem.motions),
        adequacy=adequacy,
        turning=turned,
        known_effects=tuple(effect.content() for effect in load_patch(known).effects),
        seconds=clock.seconds,
        provenance=provenance(),
    )


class _Clock:
    """Times the stages and reports them."""

    def __init__(self, tell: Tell) -> None:
        self.seconds: dict[str, float] = {}
        self._tell, self._stage, self._since = tell, "", time.perf_counter()

    def start(self, stage: str) -> None:
        self.stop()
        self._stage, self._since = stage, time.perf_counter()
        self._tell(stage, STAGES[stage])

    def detail(self, text: str) -> None:
        """Tell of a step within a stage: the share creeps towards the next stage's."""
        ends = [share for share in STAGES.values() if share > STAGES[self._stage]]
        spent = time.perf_counter() - self._since
        self._tell(f"{self._stage}: {text}", STAGES[self._stage] + (min(ends) - STAGES[self._stage]) * spent / (spent + 60.0))

    def stop(self) -> None:
        if self._stage:
            self.seconds[self._stage] = time.perf_counter() - self._since


def _verdict(scores: Sequence[Score], effects: Sequence[FoundEffect], evidence: Sequence[Evidence], floors: float) -> str:
    """The verdict.

    ``scores``: of the last round; ``floors``: largest error, in noise floors, NaN where the model cannot tell its own.
    """
    if effects:
        return UNKNOWN if all(effect.name == UNKNOWN for effect in effects) else EFFECT_FOUND
    alone = [one.gain for one in evidence if one.outcome == FAILS_CROSS_VALIDATION]
    if alone and not (floors <= HARDLY_MORE_THAN_NOISE and max(alone) <= INSISTENT):
        return NOT_EXCITED
    names = {score.candidate.name for score in scores}
    visible = {score.candidate.name for score in scores if score.visible}
    return NOTHING_MISSING if len(visible) >= LEAST_VISIBLE * len(names) else NOT_EXCITED


def _effects(search: SearchResult) -> tuple[FoundEffect, ...]:
    final, found = search.fit, []
    for (candidate, values), own in zip(final.model.effects, estimates(final), strict=True):
        look, one = next((look, one) for look, one in search.kept if one.candidate.label == candidate.label)
        frequency = selection_frequency(one, look.hypotheses, look.threshold)
        effect, setting = candidate.effect(values), final.model.setting
        tried = final.problem.reach(effect, setting, final.runs) if candidate.formula else {}
        found.append(replace(found_effect(candidate, own, frequency, one.gain), validity=tried))
    return tuple(sorted(found, key=lambda effect: -effect.gain))


def found_effect(candidate: Candidate, own: Mapping[str, ParameterEstimate], frequency: float, gain: float) -> FoundEffect:
    """Return a fitted candidate as it is written.

    Constants of its formula that were not fitted have no width, parameters that its runs hardly show no interval.
    """
    fixed = candidate.fixed if candidate.formula else {}
    given = {name: ParameterEstimate(value, value, value, candidate.units[name]) for name, value in fixed.items()}
    for name in candidate.unseen:
        given[name] = ParameterEstimate(candidate.fixed[name], math.nan, math.nan, candidate.vocabulary[name].unit)
    name, where, units = candidate.name, candidate.where, dict(candidate.units)
    return FoundEffect(name, where, {**own, **given}, frequency, gain, candidate.formula, units, doc=candidate.doc)


def _equivalent(problem: Problem, search: SearchResult) -> tuple[Equivalent, ...]:
    groups = []
    for look, one in search.kept:
        swapped = search.swaps.get(one.candidate.label)
        others = equivalents(*swapped) if swapped else look.equivalents
        if others:
            names, where = (one.candidate.name, *(other.candidate.name for other in others)), one.candidate.where
            groups.append(Equivalent(names, separating_run(names, problem.motions, where), where))
    return tuple(groups)


# ---- opening ---------------------------------------------------------------------------------------------------------

#: Kinds of rigs.
RIGS = ("pendulum",)
#: Ending of the file of a rig of one's own.
OWN_RIG = ".py"


def system_of(
    rig: str | Path | None, backend: str = "gibbs_appell", threads: int = 1, robot: str | Path | None = None
) -> tuple[Callable[[Source], Patch], Callable[[str | Path, Patch], tuple[Problem | None, list[IntakeFinding]]]]:
    """Return what loads known effects in the vocabulary of the robot or of a rig, and what opens a folder of its runs.

    The latter takes the known effects too, and returns the problem, None where the data are too bad to go on, and what was
    noticed. For the arguments see :func:`analyse`.
    """
    if rig is None:
        from wlr_gym.gap.robot.problem import open_robot

        return load_patch, lambda data, known: open_robot(data, known, backend, threads, robot)
    from wlr_gym.gap.rig.problem import rig_patch

    if rig in RIGS:
        from wlr_gym.gap.rig.pendulum import JOINT, RIG_EFFECTS, open_pendulum

        return lambda known: rig_patch(known, RIG_EFFECTS, JOINT), open_pendulum
    if Path(rig).suffix != OWN_RIG:
        raise unknown_name("rig", str(rig), RIGS)
    from wlr_gym.gap.rig.own import load_rig, open_own_rig

    own = load_rig(rig)
    return lambda known: rig_patch(known, own.laws, own.name), lambda data, known: open_own_rig(data, own, known.effects)


def known_patch(known: Source, rig: str | Path | None) -> Patch:
    """Return the effects given as known, in the vocabulary of the robot or of the rig; see :func:`system_of`."""
    return system_of(rig)[0](known)


def named_robot(data: str | Path, rig: str | Path | None, robot: str | Path | None) -> str | None:
    """Return what ``--robot`` takes for the robot that is analysed; None = nothing names it, or it is a rig."""
    from wlr_gym.data.runs import names_file, read_meta, shipped_robots

    if robot is not None or rig is not None:
        return None if rig is not None else str(robot)
    named = read_meta(data).robot
    if named is None:
        return None
    return str(Path(data) / named) if names_file(named) else shipped_robots()[named].stem
