"""Judge the best hypotheses: fitted in full, against one model without them, by every run in turn, and once they have settled.

Nothing here sees the sealed runs.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from wlr_gym.gap.estimation.fit import Fit, cheapest, equations_by_run, fit
from wlr_gym.gap.estimation.least_squares import constrained_step
from wlr_gym.gap.estimation.likelihood import estimate_noise, minus_two_log_likelihood
from wlr_gym.gap.estimation.model import FittedModel, moved, on_bounds, scaled_numbers, total_cost, untouched
from wlr_gym.gap.problem import Candidate, Problem
from wlr_gym.gap.selection.hypothesis import Hypothesis, fall_by_run, within_tolerance
from wlr_gym.gap.selection.screening import LEAST_GAIN, least_gain

Array = NDArray[np.float64]
Tell = Callable[[str], None]

#: The best of every name that buys at least this share of what the best buys is fitted in full before one is taken; so many.
FINALIST, FINALISTS = 0.75, 3
#: Beside a set of places its best single place is fitted in full, if it buys at least this share.
NARROWER = 0.4
#: So many hypotheses that promised more than the best did, and got stuck on the way there, are fitted in full too.
STUCK = 1
#: Left out one after the other, the runs must gain together at least this share of what they gain when they are fitted; asked
#: where so many are.
LEAST_CARRIED, LEAST_RUNS = 0.3, 3
#: Of so many runs, the one that loses most has no say: play and sticking make the cost rough, and a run may be thrown off.
FORGIVING = 5
#: Steps, at most, in which a model with an effect that is taken settles.
SETTLING = 8
#: Steps by which a settling effect looks for a better place, in every unknown that says where it is or over what it fades.
LOOKS = (-8.0, -4.0, 0.0, 4.0, 8.0)
#: A named effect is preferred to a formula if it buys at least this share of what the formula buys.
NAMED_FIRST = 0.9


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
        scatter = current.noise.scatter
        near = fit(problem, runs, hypothesis.model, scatter=scatter, near=current, steps=problem.steps, tell=tell)
        both = (near, *_afresh(problem, runs, hypothesis, near, tell))
        wholes.append(cheapest(problem, both, current.noise.memory))
    if not wholes:
        return [], bare
    memory = cheapest(problem, wholes, current.noise.memory).noise.memory
    if bare.columns is current.columns and _far_apart(problem, bare.model, current.model):  # they are of another minimum
        bare = _plain(problem, runs, bare, bare.model, None, memory)
    if not problem.thorough:
        pairs = zip(wholes, chosen, strict=True)
        bare = cheapest(problem, [bare, *(_left(problem, runs, whole, h.candidate, memory) for whole, h in pairs)], memory)
    found = [_judged(problem, runs, h, whole, bare, memory) for h, whole in zip(chosen, wholes, strict=True)]
    return sorted(found, key=lambda final: -final.hypothesis.gain), bare


def _far_apart(problem: Problem, one: FittedModel, other: FittedModel) -> bool:
    """Whether a number of two models differs by more than a tolerance, or an unknown by more than a step."""
    return bool(np.abs(scaled_numbers(problem, one) - scaled_numbers(problem, other)).max(initial=0.0) > 1.0)


def _worth_a_fit(hypotheses: Sequence[Hypothesis]) -> list[Hypothesis]:
    """The best of every name that buys nearly as much as the best does, the best's narrower self, and what promised more."""
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
    promised = max([LEAST_GAIN, *(leading.screened for leading in effects[:1])])
    stuck = [h for h in hypotheses if h.screened > max(h.gain, promised) and h not in best.values()]
    return [*best.values(), *sorted(stuck, key=lambda h: -h.screened)[:STUCK]]


def _judged(problem: Problem, runs: Sequence[int], hypothesis: Hypothesis, whole: Fit, bare: Fit, memory: Array) -> Final:
    """A hypothesis as its whole fit shows it: gain, agreement of the runs, what the tolerances allow.

    What the whole fit found in the known numbers is no evidence for the effect: ``bare`` is without it.
    """
    fitted = replace(
        hypothesis,
        model=whole.model,
        residuals=whole.residuals,
        carries_over=carries_over(problem, runs, bare, whole, memory),
        tolerable=within_tolerance(problem, whole.model),
    )
    return Final(beside(problem, fitted, bare, memory), whole)


def beside(problem: Problem, hypothesis: Hypothesis, bare: Fit, memory: Array) -> Hypothesis:
    """The hypothesis with what it buys over the model without any, in all and by run, under this memory."""
    cost = total_cost(problem, bare.model, bare.residuals, memory)
    gain = cost - total_cost(problem, hypothesis.model, hypothesis.residuals, memory)
    by_run = fall_by_run(bare.residuals, hypothesis.residuals, estimate_noise(hypothesis.residuals, memory))
    return replace(hypothesis, gain=gain, by_run=by_run, base=bare.model, base_residuals=bare.residuals)


def _left(problem: Problem, runs: Sequence[int], whole: Fit, candidate: Candidate, memory: Array) -> Fit:
    """The model without the last effect, from where the known numbers are beside it."""
    kept = whole.model.size - len(candidate.unknowns)
    columns = None if candidate.replaced else [column[:kept] for column in whole.columns]
    return _plain(problem, runs, whole, whole.model.without_effect(-1), columns, memory)


