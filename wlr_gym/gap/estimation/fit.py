"""Fit a model to runs: quantities within their tolerances, and the unknowns of the effects it has.

Maximum a posteriori by Gauss-Newton steps: residuals weighted by level and memory (:mod:`wlr_gym.gap.estimation.likelihood`),
quantities drawn to their nominal values by their tolerances, unknowns of effects free within their plausible range. All columns
of a step are simulated as one batch; between two simulations of them they are corrected by what each step really changed
(Broyden's secant update), which costs nothing and keeps steps from creeping.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from wlr_gym.gap.estimation.likelihood import Noise, estimate_noise, minus_two_log_likelihood, run_scatter
from wlr_gym.gap.problem import Candidate, Problem, Setting
from wlr_gym.physics.effects import PatchEffect

Array = NDArray[np.float64]

#: Step of finite differences in a quantity, in tolerances.
STEP = 0.5
#: Shares of a step that are tried; the best is taken.
SHARES = (2.0, 1.0, 0.5, 0.2, 0.05)
#: Steps that are taken before the columns are simulated anew.
CHORDS = 10
#: Sticking friction makes the cost rough on this scale; so many full steps are taken in the end if it rises by no more.
ROUGH, RELAXATIONS = 3.0, 2
#: Stiffness, in tolerances, that holds a number on its bound.
PINNED = 1e9
#: A step that gains less than this (in minus two log posterior) is the last with its columns; new columns that gain less than
#: RENEWED are the last of a fit.
SETTLED, RENEWED = 0.5, 2.0
#: A number of which the data say less than this share of what its tolerance says hardly moves: columns once simulated will do.
IDLE = 1.0


@dataclass(frozen=True, eq=False)
class Model:
    """Quantities, and effects with the values of their unknowns."""

    quantities: Array
    effects: tuple[tuple[Candidate, tuple[float, ...]], ...] = ()

    @property
    def setting(self) -> Setting:
        """What the simulator is asked for."""
        return Setting(self.quantities, self.patch)

    @property
    def patch(self) -> tuple[PatchEffect, ...]:
        """The effects as a patch's."""
        return tuple(candidate.effect(values) for candidate, values in self.effects)

    @property
    def size(self) -> int:
        """Number of fitted numbers."""
        return len(self.quantities) + sum(len(values) for _, values in self.effects)

    def with_effect(self, candidate: Candidate, values: Sequence[float]) -> Model:
        """Return the model with one effect more."""
        return replace(self, effects=(*self.effects, (candidate, tuple(values))))

    def without_effect(self, index: int) -> Model:
        """Return the model with one effect less."""
        effects = list(self.effects)
        del effects[index]
        return replace(self, effects=tuple(effects))


@dataclass(frozen=True, eq=False)
class Fit:
    """A fitted model.

    Attributes:
        model: the best found.
        residuals: of it, one (rows, channels) per run.
        noise: of these residuals.
        cost: minus two log posterior, up to a constant that is the same for all models with the same ``memory``.
        columns: one (numbers, rows x channels) array per run: change of the residuals per scaled number (quantities in
            tolerances, unknowns in their steps), at or near the best model; unweighted, NaN as 0.
        hessian: (numbers, numbers) of half the cost, scaled numbers, tolerances included; numbers on their bounds are pinned.
        precision: (numbers, numbers) inverse covariance of the scaled numbers, tolerances counted once.
        converged: whether new columns would hardly lead any further.
    """

    model: Model
    residuals: list[Array]
    noise: Noise
    cost: float
    columns: list[NDArray[np.float32]] = field(repr=False)
    hessian: Array = field(repr=False)
    precision: Array = field(repr=False)
    converged: bool = False

    def covariance(self) -> Array:
        """Covariance (numbers, numbers) of the scaled numbers: an imperfect simulator's word counts less, tolerances once."""
        return np.asarray(np.linalg.inv(self.precision), np.float64)


def _relaxed(
    problem: Problem,
    runs: Sequence[int],
    model: Model,
    columns: Sequence[NDArray[np.float32]],
    residuals: list[Array],
    memory: Array | None,
    scatter: float,
) -> tuple[Model, list[Array]]:
    """Take full steps that a rough cost hides: along what the data cannot tell apart, tolerances alone decide."""
    for _ in range(RELAXATIONS):
        noise = estimate_noise(residuals, memory, scatter)
        cost = total_cost(problem, model, residuals, noise.memory)
        other = moved(problem, model, gauss_newton_step(problem, model, columns, residuals, noise))
        found = [r[0] for r in problem.residuals([other.setting], runs)]
        if total_cost(problem, other, found, noise.memory) > cost + ROUGH:
            break
        model, residuals = other, found
    return model, residuals


