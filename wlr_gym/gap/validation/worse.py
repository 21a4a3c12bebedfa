"""Which channels do the effects make worse? A patch may reduce the error of all channels together and still harm one."""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from wlr_gym.gap.problem import Problem

Array = NDArray[np.float64]

#: s; length of a block.
BLOCK = 2.0
#: Bootstrap samples of the blocks.
SAMPLES = 2000
#: Share by which a channel's mean square must rise.
LEAST_RISE = 0.02
#: Share of the samples in which it must rise.
CONFIDENCE = 0.99


def worse_channels(
    problem: Problem, runs: Sequence[int], calibrated: Sequence[Array], after: Sequence[Array]
) -> NDArray[np.bool_]:
    """Return which channels (signals) the effects make significantly worse in these runs.

    The mean square rises by more than :data:`LEAST_RISE`, and rises in :data:`CONFIDENCE` of the samples of blocks of 2 s,
    drawn with replacement: residuals within a block depend on each other.

    Args:
        problem: the system.
        runs: whose residuals these are: the held-out ones.
        calibrated, after: residuals (rows, signals) per run without and with the effects.
    """
    before = np.concatenate([_block_squares(problem, r, e) for r, e in zip(runs, calibrated, strict=True)])
    rise = np.concatenate([_block_squares(problem, r, e) for r, e in zip(runs, after, strict=True)]) - before
    picks = np.random.default_rng(0).integers(0, len(rise), (SAMPLES, len(rise)))
    counts = np.stack([np.bincount(pick, minlength=len(rise)) for pick in picks])
    certain = np.quantile(counts @ rise, 1.0 - CONFIDENCE, axis=0) > 0.0
    return certain & (rise.sum(axis=0) > LEAST_RISE * before.sum(axis=0))


def _block_squares(problem: Problem, run: int, residual: Array) -> Array:
    """Sums of squares (blocks, signals) of one run; what is beyond the problem's cap counts as that."""
    t = problem.times(run)
    inner = np.linspace(t[0], t[-1], max(1, round(float(t[-1] - t[0]) / BLOCK)) + 1)[1:-1]
    squares = np.nan_to_num(np.minimum(residual**2, problem.cap**2))
    edges = (0, *np.searchsorted(t, inner).tolist(), len(t))
    return np.stack([squares[first:last].sum(axis=0) for first, last in itertools.pairwise(edges)])
