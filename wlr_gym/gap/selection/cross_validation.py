"""Compare the best hypotheses: fitted in full, against one model without them, by leaving out runs, and once converged.

Nothing here uses the held-out runs.
"""

from __future__ import annotations

import copy
import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from wlr_gym.base.jobs import in_threads
from wlr_gym.gap.estimation.fit import Fit, cheapest, constrained_step, equations_by_run, fit
from wlr_gym.gap.estimation.model import (
    FittedModel,
    estimate_noise,
    minus_two_log_likelihood,
    moved,
    on_bounds,
    scaled_numbers,
    total_cost,
    untouched,
)
from wlr_gym.gap.problem import Candidate, Problem
from wlr_gym.gap.selection.hypothesis import Hypothesis, fall_by_run, within_tolerance
from wlr_gym.gap.selection.screening import LEAST_GAIN, asked_of, least_gain

Array = NDArray[np.float64]
Tell = Callable[[str], None]

#: The best of every name that improves the fit by at least this share of what the best does is fitted in full.
FINALIST_SHARE = 0.75
#: So many at most.
MOST_FINALISTS = 3
#: Beside a set of places its best single place is fitted in full, if it improves the fit by at least this share.
NARROWER = 0.4
#: So many hypotheses of a larger predicted improvement than the best, which their refits fell short of, are fitted in full too.
STUCK = 1
#: Where none of these explains what is left, so many other names at most are fitted in full.
MOST_LEFT = 6
#: Left out one after the other, the runs must gain together at least this share of what they gain when they are fitted.
LEAST_VALIDATED = 0.3
#: Runs that this test needs.
LEAST_RUNS = 3
#: Of so many runs, the one that loses most is ignored: play and sticking make the cost rough, and a run may be thrown off.
FORGIVING = 5
#: Steps, at most, in which a model with a selected effect converges.
CONVERGENCE_STEPS = 8
#: Grid on which a better place is searched, in steps of every unknown that says where an effect is or over what it fades.
GRID = (-8.0, -4.0, 0.0, 4.0, 8.0)
#: An improvement beyond this is not due to how tolerances are counted.
TOLERANCES_CANNOT = 80.0
#: What tolerances do instead must fall short by this many times what is asked of an effect, unless it adds to one number only:
#: sticking friction makes the cost of either model rough by some ten units, the more so the more numbers move.
CLEARLY = 1.5
#: A named effect is preferred to a formula if it improves the fit by at least this share of what the formula does.
NAMED_FIRST = 0.9


@dataclass(frozen=True, eq=False)
class Finalist:
    """A hypothesis fitted in full."""

    hypothesis: Hypothesis
    fit: Fit


def fit_finalists(
    problem: Problem,
    runs: Sequence[int],
    current: Fit,
    chosen: Sequence[Hypothesis],
    bare: Fit,
    tell: Tell = lambda text: None,
) -> tuple[list[Finalist], Fit]:
    """Fit hypotheses in full, with responses simulated anew, and compare all with one model without them.

    Args:
        problem, runs: what is fitted.
        current: the model so far.
        chosen: refitted.
        bare: the best model without a further effect so far.
        tell: called with progress.

    Returns:
        The finalists, best first; the best model without a further effect, which may be one that a finalist has led to.
    """
    wholes: list[Fit] = []
    for hypothesis in chosen:
        tell(f"fitting {hypothesis.candidate.label} in full")
        scatter = current.noise.scatter
        near = fit(problem, runs, hypothesis.model, scatter=scatter, near=current, steps=problem.steps, tell=tell)
        both = (near, *_afresh(problem, runs, hypothesis, near, tell))
        wholes.append(cheapest(problem, both, current.noise.autocorrelation_time))
    if not wholes:
        return [], bare
    # the best of them is that which improves the fit most under the noise that it leaves itself
    best = max(
        wholes, key=lambda one: total_cost(problem, bare.model, bare.residuals, one.noise.autocorrelation_time) - one.cost
    )
    autocorrelation_time = best.noise.autocorrelation_time
    apart = np.abs(scaled_numbers(problem, bare.model) - scaled_numbers(problem, current.model)).max(initial=0.0)
    if bare.columns is current.columns and apart > 1.0:  # a tolerance or a step: they are of another minimum
        bare = _plain(problem, runs, bare, bare.model, None, autocorrelation_time)
    if not problem.thorough:
        pairs = zip(wholes, chosen, strict=True)
        bare = cheapest(
            problem,
            [bare, *(_left(problem, runs, whole, h.candidate, autocorrelation_time) for whole, h in pairs)],
            autocorrelation_time,
        )
    found = [_evaluated(problem, runs, h, whole, bare, autocorrelation_time) for h, whole in zip(chosen, wholes, strict=True)]
    return sorted(found, key=lambda final: -final.hypothesis.gain), bare


