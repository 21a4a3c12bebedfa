"""Search for missing effects: screen all candidates, refit the best of them, select the one that improves the fit most, repeat.

A candidate is accepted if it lowers minus two log posterior by more than chance and an imperfect simulator can
(:mod:`wlr_gym.gap.selection.screening`, more for every further unknown), if the runs agree on it, and if
its value lies inside its plausible range. Effects that become redundant beside others are removed.
"""

from __future__ import annotations

from collections.abc import Container, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

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
from wlr_gym.gap.estimation import (
    Columns,
    Fit,
    FittedModel,
    Tell,
    cheapest,
    estimate_noise,
    fit,
    level,
    linearise,
    mean_squares,
    quiet,
    widened,
)
from wlr_gym.gap.problem import Array, Candidate
from wlr_gym.gap.selection.finalists import (
    Finalist,
    accept,
    beside,
    fit_finalists,
    left_to_fit,
    shown_by_some_runs_only,
    worth_a_fit,
)
from wlr_gym.gap.selection.hypotheses import Hypothesis, credible_names, equivalents, probabilities, refit, refit_thoroughly
from wlr_gym.gap.selection.screening import (
    LEAST_GAIN,
    Responses,
    Score,
    acceptance_threshold,
    asked_of,
    largest_by_chance,
    least_gain,
    one_per_label,
    rescored,
    responses,
    screen,
    shortlist,
)

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


def _screened(current: Fit, excluded: Container[str], tell: Tell) -> tuple[Responses, list[Score], list[Score], list[Score]]:
    """Score all candidates beyond a fitted model, but those with ``excluded`` labels.

    Returned are the responses, the scores to first order and those under the noise that each candidate would leave, and the
    best of each group of signals; best first.
    """
    probes, candidates = current.problem.candidates(current.model.setting, current.residuals, current.runs)
    candidates = [one for one in candidates if one.label not in excluded and not _is_explained(current.model, one)]
    tell(f"screening {len(candidates)} candidates")
    found = responses(current, probes)
    linear = screen(candidates, found)
    scores, alone = rescored(found, linear)
    return found, linear, one_per_label(scores), alone


def _is_explained(model: FittedModel, candidate: Candidate) -> bool:
    """Whether the model has the candidate, or an unknown law on half of the joints where it acts.

    An improvement by a name beside a formula there is an error of the formula.
    """
    unknown = {place for other, _ in model.effects if other.formula for place in other.where}
    half = 2 * len(unknown.intersection(candidate.where)) >= len(candidate.where)
    return candidate.label in {other.label for other, _ in model.effects} or (half and not candidate.formula)


