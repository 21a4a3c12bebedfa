"""Fit the best hypotheses in full, compare them with one model without them and by leaving out runs, and accept one.

Nothing here uses the held-out runs.
"""

from __future__ import annotations

import copy
import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from wlr_gym.base.jobs import in_threads
from wlr_gym.gap.estimation import (
    Fit,
    FittedModel,
    Replayed,
    Tell,
    cheapest,
    equations_by_run,
    estimate_noise,
    fit,
    minus_two_log_likelihood,
    quiet,
    replay,
)
from wlr_gym.gap.problem import Array, Candidate
from wlr_gym.gap.selection.hypotheses import Hypothesis, fall_by_run, within_tolerance
from wlr_gym.gap.selection.screening import LEAST_GAIN, asked_of, least_gain

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


# ---- which ones ------------------------------------------------------------------------------------------------------


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


# ---- fits in full ----------------------------------------------------------------------------------------------------


def fit_finalists(current: Fit, chosen: Sequence[Hypothesis], bare: Fit, tell: Tell = quiet) -> tuple[list[Finalist], Fit]:
    """Fit hypotheses in full, with responses simulated anew, and compare all with one model without them.

    Return the finalists, best first, and the best model without a further effect: ``bare``, or one that a finalist has led to.
    """
    wholes: list[Fit] = []
    for hypothesis in chosen:
        tell(f"fitting {hypothesis.candidate.label} in full")
        near = fit(hypothesis.model, current.runs, scatter=current.noise.scatter, near=current, tell=tell)
        both = (near, *_afresh(hypothesis, near, tell))
        wholes.append(cheapest(both, current.noise.autocorrelation_time))
    if not wholes:
        return [], bare
    # the best of them is that which improves the fit most under the noise that it leaves itself
    best = max(wholes, key=lambda one: bare.cost_under(one.noise.autocorrelation_time) - one.cost)
    tau = best.noise.autocorrelation_time
    apart = np.abs(bare.model.scaled - current.model.scaled).max(initial=0.0)
    if bare.columns is current.columns and apart > 1.0:  # a tolerance or a step: they are of another minimum
        bare = fit(bare.model, bare.runs, autocorrelation_time=tau, scatter=bare.noise.scatter, steps=1)
    if not current.problem.thorough:
        pairs = zip(wholes, chosen, strict=True)
        bare = cheapest([bare, *(_left(whole, hypothesis.candidate, tau) for whole, hypothesis in pairs)], tau)
    found = [_evaluated(hypothesis, whole, bare, tau) for hypothesis, whole in zip(chosen, wholes, strict=True)]
    return sorted(found, key=lambda final: -final.hypothesis.gain), bare


def _afresh(hypothesis: Hypothesis, near: Fit, tell: Tell) -> list[Fit]:
    """The fit once more from the model as given, if calibrated parameters are at their bounds."""
    if not near.model.on_bounds.any():
        return []
    tell("a calibrated parameter at its bound: once more from the model as given")
    candidate = hypothesis.candidate
    start = hypothesis.model.without_effect(-1).untouched().with_effect(candidate, candidate.probed(candidate.starts[0]))
    return [fit(start, near.runs, scatter=near.noise.scatter, near=near, tell=tell)]


def _left(whole: Fit, candidate: Candidate, autocorrelation_time: Array) -> Fit:
    """The model without the last effect, one descent from where the calibrated parameters are beside it."""
    kept = whole.model.size - len(candidate.unknowns)
    columns = None if candidate.replaced else [column[:kept] for column in whole.columns]
    model, noise = whole.model.without_effect(-1), whole.noise
    return fit(model, whole.runs, autocorrelation_time=autocorrelation_time, scatter=noise.scatter, columns=columns, steps=1)


def _evaluated(hypothesis: Hypothesis, whole: Fit, bare: Fit, autocorrelation_time: Array) -> Finalist:
    """A hypothesis after its full fit: gain, agreement of the runs, what the tolerances allow.

    An improvement by calibrated parameters alone is no evidence for the effect: ``bare`` is the best model without it.
    """
    fitted = replace(
        hypothesis,
        model=whole.model,
        residuals=whole.residuals,
        cross_validated=cross_validated(bare, whole, autocorrelation_time),
        tolerable=within_tolerance(whole.model),
    )
    return Finalist(beside(fitted, bare, autocorrelation_time), whole)


def beside(hypothesis: Hypothesis, bare: Replayed, autocorrelation_time: Array) -> Hypothesis:
    """Return the hypothesis with its improvement, in all and by run, over the model without it, under this noise."""
    gain = bare.cost_under(autocorrelation_time) - hypothesis.cost_under(autocorrelation_time)
    noise = estimate_noise(hypothesis.residuals, autocorrelation_time)
    by_run = fall_by_run(bare.residuals, hypothesis.residuals, noise)
    return replace(hypothesis, gain=gain, by_run=by_run, base=Replayed(bare.model, bare.runs, bare.residuals))


def cross_validated(bare: Fit, whole: Fit, autocorrelation_time: Array) -> bool:
    """Whether the effect passes leave-one-run-out cross-validation: runs improve by a share of what they do when fitted.

    Only the likelihood is compared, not the prior. Two runs are not tested; of :data:`FORGIVING` and more, one is ignored.
    Where each run alone improves by :data:`LEAST_GAIN`, the share does not matter: one run may have most of it.
    """
    runs = bare.runs
    if len(runs) < LEAST_RUNS:
        return True
    before, after = (minus_two_log_likelihood(one.residuals, autocorrelation_time) for one in (bare, whole))

    def left_out(pair: tuple[FittedModel, FittedModel, int]) -> Array:
        return bare.problem.residuals([model.setting for model in pair[:2]], [pair[2]])[0]

    pairs = zip(without_each_run(bare), without_each_run(whole), runs, strict=True)
    found = in_threads(bare.problem.threads, left_out, pairs)
    if min(improvement([one], autocorrelation_time) for one in found) > LEAST_GAIN:
        return True
    kept = [found[:k] + found[k + 1 :] for k in range(len(found))] if len(runs) >= FORGIVING else [found]
    return max(improvement(some, autocorrelation_time) for some in kept) > max(LEAST_VALIDATED * (before - after), 0.0)