def _plain(
    problem: Problem,
    runs: Sequence[int],
    near: Fit,
    model: FittedModel,
    columns: list[NDArray[np.float32]] | None,
    memory: Array,
) -> Fit:
    """One descent of a model, with the columns of a fit near it where they are known."""
    return fit(problem, runs, model, memory=memory, scatter=near.noise.scatter, columns=columns, steps=1)


def _afresh(problem: Problem, runs: Sequence[int], hypothesis: Hypothesis, near: Fit, tell: Tell) -> list[Fit]:
    """The fit once more from the model as given, if known numbers are strained by what they took on in the effect's place."""
    if not on_bounds(problem, near.model).any():
        return []
    tell("a known number at its bound: once more from the model as given")
    candidate = hypothesis.candidate
    given = untouched(problem, hypothesis.model.without_effect(-1))
    start = given.with_effect(candidate, candidate.probed(candidate.starts[0]))
    return [fit(problem, runs, start, scatter=near.noise.scatter, near=near, steps=problem.steps, tell=tell)]


def carries_over(problem: Problem, runs: Sequence[int], bare: Fit, whole: Fit, memory: Array) -> bool:
    """Whether the runs, each with what the others tell of the effect, get better, by a share of what all fitted do.

    Of the likelihood alone: what an effect spares the tolerances is its own evidence, and no run's. Two runs are not asked; of
    :data:`FORGIVING` and more one may say no.
    """
    if len(runs) < LEAST_RUNS:
        return True
    fitted = minus_two_log_likelihood(bare.residuals, memory) - minus_two_log_likelihood(whole.residuals, memory)
    pairs = zip(runs, told_by_others(problem, bare), told_by_others(problem, whole), strict=True)
    found = [problem.residuals([without.setting, with_it.setting], [run])[0] for run, without, with_it in pairs]
    kept = [found[:k] + found[k + 1 :] for k in range(len(found))] if len(runs) >= FORGIVING else [found]
    return max(_carried(some, memory) for some in kept) > max(LEAST_CARRIED * fitted, 0.0)


def _carried(found: Sequence[Array], memory: Array) -> float:
    """Fall of the likelihood from the first to the second of two residuals per run."""
    before, after = (minus_two_log_likelihood([r[k] for r in found], memory) for k in (0, 1))
    return before - after


def told_by_others(problem: Problem, found: Fit) -> list[FittedModel]:
    """The model as it would be without each run in turn, to first order."""
    matrices, vectors = equations_by_run(found)
    matrix, vector = matrices.sum(axis=0), vectors.sum(axis=0)
    settled = constrained_step(problem, found.model, matrix, vector)
    steps = [
        constrained_step(problem, found.model, matrix - own, vector - pull) for own, pull in zip(matrices, vectors, strict=True)
    ]
    return [moved(problem, found.model, step - settled) for step in steps]


def accept(
    problem: Problem, runs: Sequence[int], current: Fit, finals: Sequence[Final], bare: Fit, tell: Tell
) -> tuple[Final | None, list[Final], Fit]:
    """The best that buys enough at a plausible value, also once it has settled; the finalists as far as they have settled; the
    best model without any of them.

    A formula is taken only where no named effect buys nearly as much.
    """
    good = [final for final in finals if _is_good(current.cost, final.hypothesis)]
    named = [final for final in good if not final.hypothesis.candidate.formula]
    if named and named[0].hypothesis.gain >= NAMED_FIRST * good[0].hypothesis.gain:
        good = [named[0], *(final for final in good if final is not named[0])]
    seen = list(finals)
    for final in good:
        settled, bare = (final, bare) if problem.thorough else settle(problem, runs, final, bare, tell)
        seen = [settled if other is final else other for other in seen]
        if _is_good(current.cost, settled.hypothesis):
            return settled, seen, bare
    return None, seen, bare


def shown_by_some_runs_only(hypothesis: Hypothesis, cost: float) -> bool:
    """Whether nothing speaks against a hypothesis but that the other runs do not bear it out; ``cost``: of the model so far."""
    return not hypothesis.carries_over and _is_good(cost, replace(hypothesis, carries_over=True))


def _is_good(cost: float, hypothesis: Hypothesis) -> bool:
    return hypothesis.gain >= least_gain(len(hypothesis.values), cost) and hypothesis.plausible


def settle(problem: Problem, runs: Sequence[int], final: Final, bare: Fit, tell: Tell) -> tuple[Final, Fit]:
    """The hypothesis fitted on until another step gains nothing, and once more with the known numbers as the file says; and the
    best model without it.

    Beside a strong effect the cost has several minima: known numbers that calibration had moved in the effect's place stay
    where they are and leave it too small; and the edge of a patch that one run alone has crossed is not seen from afar.
    """
    tell(f"settling {final.hypothesis.candidate.label}, also from the model as given")
    found = final.fit
    scatter = found.noise.scatter
    more = [
        fit(problem, runs, start, scatter=scatter, near=found, steps=SETTLING, tell=tell)
        for start in (looked_around(problem, runs, found), untouched(problem, found.model))
        if start is not found.model or not found.converged  # else it is where it would end
    ]
    best = cheapest(problem, (found, *more), found.noise.memory)
    memory = best.noise.memory
    bare = cheapest(problem, [bare, _left(problem, runs, best, final.hypothesis.candidate, memory)], memory)
    return _judged(problem, runs, final.hypothesis, best, bare, memory), bare


def looked_around(problem: Problem, runs: Sequence[int], found: Fit) -> FittedModel:
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
