"""How probable residuals are: each channel has a level of its own, and autocorrelated residuals.

A simulator is never exact, and its errors last for several rows. A channel of n rows whose residuals have an integrated
autocorrelation time of tau rows is worth n/tau independent ones; its level s (in units of the sensor's noise, never below 1) is
estimated. Up to a constant, minus twice the logarithm of the likelihood is then ``sum over channels of n/tau log s^2``. The
same tau serves all models that are compared: likelihoods with different tau are not comparable.

The errors of a simulator also differ from run to run: each run on its own would move the model's numbers farther than its
rows predict (three to six times, in squares, between two simulators of one robot). All autocorrelation times are multiplied
by this factor, found by :func:`run_scatter`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

Array = NDArray[np.float64]

#: Rows: the longest lag of an autocorrelation.
LONGEST = 100
#: Rows: runs that measured a channel no more often say nothing about its autocorrelation.
LEAST_SERIES = 8


@dataclass(frozen=True, eq=False)
class Noise:
    """Level and integrated autocorrelation time of every channel's residuals.

    Attributes:
        square: (channels) mean square in units of sensor noise.
        autocorrelation_time: (channels) integrated, in rows, at least 1, times ``scatter``.
        rows: (channels) how many were measured.
        scatter: of the runs' estimates of the model's numbers, in squares, over what their rows predict.
    """

    square: Array
    autocorrelation_time: Array
    rows: Array
    scatter: float = 1.0

    @property
    def level(self) -> Array:
        """Root mean square (channels), at least 1."""
        return np.sqrt(np.maximum(self.square, 1.0))

    @property
    def weight(self) -> Array:
        """Weight (channels) of a squared residual in the sum that fits minimise."""
        return np.where(self.rows > 0, 1.0 / (self.level**2 * self.autocorrelation_time), 0.0)


def estimate_noise(residuals: Sequence[Array], autocorrelation_time: Array | None = None, scatter: float = 1.0) -> Noise:
    """Return level and autocorrelation time of residuals, one (rows, channels) array per run.

    Args:
        residuals: noise units, NaN where not measured.
        autocorrelation_time: (channels) of another model that this one is compared with; None = estimated.
        scatter: of the runs; see :class:`Noise`.
    """
    total = np.sum([np.nansum(r * r, axis=0) for r in residuals], axis=0)
    rows = np.sum([np.isfinite(r).sum(axis=0) for r in residuals], axis=0)
    return Noise(
        total / np.maximum(rows, 1),
        scatter * autocorrelation_times(residuals) if autocorrelation_time is None else autocorrelation_time,
        rows,
        scatter,
    )


def minus_two_log_likelihood(residuals: Sequence[Array], autocorrelation_time: Array) -> float:
    """Return ``sum n/tau log s^2`` over the channels of all runs together; below the sensor's own noise s^2 itself counts."""
    noise = estimate_noise(residuals, autocorrelation_time)
    return float(np.sum(noise.rows / autocorrelation_time * channel_costs(noise.square)))


def channel_costs(square: Array) -> Array:
    """Return minus two log likelihood per independent row (channels) of mean squares in units of sensor noise."""
    return np.log(np.maximum(square, 1.0)) + np.minimum(square, 1.0) - 1.0


def run_scatter(matrices: Array, vectors: Array) -> float | None:
    """Return how many times more than expected the runs differ in where they pull the numbers.

    The runs' gradients at their common best fit should scatter as their curvature says (White's information equality); the mean
    ratio over the directions that the data are informative about; None where there is none.

    Args:
        matrices, vectors: (runs, numbers, numbers), (runs, numbers) normal equations of each run.
    """
    runs = len(vectors)
    if runs < 2:
        return None
    curvature, directions = np.linalg.eigh(matrices.sum(axis=0))
    pulls = (vectors - vectors.mean(axis=0)) @ directions
    known = curvature > 1.0
    if not known.any():
        return None
    ratio = (pulls**2).sum(axis=0)[known] * runs / (runs - 1) / curvature[known]
    return float(ratio.mean())


def autocorrelation_times(residuals: Sequence[Array]) -> Array:
    """Integrated autocorrelation (channels) in rows: summed until it first falls below 0.05, over measured rows only."""
    return series_times([residual.T for residual in residuals])


def series_times(series: Sequence[Array]) -> Array:
    """The same of residuals (channels, rows)."""
    edges = np.cumsum([0, *(part.shape[1] for part in series)])
    return _integrated(np.concatenate(series, axis=1, dtype=np.float64), edges, LONGEST)


@njit(cache=True, nogil=True, fastmath={"reassoc"})
def _lagged(values: Any, first: Any, last: Any, lag: Any) -> Any:
    """Sum of products of values a lag apart, side by side in vector registers."""
    late, early = values[first:last], values[first - lag : last - lag]
    total = 0.0
    for k in range(len(late)):
        total += late[k] * early[k]
    return total


@njit(cache=True, nogil=True)
def _integrated(series: Any, edges: Any, longest: Any) -> Any:
    """Integrated autocorrelation (channels) of series (channels, rows) of several runs that begin at ``edges``."""
    channels = len(series)
    found = np.ones(channels)
    values = np.zeros(series.shape[1])
    ends = np.zeros(len(edges), np.int64)
    for c in range(channels):
        count, runs = 0, 0
        for r in range(len(edges) - 1):
            first = count
            for row in range(edges[r], edges[r + 1]):
                if np.isfinite(series[c, row]):
                    values[count] = series[c, row]
                    count += 1
            if count - first > LEAST_SERIES:
                runs += 1
                ends[runs] = count
            else:
                count = first
        power = _lagged(values, 0, count, 0)
        if power <= 0.0:
            continue
        for lag in range(1, longest):
            product = 0.0
            for r in range(runs):
                product += _lagged(values, ends[r] + lag, ends[r + 1], lag)
            rho = product / power
            if rho < 0.05:
                break
            found[c] += 2.0 * rho
    return found


def mean_squares(residuals: Sequence[Array], cap: float) -> Array:
    """Return the mean square (runs, channels) of residuals, one (rows, channels) array per run; NaN where not measured.

    Residuals beyond ``cap`` count as that: one lost wheel must not dominate.
    """
    with np.errstate(invalid="ignore"):
        squares = [np.nansum(np.minimum(r * r, cap**2), axis=0) / np.isfinite(r).sum(axis=0) for r in residuals]
    return np.stack(squares)


def mean_of_runs(squares: Array) -> Array:
    """Return the mean over runs (channels) of mean squares; NaN where no run measured a channel."""
    measured = np.isfinite(squares).sum(axis=0)
    return np.where(measured > 0, np.nansum(squares, axis=0) / np.maximum(measured, 1), np.nan)


def level(squares: Array) -> float:
    """Return the root mean over channels (and runs) of mean squares."""
    return float(np.sqrt(np.nanmean(squares)))
