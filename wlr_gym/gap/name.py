"""Name what is missing: screen all candidates, refit the best of them, take the one that buys most, and look again.

A candidate is accepted if it lowers minus two log posterior by more than chance and an imperfect simulator can
(:data:`LEAST_GAIN`, more for every further unknown, and :data:`LEAST_SHARE` of what is left), if the runs agree on it, and if
its value lies inside its plausible range. In the end every effect must still be worth its place beside the others.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from wlr_gym.gap.fit import (
    SETTLED,
    Fit,
    Model,
    constrained_step,
    cross_products,
    fit,
    linearise,
    moved,
    nominal_model,
    normal_equations,
    on_bounds,
    scaled_numbers,
    total_cost,
    untouched,
    widened,
)
from wlr_gym.gap.likelihood import Noise, estimate_noise, minus_two_log_likelihood
from wlr_gym.gap.problem import Candidate, Problem, Setting, Start
from wlr_gym.gap.screen import LEAST_GAIN, Score, least_gain, responses, screen

Array = NDArray[np.float64]
Tell = Callable[[str], None]

#: Hypotheses that are refitted in one round, at most so many per name, and rounds of refitting.
SHORTLIST, PER_NAME, ROUNDS = 8, 3, 6
#: Shares of a step that a refit tries.
TRIED = (2.0, 1.0, 0.5, 0.2)
#: Share of what the best hypothesis buys by which one start may be behind another of the same before it is given up.
BEHIND = 0.5
#: The best of every name that buys at least this share of what the best buys is fitted in full before one is taken; so many.
FINALIST, FINALISTS = 0.75, 3
#: Beside a set of places its best single place is fitted in full, if it buys at least this share.
NARROWER = 0.4
#: A hypothesis that has bought less than this share of the best after so many steps is not improved any further.
HOPELESS, PATIENCE = 0.4, 2
#: An effect that helps some runs and harms others is none: harm, as a share of the help, that is put down to chance.
MOST_HARM = 0.2
#: Left out one after the other, the runs must gain together at least this share of what they gain when they are fitted; asked
#: where so many are.
LEAST_CARRIED, LEAST_RUNS = 0.3, 3
#: Of an unknown that meets no known number, what counts as an effect, in its steps.
NOTICED = 0.25
#: Hypotheses whose known numbers the model without an effect more tries too.
NUDGES = 2
#: Steps, at most, in which a model with an effect that is taken settles.
SETTLING = 8
#: Steps by which a settling effect looks for a better place, in every unknown that says where it is or over what it fades.
LOOKS = (-8.0, -4.0, 0.0, 4.0, 8.0)
#: Effects in one analysis.
MOST_EFFECTS = 4
#: A named effect is preferred to a formula if it buys at least this share of what the formula buys.
NAMED_FIRST = 0.9
#: Two explanations are equivalent if the second buys at least this share of what the first buys.
EQUIVALENT = 0.93


@dataclass(frozen=True, eq=False)
class Hypothesis:
    """One candidate after its refit.

    Attributes:
        candidate: the effect.
        model: with the effect.
        gain: fall of minus two log posterior.
        by_run: (runs) fall of the weighted squares in each run.
        screened: what the first-order score had promised.
        residuals: of the model.
        base, base_residuals: the model without the effect, refitted as long.
        carries_over: whether each run agrees with what the others tell (checked for finalists only).
        tolerable: whether the tolerances of known numbers allow as much.
    """

    candidate: Candidate
    model: Model
    gain: float
    by_run: Array
    screened: float
    residuals: list[Array] = field(repr=False)
    base: Model = field(repr=False)
    base_residuals: list[Array] = field(repr=False)
    carries_over: bool = True
    tolerable: bool = False

    @property
    def values(self) -> tuple[float, ...]:
        """Values of the candidate's unknowns."""
        return self.model.effects[-1][1]

    @property
    def at_bound(self) -> bool:
        """Whether an unknown ended at the edge of its plausible range (other than its neutral value)."""
        return any(
            (value >= u.high - 1e-9 * abs(u.high) and u.high != u.neutral)
            or (value <= u.low + 1e-9 * abs(u.low) and u.low != u.neutral)
            for u, value in zip(self.candidate.unknowns, self.values, strict=True)
        )

    @property
    def plausible(self) -> bool:
        """Whether its value says that the effect is there, at a size that a robot may have, and the runs agree."""
        return not self.at_bound and not self.tolerable and self.consistent and self.carries_over

    @property
    def consistent(self) -> bool:
        """Whether the runs agree that it is there."""
        help_, harm = self.by_run.clip(min=0.0).sum(), -self.by_run.clip(max=0.0).sum()
        return bool(harm <= MOST_HARM * help_)


