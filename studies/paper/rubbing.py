"""Dry friction in the reduced model: the velocities that minimise 1/2 (u - u*)' A (u - u*) + h D(u), one robot at a time.

D sums mu N |s| over wheels (an ellipse) and bound |rate| over gears, each rounded to sqrt(s^2 + creep^2). Reweighting: with the
roots held, the sum is quadratic; solve, take the roots anew, repeat.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

Array = NDArray[np.float64]

#: m/s and rad/s: what sticks may creep at most: 20 um in a test, far below an encoder count at the tread.
CREEP = 1e-6
JOINT_CREEP = 1e-5
_ITERATIONS = 60
_TOLERANCE = 1e-7
#: Velocities of the model; wheels; index of the first joint among the velocities.
_SIZE = 9
_WHEELS = 4
_FIRST_JOINT = 3


@njit(cache=True)
def rub(a: Array, pull: Array, rows: Array, load: Array, mu: Array, dry: Array, start: Array) -> tuple[Array, Array]:
    """Return velocities (N, 9) and impulses of the floor on the wheels (N, 4, 2), along and across.

    Args:
        a: (N, 9, 9) mass matrix with implicit damping. pull: (N, 9) momentum without dry friction.
        rows: (N, 4, 2, 9) slip velocity of every wheel along and across. load: (N, 4) normal impulse, N s.
        mu: (N, 4, 2). dry: (N, 6) friction impulse of the joints, N m s. start: (N, 9) first guess.
    """
    count = len(a)
    velocity, impulse = start.copy(), np.zeros((count, _WHEELS, 2))
    matrix, new, weight = np.empty((_SIZE, _SIZE)), np.empty(_SIZE), np.empty((_WHEELS, 2))
    for n in range(count):
        u = velocity[n]
        for _ in range(_ITERATIONS):
            matrix[:] = a[n]
            for wheel in range(_WHEELS):
                squared = (mu[n, wheel, 0] * CREEP) ** 2 + 1e-30
                for axis in range(2):
                    squared += (mu[n, wheel, axis] * (rows[n, wheel, axis] * u).sum()) ** 2
                for axis in range(2):
                    weight[wheel, axis] = load[n, wheel] * mu[n, wheel, axis] ** 2 / np.sqrt(squared)
                    row = rows[n, wheel, axis]
                    for i in range(_SIZE):
                        for j in range(i + 1):
                            matrix[i, j] += weight[wheel, axis] * row[i] * row[j]
            for joint in range(dry.shape[1]):
                i = _FIRST_JOINT + joint
                matrix[i, i] += dry[n, joint] / np.sqrt(u[i] ** 2 + JOINT_CREEP**2)
            _solve(matrix, pull[n], new)
            change = np.abs(new - u).max()
            u[:] = new
            if change < _TOLERANCE:
                break
        for wheel in range(_WHEELS):
            for axis in range(2):
                impulse[n, wheel, axis] = -weight[wheel, axis] * (rows[n, wheel, axis] * u).sum()
    return velocity, impulse


@njit(cache=True)
def _solve(matrix: Array, right: Array, solution: Array) -> None:
    """Cholesky in the lower triangle of ``matrix``, in place; forward and back substitution."""
    for j in range(_SIZE):
        for k in range(j):
            for i in range(j, _SIZE):
                matrix[i, j] -= matrix[i, k] * matrix[j, k]
        pivot = np.sqrt(matrix[j, j])
        for i in range(j, _SIZE):
            matrix[i, j] /= pivot
    for i in range(_SIZE):
        value = right[i]
        for k in range(i):
            value -= matrix[i, k] * solution[k]
        solution[i] = value / matrix[i, i]
    for i in range(_SIZE - 1, -1, -1):
        value = solution[i]
        for k in range(i + 1, _SIZE):
            value -= matrix[k, i] * solution[k]
        solution[i] = value / matrix[i, i]