def worth_a_fit(hypotheses: Sequence[Hypothesis]) -> list[Hypothesis]:
    """Return the best of every name that improves the fit nearly as much as the first, its best place, and what predicted more.

    ``hypotheses``: best first.
    """
    best: dict[str, Hypothesis] = {}
    effects = [hypothesis for hypothesis in hypotheses if not hypothesis.tolerable]
    for hypothesis in effects:
        leading = effects[0]
        enough = hypothesis.gain >= max(FINALIST_SHARE * leading.gain, 0.5 * LEAST_GAIN)
        if enough and len(best) < MOST_FINALISTS:
            best.setdefault(hypothesis.candidate.law, hypothesis)
        narrower = len(leading.candidate.where) > 1 and len(hypothesis.candidate.where) == 1
        if narrower and hypothesis.candidate.name == leading.candidate.name and hypothesis.gain > NARROWER * leading.gain:
            best.setdefault("narrower", hypothesis)
    predicted = max([LEAST_GAIN, *(leading.predicted_gain for leading in effects[:1])])
    stuck = [h for h in hypotheses if h.predicted_gain > max(h.gain, predicted) and h not in best.values()]
    return [*best.values(), *sorted(stuck, key=lambda h: -h.predicted_gain)[:STUCK]]


def left_to_fit(hypotheses: Sequence[Hypothesis], finals: Sequence[Finalist]) -> list[Hypothesis]:
    """Return the most promising of every name that has not been fitted in full, :data:`MOST_LEFT` at most."""
    had = {final.hypothesis.candidate.law for final in finals}
    best: dict[str, Hypothesis] = {}
    for hypothesis in sorted(hypotheses, key=lambda h: -max(h.gain, h.predicted_gain)):
        if hypothesis.candidate.law not in had:
            best.setdefault(hypothesis.candidate.law, hypothesis)
    return list(best.values())[:MOST_LEFT]


def _evaluated(
    problem: Problem, runs: Sequence[int], hypothesis: Hypothesis, whole: Fit, bare: Fit, autocorrelation_time: Array
) -> Finalist:
    """A hypothesis after its full fit: gain, agreement of the runs, what the tolerances allow.

    An improvement by calibrated parameters alone is no evidence for the effect: ``bare`` is the best model without it.
    """
    fitted = replace(
        hypothesis,
        model=whole.model,
        residuals=whole.residuals,
        cross_validated=cross_validated(problem, runs, bare, whole, autocorrelation_time),
        tolerable=within_tolerance(problem, whole.model),
    )
    return Finalist(beside(problem, fitted, bare, autocorrelation_time), whole)


def beside(problem: Problem, hypothesis: Hypothesis, bare: Fit, autocorrelation_time: Array) -> Hypothesis:
    """The hypothesis with its improvement over the model without it, in all and by run, under this autocorrelation time."""
    cost = total_cost(problem, bare.model, bare.residuals, autocorrelation_time)
    gain = cost - total_cost(problem, hypothesis.model, hypothesis.residuals, autocorrelation_time)
    by_run = fall_by_run(bare.residuals, hypothesis.residuals, estimate_noise(hypothesis.residuals, autocorrelation_time))
    return replace(hypothesis, gain=gain, by_run=by_run, base=bare.model, base_residuals=bare.residuals)


def _left(problem: Problem, runs: Sequence[int], whole: Fit, candidate: Candidate, autocorrelation_time: Array) -> Fit:
    """The model without the last effect, from where the calibrated parameters are beside it."""
    kept = whole.model.size - len(candidate.unknowns)
    columns = None if candidate.replaced else [column[:kept] for column in whole.columns]
    return _plain(problem, runs, whole, whole.model.without_effect(-1), columns, autocorrelation_time)


