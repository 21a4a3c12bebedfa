"""How probable each name is: Bayesian model evidence (Laplace's approximation), with "none of these" among the models.

Minus two log evidence of a model is its cost, which holds the prior's exponent, plus the log determinant of its curvature,
less that of its prior. What all models share cancels: beside the model without a further effect an effect has its gain, less
what its unknowns could have been and are not (Occam's factor): ``ln det(1 + I / P)`` with the information I that the data hold
of them, calibrated parameters projected out, and the precision P of their prior. Likelihood and prior are tempered as in the
fit. Kass and Raftery (1995) is the review.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from wlr_gym.gap.selection.hypothesis import Hypothesis
from wlr_gym.gap.selection.screening import Score

Array = NDArray[np.float64]

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
        logs.append(-np.inf if one.tolerable else np.log(shared) + 0.5 * one.evidence)
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
