"""Go on until it is decided: analyse, choose the next run, have it driven, and analyse again; see docs/gap.md.

The motion to drive next is the one that distinguishes best, per second of driving, what may still be missing
(:func:`promises`). Every explanation in play is replayed in every motion, and so is the model with each of its numbers moved.
What two explanations predict differently, less what calibrated numbers and their own can take up within their uncertainty, is
what a run of that motion would add to the difference of their minus two log evidence, to first order; levels and
autocorrelation times are those that the last analysis found. The mean over all pairs is weighted by the probabilities of both
(Box and Hill, 1967).

An explanation's own numbers are as uncertain as the runs that are there leave them: a law that becomes another one at the
edge of a number (Stribeck friction with a large speed is Coulomb friction) cannot be told from it by any run.
"""

from __future__ import annotations

import itertools
import math
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from pydantic import Field

from wlr_gym.base.errors import InputError
from wlr_gym.base.files import alone_in, check_same_request, resumes, write_json
from wlr_gym.base.paths import as_path
from wlr_gym.base.settings import SettingsModel, parse_config, read_yaml
from wlr_gym.data.excitations import EXCITATIONS, GENTLE, Motion, excite
from wlr_gym.data.format import META_FILE, Profile
from wlr_gym.data.record import motion_of, record_simulation
from wlr_gym.data.runs import Run, read_meta, read_run, robot_of, run_files
from wlr_gym.gap.analysis import BAD_DATA, FAILS_CROSS_VALIDATION, LEAST_RUNS, NOT_EXCITED, Adequacy
from wlr_gym.gap.estimation import TWO_SIDED_95
from wlr_gym.gap.problem import Array, Setting
from wlr_gym.gap.report.result import DECIDED, NOTHING, RESULT_FILE, Explanation, Result, explanations, read_result
from wlr_gym.gap.robot.candidates import shown_by
from wlr_gym.gap.robot.problem import MISFIT, RobotProblem
from wlr_gym.gap.validation.held_out import most_left
from wlr_gym.gap.workflow import Tell, analyse
from wlr_gym.physics.effects import EFFECTS, Patch, PatchEffect, Source, load_patch
from wlr_gym.robot import Robot

HISTORY_FILE = "history.json"
#: "Nothing is missing" is decided from so many runs on: fewer may not show what is.
RUNS_FOR_NOTHING = 6
#: Least weight of an explanation in play, however improbable.
LEAST_WEIGHT = 1e-6
#: Expected difference of minus two log evidence that takes even odds to 95 %: a motion that promises less would not tell.
TELLS = 2.0 * math.log(19.0)
#: Change of an explanation's own number for finite differences, a share of the way to where the effect vanishes: large, for
#: friction that sticks and slips answers small ones by chance. Before any run the number is unknown by the whole way.
STEP = 0.2
#: Share of rows in which a run of an excitation has its setpoints.
ALIKE = 0.9
#: Expected difference of minus two log evidence that takes 95 % for one name to 95 % for another.
TELLS_OTHERWISE = 2.0 * TELLS
#: Instead of a verdict: no analysis yet.
TOO_FEW_RUNS = "too_few_runs"

#: Why it ended. ``decided``: one name has 95 %, none is equivalent to it, or none that any motion promises to tell from it, and
#: what it leaves is no more than simulators leave; ``nothing would tell``: no motion promises to distinguish what is left, none
#: of which has 95 %; ``budget``: runs or seconds are used up;
#: ``stopped``: a drive recorded nothing. Empty: it goes on.
Ending = Literal["", "decided", "nothing would tell", "budget", "stopped"]


@dataclass(frozen=True)
class Budget:
    """What may be driven beside the runs that are there.

    Attributes:
        runs: further runs. seconds: of driving.
    """

    runs: int = 5
    seconds: float = math.inf

    def __post_init__(self) -> None:
        if self.runs < 0 or not self.seconds >= 0.0:
            raise InputError(f"budget of {self.runs} runs, {self.seconds:g} s: expected 0 or more of both")


@dataclass(frozen=True)
class Recorded:
    """What a drive left.

    Attributes:
        run: path of the run; None = nothing was recorded.
        reason: why it ended early; empty = it did not.
    """

    run: Path | None
    reason: str = ""


#: Has a motion driven, and a run of it left in a folder.
Recorder = Callable[[Motion, Path], Recorded]