def _plain(
    problem: Problem,
    runs: Sequence[int],
    near: Fit,
    model: FittedModel,
    columns: list[NDArray[np.float32]] | None,
    autocorrelation_time: Array,
) -> Fit:
    """One descent of a model, with the columns of a fit near it where they are known."""
    return fit(
        problem, runs, model, autocorrelation_time=autocorrelation_time, scatter=near.noise.scatter, columns=columns, steps=1
    )


def _afresh(problem: Problem, runs: Sequence[int], hypothesis: Hypothesis, near: Fit, tell: Tell) -> list[Fit]:
    """The fit once more from the model as given, if calibrated parameters are at their bounds."""
    if not on_bounds(problem, near.model).any():
        return []
    tell("a calibrated parameter at its bound: once more from the model as given")
    candidate = hypothesis.candidate
    given = untouched(problem, hypothesis.model.without_effect(-1))
    start = given.with_effect(candidate, candidate.probed(candidate.starts[0]))
    return [fit(problem, runs, start, scatter=near.noise.scatter, near=near, steps=problem.steps, tell=tell)]


def cross_validated(problem: Problem, runs: Sequence[int], bare: Fit, whole: Fit, autocorrelation_time: Array) -> bool:
    """Whether the effect passes leave-one-run-out cross-validation: runs improve by a share of what they do when fitted.

    Only the likelihood is compared, not the prior. Two runs are not tested; of :data:`FORGIVING` and more, one is ignored.
    Where each run alone improves by :data:`LEAST_GAIN`, the share does not matter: one run may have most of it.
    """
    if len(runs) < LEAST_RUNS:
        return True
    fitted = minus_two_log_likelihood(bare.residuals, autocorrelation_time) - minus_two_log_likelihood(
        whole.residuals, autocorrelation_time
    )
    pairs = zip(without_each_run(problem, bare), without_each_run(problem, whole), runs, strict=True)
    found = in_threads(problem.threads, lambda pair: problem.residuals([m.setting for m in pair[:2]], [pair[2]])[0], pairs)
    if min(improvement([one], autocorrelation_time) for one in found) > LEAST_GAIN:
        return True
    kept = [found[:k] + found[k + 1 :] for k in range(len(found))] if len(runs) >= FORGIVING else [found]
    return max(improvement(some, autocorrelation_time) for some in kept) > max(LEAST_VALIDATED * fitted, 0.0)


def improvement(found: Sequence[Array], autocorrelation_time: Array) -> float:
    """Fall of minus two log likelihood from the first to the second of two residuals per run."""
    before, after = (minus_two_log_likelihood([r[k] for r in found], autocorrelation_time) for k in (0, 1))
    return before - after


def without_each_run(problem: Problem, found: Fit) -> list[FittedModel]:
    """The model as it would be without each run in turn, to first order."""
    matrices, vectors = equations_by_run(found.columns, found.residuals, found.noise, problem.threads)
    matrix, vector = matrices.sum(axis=0), vectors.sum(axis=0)
    whole = constrained_step(problem, found.model, matrix, vector)
    steps = [
        constrained_step(problem, found.model, matrix - own, vector - pull) for own, pull in zip(matrices, vectors, strict=True)
    ]
    return [moved(problem, found.model, step - whole) for step in steps]


def accept(
    problem: Problem, runs: Sequence[int], threshold: float, finals: Sequence[Finalist], bare: Fit, tell: Tell
) -> tuple[Finalist | None, list[Finalist], Fit]:
    """The best that improves the fit enough at a plausible value, also once converged; the finalists as far as they have
    converged; the best model without any of them.

    A formula is selected only where no named effect improves the fit by nearly as much. Every further unknown must pay.
    """
    good = [final for final in finals if _is_good(threshold, final.hypothesis)]
    good.sort(key=lambda final: least_gain(len(final.hypothesis.candidate.unknowns)) - final.hypothesis.gain)
    named = [final for final in good if not final.hypothesis.candidate.formula]
    if named and named[0].hypothesis.gain >= NAMED_FIRST * good[0].hypothesis.gain:
        good = [named[0], *(final for final in good if final is not named[0])]
    seen = list(finals)
    for final in good:
        converged, bare = (final, bare) if problem.thorough else converge(problem, runs, final, bare, tell)
        if _is_good(threshold, converged.hypothesis) and _tolerances_do(problem, runs, threshold, converged, bare):
            converged = replace(converged, hypothesis=replace(converged.hypothesis, tolerable=True))
        seen = [converged if other is final else other for other in seen]
        if _is_good(threshold, converged.hypothesis):
            return converged, seen, bare
    return None, seen, bare


