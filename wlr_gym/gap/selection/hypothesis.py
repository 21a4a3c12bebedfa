"""A candidate effect after its fit: whether it may be what is missing, how probable it is, and what explains the data as well.

Probabilities are Bayesian model evidence (Laplace's approximation), with "none of these" among the models. Minus two log
evidence of a model is its cost, which holds the prior's exponent, plus the log determinant of its curvature, less that of its
prior. What all models share cancels: beside the model without a further effect an effect has its gain, less what its unknowns
could have been and are not (Occam's factor): ``ln det(1 + I / P)`` with the information I that the data hold of them,
calibrated parameters projected out, and the precision P of their prior. Likelihood and prior are tempered as in the fit. Kass
and Raftery (1995) is the review.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from wlr_gym.gap.estimation import FittedModel, Noise, Replayed
from wlr_gym.gap.problem import Array, Candidate
from wlr_gym.gap.selection.screening import LEAST_GAIN, Score, asked_of

#: An effect that helps some runs and harms others is none: harm, as a share of the help, that is put down to chance.
MOST_HARM = 0.2
#: Fall of minus two log posterior that outweighs what is known beforehand of the size of an effect, or what other runs lack.
INSISTENT = 160.0
#: Of an unknown that meets no calibrated parameter, what counts as an effect, in its steps.
NOTICED = 0.25


@dataclass(frozen=True, eq=False)
class Hypothesis(Replayed):
    """One candidate after its refit: the model with the effect as its last, and what it leaves.

    Attributes:
        base: the model without the effect, refitted as long.
        gain: fall of minus two log posterior.
        by_run: (runs) fall of the weighted squares in each run.
        predicted_gain: the improvement that the score test predicted.
        cross_validated: whether runs are replayed better by a fit to the other runs (checked for finalists only).
        tolerable: whether the tolerances of calibrated parameters allow as much.
        occam: what its unknowns cost beside its gain (:func:`occam`).
    """

    base: Replayed = field(repr=False)
    gain: float
    by_run: Array
    predicted_gain: float
    cross_validated: bool = True
    tolerable: bool = False
    occam: float = 0.0

    @property
    def candidate(self) -> Candidate:
        """The effect."""
        return self.model.effects[-1][0]

    @property
    def values(self) -> tuple[float, ...]:
        """Values of the candidate's unknowns."""
        return self.model.effects[-1][1]

    @property
    def at_bound(self) -> bool:
        """Whether an unknown ended at the edge of its plausible range (other than its neutral value)."""
        for unknown, value in zip(self.candidate.unknowns, self.values, strict=True):
            low, high = unknown.bounds
            too_much = value >= high - 1e-9 * abs(high) and high != unknown.neutral
            if too_much or (value <= low + 1e-9 * abs(low) and low != unknown.neutral):
                return True
        return False

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


def within_tolerance(model: FittedModel) -> bool:
    """Whether the tolerances of the numbers that the last effect meets allow what number and effect do together."""
    candidate, values = model.effects[-1]
    if not any(candidate.tolerances):
        return False
    known = {q.name: (q, value) for q, value in zip(model.problem.quantities, model.quantities, strict=True)}
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


# ---- probability -----------------------------------------------------------------------------------------------------

#: Prior probability that nothing is missing; the names share the rest, and the places of a name share its part.
NOTHING = 0.5
#: Probability of the set of names that the data do not distinguish.
CREDIBLE = 0.95
#: Least precision of a prior, of amplitudes in probes: a direction that hardly moves an unknown is not unbounded.
LEAST_PRECISION = 1e-3


def occam(score: Score, tempering: float) -> float:
    """Return by how much a candidate's unknowns are known better by the data than beforehand: ``ln det(1 + I / P)``."""
    start, unknowns, size = score.start, score.candidate.unknowns, len(score.information)
    if len(start.directions) != size:  # it was scored with another start
        size = min(size, len(start.directions))
    nothing = np.array(start.values(np.zeros(len(start.directions))))
    slopes = np.stack([np.array(start.values(own)) - nothing for own in np.eye(len(start.directions))[:size]], axis=1)
    precision = tempering * np.array([4.0 / (u.high - u.low) ** 2 for u in unknowns])
    prior = slopes.T @ (precision[:, None] * slopes) + LEAST_PRECISION * np.eye(size)
    data = 0.5 * (score.information + score.information.T)[:size, :size]
    return float(np.linalg.slogdet(prior + data)[1] - np.linalg.slogdet(prior)[1])