class DecisionRound(SettingsModel):
    """One round: an analysis, and the run that was driven after it.

    Attributes:
        number: from 1 on; its report is in ``round_01``, ...
        runs: that were there.
        verdict: of the analysis; ``too_few_runs``: there was none, for want of runs.
        names: left, with their probabilities, which say nothing of what simulators cannot reproduce.
        excitation: driven next; "" = none. why: it was chosen.
        run: that it left; "" = none yet. seconds: of driving. stopped: why the drive ended early.
    """

    number: int
    runs: tuple[str, ...]
    verdict: str
    names: dict[str, float] = Field(default_factory=dict)
    excitation: str = ""
    why: str = ""
    run: str = ""
    seconds: float = 0.0
    stopped: str = ""


class History(SettingsModel):
    """``history.json``: what was asked, all rounds, and how it ended."""

    data: str
    robot: str | None
    backend: str
    known: list[dict[str, Any]]
    rounds: tuple[DecisionRound, ...] = ()
    ended: Ending = ""

    @property
    def seconds(self) -> float:
        """Seconds of driving, those of runs that were there before left out."""
        return sum(one.seconds for one in self.rounds)

    @property
    def driven(self) -> list[str]:
        """Names of the excitations that were driven."""
        return [one.excitation for one in self.rounds if one.run or one.stopped]


@dataclass(frozen=True)
class Decided:
    """How it ended.

    Attributes:
        history: all rounds.
        result: of the last analysis; None = there were too few runs for one.
        folder: of its report, result and patch.
    """

    history: History
    result: Result | None
    folder: Path


def decide(
    data: str | Path,
    out: str | Path,
    record: Recorder,
    budget: Budget | None = None,
    *,
    known: Source = None,
    robot: str | Path | None = None,
    backend: str = "gibbs_appell",
    threads: int = 1,
    tell: Tell = lambda stage, share: None,
) -> Decided:
    """Analyse measured runs, have the runs driven that distinguish best what may be missing, until it is decided.

    Called again with the same folders it goes on where it was interrupted, or with a larger budget where that was used up. A
    run that somebody added to ``data`` meanwhile is analysed with the others.

    Args:
        data: folder of runs, two or more; further runs go there.
        out: ``history.json``, and the report of each round in ``round_01``, ``round_02``, ...
        record: has one motion driven.
        budget: of further runs and seconds of driving; None = five runs.
        known, robot, backend, threads, tell: see :func:`wlr_gym.gap.workflow.analyse`.

    Raises:
        InputError: see :func:`wlr_gym.gap.workflow.analyse`; or ``out`` has a history of other data, robot or simulator, or
            another process works in it.
    """
    known, data, out = load_patch(known), as_path(data), as_path(out)
    session = _Session(data, out, budget or Budget(), known, robot, backend, threads, tell)
    with alone_in(out):
        history, last = session.resumed()
        while True:
            now, result, left = session.analysed(history, last)
            ended, following = session.choice(history, now, result, left)
            folder, last = session.folder(now), None
            if following is None:
                return Decided(session.saved(history, now, ended), result, folder)
            motion, why = following
            now = now.model_copy(update={"excitation": motion.name, "why": why})
            session.saved(history, now)
            recorded = record(motion, data)
            now = _with_run(now, recorded)
            history = session.saved(history, now, "" if recorded.run else "stopped")
            if recorded.run is None:
                return Decided(history, result, folder)