@dataclass(frozen=True, eq=False)
class Round:
    """One look for an effect: what was screened, what was refitted (best first), and which was taken."""

    scores: list[Score]
    hypotheses: list[Hypothesis]
    taken: Hypothesis | None
    cost: float


@dataclass(frozen=True, eq=False)
class Naming:
    """Outcome: the calibrated model without effects, the final fit, and every round.

    ``swaps`` holds, per effect of a model of several, that effect and its rivals with the other effects kept (thorough
    problems only).
    """

    calibrated: Fit
    fit: Fit
    rounds: list[Round]
    swaps: dict[str, tuple[Hypothesis, list[Hypothesis]]]


def within_tolerance(problem: Problem, model: Model) -> bool:
    """Whether the tolerances of the numbers that the last effect meets allow what number and effect do together."""
    candidate, values = model.effects[-1]
    if not any(candidate.tolerances):
        return False
    known = {q.name: (q, value) for q, value in zip(problem.quantities, model.quantities, strict=True)}
    for unknown, value, tolerance in zip(candidate.unknowns, values, candidate.tolerances, strict=True):
        if tolerance is None:
            if abs(value - unknown.neutral) > NOTICED * unknown.step:
                return False
            continue
        for quantity, now in (known[name] for name in tolerance.quantities):
            shift = (value - quantity.nominal) / tolerance.size
            if not tolerance.replaces:
                shift = (now - quantity.nominal) / quantity.sigma + (value - unknown.neutral) / tolerance.size
            if abs(shift) > tolerance.reach:
                return False
    return True


def shortlist(scores: Sequence[Score], cost: float = 0.0) -> list[Score]:
    """Return the best scores, at most :data:`PER_NAME` of one effect, and only those that promise something.

    To first order an effect promises as little as a quarter of what it buys; ``cost`` is that of the model without it.
    """
    least = 0.25 * least_gain(1, cost)
    chosen: list[Score] = []
    for score in scores:
        if len(chosen) == SHORTLIST:
            break
        same = [other for other in chosen if other.candidate.name == score.candidate.name]
        if len(same) < PER_NAME and score.gain > least:
            chosen.append(score)
    return chosen


def name_effects(
    problem: Problem,
    runs: Sequence[int],
    start: Fit,
    tell: Tell = lambda text: None,
    given: Sequence[NDArray[np.float32]] | None = None,
) -> Naming:
    """Look for missing effects.

    Args:
        problem: the system.
        runs: those that are fitted; no other has a say.
        start: the calibrated model.
        tell: told of progress.
        given: columns of the model as its file says, where they are known.
    """
    if given is None and not problem.thorough:
        given = linearise(problem, nominal_model(problem), runs)[1]
    current, calibrated, rounds, again = start, start, [], None
    models = [start.model]
    while True:
        probes, candidates = problem.candidates(current.model.setting, current.residuals, runs)
        had = {candidate.label for candidate, _ in current.model.effects}
        candidates = [candidate for candidate in candidates if candidate.label not in had]
        tell(f"screening {len(candidates)} candidates")
        found = responses(problem, current, runs, probes)
        scores = screen(candidates, found, current.cost)
        chosen = scores if problem.thorough else shortlist(scores, cost=current.cost)
        tell(f"refitting {len(chosen)} hypotheses")
        hypotheses = (
            refit_thoroughly(problem, runs, current, chosen) if given is None else refit(problem, runs, current, chosen, given)
        )
        bare = _without_more(problem, current, hypotheses)
        finals: list[Final] = []
        if current is again or not _deeper(problem, current, bare):
            finals, bare = finalists(problem, runs, current, hypotheses, bare, tell)
        if current is not again and _deeper(problem, current, bare):
            tell("the known numbers fit better elsewhere: calibrated anew from there")
            anew = fit(problem, runs, bare.model, scatter=current.noise.scatter, steps=problem.steps)
            current = again = widened(problem, runs, anew)
            calibrated = calibrated if current.model.effects else current
            continue
        accepted, finals = _accepted(problem, runs, current, finals, bare, tell)
        taken = None if accepted is None else accepted.hypothesis
        rounds.append(Round(scores, _merged(finals, hypotheses), taken, current.cost))
        if accepted is None:
            break
        tell(f"taken: {accepted.hypothesis.candidate.label}")
        current = widened(problem, runs, drop_idle(problem, runs, accepted.fit, tell))
        if len(current.model.effects) >= MOST_EFFECTS or any(_same(current.model, earlier) for earlier in models):
            break
        models.append(current.model)
    return Naming(calibrated, current, rounds, swap_each(problem, runs, current) if problem.thorough else {})


