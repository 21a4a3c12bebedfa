"""Fit a model to runs: quantities within their tolerances, and the unknowns of the effects it has.

Maximum a posteriori by Gauss-Newton steps: residuals weighted by level and autocorrelation
(:mod:`wlr_gym.gap.estimation.model`), quantities drawn to their nominal values by their tolerances, unknowns of effects
free within their plausible range. All columns of a step are simulated as one batch; between two simulations of them they are
corrected by what each step really changed (Broyden's secant update), which costs nothing and keeps steps from creeping.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_triangular
from scipy.optimize import lsq_linear

from wlr_gym.base.jobs import in_threads
from wlr_gym.gap.estimation.model import (
    FittedModel,
    Noise,
    autocorrelation_times,
    estimate_noise,
    moved,
    on_bounds,
    prior_tightness,
    room,
    run_scatter,
    scaled_nominal,
    scaled_numbers,
    tightness_once,
    total_cost,
)
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


# ---- the fit ---------------------------------------------------------------------------------------------------------

#: Step of finite differences in a quantity, in tolerances.
STEP = 0.5
#: Times that the noise follows the numbers before a descent.
ROUNDS = 2
#: Shares of a step that are tried; the best is used.
SHARES = (2.0, 1.0, 0.5, 0.2, 0.05)
#: Steps that are taken before the columns are simulated anew.
CHORDS = 10
#: Sticking friction makes the cost rough on this scale: RELAXATIONS full steps are taken in the end if it rises by no more.
ROUGH = 3.0
RELAXATIONS = 2
#: Stiffness, in tolerances, that holds a number on its bound.
PINNED = 1e9
#: A step that gains less than this (in minus two log posterior) is the last with its columns.
CONVERGED = 0.5
#: New columns that gain less than this are the last of a fit.
RENEWED = 2.0
#: A number whose information in the data is below this share of that in its tolerance hardly moves: its first columns suffice.
IDLE = 1.0


@dataclass(frozen=True, eq=False)
class Fit:
    """A fitted model.

    Attributes:
        model: the best found.
        residuals: of it, one (rows, channels) per run.
        noise: of these residuals.
        cost: minus two log posterior, up to a constant that is the same for all models with the same ``autocorrelation_time``.
        columns: one (numbers, rows x channels) array per run: change of the residuals per scaled number (quantities in
            tolerances, unknowns in their steps), at or near the best model; unweighted, NaN as 0.
        hessian: (numbers, numbers) of half the cost, scaled numbers, tolerances included; numbers on their bounds are pinned.
        precision: (numbers, numbers) inverse covariance of the scaled numbers, tolerances counted once.
        converged: whether new columns would hardly lead any further.
    """

    model: FittedModel
    residuals: list[Array]
    noise: Noise
    cost: float
    columns: list[NDArray[np.float32]] = field(repr=False)
    hessian: Array = field(repr=False)
    precision: Array = field(repr=False)
    converged: bool = False

    def covariance(self) -> Array:
        """Covariance (numbers, numbers) of the scaled numbers: the likelihood tempered, tolerances counted once."""
        return np.asarray(np.linalg.inv(self.precision), np.float64)


def cheapest(problem: Problem, fits: Sequence[Fit], autocorrelation_time: Array) -> Fit:
    """Return the fit with the lowest cost under one autocorrelation time: otherwise costs are not comparable."""
    return min(fits, key=lambda whole: total_cost(problem, whole.model, whole.residuals, autocorrelation_time))


def linearise(
    problem: Problem,
    model: FittedModel,
    runs: Sequence[int],
    near: Sequence[NDArray[np.float32]] | None = None,
    noise: Noise | None = None,
) -> tuple[list[Array], list[NDArray[np.float32]]]:
    """Return the residuals of ``model`` and their columns, one per run; see :class:`Fit`.

    With ``near``, columns of the same numbers or of all but the last of them, and the noise there, idle numbers keep those.
    """
    idle = np.zeros(model.size, bool) if near is None or noise is None else idle_numbers(problem, model, near, noise)
    wanted = np.flatnonzero(~idle)
    models, taken = [model], np.zeros(len(wanted))
    here = scaled_numbers(problem, model)
    for place, k in enumerate(wanted):
        step = STEP if k < len(problem.quantities) else 1.0
        for direction in (1.0, -1.0):  # at a bound the other way
            change = np.zeros(model.size)
            change[k] = direction * step
            other = moved(problem, model, change)
            taken[place] = (scaled_numbers(problem, other) - here)[k]
            if abs(taken[place]) > 0.5 * step:
                break
        models.append(other)
    found = problem.residuals([m.setting for m in models], runs)
    taken[taken == 0.0] = np.inf

    def columns_of(run: tuple[int, Array]) -> NDArray[np.float32]:
        number, r = run
        own = np.zeros((model.size, r[0].size), np.float32)
        if near is not None:
            own[idle] = near[number][np.flatnonzero(idle)]
        own[wanted] = np.nan_to_num((r[1:] - r[0]) / taken[:, None, None]).reshape(len(wanted), r[0].size)
        return own

    return [r[0] for r in found], in_threads(problem.threads, columns_of, enumerate(found))


def idle_numbers(
    problem: Problem, model: FittedModel, columns: Sequence[NDArray[np.float32]], noise: Noise
) -> NDArray[np.bool_]:
    """Return of which numbers (numbers) the data say little beside their tolerances; unknowns of effects never are."""
    count, channels = len(problem.quantities), len(noise.weight)
    information = np.zeros(count)
    for column in columns:
        known = column[:count].reshape(count, -1, channels)
        information += np.einsum("krc,krc->kc", known, known) @ noise.weight
    idle = np.zeros(model.size, bool)
    idle[:count] = information < IDLE * prior_tightness(problem, model)[:count]
    return idle


def fit(
    problem: Problem,
    runs: Sequence[int],
    model: FittedModel,
    *,
    autocorrelation_time: Array | None = None,
    scatter: float = 1.0,
    columns: list[NDArray[np.float32]] | None = None,
    near: Fit | None = None,
    steps: int = 4,
    renew: bool = True,
    tell: Callable[[str], None] = lambda text: None,
) -> Fit:
    """Fit ``model`` to ``runs``.

    Args:
        problem: the system.
        runs: which of its runs.
        model: where to start, with the effects to be fitted.
        autocorrelation_time: of the models that this one is compared with; None = estimated where each descent begins.
        scatter: of the runs; see :class:`wlr_gym.gap.estimation.model.Noise`. Without ``autocorrelation_time`` the most of
            it: runs that differ by what the model's numbers can explain scatter less.
        columns: responses near ``model`` where they are known.
        near: a fit of the same numbers, or of all but the last of them, whose columns serve for idle ones.
        steps: at most this many Gauss-Newton steps.
        renew: simulate the columns, but idle ones, anew at every step; otherwise only once, where ``columns`` are missing.
        tell: called with progress.
    """
    if columns is not None:
        residuals = [r[0] for r in problem.residuals([model.setting], runs)]
    elif near is not None:
        residuals, columns = linearise(problem, model, runs, near.columns, near.noise)
    else:
        residuals, columns = linearise(problem, model, runs)
    gained, most, tau = np.inf, scatter, autocorrelation_time
    for step in range(steps):
        tau = autocorrelation_time
        if tau is None:  # the same cost in all steps of a descent
            reachable = _noise_within_reach(problem, model, columns, residuals, most)
            tau, scatter = reachable.autocorrelation_time, reachable.scatter
        model, residuals, gained = _descend(problem, runs, model, columns, residuals, tau, scatter)
        tell(f"step {step + 1} of {steps}: {gained:.0f} better")
        if gained < RENEWED or not renew or step == steps - 1:
            break
        residuals, columns = linearise(problem, model, runs, columns, estimate_noise(residuals, autocorrelation_time, scatter))
    model, residuals = _relaxed(problem, runs, model, columns, residuals, tau, scatter)
    noise = estimate_noise(residuals, autocorrelation_time, scatter)
    matrix, _ = normal_equations(columns, residuals, noise, problem.threads)
    pinned = np.diag(PINNED * on_bounds(problem, model))
    hessian = matrix + np.diag(prior_tightness(problem, model)) + pinned
    precision = matrix / problem.tempering + np.diag(tightness_once(problem, model)) + pinned
    cost = total_cost(problem, model, residuals, noise.autocorrelation_time)
    return Fit(model, residuals, noise, cost, columns, hessian, precision, bool(gained < RENEWED))


def _descend(
    problem: Problem,
    runs: Sequence[int],
    model: FittedModel,
    columns: Sequence[NDArray[np.float32]],
    residuals: list[Array],
    autocorrelation_time: Array,
    scatter: float,
) -> tuple[FittedModel, list[Array], float]:
    """Go downhill from ``model``, whose residuals are given, with the columns simulated there; return also how far it went."""
    secant, cost = list(columns), total_cost(problem, model, residuals, autocorrelation_time)
    top = cost
    for _ in range(CHORDS):
        noise = estimate_noise(residuals, autocorrelation_time, scatter)
        change = gauss_newton_step(problem, model, secant, residuals, noise)
        tries = [moved(problem, model, share * change) for share in SHARES]
        found = problem.residuals([m.setting for m in tries], runs)
        costs = [total_cost(problem, m, [r[k] for r in found], autocorrelation_time) for k, m in enumerate(tries)]
        best = int(np.argmin(costs))
        gained = cost - costs[best]
        if not gained > 0.0:
            break
        taken = scaled_numbers(problem, tries[best]) - scaled_numbers(problem, model)
        before, model, residuals, cost = residuals, tries[best], [r[best] for r in found], costs[best]
        if gained < CONVERGED:
            break
        secant = [corrected(c, taken, old, new) for c, old, new in zip(secant, before, residuals, strict=True)]
    return model, residuals, top - cost


def _noise_within_reach(
    problem: Problem, model: FittedModel, columns: Sequence[NDArray[np.float32]], residuals: Sequence[Array], scatter: float
) -> Noise:
    """Return the noise of what the model's numbers would leave if they moved, to first order.

    An error that they can remove lasts until they do: with it, a constant error of any size counts as few readings, too few to
    move a number against its tolerance (a supply that is measured 0.3 V lower than assumed). So with the runs: they differ as
    long as the model lacks what some of them show, and what differs counts little. ``scatter``: the most that is assumed.
    """
    noise = estimate_noise(residuals, np.full(residuals[0].shape[1], scatter), scatter)  # as if every row were independent
    for _ in range(ROUNDS):
        change = gauss_newton_step(problem, model, columns, residuals, noise).astype(np.float32)
        left = [r + (change @ c).reshape(r.shape) for r, c in zip(residuals, columns, strict=True)]
        own = autocorrelation_times(left)
        noise = estimate_noise(left, scatter * own, scatter)
        less = min(scatter, _scatter(problem, model, columns, left, noise))
        noise = replace(noise, autocorrelation_time=less * own, scatter=less)
    return noise


def _scatter(
    problem: Problem, model: FittedModel, columns: Sequence[NDArray[np.float32]], residuals: Sequence[Array], noise: Noise
) -> float:
    """Return the scatter of the runs, times what the simulator errs; that of ``noise`` where the data do not tell."""
    free = ~on_bounds(problem, model)
    matrices, vectors = equations_by_run(columns, residuals, noise, problem.threads)
    differ = run_scatter(matrices[:, free][:, :, free], vectors[:, free])
    return noise.scatter if differ is None else max(problem.tempering * noise.scatter * differ, 1.0)


def _relaxed(
    problem: Problem,
    runs: Sequence[int],
    model: FittedModel,
    columns: Sequence[NDArray[np.float32]],
    residuals: list[Array],
    autocorrelation_time: Array | None,
    scatter: float,
) -> tuple[FittedModel, list[Array]]:
    """Take full steps that a rough cost hides: where the data cannot distinguish numbers, tolerances alone decide."""
    for _ in range(RELAXATIONS):
        noise = estimate_noise(residuals, autocorrelation_time, scatter)
        cost = total_cost(problem, model, residuals, noise.autocorrelation_time)
        other = moved(problem, model, gauss_newton_step(problem, model, columns, residuals, noise))
        found = [r[0] for r in problem.residuals([other.setting], runs)]
        if total_cost(problem, other, found, noise.autocorrelation_time) > cost + ROUGH:
            break
        model, residuals = other, found
    return model, residuals


def widened(problem: Problem, runs: Sequence[int], found: Fit) -> Fit:
    """Return the fit with a likelihood as wide as the runs differ and the simulator errs; its numbers follow."""
    scatter = _scatter(problem, found.model, found.columns, found.residuals, found.noise)
    return fit(problem, runs, found.model, scatter=scatter, columns=found.columns, steps=1)