def search_effects(start: Fit, tell: Tell = quiet, given: Columns | None = None, excluded: Container[str] = ()) -> SearchResult:
    """Search for missing effects; no other runs are used than those that are fitted.

    ``start``: the calibrated model. ``given``: columns of it without its calibration, where they are known. ``excluded``:
    labels of candidates that are not tried.
    """
    problem = start.problem
    if given is None and not problem.thorough:
        given = linearise(start.model.untouched(), start.runs)[1]
    current, calibrated, rounds, again = start, start, [], None
    had = [_labels(start)]

    def settled(bare: Fit) -> bool:
        """Whether the calibrated model stands: once calibrated anew it does, else where none without an effect is lower."""
        return current is again or not _deeper(current, bare)

    while True:
        found, linear, scores, alone = _screened(current, excluded, tell)
        by_chance = np.zeros(0) if problem.thorough else largest_by_chance(found, scores)
        formulas = {candidate.label for candidate, _ in current.model.effects if candidate.formula}
        gains = [one.gain for look in rounds if (one := look.selected) is not None and one.candidate.label in formulas]
        threshold = max(acceptance_threshold(current.cost, by_chance), BESIDE_FORMULA * max(gains, default=0.0))
        visible = {score.candidate.label for score in linear if score.is_visible(threshold)}
        scores = [replace(score, visible=score.candidate.label in visible) for score in scores]
        chosen = scores if problem.thorough else shortlist(scores, threshold, alone)
        tell(f"refitting {len(chosen)} hypotheses")
        hypotheses = refit_thoroughly(current, chosen) if given is None else refit(current, chosen, given)
        bare = _without_more(current, hypotheses)
        finals: list[Finalist] = []
        accepted: Finalist | None = None
        if settled(bare):
            finals, bare = fit_finalists(current, worth_a_fit(hypotheses), bare, tell)
        if settled(bare):
            accepted, finals, bare = accept(threshold, finals, bare, tell)
        left = level(mean_squares(bare.residuals, problem.cap))
        if accepted is None and left > MUCH_LEFT * problem.misfit and settled(bare):
            more, bare = fit_finalists(current, left_to_fit(hypotheses, finals), bare, tell)
            accepted, more, bare = accept(threshold, more, bare, tell)
            finals = sorted((*finals, *more), key=lambda final: -final.hypothesis.gain)
        if not settled(bare):
            tell("calibrated parameters fit better elsewhere: calibrated anew from there")
            current = again = widened(fit(bare.model, bare.runs, scatter=current.noise.scatter))
            calibrated = calibrated if current.model.effects else current
            given = _as_given(current, given)
            continue
        merged = _merged(finals, hypotheses, bare, accepted or (finals[0] if finals else None))
        chosen_label = accepted and accepted.hypothesis.candidate.label
        selected = next((one for one in merged if one.candidate.label == chosen_label), None)
        rounds.append(Round(scores, merged, selected, threshold, by_chance))
        if accepted is None:
            break
        tell(f"selected: {accepted.hypothesis.candidate.label}")
        current = widened(remove_redundant(accepted.fit, tell))
        if len(current.model.effects) >= MOST_EFFECTS or _labels(current) in had:
            break
        had.append(_labels(current))
        given = _as_given(current, given)
    return SearchResult(calibrated, current, rounds, swap_each(current) if problem.thorough else {})


def _labels(found: Fit) -> list[str]:
    return [candidate.label for candidate, _ in found.model.effects]


def _as_given(current: Fit, given: Columns | None) -> Columns | None:
    """Columns of the model without its calibration: beside a strong effect their responses differ."""
    if given is None or not current.model.effects:
        return given
    return linearise(current.model.untouched(), current.runs, current.columns, current.noise)[1]


def _without_more(current: Fit, hypotheses: Sequence[Hypothesis]) -> Fit:
    """The model without a further effect: the present one, or the one that refits have found if that is better."""
    if not hypotheses:
        return current
    base = hypotheses[0].base
    noise = estimate_noise(base.residuals, scatter=current.noise.scatter)
    tau = noise.autocorrelation_time
    own = {"model": base.model, "residuals": base.residuals, "noise": noise, "cost": base.cost_under(tau), "converged": False}
    return cheapest((current, replace(current, **own)), tau)


def _deeper(current: Fit, bare: Fit) -> bool:
    """Whether a model without a further effect, in another minimum than the present one, is clearly lower."""
    if current.problem.thorough:
        return False
    times = (current.noise.autocorrelation_time, bare.noise.autocorrelation_time)  # bare may stand under an effect's
    return min(current.cost_under(tau) - bare.cost_under(tau) for tau in times) > LEAST_GAIN


def swap_each(final: Fit) -> dict[str, tuple[Hypothesis, list[Hypothesis]]]:
    """Put every candidate in the place of each effect of a model of several, and fit it there."""
    swaps: dict[str, tuple[Hypothesis, list[Hypothesis]]] = {}
    if len(final.model.effects) < 2:
        return swaps
    tau, scatter = final.noise.autocorrelation_time, final.noise.scatter
    for index, (candidate, _) in enumerate(final.model.effects):
        without = fit(final.model.without_effect(index), final.runs, autocorrelation_time=tau, scatter=scatter)
        probes, candidates = final.problem.candidates(without.model.setting, without.residuals, final.runs)
        rivals = refit_thoroughly(without, screen(candidates, responses(without, probes)))
        own = [rival for rival in rivals if rival.candidate.label == candidate.label]
        if own:
            swaps[candidate.label] = (own[0], rivals)
    return swaps


