"""Search for missing effects: screen all candidates, refit the best of them, select the one that improves the fit most, repeat.

A candidate is accepted if it lowers minus two log posterior by more than chance and an imperfect simulator can
(:mod:`wlr_gym.gap.selection.screening`, more for every further unknown), if the runs agree on it, and if
its value lies inside its plausible range. Effects that become redundant beside others are removed.
"""

from __future__ import annotations

from collections.abc import Callable, Container, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from wlr_gym.gap.analysis import (
    EQUIVALENT,
    FAILS_CROSS_VALIDATION,
    REJECTED,
    REMOVED,
    SELECTED,
    TOO_LITTLE,
    WORSE_FIT,
    Evidence,
)
from wlr_gym.gap.estimation.fit import Fit, cheapest, fit, linearise, widened
from wlr_gym.gap.estimation.model import FittedModel, estimate_noise, level, mean_squares, total_cost, untouched
from wlr_gym.gap.problem import Candidate, Problem
from wlr_gym.gap.selection.cross_validation import (
    Finalist,
    accept,
    beside,
    fit_finalists,
    left_to_fit,
    shown_by_some_runs_only,
    worth_a_fit,
)
from wlr_gym.gap.selection.hypothesis import Hypothesis, credible_names, equivalents, probabilities
from wlr_gym.gap.selection.refit import refit, refit_thoroughly
from wlr_gym.gap.selection.screening import (
    LEAST_GAIN,
    Products,
    Responses,
    Score,
    acceptance_threshold,
    asked_of,
    is_visible,
    largest_by_chance,
    least_gain,
    one_per_label,
    rescored,
    responses,
    screen,
    shortlist,
    with_proposals,
)

Array = NDArray[np.float64]
Tell = Callable[[str], None]

#: Share of :attr:`wlr_gym.gap.problem.Problem.misfit`, in units of sensor noise, above which an error is so much that effects
#: whose refits have told nothing are worth a fit in full. Refits keep the calibrated parameters' responses of the model without
#: the effect: where motors reach the voltage of their supply, a descent ends at once.
MUCH_LEFT = 0.55
#: Beside a formula, which only resembles the law, an effect must improve the fit by this share of what the formula did.
BESIDE_FORMULA = 0.1
#: Effects in one analysis.
MOST_EFFECTS = 4


@dataclass(frozen=True, eq=False)
class Round:
    """One round of the search: what was screened, what was refitted (best first), and which was selected.

    Attributes:
        scores: of all candidates, best first.
        hypotheses: refitted, best first.
        selected: one of them, or None.
        threshold: by how much one with a single unknown had to improve the fit.
        by_chance: (draws) of :func:`wlr_gym.gap.selection.screening.largest_by_chance`.
    """

    scores: list[Score]
    hypotheses: list[Hypothesis]
    selected: Hypothesis | None
    threshold: float = LEAST_GAIN
    by_chance: Array = field(default_factory=lambda: np.zeros(0), repr=False)

    @property
    def probabilities(self) -> tuple[list[float], float]:
        """Probability of each hypothesis, and that of none of them."""
        return probabilities(self.hypotheses, self.scores)

    @property
    def equivalents(self) -> list[Hypothesis]:
        """The best hypothesis of every other name that the data cannot distinguish from the selected one."""
        if self.selected is None or not self.selected.cross_validated:  # the latter: refuted by the held-out runs
            return []
        return equivalents(self.selected, self.hypotheses, credible_names(self.hypotheses, self.probabilities[0]))


@dataclass(frozen=True, eq=False)
class SearchResult:
    """Outcome: the calibrated model without effects, the final fit, and every round.

    ``swaps`` holds, per effect of a model of several, that effect and its rivals with the other effects kept (thorough
    problems only); ``refuted``: what an earlier search selected and held-out runs refuted.
    """

    calibrated: Fit
    fit: Fit
    rounds: list[Round]
    swaps: dict[str, tuple[Hypothesis, list[Hypothesis]]]
    refuted: Sequence[Hypothesis] = ()

    @property
    def kept(self) -> list[tuple[Round, Hypothesis]]:
        """Rounds whose selected effect the final model has, and that effect."""
        labels = {candidate.label for candidate, _ in self.fit.model.effects}
        return [(look, one) for look in self.rounds if (one := look.selected) is not None and one.candidate.label in labels]