@dataclass(frozen=True)
class _Session:
    """The steps of a round, on what :func:`decide` was asked."""

    data: Path
    out: Path
    budget: Budget
    known: Patch
    robot: str | Path | None
    backend: str
    threads: int
    tell: Tell

    def folder(self, now: DecisionRound) -> Path:
        """Return where the report of a round goes."""
        return self.out / f"round_{now.number:02d}"

    def resumed(self) -> tuple[History, DecisionRound | None]:
        """Return the history of complete rounds, and the last one where it was interrupted or nothing was driven after it."""
        if not run_files(self.data):
            raise InputError(
                f"{self.data}: no run_*.csv or run_*.parquet: record two first: wlr record --excitation straight random"
            )
        known, robot = [dict(effect.content()) for effect in self.known.effects], self.robot and str(self.robot)
        fresh = History(data=str(self.data.resolve()), robot=robot, backend=self.backend, known=known)
        path = self.out / HISTORY_FILE
        if not resumes(self.out, HISTORY_FILE):
            return fresh, None
        history = parse_config(History, read_yaml(path), str(path))
        check_same_request(path, dict(history), {name: getattr(fresh, name) for name in ("data", "robot", "backend", "known")})
        if not history.rounds or history.rounds[-1].run:
            return history, None
        *before, last = history.rounds
        new = [path for path in run_files(self.data) if path.stem not in last.runs]
        if last.excitation and new:  # it was driven, but nobody was there to note it
            return history.model_copy(update={"rounds": (*before, _with_run(last, Recorded(new[0])))}), None
        return history.model_copy(update={"rounds": tuple(before)}), last

    def saved(self, history: History, now: DecisionRound, ended: Ending = "") -> History:
        """Return the history with a further round, and write it."""
        longer = history.model_copy(update={"rounds": (*history.rounds, now), "ended": ended})
        write_json(self.out / HISTORY_FILE, longer.model_dump(mode="json"))
        return longer

    def analysed(
        self, history: History, last: DecisionRound | None
    ) -> tuple[DecisionRound, Result | None, tuple[Explanation, ...]]:
        """Analyse the runs that are there, unless the round that was interrupted, ``last``, has done so."""
        files = run_files(self.data)
        runs = tuple(path.stem for path in files)
        now = DecisionRound(number=len(history.rounds) + 1, runs=runs, verdict=TOO_FEW_RUNS)
        if len(runs) < LEAST_RUNS:
            return now, None, ()
        folder = self.folder(now)
        path = folder / RESULT_FILE
        # runs and meta data may have been mended since
        changed = max(one.stat().st_mtime_ns for one in (*files, self.data / META_FILE) if one.exists())
        is_current = path.is_file() and path.stat().st_mtime_ns >= changed
        if last is None or last.runs != runs or not is_current:
            known, robot, backend = self.known, self.robot, self.backend
            analyse(self.data, folder, known=known, robot=robot, backend=backend, threads=self.threads, tell=self.tell)
        result = read_result(path)
        left = explanations(result)
        now = now.model_copy(update={"verdict": result.verdict, "names": {one.name: one.probability for one in left}})
        self.saved(history, now)
        return now, result, left

    def choice(
        self, history: History, now: DecisionRound, result: Result | None, left: Sequence[Explanation]
    ) -> tuple[Ending, tuple[Motion, str] | None]:
        """Return what to drive next, and why; or None and why it ends."""
        doubt = _doubt(now, result, left)
        # nothing was selected, and some runs show an effect that runs left out of the fit do not
        nothing = [] if result is None or result.effects else result.evidence
        alone = any(one.outcome == FAILS_CROSS_VALIDATION for one in nothing)
        answered = now.verdict not in (NOT_EXCITED, BAD_DATA) and not doubt and not alone
        if len(left) == 1 and answered:
            return "decided", None
        if len(history.driven) >= self.budget.runs:
            return "budget", None
        runs = {path.stem: read_run(path) for path in run_files(self.data)}
        before = [run for name, run in runs.items() if name not in {one.run for one in history.rounds}]
        own = robot_of(next(iter(runs.values())), self.robot)
        driven = [*driven_already(before, own), *history.driven]
        motions = motions_to_drive(own, read_meta(self.data).profile, driven)
        motions = [motion for motion in motions if motion.duration <= self.budget.seconds - history.seconds]
        if not motions:
            return "budget", None
        # where there are no explanations to distinguish: what the report recommends, else what shows most effects best
        advised = [one.excitation for one in result.recommendations] if result is not None else []
        new = [motion for name in advised for motion in motions if motion.name == name and name not in driven]
        why = doubt + ("the report recommends it" if new else "shows most effects best")
        shows_most = new[0] if new else most_shown(motions, driven), why
        if result is None or len(left) < 2:
            return "", shows_most
        self.tell("choosing the next run", 1.0)
        there = [runs[name] for name in now.runs]
        problem = RobotProblem(there, own, self.known, self.backend, threads=self.threads)
        found = promises(result, left, motions, problem)
        sure = left[0].probability >= DECIDED and left[0].name in {NOTHING, *(effect.name for effect in result.effects)}
        if max(one.most for one in found) >= (TELLS_OTHERWISE if sure else TELLS):
            best = found[0]
            between = f"{best.most:.0f} between {' and '.join(best.pair)}"
            return "", (best.motion, f"promises {best.per_second:.2g} per s, {between}")
        if doubt:
            return "", shows_most
        return "decided" if sure and answered else "nothing would tell", None


def _doubt(now: DecisionRound, result: Result | None, left: Sequence[Explanation]) -> str:
    """Why the runs do not carry an answer yet, whatever it is; empty: they do."""
    if result is None:
        return ""
    unnamed = any(one.name == NOTHING for one in left[:1])
    if unnamed and not result.effects and len(now.runs) < RUNS_FOR_NOTHING:
        return f"{RUNS_FOR_NOTHING} runs or more tell that nothing is missing; "
    if result.gap is None:
        return ""
    # where the error is large, a name may be the best of wrong ones
    misfit = most_left(result.gap.fit_after, result.run_gaps if unnamed else [])[0] / (result.gap.noise_floor or math.inf)
    return f"an error of {misfit:.1f} noise floors is left, more than {MISFIT:g}; " if misfit > MISFIT else ""