def _without_more(problem: Problem, current: Fit, hypotheses: Sequence[Hypothesis]) -> Fit:
    """The model without a further effect: the present one, or the one that refits have found if that is better."""
    if not hypotheses:
        return current
    model, residuals = hypotheses[0].base, hypotheses[0].base_residuals
    noise = estimate_noise(residuals, scatter=current.noise.scatter)
    found = replace(
        current, model=model, residuals=residuals, noise=noise, cost=total_cost(problem, model, residuals, noise.memory)
    )
    return _cheapest(problem, (current, found), noise.memory)


def _deeper(problem: Problem, current: Fit, bare: Fit) -> bool:
    """Whether a model without a further effect, in another minimum than the present one, is clearly lower."""
    if problem.thorough:
        return False
    memory = bare.noise.memory
    lower = total_cost(problem, current.model, current.residuals, memory) - total_cost(
        problem, bare.model, bare.residuals, memory
    )
    return lower > LEAST_GAIN


def swap_each(problem: Problem, runs: Sequence[int], final: Fit) -> dict[str, tuple[Hypothesis, list[Hypothesis]]]:
    """Put every candidate in the place of each effect of a model of several, and fit it there."""
    swaps: dict[str, tuple[Hypothesis, list[Hypothesis]]] = {}
    if len(final.model.effects) < 2:
        return swaps
    for index, (candidate, _) in enumerate(final.model.effects):
        without = fit(
            problem,
            runs,
            final.model.without_effect(index),
            memory=final.noise.memory,
            scatter=final.noise.scatter,
            steps=problem.steps,
        )
        probes, candidates = problem.candidates(without.model.setting, without.residuals, runs)
        scores = screen(candidates, responses(problem, without, runs, probes))
        rivals = refit_thoroughly(problem, runs, without, scores)
        own = [rival for rival in rivals if rival.candidate.label == candidate.label]
        if own:
            swaps[candidate.label] = (own[0], rivals)
    return swaps


def _same(one: Model, other: Model) -> bool:
    return [candidate.label for candidate, _ in one.effects] == [candidate.label for candidate, _ in other.effects]


def drop_idle(problem: Problem, runs: Sequence[int], current: Fit, tell: Tell = lambda text: None) -> Fit:
    """Take out effects that the others have made needless, one after the other, the least useful first."""
    while len(current.model.effects) > 1:
        noise = current.noise
        kept = len(problem.quantities)
        trials = []
        for index in range(len(current.model.effects)):
            sizes = [len(values) for _, values in current.model.effects]
            own = slice(kept + sum(sizes[:index]), kept + sum(sizes[: index + 1]))
            silent = _replaced(current.model.effects[index][0])  # a number that an effect replaces has no columns beside it
            columns = None if silent else [np.delete(column, own, axis=0) for column in current.columns]
            model = current.model.without_effect(index)
            trials.append(
                fit(
                    problem,
                    runs,
                    model,
                    memory=noise.memory,
                    scatter=noise.scatter,
                    columns=columns,
                    steps=problem.steps,
                    renew=False,
                )
            )
        losses = [trial.cost - current.cost for trial in trials]
        least = int(np.argmin(losses))
        unknowns = len(current.model.effects[least][1])
        if losses[least] > least_gain(unknowns):
            return current
        tell(f"dropped: {current.model.effects[least][0].label}")
        current = fit(problem, runs, trials[least].model, scatter=noise.scatter, steps=1, tell=tell)
    return current


@dataclass(frozen=True, eq=False)
class Final:
    """A hypothesis fitted in full."""

    hypothesis: Hypothesis
    fit: Fit


def finalists(
    problem: Problem,
    runs: Sequence[int],
    current: Fit,
    hypotheses: Sequence[Hypothesis],
    bare: Fit,
    tell: Tell = lambda text: None,
) -> tuple[list[Final], Fit]:
    """Fit the best hypotheses in full, with responses simulated anew, and judge all against one model without them.

    Args:
        problem, runs: what is fitted.
        current: the model so far.
        hypotheses: refitted, best first.
        bare: the best model without a further effect so far.
        tell: told of progress.

    Returns:
        The finalists, best first; the best model without a further effect, which may be one that a finalist has led to.
    """
    chosen, wholes = _worth_a_fit(hypotheses), []
    for hypothesis in chosen:
        tell(f"fitting {hypothesis.candidate.label} in full")
        near = fit(problem, runs, hypothesis.model, scatter=current.noise.scatter, steps=problem.steps, tell=tell)
        both = (near, *_afresh(problem, runs, hypothesis, near, tell))
        wholes.append(_cheapest(problem, both, current.noise.memory))
    if not wholes:
        return [], bare
    memory = _cheapest(problem, wholes, current.noise.memory).noise.memory
    if not problem.thorough:
        pairs = zip(wholes, chosen, strict=True)
        bare = _cheapest(problem, [bare, *(_left(problem, runs, whole, h.candidate, memory) for whole, h in pairs)], memory)
    found = [_judged(problem, runs, h, whole, bare, memory) for h, whole in zip(chosen, wholes, strict=True)]
    return sorted(found, key=lambda final: -final.hypothesis.gain), bare


