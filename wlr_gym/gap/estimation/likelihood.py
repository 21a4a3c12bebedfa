"""How probable residuals are: each channel has a level of its own, and neighbouring rows say much the same.

A simulator is never right to the last digit, and what it gets wrong lasts for several rows. A channel of n rows whose errors
last for tau rows is worth n/tau independent ones; its level s (in units of the sensor's noise, never below 1) is estimated.
Up to a constant, minus twice the logarithm of the likelihood is then ``sum over channels of n/tau log s^2``. The same tau
serves all models that are compared: who whitens each with its own compares nothing.

What a simulator gets wrong also differs from run to run: each run on its own would move the model's numbers farther than its
rows promise (three to six times, in squares, between two simulators of one robot). By this factor, found by
:func:`run_scatter`, all memories are longer.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

#: Rows; longer memory than this is not looked for.
LONGEST = 100


@dataclass(frozen=True, eq=False)
class Noise:
    """Level and memory of every channel's residuals.

    Attributes:
        square: (channels) mean square in units of sensor noise.
        memory: (channels) rows that say the same, at least 1, times ``scatter``.
        rows: (channels) how many were measured.
        scatter: how many times more than the rows promise the runs differ in what they say of the model's numbers.
    """

    square: Array
    memory: Array
    rows: Array
    scatter: float = 1.0

    @property
    def level(self) -> Array:
        """Root mean square (channels), at least 1."""
        return np.sqrt(np.maximum(self.square, 1.0))

    @property
    def weight(self) -> Array:
        """Weight (channels) of a squared residual in the sum that fits minimise."""
        return np.where(self.rows > 0, 1.0 / (self.level**2 * self.memory), 0.0)


def estimate_noise(residuals: Sequence[Array], memory: Array | None = None, scatter: float = 1.0) -> Noise:
    """Return level and memory of residuals, one (rows, channels) array per run; ``memory`` keeps one known before."""
    total = np.sum([np.nansum(r * r, axis=0) for r in residuals], axis=0)
    rows = np.sum([np.isfinite(r).sum(axis=0) for r in residuals], axis=0)
    return Noise(total / np.maximum(rows, 1), scatter * _memory(residuals) if memory is None else memory, rows, scatter)


def minus_two_log_likelihood(residuals: Sequence[Array], memory: Array) -> float:
    """Return ``sum n/tau log s^2`` over the channels of all runs together; below the sensor's own noise s^2 itself counts."""
    noise = estimate_noise(residuals, memory)
    return float(np.sum(noise.rows / memory * (np.log(noise.level**2) + np.minimum(noise.square, 1.0) - 1.0)))


def run_scatter(matrices: Array, vectors: Array) -> float | None:
    """Return how many times more than expected the runs differ in where they pull the numbers.

    The runs' gradients at their common best fit should scatter as their curvature says (White's information equality); the mean
    ratio over the directions that the data tell something of; None where they tell nothing.

    Args:
        matrices, vectors: (runs, numbers, numbers), (runs, numbers) normal equations of each run.
    """
    runs = len(vectors)
    if runs < 2:
        return None
    told, directions = np.linalg.eigh(matrices.sum(axis=0))
    pulls = (vectors - vectors.mean(axis=0)) @ directions
    known = told > 1.0
    if not known.any():
        return None
    ratio = (pulls**2).sum(axis=0)[known] * runs / (runs - 1) / told[known]
    return float(ratio.mean())


def _memory(residuals: Sequence[Array]) -> Array:
    """Integrated autocorrelation (channels) in rows: summed until it first falls below 0.05, over measured rows only."""
    channels = residuals[0].shape[1]
    memory = np.ones(channels)
    for c in range(channels):
        series = [r[np.isfinite(r[:, c]), c] for r in residuals]
        series = [s for s in series if len(s) > 8]
        power = sum(float(s @ s) for s in series)
        if power <= 0.0:
            continue
        for lag in range(1, LONGEST):
            rho = sum(float(s[lag:] @ s[:-lag]) for s in series if len(s) > lag) / power
            if rho < 0.05:
                break
            memory[c] += 2.0 * rho
    return memory