def remove_redundant(current: Fit, tell: Tell = quiet) -> Fit:
    """Remove effects that are redundant beside the others, one after the other, the least useful first."""
    while len(current.model.effects) > 1:
        trials = without_each(current)
        losses = [trial.cost - current.cost for trial in trials]
        least = int(np.argmin(losses))
        candidate, values = current.model.effects[least]
        if losses[least] > least_gain(len(values)):
            return current
        tell(f"removed: {candidate.label}")
        current = fit(trials[least].model, current.runs, scatter=current.noise.scatter, steps=1, tell=tell)
    return current


def without_each(current: Fit) -> list[Fit]:
    """Fit the model without each of its effects in turn, under the same noise."""
    tau, scatter, at = current.noise.autocorrelation_time, current.noise.scatter, len(current.problem.quantities)
    trials = []
    for index, (candidate, values) in enumerate(current.model.effects):
        own = slice(at, at + len(values))
        at = own.stop
        silent = candidate.replaced  # a number that an effect replaces has no columns beside it
        columns = None if silent else [np.delete(column, own, axis=0) for column in current.columns]
        model = current.model.without_effect(index)
        trials.append(fit(model, current.runs, autocorrelation_time=tau, scatter=scatter, columns=columns, renew=False))
    return trials


def _merged(finals: Sequence[Finalist], hypotheses: Sequence[Hypothesis], bare: Fit, best: Finalist | None) -> list[Hypothesis]:
    """All hypotheses, those fitted in full in their final form; where one was, all compared under its autocorrelation time."""
    final = {f.hypothesis.candidate.label: f.hypothesis for f in finals}
    merged = [final.get(h.candidate.label, h) for h in hypotheses]
    if best is not None:
        merged = [beside(hypothesis, bare, best.fit.noise.autocorrelation_time) for hypothesis in merged]
    return sorted(merged, key=lambda hypothesis: -hypothesis.gain)


# ---- outcomes --------------------------------------------------------------------------------------------------------

#: Reason why an effect that was selected is not kept.
REFUTED = "the held-out runs refute it"
#: Reason why a candidate is rejected at screening: calibration reproduces its response.
CONFOUNDED = "confounded with calibrated parameters"


def evidence_of(number: int, look: Round, kept: Container[str]) -> list[Evidence]:
    """Every candidate's outcome in one round: the refitted ones, then the best place of every other name.

    ``kept`` are the labels of what the final model has: what was selected may have been removed again.
    """
    equal, (shares, _) = {h.candidate.label for h in look.equivalents}, look.probabilities
    pairs = zip(look.hypotheses, shares, strict=True)
    entries = [_fitted_evidence(number, one, _outcome(one, look, equal, kept), share) for one, share in pairs]
    seen = {entry.name for entry in entries}
    for score in look.scores:
        name, where = score.candidate.name, score.candidate.where
        if name not in seen:
            seen.add(name)
            values = score.candidate.parameters(score.values)
            reason = CONFOUNDED if score.own < 0.05 else "its predicted improvement is too small"
            entries.append(Evidence(number, name, where, values, score.gain, score.gain, REJECTED, reason))
    return entries


def refuted_evidence(one: Hypothesis) -> Evidence:
    """What came of an effect that an earlier search selected beside others."""
    return _fitted_evidence(1, one, (FAILS_CROSS_VALIDATION, REFUTED))


def _fitted_evidence(number: int, one: Hypothesis, outcome: tuple[str, str], probability: float = 0.0) -> Evidence:
    candidate = one.candidate
    own_units = {unknown.name: unknown.unit for unknown in candidate.unknowns} if candidate.doc else {}
    return Evidence(
        number,
        candidate.name,
        candidate.where,
        candidate.effect(one.values).parameters,
        one.gain,
        one.predicted_gain,
        *outcome,
        by_run={one.problem.runs[k]: float(gain) for k, gain in zip(one.runs, one.by_run, strict=True)},
        probability=probability,
        formula=candidate.formula,
        units=candidate.units or own_units,
    )


def _outcome(hypothesis: Hypothesis, look: Round, equal: set[str], kept: Container[str]) -> tuple[str, str]:
    best = look.selected
    if best is not None and hypothesis.candidate.label == best.candidate.label:
        if not best.cross_validated:
            return FAILS_CROSS_VALIDATION, REFUTED
        if best.candidate.label in kept:
            return SELECTED, "improves the fit most"
        return REMOVED, "redundant beside effects selected later"
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