def _worth_a_fit(hypotheses: Sequence[Hypothesis]) -> list[Hypothesis]:
    """The best of every name that buys nearly as much as the best does, and the best's narrower self."""
    best: dict[str, Hypothesis] = {}
    effects = [hypothesis for hypothesis in hypotheses if not hypothesis.tolerable]
    for hypothesis in effects:
        leading = effects[0]
        enough = hypothesis.gain >= max(FINALIST * leading.gain, 0.5 * LEAST_GAIN)
        if enough and len(best) < FINALISTS:
            best.setdefault(hypothesis.candidate.name + hypothesis.candidate.formula, hypothesis)
        narrower = len(leading.candidate.where) > 1 and len(hypothesis.candidate.where) == 1
        if narrower and hypothesis.candidate.name == leading.candidate.name and hypothesis.gain > NARROWER * leading.gain:
            best.setdefault("narrower", hypothesis)
    return list(best.values())


def _judged(problem: Problem, runs: Sequence[int], hypothesis: Hypothesis, whole: Fit, bare: Fit, memory: Array) -> Final:
    """A hypothesis as its whole fit shows it: gain, agreement of the runs, what the tolerances allow.

    What the whole fit found in the known numbers is no evidence for the effect: ``bare`` is without it.
    """
    gain = total_cost(problem, bare.model, bare.residuals, memory) - total_cost(problem, whole.model, whole.residuals, memory)
    judged = replace(
        hypothesis,
        model=whole.model,
        gain=gain,
        by_run=_by_run(bare.residuals, whole.residuals, estimate_noise(whole.residuals, memory, whole.noise.scatter)),
        residuals=whole.residuals,
        base=bare.model,
        base_residuals=bare.residuals,
        carries_over=carries_over(problem, runs, bare, whole, gain, memory),
        tolerable=within_tolerance(problem, whole.model),
    )
    return Final(judged, whole)


def _left(problem: Problem, runs: Sequence[int], whole: Fit, candidate: Candidate, memory: Array) -> Fit:
    """The model without the last effect, from where the known numbers are beside it."""
    kept = whole.model.size - len(candidate.unknowns)
    columns = None if _replaced(candidate) else [column[:kept] for column in whole.columns]
    return _plain(problem, runs, whole, whole.model.without_effect(-1), columns, memory)


def _plain(
    problem: Problem, runs: Sequence[int], near: Fit, model: Model, columns: list[NDArray[np.float32]] | None, memory: Array
) -> Fit:
    """One descent of a model, with the columns of a fit near it where they are known."""
    return fit(problem, runs, model, memory=memory, scatter=near.noise.scatter, columns=columns, steps=1)


def _cheapest(problem: Problem, fits: Sequence[Fit], memory: Array) -> Fit:
    """The fit with the lowest cost under one memory: each under its own would compare nothing."""
    return min(fits, key=lambda whole: total_cost(problem, whole.model, whole.residuals, memory))


def _probed(candidate: Candidate, start: Start) -> tuple[float, ...]:
    """Values of a candidate's unknowns in a start's own probes, within the plausible range."""
    return candidate.kept(start.values(np.ones(len(start.directions))))


def _afresh(problem: Problem, runs: Sequence[int], hypothesis: Hypothesis, near: Fit, tell: Tell) -> list[Fit]:
    """The fit once more from the model as given, if known numbers are strained by what they took on in the effect's place."""
    if not on_bounds(problem, near.model).any():
        return []
    tell("a known number at its bound: once more from the model as given")
    candidate = hypothesis.candidate
    given = untouched(problem, hypothesis.model.without_effect(-1))
    start = given.with_effect(candidate, _probed(candidate, candidate.starts[0]))
    return [fit(problem, runs, start, scatter=near.noise.scatter, steps=problem.steps, tell=tell)]


def carries_over(problem: Problem, runs: Sequence[int], bare: Fit, whole: Fit, gain: float, memory: Array) -> bool:
    """Whether each run gets better by what the other runs tell of the effect, all together by a share of the gain."""
    if len(runs) < LEAST_RUNS:
        return True
    found = [
        problem.residuals([without.setting, with_it.setting], [run])[0]
        for run, without, with_it in zip(runs, told_by_others(problem, bare), told_by_others(problem, whole), strict=True)
    ]
    before, after = (minus_two_log_likelihood([r[k] for r in found], memory) for k in (0, 1))
    return before - after > LEAST_CARRIED * gain