@dataclass(frozen=True, eq=False)
class Screened:
    """What screening says of the candidates of one round.

    Attributes:
        scores: under the noise that each candidate would leave, best first.
        alone: the best of each group of signals, best first.
        linear: to first order under the noise of the model without them, best first.
        found, products: responses of the model's numbers and the candidates' probes, and their products.
    """

    scores: list[Score]
    alone: list[Score]
    linear: list[Score]
    found: Responses
    products: Products


def screened(
    problem: Problem,
    runs: Sequence[int],
    current: Fit,
    tell: Tell = lambda text: None,
    excluded: Container[str] = (),
) -> Screened:
    """Score all candidates beyond a fitted model, but those with ``excluded`` labels."""
    probes, candidates = problem.candidates(current.model.setting, current.residuals, runs)
    candidates = [one for one in candidates if one.label not in excluded and not _is_explained(current.model, one)]
    tell(f"screening {len(candidates)} candidates")
    found = responses(problem, current, runs, probes)
    products = Products.of(current, found, problem.threads)
    linear = screen(candidates, found)
    scores, alone = rescored(problem, current, found, products, linear)
    return Screened(one_per_label(scores), alone, linear, found, products)


def search_effects(
    problem: Problem,
    runs: Sequence[int],
    start: Fit,
    tell: Tell = lambda text: None,
    given: Sequence[NDArray[np.float32]] | None = None,
    excluded: Container[str] = (),
) -> SearchResult:
    """Search for missing effects.

    Args:
        problem: the system.
        runs: those that are fitted; no other is used.
        start: the calibrated model.
        tell: called with progress.
        given: columns of ``start`` without its calibration, where they are known: one (numbers, rows x channels) array per run.
        excluded: labels of candidates that are not tried.
    """
    if given is None and not problem.thorough:
        given = linearise(problem, untouched(problem, start.model), runs)[1]
    current, calibrated, rounds, again = start, start, [], None
    had = [[candidate.label for candidate, _ in start.model.effects]]

    def settled(bare: Fit) -> bool:
        """Whether the calibrated model stands: once calibrated anew it does, else where none without an effect is lower."""
        return current is again or not _deeper(problem, current, bare)

    while True:
        first = screened(problem, runs, current, tell, excluded)
        scores, alone, found, products = first.scores, first.alone, first.found, first.products
        by_chance = np.zeros(0) if problem.thorough else largest_by_chance(problem, runs, current, found, products, scores)
        formulas = {candidate.label for candidate, _ in current.model.effects if candidate.formula}
        gains = [one.gain for look in rounds if (one := look.selected) is not None and one.candidate.label in formulas]
        threshold = max(acceptance_threshold(current.cost, by_chance), BESIDE_FORMULA * max(gains, default=0.0))
        visible = {score.candidate.label for score in first.linear if is_visible(score, threshold)}
        scores = [replace(score, visible=score.candidate.label in visible) for score in scores]
        chosen = scores if problem.thorough else with_proposals(shortlist(scores, threshold), alone)
        tell(f"refitting {len(chosen)} hypotheses")
        hypotheses = (
            refit_thoroughly(problem, runs, current, chosen) if given is None else refit(problem, runs, current, chosen, given)
        )
        bare = _without_more(problem, current, hypotheses)
        finals: list[Finalist] = []
        accepted: Finalist | None = None
        if settled(bare):
            finals, bare = fit_finalists(problem, runs, current, worth_a_fit(hypotheses), bare, tell)
        if settled(bare):
            accepted, finals, bare = accept(problem, runs, threshold, finals, bare, tell)
        left = level(mean_squares(bare.residuals, problem.cap))
        if accepted is None and left > MUCH_LEFT * problem.misfit and settled(bare):
            more, bare = fit_finalists(problem, runs, current, left_to_fit(hypotheses, finals), bare, tell)
            accepted, more, bare = accept(problem, runs, threshold, more, bare, tell)
            finals = sorted((*finals, *more), key=lambda final: -final.hypothesis.gain)
        if not settled(bare):
            tell("calibrated parameters fit better elsewhere: calibrated anew from there")
            anew = fit(problem, runs, bare.model, scatter=current.noise.scatter, steps=problem.steps)
            current = again = widened(problem, runs, anew)
            calibrated = calibrated if current.model.effects else current
            given = _as_given(problem, runs, current, given)
            continue
        merged = _merged(problem, finals, hypotheses, bare, accepted or (finals[0] if finals else None))
        chosen_label = accepted and accepted.hypothesis.candidate.label
        selected = next((one for one in merged if one.candidate.label == chosen_label), None)
        rounds.append(Round(scores, merged, selected, threshold, by_chance))
        if accepted is None:
            break
        tell(f"selected: {accepted.hypothesis.candidate.label}")
        current = widened(problem, runs, remove_redundant(problem, runs, accepted.fit, tell))
        labels = [candidate.label for candidate, _ in current.model.effects]
        if len(labels) >= MOST_EFFECTS or labels in had:
            break
        had.append(labels)
        given = _as_given(problem, runs, current, given)
    return SearchResult(calibrated, current, rounds, swap_each(problem, runs, current) if problem.thorough else {})


