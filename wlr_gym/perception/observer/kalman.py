"""Kalman filter of one horizontal direction: position, velocity, leak of the accelerometer, error of the flow sensor.

x = (p, v, l, e): p' = v; v' = a - l with the measured acceleration a; l, what leaks into the accelerometer (bias, and
gravity on a slope that is not known), a random walk; e, ahead the scale of the optical flow less 1, to the side its
rotation. Covariances only: the means live in frames that turn, see ``prediction.py``.
"""

from __future__ import annotations

from typing import Any

from numba import njit

# Where the state's elements stand; the position is first.
VELOCITY = 1
LEAK = 2
LENS = 3
#: Number of elements.
SIZE = 4


@njit(cache=True, nogil=True)
def predict(p: Any, step: float, velocity_noise: float, leak_noise: float) -> None:
    """P = F P F' + diag(0, velocity_noise, leak_noise, 0) over ``step`` s; ``p`` (4, 4) is changed."""
    half = 0.5 * step * step
    for k in range(SIZE):
        p[0, k] += step * p[1, k] - half * p[2, k]
        p[1, k] -= step * p[2, k]
    for k in range(SIZE):
        p[k, 0] += step * p[k, 1] - half * p[k, 2]
        p[k, 1] -= step * p[k, 2]
    p[VELOCITY, VELOCITY] += velocity_noise
    p[LEAK, LEAK] += leak_noise


@njit(cache=True, nogil=True)
def see_velocity(p: Any, age: float, flow: float, column: Any) -> float:
    """Put P h' of the measurement of the velocity ``age`` s ago less e ``flow`` into ``column`` (4,); return h P h'.

    ``flow``: m/s, that the flow sensor measures; 0 = the wheels measure.
    """
    for k in range(SIZE):
        column[k] = p[k, VELOCITY] + age * p[k, LEAK] - flow * p[k, LENS]
    return column[VELOCITY] + age * column[LEAK] - flow * column[LENS]


@njit(cache=True, nogil=True)
def see_position(p: Any, age: float, column: Any) -> float:
    """Put P h' of the measurement of the position ``age`` s ago into ``column`` (4,); return h P h'."""
    half = 0.5 * age * age
    for k in range(SIZE):
        column[k] = p[k, 0] - age * p[k, VELOCITY] - half * p[k, LEAK]
    return column[0] - age * column[VELOCITY] - half * column[LEAK]


@njit(cache=True, nogil=True)
def correct(p: Any, column: Any, innovation: float, total: float, change: Any) -> None:
    """Take in a measurement that came out ``innovation`` above its prediction.

    Args:
        p: covariance (4, 4), changed; it stays symmetric and positive.
        column: (4,) P h'.
        total: variance of the innovation, h P h' and the measurement's own.
        change: (4,) becomes what the state changes.
    """
    share = 1.0 / total
    for j in range(SIZE):
        gain = column[j] * share
        change[j] = gain * innovation
        for k in range(j + 1):
            value = p[j, k] - gain * column[k]
            p[j, k] = value
            p[k, j] = value