def scales(problem: Problem, model: Model) -> Array:
    """Return what one scaled number is worth (numbers): tolerances, then steps of the unknowns."""
    steps = [unknown.step for candidate, _ in model.effects for unknown in candidate.unknowns]
    return np.array([*(quantity.sigma for quantity in problem.quantities), *steps])


def nominal_model(problem: Problem) -> Model:
    """Return the model as its file says."""
    return Model(np.array([quantity.nominal for quantity in problem.quantities]))


def untouched(problem: Problem, model: Model) -> Model:
    """Return the model with its effects, and its numbers as the file says, but for those that drift."""
    drifts = np.array([quantity.drifts for quantity in problem.quantities])
    return replace(model, quantities=np.where(drifts, model.quantities, nominal_model(problem).quantities))


def prior_cost(problem: Problem, model: Model) -> float:
    """Return the squared distance of all numbers from nominal or neutral, in what is known beforehand."""
    away = scaled_numbers(problem, model) - scaled_nominal(problem, model)
    return float(prior_tightness(problem, model) @ away**2)


def total_cost(problem: Problem, model: Model, residuals: Sequence[Array], memory: Array) -> float:
    """Return minus two log posterior."""
    return minus_two_log_likelihood(residuals, memory) + prior_cost(problem, model)


def cheapest(problem: Problem, fits: Sequence[Fit], memory: Array) -> Fit:
    """Return the fit with the lowest cost under one memory: each under its own would compare nothing."""
    return min(fits, key=lambda whole: total_cost(problem, whole.model, whole.residuals, memory))


def moved(problem: Problem, model: Model, change: Array) -> Model:
    """Return the model moved by scaled numbers, kept within bounds and plausible ranges."""
    count = len(problem.quantities)
    sigma, low, high = (np.array([getattr(q, name) for q in problem.quantities]) for name in ("sigma", "low", "high"))
    quantities = np.clip(model.quantities + sigma * change[:count], low, high)
    effects, at = [], count
    for candidate, values in model.effects:
        steps = np.array([unknown.step for unknown in candidate.unknowns])
        new = np.array(values) + steps * change[at : at + len(values)]
        effects.append((candidate, candidate.kept(new.tolist())))
        at += len(values)
    return Model(quantities, tuple(effects))


