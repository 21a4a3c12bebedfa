"""Weighted least squares: normal equations of columns and residuals, and steps within bounds."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_triangular
from scipy.optimize import lsq_linear

from wlr_gym.base.threads import in_threads
from wlr_gym.gap.estimation.likelihood import Noise
from wlr_gym.gap.estimation.model import FittedModel, prior_tightness, room, scaled_nominal, scaled_numbers
from wlr_gym.gap.problem import Problem

Array = NDArray[np.float64]


def normal_equations(
    columns: Sequence[NDArray[np.float32]], residuals: Sequence[Array], noise: Noise, threads: int = 1
) -> tuple[Array, Array]:
    """Return ``C W C^T`` (numbers, numbers) and ``C W r`` (numbers) over all runs."""
    matrices, vectors = equations_by_run(columns, residuals, noise, threads)
    return matrices.sum(axis=0), vectors.sum(axis=0)


def equations_by_run(
    columns: Sequence[NDArray[np.float32]], residuals: Sequence[Array], noise: Noise, threads: int = 1
) -> tuple[Array, Array]:
    """Return each run's own normal equations: (runs, numbers, numbers) and (runs, numbers).

    Products of one run are sums of single precision, as the columns are.
    """
    root = np.sqrt(noise.weight).astype(np.float32)

    def of_one(run: tuple[NDArray[np.float32], Array]) -> tuple[Array, Array]:
        column, residual = run
        weights = np.broadcast_to(root, residual.shape).ravel()
        weighted = column * weights
        return weighted @ weighted.T, weighted @ (np.nan_to_num(residual).ravel().astype(np.float32) * weights)

    found = in_threads(threads, of_one, zip(columns, residuals, strict=True))
    matrices, vectors = (np.stack(parts).astype(np.float64) for parts in zip(*found, strict=True))
    return matrices, vectors


def by_channel(columns: NDArray[np.float32], channels: int) -> NDArray[np.float32]:
    """Return one run's columns (numbers, rows x channels) as (channels, numbers, rows)."""
    return np.ascontiguousarray(columns.reshape(len(columns), -1, channels).transpose(2, 0, 1))


def channel_products(columns: Sequence[NDArray[np.float32]], channels: int, threads: int = 1) -> Array:
    """Return ``C C^T`` of each channel alone (channels, numbers, numbers), over all runs: weights come later."""

    def of_one(column: NDArray[np.float32]) -> NDArray[np.float32]:
        own = by_channel(column, channels)
        return own @ own.transpose(0, 2, 1)

    return np.stack(in_threads(threads, of_one, columns)).sum(axis=0, dtype=np.float64)


def cross_products(columns: Sequence[NDArray[np.float32]], others: Sequence[Array], noise: Noise) -> Array:
    """Return ``C W D^T`` of known columns with a few others (D: per run (k, rows, channels)), over all runs."""
    total = 0.0
    for column, other in zip(columns, others, strict=True):
        weighted = (np.nan_to_num(other) * noise.weight).reshape(len(other), -1).astype(np.float32)
        total = total + column @ weighted.T
    return np.asarray(total, np.float64)


def gauss_newton_step(
    problem: Problem, model: FittedModel, columns: Sequence[NDArray[np.float32]], residuals: Sequence[Array], noise: Noise
) -> Array:
    """Step (numbers), scaled; numbers that would leave their bounds stay on them and the rest is solved anew."""
    return constrained_step(problem, model, *normal_equations(columns, residuals, noise, problem.threads))


def constrained_step(problem: Problem, model: FittedModel, matrix: Array, vector: Array) -> Array:
    """Return the step that solves these normal equations, tolerances added, within bounds; see :func:`gauss_newton_step`."""
    tight = prior_tightness(problem, model)
    nominal = scaled_nominal(problem, model)
    here = scaled_numbers(problem, model)
    gradient = vector + tight * (here - nominal)
    return bounded_minimum(matrix + np.diag(tight), gradient, *room(problem, model))


def bounded_minimum(matrix: Array, gradient: Array, low: Array, high: Array) -> Array:
    """Return the x within bounds that minimises ``x matrix x / 2 + gradient x``.

    What leaves its bounds is held there and the rest is solved anew. Where something held would rather return, which is rare,
    scipy's bounded least squares solves the whole.
    """
    free = np.ones(len(gradient), bool)
    x = np.zeros(len(gradient))
    while True:
        held = gradient + matrix @ np.where(free, 0.0, x)
        x[free] = -np.linalg.solve(matrix[np.ix_(free, free)], held[free])
        out = free & ((x < low - 1e-12) | (x > high + 1e-12))
        if not out.any():
            break
        x[out] = np.clip(x, low, high)[out]
        free &= ~out
    slope = matrix @ x + gradient
    returns = ~free & np.where(x <= low, slope < 0.0, slope > 0.0) & (low < high)
    return _bounded_least_squares(matrix, gradient, low, high) if returns.any() else np.clip(x, low, high)


def _bounded_least_squares(matrix: Array, gradient: Array, low: Array, high: Array) -> Array:
    """The same as least squares of the matrix's Cholesky factor, every number scaled by its own curvature."""
    movable = low < high
    x = np.where(movable, 0.0, low)
    scale = 1.0 / np.sqrt(np.diag(matrix)[movable])
    inner = matrix[np.ix_(movable, movable)] * np.outer(scale, scale)
    root = np.linalg.cholesky(inner).T
    target = -solve_triangular(root.T, (gradient + matrix @ x)[movable] * scale, lower=True)
    found = lsq_linear(root, target, (low[movable] / scale, high[movable] / scale), method="bvls").x
    x[movable] = np.clip(found * scale, low[movable], high[movable])
    return x


def corrected(columns: NDArray[np.float32], taken: Array, before: Array, after: Array) -> NDArray[np.float32]:
    """Return one run's columns with the least change that predicts what the step ``taken`` (scaled) really did."""
    change = taken.astype(np.float32)
    missed = np.nan_to_num(after - before).ravel() - change @ columns
    return (columns + np.outer(change / (change @ change), missed.astype(np.float32))).astype(np.float32, copy=False)
