"""What came of every candidate of a search: its outcome, and why."""

from __future__ import annotations

from collections.abc import Container, Sequence

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
from wlr_gym.gap.problem import Problem
from wlr_gym.gap.selection.cross_validation import shown_by_some_runs_only
from wlr_gym.gap.selection.hypothesis import Hypothesis
from wlr_gym.gap.selection.screening import asked_of
from wlr_gym.gap.selection.search import Round

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
