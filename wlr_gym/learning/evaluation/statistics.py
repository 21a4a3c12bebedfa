"""Means and differences with bootstrap confidence intervals over training seeds, blocks of episodes, and episodes."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtri, stdtrit

Array = NDArray[np.float64]

RESAMPLES = 2000
CONFIDENCE = 0.95
#: Share of the training seeds that the interquartile mean leaves out at either end, rounded down to whole seeds.
TRIM = 0.25


@dataclass(frozen=True)
class Estimate:
    """A number with its confidence interval; NaN where the quantity, or its interval, does not exist."""

    mean: float
    low: float
    high: float

    @property
    def excludes_zero(self) -> bool:
        """Whether the whole interval lies on one side of zero."""
        return self.low > 0.0 or self.high < 0.0


def mean(scores: Array) -> Array:
    """Return the mean over training seeds, (R, T) to (R,)."""
    return scores.mean(axis=1)


def interquartile_mean(scores: Array) -> Array:
    """Return the mean over the middle half of the training seeds, (R, T) to (R,); that of all where T is below 4."""
    cut = int(TRIM * scores.shape[1])
    return np.sort(scores, axis=1)[:, cut : scores.shape[1] - cut].mean(axis=1)


def _over(above: Array, below: Array) -> Array:
    """Return quotients (R,); NaN where the first divisor, as measured, is not above 0: the sign would say the opposite."""
    return above / below if below[0] > 0.0 else np.full_like(above, np.nan)


def expansion(seeds: int) -> float:
    """Return by how much resampled means of T training seeds must spread more to give Student's interval; 0 for one seed.

    Resampling few values gives too narrow an interval: the variance lacks T / (T - 1), and normal quantiles stand for those of
    Student's t with T - 1 degrees of freedom (Hesterberg 2015, section 4).
    """
    if seeds < 2:
        return 0.0
    tail = 0.5 * (1.0 + CONFIDENCE)
    return float(np.sqrt(seeds / (seeds - 1.0)) * stdtrit(seeds - 1, tail) / ndtri(tail))


class Bootstrap:
    """Resampling of blocks, of episodes within them (Davison and Hinkley 1997, section 3.8), and of training seeds.

    All subjects play the same episodes and get the same resamples of them, so that differences between them are paired. So do
    all training seeds of a subject: what is particular to an episode does not average out over seeds. Training seeds of one
    subject have nothing to do with those of another: each subject's are resampled by themselves, as blocks of all their
    episodes.

    Args:
        blocks: B, of episodes with their own seeds.
        episodes: N per block.
    """

    def __init__(self, blocks: int, episodes: int) -> None:
        draws = np.random.default_rng(0)
        counts = draws.multinomial(episodes, np.full(episodes, 1.0 / episodes), (RESAMPLES, blocks)).astype(np.float64)
        chosen = draws.integers(0, blocks, (RESAMPLES, blocks))
        weights = np.zeros((RESAMPLES, blocks, episodes))
        for stage in range(blocks):
            weights[np.arange(RESAMPLES), chosen[:, stage]] += counts[:, stage]
        self._weights = weights.reshape(RESAMPLES, -1)

    def scores(self, pairs: Array, quantile: float | None = None) -> Array:
        """Return each training seed's metric (RESAMPLES + 1, T) of numerators and denominators (T, B, N, 2).

        The first row is as measured, the others with resampled episodes. ``quantile``: of the episodes, in place of their mean.
        """
        flat = pairs.reshape(-1, self._weights.shape[1], 2)
        if quantile is not None:
            return self._quantiles(flat, quantile)
        columns = flat.transpose(1, 0, 2).reshape(self._weights.shape[1], -1)
        sums = np.concatenate([columns.sum(axis=0, keepdims=True), self._weights @ columns]).reshape(-1, len(flat), 2)
        above, below = sums[:, :, 0], sums[:, :, 1]
        return np.divide(above, below, out=np.full(above.shape, np.nan), where=below > 0)

    def _quantiles(self, flat: Array, quantile: float) -> Array:
        """Return the smallest values (RESAMPLES + 1, T) that the share ``quantile`` of the episodes does not exceed."""
        weights = np.concatenate([np.ones((1, flat.shape[1])), self._weights])
        found = []
        for own in flat:
            values = np.divide(own[:, 0], own[:, 1], out=np.full(len(own), np.nan), where=own[:, 1] > 0)
            order = np.argsort(values)
            reached = np.cumsum(weights[:, order] * (own[order, 1] > 0), axis=1)
            found.append(values[order][np.argmax(reached >= quantile * reached[:, -1:] - 1e-9, axis=1)])
        return np.stack(found, axis=1)

    def estimate(
        self,
        function: Callable[..., Array],
        *pairs: Array,
        subjects: Sequence[int] | None = None,
        over_seeds: Callable[[Array], Array] = mean,
        quantile: float | None = None,
    ) -> Estimate:
        """Return ``function`` of metrics with its interval.

        Args:
            function: of as many metrics, each (RESAMPLES + 1,), as there are ``pairs``.
            pairs: numerators and denominators (T, B, N, 2), or (B, N, 2) of one training seed; T may differ.
            subjects: number of the subject that each belongs to; None = all different ones.
            over_seeds: makes one score of those of a subject's training seeds.
            quantile: of the episodes, in place of their mean.
        """
        numbers = range(len(pairs)) if subjects is None else subjects
        drawn = [self._draw(pair, number, over_seeds, quantile) for pair, number in zip(pairs, numbers, strict=True)]
        by_episodes, by_both, seeds = zip(*drawn, strict=True)
        factor = expansion(min((count for count in seeds if count > 1), default=1))
        with np.errstate(divide="ignore", invalid="ignore"):
            values = function(*by_episodes)
            values = values + factor * (function(*by_both) - values)
        if not np.isfinite(values[0]):
            return Estimate(np.nan, np.nan, np.nan)
        if not factor and self._weights.shape[1] == 1:  # one episode of one training says nothing of others
            return Estimate(float(values[0]), np.nan, np.nan)
        tail = 50.0 * (1.0 - CONFIDENCE)
        low, high = np.nanpercentile(np.where(np.isfinite(values), values, np.nan)[1:], (tail, 100.0 - tail))
        return Estimate(float(values[0]), float(low), float(high))

    def _draw(
        self, pairs: Array, subject: int, over_seeds: Callable[[Array], Array], quantile: float | None
    ) -> tuple[Array, Array, int]:
        """Return a metric (RESAMPLES + 1,), as measured first: resampled in its episodes, in its seeds too; how many seeds."""
        scores = self.scores(pairs, quantile)
        seeds = scores.shape[1]
        chosen = np.random.default_rng([subject, seeds]).integers(0, seeds, (RESAMPLES, seeds))
        chosen = np.concatenate([np.arange(seeds)[None], chosen])
        return over_seeds(scores), over_seeds(np.take_along_axis(scores, chosen, axis=1)), seeds

    def mean(self, pairs: Array, quantile: float | None = None) -> Estimate:
        """Return the metric itself, mean over training seeds."""
        return self.estimate(lambda value: value, pairs, quantile=quantile)

    def interquartile_mean(self, pairs: Array, quantile: float | None = None) -> Estimate:
        """Return the metric itself, interquartile mean over training seeds (Agarwal et al. 2021)."""
        return self.estimate(lambda value: value, pairs, over_seeds=interquartile_mean, quantile=quantile)

    def difference(self, ours: Array, theirs: Array) -> Estimate:
        """Return ours - theirs."""
        return self.estimate(lambda a, b: a - b, ours, theirs)

    def reduction(self, ours: Array, theirs: Array, quantile: float | None = None) -> Estimate:
        """Return by how much ours is smaller than theirs, in % of theirs."""
        return self.estimate(lambda a, b: 100.0 * (1.0 - _over(a, b)), ours, theirs, quantile=quantile)

    def share(self, ours: Array, theirs: Array, our_zero: Array, their_zero: Array, *, subjects: Sequence[int]) -> Estimate:
        """Return ours in % of theirs, each above its own zero; ``subjects`` as for :meth:`estimate`."""
        return self.estimate(
            lambda a, b, zero_a, zero_b: 100.0 * _over(a - zero_a, b - zero_b),
            ours, theirs, our_zero, their_zero, subjects=subjects,
        )  # fmt: skip