def probabilities(hypotheses: Sequence[Hypothesis], scores: Sequence[Score]) -> tuple[list[float], float]:
    """Return the probability of each hypothesis, and that of none of them.

    Args:
        hypotheses: refitted; what tolerances allow is no effect and has none.
        scores: of all candidates of the round: how many names and places there are.
    """
    places = Counter(score.candidate.name for score in scores)
    logs = [np.log(NOTHING)]
    for one in hypotheses:
        shared = (1.0 - NOTHING) / max(len(places), 1) / max(places[one.candidate.name], 1)
        logs.append(-np.inf if one.tolerable else np.log(shared) + 0.5 * (one.gain - one.occam))
    weights = np.exp(np.array(logs) - max(logs))
    shares = (weights / weights.sum()).tolist()
    return shares[1:], shares[0]


def credible_names(hypotheses: Sequence[Hypothesis], shares: Sequence[float]) -> list[str]:
    """Return the smallest set of names that together have :data:`CREDIBLE` of what all names have, most probable first."""
    total: dict[str, float] = {}
    for one, share in zip(hypotheses, shares, strict=True):
        total[one.candidate.name] = total.get(one.candidate.name, 0.0) + share
    found, reached, whole = [], 0.0, sum(total.values())
    for name in sorted(total, key=lambda name: -total[name]):
        if reached >= CREDIBLE * whole:
            break
        found.append(name)
        reached += total[name]
    return found


# ---- bootstrap and equivalence ---------------------------------------------------------------------------------------

#: Bootstrap samples of the runs.
SAMPLES = 500
#: Two effects are equivalent if the second improves the fit by at least this share of what the first does.
EQUIVALENT = 0.93
#: A rival that improves the fit by this share is equivalent unless the runs agree that it is worse ...
RIVAL = 0.75
#: ... by so many standard errors.
AGREED = 2.0


def selection_frequency(selected: Hypothesis, others: Sequence[Hypothesis], threshold: float = LEAST_GAIN) -> float:
    """Return the share of bootstrap samples of the runs in which the selected effect is accepted and no other fits better.

    A run counts by its part in the gain, as fitted to all runs: no sample is refitted. ``threshold``: see
    :func:`wlr_gym.gap.selection.screening.asked_of`.
    """
    rng = np.random.default_rng(0)
    rivals = [other for other in others if other.candidate.name != selected.candidate.name and not other.tolerable]
    picks = rng.integers(0, len(selected.by_run), (SAMPLES, len(selected.by_run)))
    parts = _parts(selected)[picks]
    gains = parts.sum(axis=1)
    agreed = -parts.clip(max=0.0).sum(axis=1) <= MOST_HARM * parts.clip(min=0.0).sum(axis=1)
    wins = agreed & (gains >= asked_of(selected.candidate, threshold))
    for rival in rivals:
        wins &= gains >= _parts(rival)[picks].sum(axis=1)
    return float(wins.mean())


def _parts(hypothesis: Hypothesis) -> Array:
    """The runs' parts (runs) in the gain of a hypothesis: their falls of squares, scaled to it."""
    total = float(hypothesis.by_run.sum())
    return hypothesis.by_run * (hypothesis.gain / total) if total > 0.0 < hypothesis.gain else hypothesis.by_run


def equivalents(selected: Hypothesis, others: Sequence[Hypothesis], credible: Sequence[str] = ()) -> list[Hypothesis]:
    """Return the best hypothesis of every other name that the data cannot distinguish from the selected one.

    ``credible``: names that cannot be left out of a set with 95 % of the probability.
    """
    found: dict[str, Hypothesis] = {}
    for other in others:
        name = other.candidate.name
        possible = name != selected.candidate.name and not other.at_bound and not other.tolerable
        if possible and (name in credible or _as_good(selected, other)):
            found.setdefault(name, other)
    return list(found.values())


def _as_good(selected: Hypothesis, other: Hypothesis) -> bool:
    """Whether another hypothesis improves the fit by nearly as much, or the runs do not agree that it does by less."""
    if other.gain > EQUIVALENT * selected.gain or selected.gain - other.gain < 0.25 * LEAST_GAIN:
        return True
    ahead = selected.by_run - other.by_run
    spread = float(ahead.std(ddof=1)) / np.sqrt(len(ahead)) if len(ahead) > 1 else 0.0
    return bool(other.gain > RIVAL * selected.gain and ahead.mean() < AGREED * spread)
