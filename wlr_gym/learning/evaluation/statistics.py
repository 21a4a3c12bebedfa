"""Means and differences with bootstrap confidence intervals over seeds and episodes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

RESAMPLES = 2000
CONFIDENCE = 0.95


@dataclass(frozen=True)
class Estimate:
    """A number with its confidence interval; NaN where the quantity does not exist."""

    mean: float
    low: float
    high: float

    @property
    def excludes_zero(self) -> bool:
        """Whether the whole interval lies on one side of zero."""
        return self.low > 0.0 or self.high < 0.0


class Bootstrap:
    """Resampling in two stages: seeds with replacement, then episodes within each (Davison and Hinkley 1997, section 3.8).

    All subjects play the same episodes and get the same resamples, so that differences between them are paired.

    Args:
        seeds: S, blocks of episodes with their own seeds.
        episodes: N per block.
    """

    def __init__(self, seeds: int, episodes: int) -> None:
        draws = np.random.default_rng(0)
        counts = draws.multinomial(episodes, np.full(episodes, 1.0 / episodes), (RESAMPLES, seeds)).astype(np.float64)
        chosen = draws.integers(0, seeds, (RESAMPLES, seeds))
        weights = np.zeros((RESAMPLES, seeds, episodes))
        for stage in range(seeds):
            weights[np.arange(RESAMPLES), chosen[:, stage]] += counts[:, stage]
        self._weights = weights.reshape(RESAMPLES, -1)

    def draws(self, pairs: Array) -> Array:
        """Return the metric (RESAMPLES + 1,) of numerators and denominators (S, N, 2): as measured, then resampled."""
        flat = pairs.reshape(-1, 2)
        sums = np.concatenate([flat.sum(axis=0, keepdims=True), self._weights @ flat])
        return np.divide(sums[:, 0], sums[:, 1], out=np.full(len(sums), np.nan), where=sums[:, 1] > 0)

    def estimate(self, function: Callable[..., Array], *pairs: Array) -> Estimate:
        """Return ``function`` of the metrics of ``pairs`` with its interval."""
        with np.errstate(divide="ignore", invalid="ignore"):
            values = function(*(self.draws(pair) for pair in pairs))
        if not np.isfinite(values[0]):
            return Estimate(np.nan, np.nan, np.nan)
        tail = 50.0 * (1.0 - CONFIDENCE)
        low, high = np.nanpercentile(np.where(np.isfinite(values), values, np.nan)[1:], (tail, 100.0 - tail))
        return Estimate(float(values[0]), float(low), float(high))

    def mean(self, pairs: Array) -> Estimate:
        """Return the metric itself."""
        return self.estimate(lambda value: value, pairs)

    def difference(self, ours: Array, theirs: Array) -> Estimate:
        """Return ours - theirs."""
        return self.estimate(lambda a, b: a - b, ours, theirs)

    def reduction(self, ours: Array, theirs: Array) -> Estimate:
        """Return by how much ours is smaller than theirs, in % of theirs."""
        return self.estimate(lambda a, b: 100.0 * (1.0 - a / b), ours, theirs)

    def share(self, ours: Array, theirs: Array, our_zero: Array, their_zero: Array) -> Estimate:
        """Return ours in % of theirs, each above its own zero."""
        return self.estimate(
            lambda a, b, zero_a, zero_b: 100.0 * (a - zero_a) / (b - zero_b), ours, theirs, our_zero, their_zero
        )
