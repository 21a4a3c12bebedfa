"""Smooth sampled signals with gaps and known noise, and get their rates: Kalman filter and Rauch-Tung-Striebel smoother.

The model is a constant acceleration with white jerk; how much jerk is what makes the data most likely. A sample far off what
the others say is left out.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import ArrayLike, NDArray

from wlr_gym.base.compiled import inner_kernel
from wlr_gym.base.errors import InputError

Array = NDArray[np.float64]

#: log10 of the jerk's spectral density, in unit^2/s^5, that are tried.
_DENSITIES = np.arange(-6.0, 8.1, 0.5)
_GATE = 100.0  # squared deviations from the prediction, in its variance
_MOST_REJECTED = 4  # in a row; then the signal has really jumped
#: What white jerk of density 1 adds to the covariance of value, rate and acceleration in 1 s is 1 over these.
_SHARES = np.array([[20.0, 8.0, 6.0], [8.0, 3.0, 2.0], [6.0, 2.0, 1.0]])


@dataclass(frozen=True, eq=False)
class Smoothed:
    """A signal at the requested times.

    Attributes:
        value, rate, acceleration: (K,). value_std, rate_std: 1 sigma.
        outliers: (T,) samples left out.
        density: spectral density of the jerk that was found, unit^2/s^5.
    """

    value: Array
    rate: Array
    acceleration: Array
    value_std: Array
    rate_std: Array
    outliers: NDArray[np.bool_]
    density: float


def smooth(time: ArrayLike, values: ArrayLike, std: ArrayLike | float, at: ArrayLike, jump: float = math.inf) -> Smoothed:
    """Smooth one signal.

    Args:
        time: (T,) s, increasing. values: (T,), NaN = missing. std: (T,) or one number, 1 sigma of the noise.
        at: (K,) s, increasing: where the result is wanted.
        jump: a sample is an outlier only if it is also this far from its prediction.

    Raises:
        InputError: fewer than three samples.
    """
    time, values, at = (np.asarray(x, np.float64) for x in (time, values, at))
    known = np.isfinite(values)
    if known.sum() < 3:
        raise InputError(f"{int(known.sum())} samples; at least 3 are needed to smooth")
    t, z = time[known], values[known]
    variance = np.broadcast_to(np.asarray(std, np.float64), values.shape)[known] ** 2
    middle = z.mean()
    rejected, none, spreads = np.zeros(len(t), np.bool_), np.empty((0, 3)), np.empty((0, 3, 3))
    likelihood = [_filter(t, z - middle, variance, 10.0**q, jump, rejected, none, spreads) for q in _DENSITIES]
    density = 10.0 ** _DENSITIES[int(np.argmax(likelihood))]
    moments = np.concatenate([t, at])  # of samples, then of results
    order = np.argsort(moments, kind="stable")
    moments, places = moments[order], np.argsort(order, kind="stable")
    inputs = np.concatenate([z - middle, np.full(len(at), np.nan)])[order]
    noise = np.concatenate([variance, np.ones(len(at))])[order]
    count = len(moments)
    rejected, states, spreads = np.zeros(count, np.bool_), np.empty((count, 3)), np.empty((count, 3, 3))
    _filter(moments, inputs, noise, density, jump, rejected, states, spreads)
    _smooth_back(moments, density, states, spreads)
    rows, outliers = places[len(t) :], np.zeros(len(time), np.bool_)
    outliers[known] = rejected[places[: len(t)]]
    deviations = np.sqrt(np.maximum(spreads[rows][:, [0, 1], [0, 1]], 0.0))
    value, rate, acceleration = states[rows].T
    return Smoothed(value + middle, rate, acceleration, deviations[:, 0], deviations[:, 1], outliers, density)


@inner_kernel
def _sandwich(matrix: Any, spread: Any, result: Any) -> None:
    """Write ``matrix`` ``spread`` ``matrix``^T, all (3, 3); the result may be in the same array as ``spread``."""
    half = np.empty((3, 3))
    for i in range(3):
        for j in range(3):
            half[i, j] = matrix[i, 0] * spread[0, j] + matrix[i, 1] * spread[1, j] + matrix[i, 2] * spread[2, j]
    for i in range(3):
        for j in range(3):
            result[i, j] = half[i, 0] * matrix[j, 0] + half[i, 1] * matrix[j, 1] + half[i, 2] * matrix[j, 2]


@inner_kernel
def _predict(step: float, density: float, spread: Any, matrix: Any, ahead: Any) -> None:
    """Write the change over a step to ``matrix``, and the covariance after it to ``ahead``, which may be ``spread``."""
    for i in range(3):
        for j in range(3):
            matrix[i, j] = 1.0 if i == j else 0.0
    matrix[0, 1], matrix[1, 2], matrix[0, 2] = step, step, 0.5 * step * step
    _sandwich(matrix, spread, ahead)
    for i in range(3):
        for j in range(3):  # white jerk for the step's time
            ahead[i, j] += density * step ** (5 - i - j) / _SHARES[i, j]


@njit(cache=True, nogil=True)
def _filter(
    time: Any, values: Any, variances: Any, density: float, jump: float, rejected: Any, states: Any, spreads: Any
) -> float:
    """Kalman filter; returns the log likelihood. Filtered states and covariances go to ``states``, ``spreads`` unless empty."""
    matrix, spread, state, gain = np.empty((3, 3)), np.empty((3, 3)), np.empty(3), np.empty(3)
    for k in range(3):
        state[k] = 0.0
        for j in range(3):
            spread[k, j] = (1e4 if k == 0 else 1e2) if k == j else 0.0
    likelihood, in_a_row = 0.0, 0
    for i in range(time.shape[0]):
        if i > 0 and time[i] > time[i - 1]:
            _predict(time[i] - time[i - 1], density, spread, matrix, spread)
            state[0] += matrix[0, 1] * state[1] + matrix[0, 2] * state[2]
            state[1] += matrix[1, 2] * state[2]
        rejected[i] = False
        if not math.isnan(values[i]):
            total = spread[0, 0] + variances[i]
            error = values[i] - state[0]
            if error * error > _GATE * total and abs(error) > jump and in_a_row < _MOST_REJECTED:
                rejected[i] = True
                in_a_row += 1
                likelihood -= 0.5 * (_GATE + math.log(total))
            else:
                in_a_row = 0
                for k in range(3):
                    gain[k] = spread[k, 0] / total
                    state[k] += gain[k] * error
                    for j in range(3):
                        matrix[k, j] = (1.0 if k == j else 0.0) - (gain[k] if j == 0 else 0.0)
                _sandwich(matrix, spread, spread)
                for k in range(3):
                    for j in range(3):
                        spread[k, j] += variances[i] * gain[k] * gain[j]
                likelihood -= 0.5 * (error * error / total + math.log(total))
        if states.shape[0] > 0:
            for k in range(3):
                states[i, k] = state[k]
                for j in range(3):
                    spreads[i, k, j] = spread[k, j]
    return likelihood


@inner_kernel
def _divide(matrix: Any, spread: Any) -> None:
    """Write ``matrix`` ``spread``^-1 to ``matrix``, by columns; ``spread`` is positive definite and used up."""
    for i in range(3):
        for k in range(3):
            if k != i:
                share = spread[i, k] / spread[i, i]
                for j in range(3):
                    spread[j, k] -= share * spread[j, i]
                    matrix[j, k] -= share * matrix[j, i]
    for i in range(3):
        for j in range(3):
            matrix[j, i] /= spread[i, i]


@njit(cache=True, nogil=True)
def _smooth_back(time: Any, density: float, states: Any, spreads: Any) -> None:
    matrix, ahead, gain, change = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3))
    off = np.empty(3)
    for i in range(time.shape[0] - 2, -1, -1):
        state, spread, later, later_spread = states[i], spreads[i], states[i + 1], spreads[i + 1]
        if time[i + 1] == time[i]:
            for k in range(3):
                state[k] = later[k]
                for j in range(3):
                    spread[k, j] = later_spread[k, j]
            continue
        _predict(time[i + 1] - time[i], density, spread, matrix, ahead)
        for k in range(3):
            off[k] = later[k] - (matrix[k, 0] * state[0] + matrix[k, 1] * state[1] + matrix[k, 2] * state[2])
            for j in range(3):
                change[k, j] = later_spread[k, j] - ahead[k, j]
                gain[k, j] = spread[k, 0] * matrix[j, 0] + spread[k, 1] * matrix[j, 1] + spread[k, 2] * matrix[j, 2]
        _divide(gain, ahead)
        _sandwich(gain, change, change)
        for k in range(3):
            state[k] += gain[k, 0] * off[0] + gain[k, 1] * off[1] + gain[k, 2] * off[2]
            for j in range(3):
                spread[k, j] += change[k, j]