def _with_run(now: DecisionRound, recorded: Recorded) -> DecisionRound:
    """The round with the run that was driven after it."""
    if recorded.run is None:
        return now.model_copy(update={"stopped": recorded.reason or "nothing was recorded"})
    t = read_run(recorded.run)["t"]
    own = {"run": recorded.run.stem, "seconds": round(float(t[-1] - t[0]), 3), "stopped": recorded.reason}
    return now.model_copy(update=own)


# ---- the next run ----------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Promise:
    """What a run of a motion would tell.

    Attributes:
        motion: its setpoints.
        telling: expected difference of minus two log evidence, mean over the pairs of explanations.
        most: the same of the pair that it distinguishes best. pair: their names.
    """

    motion: Motion
    telling: float
    most: float
    pair: tuple[str, str]

    @property
    def per_second(self) -> float:
        """``telling`` per second of driving."""
        return self.telling / self.motion.duration


def motions_to_drive(robot: Robot, profile: Profile, driven: Sequence[str]) -> list[Motion]:
    """Return the excitations made for a servo profile, within a robot's limits; what was driven already is drawn anew.

    ``driven``: names of the excitations that were driven, once for each time.
    """
    names = [name for name, excitation in EXCITATIONS.items() if excitation.profile in (GENTLE, profile)]
    return [replace(excite(name, list(driven).count(name), robot), profile=profile) for name in names]


def driven_already(runs: Sequence[Run], robot: Robot) -> list[str]:
    """Return the names of the excitations that some runs are of, as ``wlr record`` drives them."""
    names = [(name, excite(name, robot=robot).setpoints) for name in EXCITATIONS]
    found = []
    for own in (motion_of(run).setpoints for run in runs):
        for name, setpoints in names:
            rows, most = sorted((len(own), len(setpoints)))
            alike = np.isclose(own[:rows], setpoints[:rows], equal_nan=True).all(axis=1)
            if rows >= ALIKE * most and alike.mean() >= ALIKE:
                found.append(name)
    return found


def most_shown(motions: Sequence[Motion], driven: Sequence[str]) -> Motion:
    """Return the motion that shows most effects best, of those that were driven least often: before any analysis."""
    shows = list(shown_by().values())
    return min(motions, key=lambda motion: (list(driven).count(motion.name), -shows.count(motion.name)))


def promises(
    result: Result, explanations: Sequence[Explanation], motions: Sequence[Motion], problem: RobotProblem
) -> list[Promise]:
    """Return what motions promise, most per second first; the first is the best of all.

    What numbers take up costs most to know, and only lowers a promise: motions that promise less even without it, and would
    tell no more, are left out.

    ``result`` and ``problem`` are those of the last analysis; ``explanations`` are those in play, two or more.
    """
    robot, known, backend, threads = problem.robot, problem.known, problem.backend, problem.threads
    free = _Foresight(problem, result, explanations).own_uncertainty()
    with tempfile.TemporaryDirectory() as folder:
        bounds = []
        for motion in motions:
            path = record_simulation(Path(folder) / f"run_{motion.name}.parquet", motion, robot, "gibbs_appell")
            driven = RobotProblem([read_run(path)], robot, known, backend, threads=threads)
            seen = _Foresight(driven, result, explanations)
            bounds.append((seen.promise(motion), seen))
        found: list[Promise] = []
        for bound, seen in sorted(bounds, key=lambda pair: -pair[0].per_second):
            best = max((one.per_second for one in found), default=-math.inf)
            tells = max((one.most for one in found), default=0.0) >= TELLS
            if bound.per_second > best or (bound.most >= TELLS and not tells):
                found.append(seen.promise(bound.motion, free))
    return sorted(found, key=lambda one: -one.per_second)