def _as_given(
    problem: Problem, runs: Sequence[int], current: Fit, given: Sequence[NDArray[np.float32]] | None
) -> Sequence[NDArray[np.float32]] | None:
    """Columns of the model without its calibration: beside a strong effect their responses differ."""
    if given is None or not current.model.effects:
        return given
    return linearise(problem, untouched(problem, current.model), runs, current.columns, current.noise)[1]


def _is_explained(model: FittedModel, candidate: Candidate) -> bool:
    """Whether the model has the candidate, or an unknown law on half of the joints where it acts.

    An improvement by a name beside a formula there is an error of the formula.
    """
    unknown = {place for other, _ in model.effects if other.formula for place in other.where}
    half = 2 * len(unknown.intersection(candidate.where)) >= len(candidate.where)
    return candidate.label in {other.label for other, _ in model.effects} or (half and not candidate.formula)


def _without_more(problem: Problem, current: Fit, hypotheses: Sequence[Hypothesis]) -> Fit:
    """The model without a further effect: the present one, or the one that refits have found if that is better."""
    if not hypotheses:
        return current
    model, residuals = hypotheses[0].base, hypotheses[0].base_residuals
    noise = estimate_noise(residuals, scatter=current.noise.scatter)
    found = replace(
        current,
        model=model,
        residuals=residuals,
        noise=noise,
        cost=total_cost(problem, model, residuals, noise.autocorrelation_time),
        converged=False,
    )
    return cheapest(problem, (current, found), noise.autocorrelation_time)


def _deeper(problem: Problem, current: Fit, bare: Fit) -> bool:
    """Whether a model without a further effect, in another minimum than the present one, is clearly lower."""
    if problem.thorough:
        return False
    lower = [
        total_cost(problem, current.model, current.residuals, tau) - total_cost(problem, bare.model, bare.residuals, tau)
        for tau in (current.noise.autocorrelation_time, bare.noise.autocorrelation_time)  # bare may stand under an effect's
    ]
    return min(lower) > LEAST_GAIN


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
            autocorrelation_time=final.noise.autocorrelation_time,
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


def remove_redundant(problem: Problem, runs: Sequence[int], current: Fit, tell: Tell = lambda text: None) -> Fit:
    """Remove effects that are redundant beside the others, one after the other, the least useful first."""
    while len(current.model.effects) > 1:
        trials = without_each(problem, runs, current)
        losses = [trial.cost - current.cost for trial in trials]
        least = int(np.argmin(losses))
        unknowns = len(current.model.effects[least][1])
        if losses[least] > least_gain(unknowns):
            return current
        tell(f"removed: {current.model.effects[least][0].label}")
        current = fit(problem, runs, trials[least].model, scatter=current.noise.scatter, steps=1, tell=tell)
    return current


def without_each(problem: Problem, runs: Sequence[int], current: Fit) -> list[Fit]:
    """Fit the model without each of its effects in turn, under the same noise."""
    kept = len(problem.quantities)
    sizes = [len(values) for _, values in current.model.effects]
    trials = []
    for index, (candidate, _) in enumerate(current.model.effects):
        own = slice(kept + sum(sizes[:index]), kept + sum(sizes[: index + 1]))
        silent = candidate.replaced  # a number that an effect replaces has no columns beside it
        columns = None if silent else [np.delete(column, own, axis=0) for column in current.columns]
        trials.append(
            fit(
                problem,
                runs,
                current.model.without_effect(index),
                autocorrelation_time=current.noise.autocorrelation_time,
                scatter=current.noise.scatter,
                columns=columns,
                steps=problem.steps,
                renew=False,
            )
        )
    return trials


