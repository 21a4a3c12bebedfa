"""By how much must an effect improve the fit? Calibrated on each data set: the largest improvement that chance alone gives.

The residuals that the best candidate leaves are cut into blocks longer than their autocorrelation, and each block's sign is
drawn anew (wild block bootstrap; Wu 1986, Liu 1988): what an effect would do alike in all blocks is gone, while size,
autocorrelation, and covariance of the channels stay those of these data. Every candidate is scored on every draw, to first
order and with the calibrated parameters projected out, and the largest improvement of each draw is taken. All of it is products
of matrices: nothing is simulated.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from wlr_gym.gap.estimation.fit import Fit
from wlr_gym.gap.estimation.likelihood import estimate_noise
from wlr_gym.gap.problem import Problem
from wlr_gym.gap.selection.alternative import Products
from wlr_gym.gap.selection.screening import (
    LEAST_GAIN,
    LEAST_OWN,
    LEAST_SHARE,
    PER_UNKNOWN,
    Responses,
    Score,
    directions,
    with_tolerances,
)

Array = NDArray[np.float64]

#: Draws of the signs.
DRAWS = 200
#: s; length of a block.
BLOCK = 2.0
#: Share of the draws whose largest improvement lies below the threshold.
QUANTILE = 0.98


def acceptance_threshold(cost: float, by_chance: Array) -> float:
    """Return by how much an effect with one unknown must improve the fit.

    Args:
        cost: minus two log posterior of the model without it.
        by_chance: (draws) of :func:`largest_by_chance`; may be empty.
    """
    return max(LEAST_GAIN, LEAST_SHARE * cost, chance(by_chance) if by_chance.size else 0.0)


def chance(by_chance: Array) -> float:
    """Return what :data:`QUANTILE` of the draws do not exceed; NaN where there are none."""
    return float(np.quantile(by_chance, QUANTILE)) if by_chance.size else math.nan


def largest_by_chance(
    problem: Problem, runs: Sequence[int], fit: Fit, found: Responses, products: Products, scores: Sequence[Score]
) -> Array:
    """Return the largest improvement (:data:`DRAWS`) of any candidate where only the signs of blocks of residuals are random.

    Nothing where there is no candidate. What further unknowns of a candidate cost is taken off, so that all compare with one
    threshold.

    Args:
        problem, runs: what is fitted.
        fit: the model without the candidates.
        found: responses of its numbers and of the candidates' probes.
        products: of both.
        scores: of the candidates, best first.
    """
    if not scores:
        return np.zeros(0)
    left = _left_by(scores[0], fit, found)
    noise = estimate_noise(left, scatter=fit.noise.scatter)
    known = len(found.tight)
    response = np.tensordot(noise.weight, products.gram, 1)
    follow = np.linalg.solve(response[:known, :known] + np.diag(found.tight), response[:known])
    information = response - response[:known].T @ follow  # the calibrated parameters follow each column
    pushes = _block_pushes(problem, runs, left, noise.weight, found)
    drawn = np.random.default_rng(0).choice((-1.0, 1.0), (DRAWS, len(pushes))) @ pushes
    own = drawn - drawn[:, :known] @ follow
    largest = np.zeros(DRAWS)
    for score in scores:
        for start in score.candidate.starts:
            mix = directions(start, found)
            inner = mix @ information @ mix.T + np.diag(LEAST_OWN * np.diag(mix @ response @ mix.T) + 1e-9)
            push = own @ mix.T
            improved = (push * np.linalg.solve(inner, push.T).T).sum(axis=1)
            np.maximum(largest, improved - PER_UNKNOWN * (len(score.candidate.unknowns) - 1), out=largest)
    return largest


def _left_by(best: Score, fit: Fit, found: Responses) -> list[Array]:
    """Residuals (rows, channels) per run that a candidate would leave, to first order: without it they are no noise."""
    mix = directions(best.start, found)
    rows = np.vstack([np.eye(len(found.tight), len(found.push)), mix])
    matrix, gradient = with_tolerances(rows @ found.response @ rows.T, rows @ found.push, found)
    moves = (-np.linalg.solve(matrix, gradient) @ rows).astype(np.float32)
    return [r + (moves @ column).reshape(r.shape) for r, column in zip(fit.residuals, found.columns, strict=True)]


def _block_pushes(problem: Problem, runs: Sequence[int], left: Sequence[Array], weight: Array, found: Responses) -> Array:
    """Weighted products (blocks of all runs, columns) of columns and residuals."""
    blocks = []
    for run, column, residual in zip(runs, found.columns, left, strict=True):
        t = problem.times(run)
        inner = np.linspace(t[0], t[-1], max(1, round(float(t[-1] - t[0]) / BLOCK)) + 1)[1:-1]
        weighted = (np.nan_to_num(residual) * weight).astype(np.float32)
        shaped = column.reshape(len(column), *residual.shape)
        for first, last in itertools.pairwise((0, *np.searchsorted(t, inner).tolist(), len(t))):
            blocks.append(shaped[:, first:last].reshape(len(column), -1) @ weighted[first:last].ravel())
    return np.stack(blocks).astype(np.float64)