def told_by_others(problem: Problem, found: Fit) -> list[Model]:
    """The model as it would be without each run in turn, to first order."""
    parts = [normal_equations([c], [r], found.noise) for c, r in zip(found.columns, found.residuals, strict=True)]
    matrix, vector = np.sum([m for m, _ in parts], axis=0), np.sum([v for _, v in parts], axis=0)
    settled = constrained_step(problem, found.model, matrix, vector)
    steps = [constrained_step(problem, found.model, matrix - own, vector - pull) for own, pull in parts]
    return [moved(problem, found.model, step - settled) for step in steps]


def _merged(finals: Sequence[Final], hypotheses: Sequence[Hypothesis]) -> list[Hypothesis]:
    """All hypotheses, those fitted in full in their final form."""
    final = {f.hypothesis.candidate.label: f.hypothesis for f in finals}
    merged = [final.get(h.candidate.label, h) for h in hypotheses]
    return sorted(merged, key=lambda hypothesis: -hypothesis.gain)


def _accepted(
    problem: Problem, runs: Sequence[int], current: Fit, finals: Sequence[Final], bare: Fit, tell: Tell
) -> tuple[Final | None, list[Final]]:
    """The best that buys enough at a plausible value, also once it has settled, and the finalists as far as they have settled.

    A formula is taken only where no named effect buys nearly as much.
    """
    good = [final for final in finals if _is_good(current, final)]
    named = [final for final in good if not final.hypothesis.candidate.formula]
    if named and named[0].hypothesis.gain >= NAMED_FIRST * good[0].hypothesis.gain:
        good = [named[0], *(final for final in good if final is not named[0])]
    seen = list(finals)
    for final in good:
        settled, bare = (final, bare) if problem.thorough else settle(problem, runs, final, bare, tell)
        seen = [settled if other is final else other for other in seen]
        if _is_good(current, settled):
            return settled, seen
    return None, seen


def _is_good(current: Fit, final: Final) -> bool:
    least = least_gain(len(final.hypothesis.values), current.cost)
    return final.hypothesis.gain >= least and final.hypothesis.plausible


def settle(problem: Problem, runs: Sequence[int], final: Final, bare: Fit, tell: Tell) -> tuple[Final, Fit]:
    """The hypothesis fitted on until another step gains nothing, and once more with the known numbers as the file says; and the
    best model without it.

    Beside a strong effect the cost has several minima: known numbers that calibration had moved in the effect's place stay
    where they are and leave it too small; and the edge of a patch that one run alone has crossed is not seen from afar.
    """
    tell(f"settling {final.hypothesis.candidate.label}, also from the model as given")
    found = final.fit
    starts = (looked_around(problem, runs, found), untouched(problem, found.model))
    more = [fit(problem, runs, start, scatter=found.noise.scatter, steps=SETTLING, tell=tell) for start in starts]
    best = _cheapest(problem, (found, *more), found.noise.memory)
    memory = best.noise.memory
    bare = _cheapest(problem, [bare, _left(problem, runs, best, final.hypothesis.candidate, memory)], memory)
    return _judged(problem, runs, final.hypothesis, best, bare, memory), bare


def looked_around(problem: Problem, runs: Sequence[int], found: Fit) -> Model:
    """The model with the last effect where it explains most: steps apart in each unknown that does not say how large it is."""
    candidate, values = found.model.effects[-1]
    steps = [np.array(LOOKS) * u.step if not u.is_size else np.zeros(1) for u in candidate.unknowns]
    places = {candidate.kept((np.array(values) + moves).tolist()) for moves in itertools.product(*steps)}
    without = found.model.without_effect(-1)
    models = [found.model, *(without.with_effect(candidate, place) for place in sorted(places - {tuple(values)}))]
    if len(models) == 1:
        return found.model
    residuals = problem.residuals([model.setting for model in models], runs)
    costs = [total_cost(problem, model, [r[k] for r in residuals], found.noise.memory) for k, model in enumerate(models)]
    return models[int(np.argmin(costs))]


def _by_run(before: Sequence[Array], after: Sequence[Array], noise: Noise) -> Array:
    """Fall of the weighted squares in each run."""
    return np.array([np.nansum((b * b - a * a) * noise.weight) for b, a in zip(before, after, strict=True)])


@dataclass(frozen=True, eq=False)
class _Trial:
    """One start of a hypothesis' refit, and how far it got.

    Attributes:
        of: which hypothesis; -1 = none, the model without an effect more.
        known: columns of the numbers that all hypotheses share, where the trial started; what its effect replaces does nothing.
        whole: the same, with those that its effect replaces.
        model, residuals: the best so far.
        corrections: of ``known``, one per step taken (Broyden): a direction (numbers) of these numbers, and by what residuals
            change more along it, one (rows, channels) per run.
        settled: whether another step gains nothing.
    """

    of: int
    known: Sequence[NDArray[np.float32]] = field(repr=False)
    whole: Sequence[NDArray[np.float32]] = field(repr=False)
    model: Model
    residuals: list[Array] = field(default_factory=list, repr=False)
    corrections: tuple[tuple[Array, list[Array]], ...] = field(default=(), repr=False)
    settled: bool = False