def _merged(
    problem: Problem, finals: Sequence[Finalist], hypotheses: Sequence[Hypothesis], bare: Fit, best: Finalist | None
) -> list[Hypothesis]:
    """All hypotheses, those fitted in full in their final form; where one was, all compared under its autocorrelation time."""
    final = {f.hypothesis.candidate.label: f.hypothesis for f in finals}
    merged = [final.get(h.candidate.label, h) for h in hypotheses]
    if best is not None:
        merged = [beside(problem, hypothesis, bare, best.fit.noise.autocorrelation_time) for hypothesis in merged]
    return sorted(merged, key=lambda hypothesis: -hypothesis.gain)


# ---- outcomes --------------------------------------------------------------------------------------------------------

#: Reason why an effect that was selected is not kept.
REFUTED = "the held-out runs refute it"
#: Reason why a candidate is rejected at screening: calibration reproduces its response.
CONFOUNDED = "confounded with calibrated parameters"


def evidence_of(problem: Problem, number: int, look: Round, fitted: Sequence[int], kept: Container[str]) -> list[Evidence]:
    """Every candidate's outcome in one round: the refitted ones, then the best place of every other name.

    ``kept`` are the labels of what the final model has: what was selected may have been removed again.
    """
    equal, (shares, _) = {h.candidate.label for h in look.equivalents}, look.probabilities
    entries = [
        _fitted_evidence(problem, number, one, _outcome(one, look, equal, kept), fitted, share)
        for one, share in zip(look.hypotheses, shares, strict=True)
    ]
    seen = {entry.name for entry in entries}
    for score in look.scores:
        if score.candidate.name in seen:
            continue
        seen.add(score.candidate.name)
        values = score.candidate.parameters(score.values)
        reason = CONFOUNDED if score.own < 0.05 else "its predicted improvement is too small"
        entries.append(
            Evidence(number, score.candidate.name, score.candidate.where, values, score.gain, score.gain, REJECTED, reason)
        )
    return entries


def _fitted_evidence(
    problem: Problem, number: int, one: Hypothesis, outcome: tuple[str, str], fitted: Sequence[int], probability: float = 0.0
) -> Evidence:
    return Evidence(
        number,
        one.candidate.name,
        one.candidate.where,
        one.candidate.effect(one.values).parameters,
        one.gain,
        one.predicted_gain,
        *outcome,
        {problem.runs[k]: float(gain) for k, gain in zip(fitted, one.by_run, strict=True)},
        probability,
        one.candidate.formula,
        one.candidate.units or ({u.name: u.unit for u in one.candidate.unknowns} if one.candidate.doc else {}),
    )


def _outcome(hypothesis: Hypothesis, look: Round, equal: set[str], kept: Container[str]) -> tuple[str, str]:
    best = look.selected
    if best is not None and hypothesis.candidate.label == best.candidate.label:
        if not best.cross_validated:
            return FAILS_CROSS_VALIDATION, REFUTED
        return (
            (SELECTED, "improves the fit most")
            if best.candidate.label in kept
            else (REMOVED, "redundant beside effects selected later")
        )
    if hypothesis.candidate.label in equal and best is not None:
        return EQUIVALENT, f"improves the fit by {hypothesis.gain / best.gain:.0%} of what the best does"
    if hypothesis.at_bound:
        return "implausible", "needs a value outside its plausible range"
    if hypothesis.tolerable:
        return "within tolerance", "the tolerances of calibrated parameters allow as much"
    if shown_by_some_runs_only(hypothesis, look.threshold):
        return FAILS_CROSS_VALIDATION, "left out of the fit, runs are not replayed better with it"
    if not hypothesis.consistent:
        return "inconsistent", "helps some runs and harms others"
    if best is None:
        least = asked_of(hypothesis.candidate, look.threshold)
        return TOO_LITTLE, f"improves the fit by less than chance or an imperfect simulator or formula can ({least:.0f})"
    return WORSE_FIT, f"improves the fit by {max(hypothesis.gain, 0.0) / best.gain:.0%} of what the best does"


def refuted_evidence(problem: Problem, one: Hypothesis, fitted: Sequence[int]) -> Evidence:
    """What came of an effect that an earlier search selected beside others."""
    return _fitted_evidence(problem, 1, one, (FAILS_CROSS_VALIDATION, REFUTED), fitted)