def _tolerances_do(problem: Problem, runs: Sequence[int], threshold: float, final: Finalist, bare: Fit) -> bool:
    """Whether tolerances that count once explain nearly as much: one number for all wheels costs less than four tolerances do,
    the more so where they are tempered."""
    if problem.tempering == 1.0 or final.hypothesis.gain > TOLERANCES_CANNOT:
        return False
    once = copy.copy(problem)
    once.tempering = 1.0
    noise = final.fit.noise
    costs = [
        fit(
            once,
            runs,
            found.model,
            autocorrelation_time=noise.autocorrelation_time,
            scatter=noise.scatter,
            columns=found.columns,
            steps=1,
        ).cost
        for found in (bare, final.fit)
    ]
    met = [tolerance for tolerance in final.hypothesis.candidate.tolerances if tolerance is not None]
    adds_to_one = bool(met) and all(len(tolerance.quantities) == 1 for tolerance in met)  # zero of a joint, camera's angle
    room = 1.0 if adds_to_one else CLEARLY
    return costs[0] - costs[1] < room * asked_of(final.hypothesis.candidate, threshold)


def shown_by_some_runs_only(hypothesis: Hypothesis, threshold: float) -> bool:
    """Whether a hypothesis would be accepted but for failing cross-validation; ``threshold``: of its round."""
    return not hypothesis.cross_validated and _is_good(threshold, replace(hypothesis, cross_validated=True))


def _is_good(threshold: float, hypothesis: Hypothesis) -> bool:
    return hypothesis.gain >= asked_of(hypothesis.candidate, threshold) and hypothesis.plausible


def converge(problem: Problem, runs: Sequence[int], final: Finalist, bare: Fit, tell: Tell) -> tuple[Finalist, Fit]:
    """The hypothesis fitted to convergence, also from calibrated parameters as the file says; and the best model without it.

    Beside a strong effect the cost has several minima: parameters that calibration had moved in the effect's place stay where
    they are and leave it too small; and the edge of a patch that one run alone has crossed has no gradient from afar.
    """
    tell(f"converging {final.hypothesis.candidate.label}, also from the model as given")
    found = final.fit

    def descent(start: FittedModel, near: Fit) -> Fit:
        scatter = near.noise.scatter
        return fit(problem, runs, start, scatter=scatter, near=near, steps=CONVERGENCE_STEPS, tell=tell)

    starts = (best_on_grid(problem, runs, found), untouched(problem, found.model))
    more = [descent(start, found) for start in starts if start is not found.model or not found.converged]  # else it ends there
    best = cheapest(problem, (found, *more), found.noise.autocorrelation_time)
    if best is not found and (start := best_on_grid(problem, runs, best)) is not best.model:  # once more, from where it is now
        best = cheapest(problem, (best, descent(start, best)), best.noise.autocorrelation_time)
    autocorrelation_time = best.noise.autocorrelation_time
    bare = cheapest(
        problem, [bare, _left(problem, runs, best, final.hypothesis.candidate, autocorrelation_time)], autocorrelation_time
    )
    return _evaluated(problem, runs, final.hypothesis, best, bare, autocorrelation_time), bare


def best_on_grid(problem: Problem, runs: Sequence[int], found: Fit) -> FittedModel:
    """The model with the last effect where it explains most: steps apart in each unknown that does not say how large it is."""
    candidate, values = found.model.effects[-1]
    steps = [np.array(GRID) * u.step if not u.is_size else np.zeros(1) for u in candidate.unknowns]
    places = {candidate.kept((np.array(values) + moves).tolist()) for moves in itertools.product(*steps)}
    without = found.model.without_effect(-1)
    models = [found.model, *(without.with_effect(candidate, place) for place in sorted(places - {tuple(values)}))]
    if len(models) == 1:
        return found.model
    residuals = problem.residuals([model.setting for model in models], runs)
    costs = [
        total_cost(problem, model, [r[k] for r in residuals], found.noise.autocorrelation_time)
        for k, model in enumerate(models)
    ]
    return models[int(np.argmin(costs))]