def refit(
    problem: Problem,
    runs: Sequence[int],
    current: Fit,
    scores: Sequence[Score],
    given: Sequence[NDArray[np.float32]],
    rounds: int = ROUNDS,
) -> list[Hypothesis]:
    """Refit every hypothesis together with all known numbers; best first.

    Each starts twice: from the calibrated model with its first guess, and from the model as given with its probe, as
    calibration may have taken on what the effect does, and not let go of it. The responses of the known numbers are those of
    the two starts; those of each hypothesis' own unknowns are simulated anew. The model without an effect more is refitted too,
    in the end also from where the best hypotheses are.
    """
    if not scores:
        return []
    trials = _simulated(problem, _starts(problem, current, scores, given), runs)
    trials = _descended(problem, runs, current, trials, rounds)
    for plain in _simulated(problem, _without_effect(problem, current, trials), runs):
        trials += _descended(problem, runs, current, [plain], rounds)
    memory = _best_memory(problem, current, trials)
    costs = [total_cost(problem, t.model, t.residuals, memory) for t in trials]
    best = [
        trials[min((k for k, t in enumerate(trials) if t.of == of), key=lambda k: costs[k])] for of in (*range(len(scores)), -1)
    ]
    return _ranked(problem, scores, [t.model for t in best], [t.residuals for t in best], memory)


def _descended(problem: Problem, runs: Sequence[int], current: Fit, trials: list[_Trial], rounds: int) -> list[_Trial]:
    """The trials after so many steps; those that are far behind are dropped or no longer improved."""
    for done in range(rounds):
        memory = _best_memory(problem, current, trials)
        if done >= PATIENCE:
            trials = _given_up(problem, trials, memory)
        noise = estimate_noise(min((t.residuals for t in trials), key=lambda r: minus_two_log_likelihood(r, memory)), memory)
        going = [trial for trial in trials if not trial.settled]
        if not going:
            break
        moved_on = _improved(problem, runs, current, going, noise)
        trials = _hopeful(problem, [*(trial for trial in trials if trial.settled), *moved_on], memory)
    return trials


def _without_effect(problem: Problem, current: Fit, trials: Sequence[_Trial]) -> list[_Trial]:
    """The model without an effect more, where the best hypotheses have moved the known numbers.

    The cost is rough: what lets go of a minimum may be any nudge, and then it is no evidence for the effect that gave it.
    """
    memory = _best_memory(problem, current, trials)
    best: dict[int, _Trial] = {}
    for trial in sorted(trials, key=lambda t: total_cost(problem, t.model, t.residuals, memory)):
        if trial.of >= 0:
            best.setdefault(trial.of, trial)
    free = [replace(t, of=-1, model=t.model.without_effect(-1), settled=False) for t in list(best.values())[:NUDGES]]
    return [t if t.known is t.whole else replace(t, known=t.whole, corrections=()) for t in free]


def _improved(problem: Problem, runs: Sequence[int], current: Fit, trials: Sequence[_Trial], noise: Noise) -> list[_Trial]:
    """The trials one Gauss-Newton step on."""
    bases = {id(trial.known): trial.known for trial in trials}
    matrices = {key: normal_equations(known, current.residuals, noise)[0] for key, known in bases.items()}
    tries, owns = [], _own_columns(problem, trials, runs)
    for trial, own in zip(trials, owns, strict=True):
        equations = _equations(matrices[id(trial.known)], trial, own, noise)
        change = constrained_step(problem, trial.model, *equations)
        tries += [replace(trial, model=moved(problem, trial.model, share * change)) for share in TRIED]
    tries = _simulated(problem, tries, runs)
    costs = [total_cost(problem, t.model, t.residuals, noise.memory) for t in tries]
    improved = []
    for k, (trial, own) in enumerate(zip(trials, owns, strict=True)):
        best = min(range(len(TRIED) * k, len(TRIED) * (k + 1)), key=lambda i: costs[i])
        gained = total_cost(problem, trial.model, trial.residuals, noise.memory) - costs[best]
        better = _corrected(problem, trial, own, tries[best]) if gained > 0.0 else trial
        improved.append(replace(better, settled=gained < SETTLED))
    return improved


