"""A candidate effect after its fit, and whether it may be what is missing."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from wlr_gym.gap.estimation.likelihood import Noise
from wlr_gym.gap.estimation.model import FittedModel
from wlr_gym.gap.problem import Candidate, Problem, Unknown

Array = NDArray[np.float64]

#: An effect that helps some runs and harms others is none: harm, as a share of the help, that is put down to chance.
MOST_HARM = 0.2
#: Fall of minus two log posterior that outweighs what is known beforehand of the size of an effect, or what other runs lack.
INSISTENT = 160.0
#: Of an unknown that meets no calibrated parameter, what counts as an effect, in its steps.
NOTICED = 0.25


@dataclass(frozen=True, eq=False)
class Hypothesis:
    """One candidate after its refit.

    Attributes:
        candidate: the effect.
        model: with the effect.
        gain: fall of minus two log posterior.
        by_run: (runs) fall of the weighted squares in each run.
        predicted_gain: the improvement that the score test predicted.
        residuals: of the model.
        base, base_residuals: the model without the effect, refitted as long.
        cross_validated: whether runs are replayed better by a fit to the other runs (checked for finalists only).
        tolerable: whether the tolerances of calibrated parameters allow as much.
        occam: what its unknowns cost beside its gain (:func:`wlr_gym.gap.selection.evidence.occam`).
    """

    candidate: Candidate
    model: FittedModel
    gain: float
    by_run: Array
    predicted_gain: float
    residuals: list[Array] = field(repr=False)
    base: FittedModel = field(repr=False)
    base_residuals: list[Array] = field(repr=False)
    cross_validated: bool = True
    tolerable: bool = False
    occam: float = 0.0

    @property
    def values(self) -> tuple[float, ...]:
        """Values of the candidate's unknowns."""
        return self.model.effects[-1][1]

    @property
    def evidence(self) -> float:
        """Twice the log evidence beyond that of the model without it."""
        return self.gain - self.occam

    @property
    def at_bound(self) -> bool:
        """Whether an unknown ended at the edge of its plausible range (other than its neutral value)."""
        return any(_is_at_bound(unknown, value) for unknown, value in zip(self.candidate.unknowns, self.values, strict=True))

    @property
    def plausible(self) -> bool:
        """Whether its size is one that a robot may have, and more than tolerances allow, and the runs agree.

        At the edge of what a robot may have it is, too, where the data insist.
        """
        inside = not self.at_bound or self.gain > INSISTENT
        return inside and not self.tolerable and self.consistent and self.cross_validated

    @property
    def consistent(self) -> bool:
        """Whether the runs agree that it is there."""
        help_, harm = self.by_run.clip(min=0.0).sum(), -self.by_run.clip(max=0.0).sum()
        return bool(harm <= MOST_HARM * help_)


def _is_at_bound(unknown: Unknown, value: float) -> bool:
    low, high = unknown.bounds
    too_much = value >= high - 1e-9 * abs(high) and high != unknown.neutral
    return too_much or (value <= low + 1e-9 * abs(low) and low != unknown.neutral)


def within_tolerance(problem: Problem, model: FittedModel) -> bool:
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


def fall_by_run(before: Sequence[Array], after: Sequence[Array], noise: Noise) -> Array:
    """Fall of the weighted squares in each run."""
    return np.array([np.nansum((b * b - a * a) * noise.weight) for b, a in zip(before, after, strict=True)])
