"""Kalman filter of one horizontal direction: position, velocity, leak of the accelerometer, slip of four wheels.

x = (p, v, l, c_1 .. c_4): p' = v; v' = a - l with the measured acceleration a; l, what leaks into the accelerometer (bias, and
gravity on a slope that is not known), a random walk; c_i, by how much wheel i rolls faster than the body moves, first-order
Gauss-Markov. Covariances only: the means live in frames that turn, see ``prediction.py``.
"""

from __future__ import annotations

from typing import Any

from numba import njit

# Where the state's elements stand; the position is first.
VELOCITY = 1
LEAK = 2
SLIP = 3
#: Number of elements.
SIZE = 7


@njit(cache=True, nogil=True)
def predict(p: Any, step: float, decay: Any, noise: Any) -> None:
    """P = F P F' + diag(noise) over ``step`` s.

    Args:
        p: covariance (7, 7), changed.
        decay: (4,) factors on the c_i.
        noise: (7,) variances added.
    """
    half = 0.5 * step * step
    for k in range(SIZE):
        p[0, k] += step * p[1, k] - half * p[2, k]
        p[1, k] -= step * p[2, k]
    for k in range(SIZE):
        p[k, 0] += step * p[k, 1] - half * p[k, 2]
        p[k, 1] -= step * p[k, 2]
    for i in range(4):
        for k in range(SIZE):
            p[SLIP + i, k] *= decay[i]
        for k in range(SIZE):
            p[k, SLIP + i] *= decay[i]
    for k in range(SIZE):
        p[k, k] += noise[k]


@njit(cache=True, nogil=True)
def see_wheel(p: Any, i: int, column: Any) -> float:
    """Put P h' of the measurement v + c_i into ``column`` (7,); return h P h'."""
    for k in range(SIZE):
        column[k] = p[k, VELOCITY] + p[k, SLIP + i]
    return column[VELOCITY] + column[SLIP + i]


@njit(cache=True, nogil=True)
def see_balance(p: Any, weights: Any, column: Any) -> float:
    """Put P h' of the measurement sum weights_i c_i into ``column`` (7,); return h P h'."""
    for k in range(SIZE):
        column[k] = 0.0
        for i in range(4):
            column[k] += weights[i] * p[k, SLIP + i]
    total = 0.0
    for i in range(4):
        total += weights[i] * column[SLIP + i]
    return total


@njit(cache=True, nogil=True)
def see_position(p: Any, age: float, column: Any) -> float:
    """Put P h' of the measurement of the position ``age`` s ago into ``column`` (7,); return h P h'."""
    half = 0.5 * age * age
    for k in range(SIZE):
        column[k] = p[k, 0] - age * p[k, VELOCITY] - half * p[k, LEAK]
    return column[0] - age * column[VELOCITY] - half * column[LEAK]


@njit(cache=True, nogil=True)
def correct(p: Any, column: Any, innovation: float, total: float, change: Any) -> None:
    """Take in a measurement that came out ``innovation`` above its prediction.

    Args:
        p: covariance (7, 7), changed; it stays symmetric and positive.
        column: (7,) P h'.
        total: variance of the innovation, h P h' and the measurement's own.
        change: (7,) is increased by what the state changes.
    """
    share = 1.0 / total
    for j in range(SIZE):
        gain = column[j] * share
        change[j] += gain * innovation
        for k in range(j + 1):
            value = p[j, k] - gain * column[k]
            p[j, k] = value
            p[k, j] = value