def _equations(matrix: Array, trial: _Trial, own: Sequence[Array], noise: Noise) -> tuple[Array, Array]:
    """Normal equations of a trial's numbers: the known ones' matrix is given, its corrections are so many columns more."""
    size, more = len(matrix), len(trial.corrections)
    runs = range(len(trial.residuals))
    columns = [np.concatenate([own[r], *(missed[r][None] for _, missed in trial.corrections)]) for r in runs]
    wide, push = _bordered(matrix, trial.known, columns, trial.residuals, noise)
    mix = np.eye(len(wide) - more, len(wide))
    for k, (direction, _) in enumerate(trial.corrections):
        mix[:size, len(wide) - more + k] = direction
    return mix @ wide @ mix.T, mix @ push


def _corrected(problem: Problem, before: _Trial, own: Sequence[Array], after: _Trial) -> _Trial:
    """The trial after a step, its known columns corrected by what the step did beyond what they and its own had promised."""
    taken = scaled_numbers(problem, after.model) - scaled_numbers(problem, before.model)
    size = len(before.known[0])
    known, rest = taken[:size], taken[size:]
    length = float(known @ known)
    if length < 1e-9:
        return after
    shares = [known @ direction for direction, _ in before.corrections]
    missed = []
    for r, (old, new) in enumerate(zip(before.residuals, after.residuals, strict=True)):
        promised = (known.astype(np.float32) @ before.known[r]).reshape(old.shape) + np.tensordot(rest, own[r], 1)
        for share, (_, beyond) in zip(shares, before.corrections, strict=True):
            promised += share * beyond[r]
        missed.append((np.nan_to_num(new - old) - promised) / length)
    return replace(after, corrections=(*before.corrections, (known, missed)))


def _least_costs(problem: Problem, trials: Sequence[_Trial], memory: Array) -> tuple[list[float], dict[int, float]]:
    """Costs of the trials, and of the best trial of each hypothesis."""
    costs = [total_cost(problem, t.model, t.residuals, memory) for t in trials]
    return costs, {of: min(c for c, t in zip(costs, trials, strict=True) if t.of == of) for of in {t.of for t in trials}}


def _hopeful(problem: Problem, trials: Sequence[_Trial], memory: Array) -> list[_Trial]:
    """Of two starts of a hypothesis the better one, if the other is far behind."""
    costs, least = _least_costs(problem, trials, memory)
    room = max(max(least.values()) - min(least.values()), LEAST_GAIN)
    return [t for c, t in zip(costs, trials, strict=True) if c - least[t.of] < BEHIND * room]


def _given_up(problem: Problem, trials: Sequence[_Trial], memory: Array) -> list[_Trial]:
    """The trials; those of hypotheses that are far behind the best are settled."""
    _, least = _least_costs(problem, trials, memory)
    enough = HOPELESS * (least[-1] - min(least.values()))
    return [replace(t, settled=t.settled or (t.of >= 0 and least[-1] - least[t.of] < enough)) for t in trials]


def _starts(problem: Problem, current: Fit, scores: Sequence[Score], given: Sequence[NDArray[np.float32]]) -> list[_Trial]:
    """Where refits begin. The model as given keeps the effects found before."""
    count = len(problem.quantities)
    given = [np.vstack([column, now[count:]]) for column, now in zip(given, current.columns, strict=True)]
    as_given = untouched(problem, current.model)
    trials = [_Trial(-1, current.columns, current.columns, current.model)]
    for k, score in enumerate(scores):
        candidate = score.candidate
        near, anew = (_without_replaced(problem, candidate, known) for known in (current.columns, given))
        trials.append(_Trial(k, near, current.columns, current.model.with_effect(candidate, score.values)))
        probed = as_given.with_effect(candidate, _probed(candidate, candidate.starts[0]))
        trials.append(_Trial(k, anew, given, probed))
    return trials


def _without_replaced(
    problem: Problem, candidate: Candidate, known: Sequence[NDArray[np.float32]]
) -> Sequence[NDArray[np.float32]]:
    """Columns of the known numbers; those whose place a candidate takes do nothing beside it."""
    replaced = _replaced(candidate)
    if not replaced:
        return known
    rows = [k for k, quantity in enumerate(problem.quantities) if quantity.name in replaced]
    silent = [column.copy() for column in known]
    for column in silent:
        column[rows] = 0.0
    return silent


def _replaced(candidate: Candidate) -> set[str]:
    """Names of the known numbers whose place a candidate takes."""
    return {name for met in candidate.tolerances if met is not None and met.replaces for name in met.quantities}


def _simulated(problem: Problem, trials: Sequence[_Trial], runs: Sequence[int]) -> list[_Trial]:
    """The trials with the residuals of their models."""
    found = problem.residuals([trial.model.setting for trial in trials], runs)
    return [replace(trial, residuals=[r[k] for r in found]) for k, trial in enumerate(trials)]