def improvement(found: Sequence[Array], autocorrelation_time: Array) -> float:
    """Fall of minus two log likelihood from the first to the second of two residuals per run."""
    before, after = (minus_two_log_likelihood([r[k] for r in found], autocorrelation_time) for k in (0, 1))
    return before - after


def without_each_run(found: Fit) -> list[FittedModel]:
    """The model as it would be without each run in turn, to first order."""
    matrices, vectors = equations_by_run(found.columns, found.residuals, found.noise, found.problem.threads)
    matrix, vector = matrices.sum(axis=0), vectors.sum(axis=0)
    whole = found.model.step(matrix, vector)
    steps = [found.model.step(matrix - own, vector - pull) for own, pull in zip(matrices, vectors, strict=True)]
    return [found.model.moved(step - whole) for step in steps]


# ---- the one that is accepted ----------------------------------------------------------------------------------------


def accept(
    threshold: float, finals: Sequence[Finalist], bare: Fit, tell: Tell = quiet
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
        converged, bare = (final, bare) if bare.problem.thorough else converge(final, bare, tell)
        if _is_good(threshold, converged.hypothesis) and _tolerances_do(threshold, converged, bare):
            converged = replace(converged, hypothesis=replace(converged.hypothesis, tolerable=True))
        seen = [converged if other is final else other for other in seen]
        if _is_good(threshold, converged.hypothesis):
            return converged, seen, bare
    return None, seen, bare


def _is_good(threshold: float, hypothesis: Hypothesis) -> bool:
    return hypothesis.gain >= asked_of(hypothesis.candidate, threshold) and hypothesis.plausible


def shown_by_some_runs_only(hypothesis: Hypothesis, threshold: float) -> bool:
    """Whether a hypothesis would be accepted but for failing cross-validation; ``threshold``: of its round."""
    return not hypothesis.cross_validated and _is_good(threshold, replace(hypothesis, cross_validated=True))


def _tolerances_do(threshold: float, final: Finalist, bare: Fit) -> bool:
    """Whether tolerances that count once explain nearly as much: one number for all wheels costs less than four tolerances do,
    the more so where they are tempered."""
    if bare.problem.tempering == 1.0 or final.hypothesis.gain > TOLERANCES_CANNOT:
        return False
    once = copy.copy(bare.problem)
    once.tempering = 1.0
    tau, scatter = final.fit.noise.autocorrelation_time, final.fit.noise.scatter
    without, with_it = (
        fit(replace(one.model, problem=once), one.runs, autocorrelation_time=tau, scatter=scatter, columns=one.columns, steps=1)
        for one in (bare, final.fit)
    )
    met = [tolerance for tolerance in final.hypothesis.candidate.tolerances if tolerance is not None]
    adds_to_one = bool(met) and all(len(tolerance.quantities) == 1 for tolerance in met)  # zero of a joint, camera's angle
    room = 1.0 if adds_to_one else CLEARLY
    return without.cost - with_it.cost < room * asked_of(final.hypothesis.candidate, threshold)


def converge(final: Finalist, bare: Fit, tell: Tell = quiet) -> tuple[Finalist, Fit]:
    """The hypothesis fitted to convergence, also from calibrated parameters as the file says; and the best model without it.

    Beside a strong effect the cost has several minima: parameters that calibration had moved in the effect's place stay where
    they are and leave it too small; and the edge of a patch that one run alone has crossed has no gradient from afar.
    """
    candidate, found = final.hypothesis.candidate, final.fit
    tell(f"converging {candidate.label}, also from the model as given")

    def descent(start: FittedModel, near: Fit) -> Fit:
        return fit(start, near.runs, scatter=near.noise.scatter, near=near, steps=CONVERGENCE_STEPS, tell=tell)

    starts = (best_on_grid(found), found.model.untouched())
    more = [descent(start, found) for start in starts if start is not found.model or not found.converged]  # else it ends there
    best = cheapest((found, *more), found.noise.autocorrelation_time)
    if best is not found and (start := best_on_grid(best)) is not best.model:  # once more, from where it is now
        best = cheapest((best, descent(start, best)), best.noise.autocorrelation_time)
    tau = best.noise.autocorrelation_time
    bare = cheapest([bare, _left(best, candidate, tau)], tau)
    return _evaluated(final.hypothesis, best, bare, tau), bare


def best_on_grid(found: Fit) -> FittedModel:
    """The model with the last effect where it explains most: steps apart in each unknown that does not say how large it is."""
    candidate, values = found.model.effects[-1]
    steps = [np.array(GRID) * u.step if not u.is_size else np.zeros(1) for u in candidate.unknowns]
    places = {candidate.kept((np.array(values) + moves).tolist()) for moves in itertools.product(*steps)}
    without = found.model.without_effect(-1)
    models = [found.model, *(without.with_effect(candidate, place) for place in sorted(places - {tuple(values)}))]
    if len(models) == 1:
        return found.model
    return min(replay(models, found.runs), key=lambda one: one.cost_under(found.noise.autocorrelation_time)).model
