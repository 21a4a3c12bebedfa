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
_OUTLYING = 100.0  # squared deviations from the prediction, in its variance
_MOST_REJECTED = 4  # in a row; then the signal has really jumped
#: What white jerk of density 1 adds to the covariance of value, rate and acceleration: these times these powers of the time.
_SHARES = 1 / np.array([[20.0, 8.0, 6.0], [8.0, 3.0, 2.0], [6.0, 2.0, 1.0]])
_POWERS = np.array([[5, 4, 3], [4, 3, 2], [3, 2, 1]])


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
def _predict(step: float, density: float, spread: Any) -> None:
    """Carry a covariance (3, 3) over a step of constant acceleration with white jerk of that density."""
    half = 0.5 * step * step
    for j in range(3):
        spread[0, j] += step * spread[1, j] + half * spread[2, j]
        spread[1, j] += step * spread[2, j]
    for i in range(3):
        spread[i, 0] += step * spread[i, 1] + half * spread[i, 2]
        spread[i, 1] += step * spread[i, 2]
    for i in range(3):
        for j in range(3):
            spread[i, j] += density * _SHARES[i, j] * step ** _POWERS[i, j]


@njit(cache=True, nogil=True)
def _filter(
    time: Any, values: Any, variances: Any, density: float, jump: float, rejected: Any, states: Any, spreads: Any
) -> float:
    """Kalman filter; returns the log likelihood. Filtered states and covariances go to ``states``, ``spreads`` unless empty."""
    spread, half, state, gain = np.zeros((3, 3)), np.empty((3, 3)), np.zeros(3), np.empty(3)
    spread[0, 0], spread[1, 1], spread[2, 2] = 1e4, 1e2, 1e2
    likelihood, in_a_row = 0.0, 0
    for i in range(time.shape[0]):
        if i > 0 and time[i] > time[i - 1]:
            step = time[i] - time[i - 1]
            _predict(step, density, spread)
            state[0] += step * state[1] + 0.5 * step * step * state[2]
            state[1] += step * state[2]
        rejected[i] = False
        if not math.isnan(values[i]):
            total = spread[0, 0] + variances[i]
            error = values[i] - state[0]
            if error * error > _OUTLYING * total and abs(error) > jump and in_a_row < _MOST_REJECTED:
                rejected[i] = True
                in_a_row += 1
                likelihood -= 0.5 * (_OUTLYING + math.log(total))
            else:
                in_a_row = 0
                for k in range(3):  # Joseph's form: it stays positive however sure a sample is
                    gain[k] = spread[k, 0] / total
                    state[k] += gain[k] * error
                    for j in range(3):
                        half[k, j] = spread[k, j] - gain[k] * spread[0, j]
                for k in range(3):
                    for j in range(3):
                        spread[k, j] = half[k, j] - half[k, 0] * gain[j] + variances[i] * gain[k] * gain[j]
                likelihood -= 0.5 * (error * error / total + math.log(total))
        if states.shape[0] > 0:
            for k in range(3):
                states[i, k] = state[k]
                for j in range(3):
                    spreads[i, k, j] = spread[k, j]
    return likelihood


def _smooth_back(time: Array, density: float, states: Array, spreads: Array) -> None:
    """Rauch, Tung and Striebel: let filtered states (N, 3) and covariances hear of all later ones."""
    step, before = np.diff(time)[:, None, None], spreads[:-1]
    matrix = np.eye(3) + step * np.eye(3, k=1) + 0.5 * step**2 * np.eye(3, k=2)
    ahead = matrix @ before @ matrix.transpose(0, 2, 1) + density * _SHARES * step**_POWERS
    gain = np.linalg.solve(np.where(step > 0, ahead, np.eye(3)), matrix @ before).transpose(0, 2, 1)
    gain = np.where(step > 0, gain, np.eye(3))
    states[:-1] -= (gain @ matrix @ states[:-1, :, None])[..., 0]
    spreads[:-1] -= gain @ ahead @ gain.transpose(0, 2, 1)
    _add_later(gain, states, spreads)


@njit(cache=True, nogil=True)
def _add_later(gain: Any, states: Any, spreads: Any) -> None:
    half = np.empty((3, 3))
    for n in range(gain.shape[0] - 1, -1, -1):
        g, later = gain[n], spreads[n + 1]
        for i in range(3):
            for j in range(3):
                states[n, i] += g[i, j] * states[n + 1, j]
                half[i, j] = g[i, 0] * later[0, j] + g[i, 1] * later[1, j] + g[i, 2] * later[2, j]
        for i in range(3):
            for j in range(3):
                spreads[n, i, j] += half[i, 0] * g[j, 0] + half[i, 1] * g[j, 1] + half[i, 2] * g[j, 2]