def refit_thoroughly(problem: Problem, runs: Sequence[int], current: Fit, scores: Sequence[Score]) -> list[Hypothesis]:
    """Fit every hypothesis in full, from its first guess and from its probes; best first."""
    memory, scatter = current.noise.memory, current.noise.scatter
    fits = [
        min(
            (
                fit(
                    problem,
                    runs,
                    current.model.with_effect(score.candidate, values),
                    memory=memory,
                    scatter=scatter,
                    steps=problem.steps,
                )
                for values in _starting_values(score)
            ),
            key=lambda found: found.cost,
        )
        for score in scores
    ]
    fits.append(fit(problem, runs, current.model, memory=memory, scatter=scatter, steps=problem.steps))
    trials = [_Trial(k, found.columns, found.columns, found.model, found.residuals) for k, found in enumerate(fits)]
    memory = _best_memory(problem, current, trials)
    return _ranked(problem, scores, [t.model for t in trials], [t.residuals for t in trials], memory)


def _starting_values(score: Score) -> list[tuple[float, ...]]:
    """The first guess, and the first two probes."""
    candidate = score.candidate
    return list(dict.fromkeys((score.values, *(_probed(candidate, start) for start in candidate.starts[:2]))))


def _bordered(
    matrix: Array, known: Sequence[NDArray[np.float32]], own: Sequence[Array], residuals: Sequence[Array], noise: Noise
) -> tuple[Array, Array]:
    """Normal equations of the known numbers, whose matrix is given, and a candidate's own unknowns."""
    both = [np.concatenate([columns, residual[None]]) for columns, residual in zip(own, residuals, strict=True)]
    across = cross_products(known, both, noise)
    root = np.sqrt(noise.weight)
    flat = [np.nan_to_num(part * root).reshape(len(part), -1) for part in both]
    inner = np.sum([part @ part.T for part in flat], axis=0)
    whole = np.block([[matrix, across[:, :-1]], [across[:, :-1].T, inner[:-1, :-1]]])
    return whole, np.concatenate([across[:, -1], inner[:-1, -1]])


def _ranked(
    problem: Problem, scores: Sequence[Score], models: Sequence[Model], residuals: Sequence[list[Array]], memory: Array
) -> list[Hypothesis]:
    """Hypotheses from refitted models, the last of which has no effect more; best first."""
    base = total_cost(problem, models[-1], residuals[-1], memory)
    found = []
    for score, model, residual in zip(scores, models[:-1], residuals[:-1], strict=True):
        by_run = _by_run(residuals[-1], residual, estimate_noise(residual, memory))
        gain = base - total_cost(problem, model, residual, memory)
        hypothesis = Hypothesis(score.candidate, model, gain, by_run, score.gain, residual, models[-1], residuals[-1])
        found.append(replace(hypothesis, tolerable=within_tolerance(problem, model)))
    return sorted(found, key=lambda hypothesis: -hypothesis.gain)


def _best_memory(problem: Problem, current: Fit, trials: Sequence[_Trial]) -> Array:
    """Memory of the residuals of the best model so far: the same for all that are compared."""
    memory = current.noise.memory
    best = min(trials, key=lambda t: total_cost(problem, t.model, t.residuals, memory))
    if total_cost(problem, best.model, best.residuals, memory) >= current.cost:
        return memory
    return estimate_noise(best.residuals, scatter=current.noise.scatter).memory


def _own_columns(problem: Problem, trials: Sequence[_Trial], runs: Sequence[int]) -> list[list[Array]]:
    """Responses of each trial's last effect's unknowns, scaled by their steps: per trial, per run, (unknowns, rows, channels).

    Only those of the last effect are simulated anew: the others' are among the known columns.
    """
    settings: list[Setting] = []
    taken: list[list[float]] = []
    for trial in trials:
        taken.append([])
        if trial.of < 0:
            continue
        candidate, values = trial.model.effects[-1]
        for k, unknown in enumerate(candidate.unknowns):
            step = unknown.step if values[k] + unknown.step <= unknown.high else -unknown.step
            changed = tuple(v + step * (i == k) for i, v in enumerate(values))
            settings.append(replace(trial.model, effects=(*trial.model.effects[:-1], (candidate, changed))).setting)
            taken[-1].append(step / unknown.step)
    if not settings:
        return [[np.zeros((0, *residual.shape)) for residual in trial.residuals] for trial in trials]
    found = problem.residuals(settings, runs)
    columns, at = [], 0
    for trial, steps in zip(trials, taken, strict=True):
        mine = [r[at : at + len(steps)] for r in found]
        scale = np.array(steps)[:, None, None]
        columns.append([np.nan_to_num((r - base) / scale) for r, base in zip(mine, trial.residuals, strict=True)])
        at += len(steps)
    return columns