def linearise(
    problem: Problem,
    model: Model,
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
    columns = []
    for number, r in enumerate(found):
        change = (r[1:] - r[0]) / np.where(taken == 0.0, np.inf, taken)[:, None, None]
        own = np.zeros((model.size, r[0].size), np.float32)
        if near is not None:
            own[idle] = near[number][np.flatnonzero(idle)]
        own[wanted] = np.nan_to_num(change).reshape(len(wanted), r[0].size)
        columns.append(own)
    return [r[0] for r in found], columns


def idle_numbers(problem: Problem, model: Model, columns: Sequence[NDArray[np.float32]], noise: Noise) -> NDArray[np.bool_]:
    """Return of which numbers (numbers) the data say little beside their tolerances; unknowns of effects never are."""
    count, channels = len(problem.quantities), len(noise.weight)
    told = np.zeros(count)
    for column in columns:
        known = column[:count].reshape(count, -1, channels)
        told += np.einsum("krc,krc->kc", known, known) @ noise.weight
    idle = np.zeros(model.size, bool)
    idle[:count] = told < IDLE * prior_tightness(problem, model)[:count]
    return idle


def scaled_numbers(problem: Problem, model: Model) -> Array:
    """Values of all numbers, scaled."""
    values = np.array([*model.quantities, *(v for _, values in model.effects for v in values)])
    return values / scales(problem, model)


def normal_equations(columns: Sequence[NDArray[np.float32]], residuals: Sequence[Array], noise: Noise) -> tuple[Array, Array]:
    """Return ``C W C^T`` (numbers, numbers) and ``C W r`` (numbers) over all runs."""
    size = len(columns[0])
    matrix, vector = np.zeros((size, size)), np.zeros(size)
    root = np.sqrt(noise.weight)
    for column, residual in zip(columns, residuals, strict=True):
        weights = np.broadcast_to(root, residual.shape).ravel()
        weighted = column * weights
        matrix += weighted @ weighted.T
        vector += weighted @ (np.nan_to_num(residual).ravel() * weights)
    return matrix, vector


def equations_by_run(found: Fit) -> tuple[Array, Array]:
    """Return each run's own normal equations: (runs, numbers, numbers) and (runs, numbers)."""
    parts = [normal_equations([c], [r], found.noise) for c, r in zip(found.columns, found.residuals, strict=True)]
    return np.stack([matrix for matrix, _ in parts]), np.stack([vector for _, vector in parts])


def cross_products(columns: Sequence[NDArray[np.float32]], others: Sequence[Array], noise: Noise) -> Array:
    """Return ``C W D^T`` of known columns with a few others (D: per run (k, rows, channels)), over all runs."""
    total = 0.0
    for column, other in zip(columns, others, strict=True):
        weighted = (np.nan_to_num(other) * noise.weight).reshape(len(other), -1).astype(np.float32)
        total = total + column @ weighted.T
    return np.asarray(total, np.float64)


def fit(
    problem: Problem,
    runs: Sequence[int],
    model: Model,
    *,
    memory: Array | None = None,
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
        memory: of the residuals where it is known already, and must be the same; None = estimated where each descent begins.
        scatter: of the runs; see :class:`wlr_gym.gap.estimation.likelihood.Noise`.
        columns: responses near ``model`` where they are known.
        near: a fit of the same numbers, or of all but the last of them, whose columns serve for idle ones.
        steps: at most this many Gauss-Newton steps.
        renew: simulate the columns, but idle ones, anew at every step; otherwise only once, where ``columns`` are missing.
        tell: told of progress.
    """
    if columns is not None:
        residuals = [r[0] for r in problem.residuals([model.setting], runs)]
    elif near is not None:
        residuals, columns = linearise(problem, model, runs, near.columns, near.noise)
    else:
        residuals, columns = linearise(problem, model, runs)
    gained = np.inf
    for step in range(steps):
        model, residuals, gained = _descend(problem, runs, model, columns, residuals, memory, scatter)
        tell(f"step {step + 1} of {steps}: {gained:.0f} better")
        if gained < RENEWED or not renew or step == steps - 1:
            break
        residuals, columns = linearise(problem, model, runs, columns, estimate_noise(residuals, memory, scatter))
    model, residuals = _relaxed(problem, runs, model, columns, residuals, memory, scatter)
    noise = estimate_noise(residuals, memory, scatter)
    matrix, _ = normal_equations(columns, residuals, noise)
    pinned = np.diag(PINNED * on_bounds(problem, model))
    hessian = matrix + np.diag(prior_tightness(problem, model)) + pinned
    precision = matrix / problem.firmness + np.diag(_tightness_once(problem, model)) + pinned
    cost = total_cost(problem, model, residuals, noise.memory)
    return Fit(model, residuals, noise, cost, columns, hessian, precision, bool(gained < RENEWED))


def _descend(
    problem: Problem,
    runs: Sequence[int],
    model: Model,
    columns: Sequence[NDArray[np.float32]],
    residuals: list[Array],
    memory: Array | None,
    scatter: float,
) -> tuple[Model, list[Array], float]:
    """Go downhill from ``model``, whose residuals are given, with the columns simulated there; return also how far it went."""
    memory = estimate_noise(residuals, scatter=scatter).memory if memory is None else memory  # one hill, not another each step
    secant, cost = list(columns), total_cost(problem, model, residuals, memory)
    top = cost
    for _ in range(CHORDS):
        noise = estimate_noise(residuals, memory, scatter)
        change = gauss_newton_step(problem, model, secant, residuals, noise)
        tries = [moved(problem, model, share * change) for share in SHARES]
        found = problem.residuals([m.setting for m in tries], runs)
        costs = [total_cost(problem, m, [r[k] for r in found], memory) for k, m in enumerate(tries)]
        best = int(np.argmin(costs))
        gained = cost - costs[best]
        if not gained > 0.0:
            break
        taken = scaled_numbers(problem, tries[best]) - scaled_numbers(problem, model)
        before, model, residuals, cost = residuals, tries[best], [r[best] for r in found], costs[best]
        if gained < SETTLED:
            break
        secant = [corrected(c, taken, old, new) for c, old, new in zip(secant, before, residuals, strict=True)]
    return model, residuals, top - cost


def corrected(columns: NDArray[np.float32], taken: Array, before: Array, after: Array) -> NDArray[np.float32]:
    """Return one run's columns with the least change that predicts what the step ``taken`` (scaled) really did."""
    change = taken.astype(np.float32)
    missed = np.nan_to_num(after - before).ravel() - change @ columns
    return (columns + np.outer(change / (change @ change), missed.astype(np.float32))).astype(np.float32, copy=False)


def widened(problem: Problem, runs: Sequence[int], found: Fit) -> Fit:
    """Return the fit with a likelihood as wide as the runs differ and the simulator errs; its numbers follow."""
    free = ~on_bounds(problem, found.model)
    matrices, vectors = equations_by_run(found)
    differ = run_scatter(matrices[:, free][:, :, free], vectors[:, free])
    scatter = found.noise.scatter if differ is None else max(problem.firmness * found.noise.scatter * differ, 1.0)
    return fit(problem, runs, found.model, scatter=scatter, columns=found.columns, steps=1)


def prior_tightness(problem: Problem, model: Model) -> Array:
    """Weight (numbers) of what is known beforehand, scaled: tolerances; unknowns lie within half their range of neutral.

    It counts ``problem.firmness`` times, but for numbers that drift.
    """
    drifts = [quantity.drifts for quantity in problem.quantities]
    firmness = np.where([*drifts, *(False,) * (model.size - len(drifts))], 1.0, problem.firmness)
    return firmness * _tightness_once(problem, model)


def _tightness_once(problem: Problem, model: Model) -> Array:
    unknowns = [4.0 * (u.step / (u.high - u.low)) ** 2 for candidate, _ in model.effects for u in candidate.unknowns]
    return np.array([1.0] * len(problem.quantities) + unknowns)


def gauss_newton_step(
    problem: Problem, model: Model, columns: Sequence[NDArray[np.float32]], residuals: Sequence[Array], noise: Noise
) -> Array:
    """Step (numbers), scaled; numbers that would leave their bounds stay on them and the rest is solved anew."""
    return constrained_step(problem, model, *normal_equations(columns, residuals, noise))


def constrained_step(problem: Problem, model: Model, matrix: Array, vector: Array) -> Array:
    """Return the step that solves these normal equations, tolerances added, within bounds; see :func:`gauss_newton_step`."""
    tight = prior_tightness(problem, model)
    nominal = scaled_nominal(problem, model)
    here = scaled_numbers(problem, model)
    gradient = vector + tight * (here - nominal)
    return bounded_minimum(matrix + np.diag(tight), gradient, *room(problem, model))


def bounded_minimum(matrix: Array, gradient: Array, low: Array, high: Array) -> Array:
    """Return the x within bounds that minimises ``x matrix x / 2 + gradient x``: what leaves them is held there, one by one."""
    free = np.ones(len(gradient), bool)
    x = np.zeros(len(gradient))
    for _ in range(8):
        held = gradient + matrix @ np.where(free, 0.0, x)
        x[free] = -np.linalg.solve(matrix[np.ix_(free, free)], held[free])
        out = free & ((x < low - 1e-12) | (x > high + 1e-12))
        if not out.any():
            break
        x[out] = np.clip(x, low, high)[out]
        free &= ~out
    return np.clip(x, low, high)


def scaled_nominal(problem: Problem, model: Model) -> Array:
    """Nominal values of all numbers, scaled; effects' unknowns at neutral."""
    neutral = [u.neutral for candidate, _ in model.effects for u in candidate.unknowns]
    return np.array([*(q.nominal for q in problem.quantities), *neutral]) / scales(problem, model)


def room(problem: Problem, model: Model) -> tuple[Array, Array]:
    """Return how far each scaled number may still move down and up (numbers)."""
    low, high = _bounds(problem, model)
    here = scaled_numbers(problem, model)
    return low - here, high - here


def on_bounds(problem: Problem, model: Model) -> NDArray[np.bool_]:
    """Which quantities (numbers) calibration has moved as far as it may; unknowns of effects do not count."""
    low, high = _bounds(problem, model)
    here = scaled_numbers(problem, model)
    known = np.arange(model.size) < len(problem.quantities)
    nominal = scaled_nominal(problem, model)
    return known & (((here <= low + 1e-9) & (low != nominal)) | ((here >= high - 1e-9) & (high != nominal)))


def _bounds(problem: Problem, model: Model) -> tuple[Array, Array]:
    unknowns = [u for candidate, _ in model.effects for u in candidate.unknowns]
    scale = scales(problem, model)
    low = np.array([*(q.low for q in problem.quantities), *(u.low for u in unknowns)]) / scale
    high = np.array([*(q.high for q in problem.quantities), *(u.high for u in unknowns)]) / scale
    return low, high