class _Foresight:
    """What explanations predict in the runs of a problem, weighted as the last analysis weighs residuals."""

    def __init__(self, problem: RobotProblem, result: Result, explanations: Sequence[Explanation]) -> None:
        self.problem, self.explanations = problem, explanations
        # values and standard deviations of the quantities; nominal, to their tolerance, where the result has none
        values, steps = [], []
        for quantity in problem.quantities:
            entry = result.calibration.get(quantity.name)
            value = quantity.nominal if entry is None else entry.fitted
            half = None if entry is None or entry.ci95 is None else 0.5 * (entry.ci95[1] - entry.ci95[0])
            deviation = quantity.sigma if half is None else min(half / TWO_SIDED_95, quantity.sigma)
            values.append(value)
            steps.append(deviation if value + deviation <= quantity.high else -deviation)  # where there is room
        self.values: Array = np.array(values)
        self.steps: Array = np.array(steps)
        # weight (channels) of a squared residual, as of the fit that left what the result says; 0 where nothing was measured
        adequacy, weights = result.adequacy, np.full(len(problem.signals), 1.0 / problem.tempering)
        if isinstance(adequacy, Adequacy):
            scatter = problem.tempering * float(np.fmax(adequacy.constancy.value, 1.0))
            times = adequacy.whiteness.channels
            worth = {
                name: 1.0 / (max(level.value, 1.0) ** 2 * times[name].value * scatter)
                for name, level in adequacy.level.channels.items()
                if name in times and math.isfinite(level.value + times[name].value)
            }
            weights = np.array([worth.get(signal.name, 0.0) for signal in problem.signals])
        self._root = np.sqrt(weights)

    def promise(self, motion: Motion, free: Sequence[Array] | None = None) -> Promise:
        """What a motion promises; ``free``: of :meth:`own_uncertainty`; None: the most it can, if numbers take up nothing."""
        moved = [] if free is None else [self.values + step for step in np.diag(self.steps)]
        bare, *calibrated = self._rows([Setting(self.values), *map(Setting, moved)])
        columns = np.array(calibrated).reshape(-1, len(bare)) - bare
        predicted, slopes = self._predicted(with_own=free is not None)
        own = slopes if free is None else [share @ own for share, own in zip(free, slopes, strict=True)]
        weights = np.maximum([one.probability for one in self.explanations], LEAST_WEIGHT)
        pairs = list(itertools.combinations(range(len(self.explanations)), 2))
        shares = np.array([weights[i] * weights[j] for i, j in pairs])
        told = np.array([_told(predicted[i] - predicted[j], np.vstack([columns, own[i], own[j]])) for i, j in pairs])
        one, other = (self.explanations[k].name for k in pairs[int(np.argmax(told))])
        return Promise(motion, float(shares @ told / shares.sum()), float(told.max()), (one, other))

    def own_uncertainty(self) -> list[Array]:
        """How explanations' own numbers may still move, each (numbers, numbers): rows are independent, of unit variance."""
        _, columns = self._predicted()
        found = (np.linalg.inv(np.linalg.cholesky(np.eye(len(own)) + own @ own.T)) for own in columns)
        return [np.asarray(one, np.float64) for one in found]

    def _predicted(self, *, with_own: bool = True) -> tuple[list[Array], list[Array]]:
        """Weighted predictions (rows) of explanations, and their change per way of their own numbers (see :data:`STEP`), each
        (numbers, rows); none of them unless ``with_own``."""
        models = [(one.effects, *(_own_moved(one) if with_own else ())) for one in self.explanations]
        rows = self._rows([Setting(self.values, effects) for tried in models for effects in tried])
        parts = np.split(rows, np.cumsum([len(tried) for tried in models])[:-1])
        return [part[0] for part in parts], [(part[1:] - part[0]) / STEP for part in parts]

    def _rows(self, settings: Sequence[Setting]) -> Array:
        """Weighted predictions (settings, rows of all runs and channels)."""
        runs = self.problem.residuals(settings, range(len(self.problem.runs)))
        return np.concatenate([(np.nan_to_num(one) * self._root).reshape(len(settings), -1) for one in runs], axis=1)


def _told(difference: Array, columns: Array) -> float:
    """Square of a weighted difference (rows), less what numbers of unit variance, whose columns are given, take up."""
    across = columns @ difference
    taken = across @ np.linalg.solve(np.eye(len(columns)) + columns @ columns.T, across)
    return max(float(difference @ difference - taken), 0.0)


def _own_moved(one: Explanation) -> list[tuple[PatchEffect, ...]]:
    """The effects of an explanation with each of its own numbers moved by :data:`STEP`."""
    if one.name == NOTHING:
        return []
    *before, own = one.effects
    known = EFFECTS[own.name].parameters if own.name in EFFECTS else {}
    neutral = {name: parameter.neutral for name, parameter in known.items() if isinstance(parameter.neutral, float | int)}
    ways = {name: value - neutral.get(name, 0.0) for name, value in own.parameters.items()}
    moved = [{**own.parameters, name: own.parameters[name] - STEP * way} for name, way in ways.items() if way]
    return [(*before, replace(own, parameters=parameters)) for parameters in moved]
