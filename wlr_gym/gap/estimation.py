"""Fit a model to runs: its numbers, their scales, bounds and priors; how probable it is; steps to the best; 95 % intervals.

**Likelihood.** A simulator is never exact, and its errors last for several rows. A channel of n rows whose residuals have an
integrated autocorrelation time of tau rows is worth n/tau independent ones; its level s (in units of the sensor's noise, never
below 1) is estimated. Up to a constant, minus twice the logarithm of the likelihood is then
``sum over channels of n/tau log s^2``. The same tau serves all models that are compared: likelihoods with different tau are
not comparable.

The errors of a simulator also differ from run to run: each run on its own would move the model's numbers farther than its
rows predict (three to six times, in squares, between two simulators of one robot). All autocorrelation times are multiplied
by this factor, found by :func:`run_scatter`.

**Prior.** Quantities lie within their tolerances about their nominal values, unknowns of effects within half their plausible
range of neutral.

**Fit.** Maximum a posteriori by Gauss-Newton steps, within bounds. All columns of a step are simulated as one batch; between
two simulations of them they are corrected by what each step really changed (Broyden's secant update), which costs nothing and
keeps steps from creeping.

**Intervals** come from the curvature of the likelihood, and from leaving out runs (jackknife).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_triangular
from scipy.optimize import lsq_linear
from scipy.special import stdtrit

from wlr_gym.base.compiled import compiled
from wlr_gym.base.jobs import in_threads
from wlr_gym.gap.analysis import ParameterEstimate
from wlr_gym.gap.problem import Array, Candidate, Problem, Quantity, Setting, Unknown
from wlr_gym.physics.effects import PatchEffect

#: Change of the residuals per scaled number, one (numbers, rows x channels) array per run; NaN as 0.
Columns = Sequence[NDArray[np.float32]]
#: Told of progress, in words.
Tell = Callable[[str], None]

#: Rows: the longest lag of an autocorrelation.
LONGEST = 100
#: Rows: runs that measured a channel no more often say nothing about its autocorrelation.
LEAST_SERIES = 8


def quiet(text: str) -> None:
    """Tell nobody."""


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
    """Return level and autocorrelation time of residuals, one (rows, channels) array per run, NaN where not measured.

    ``autocorrelation_time``: (channels) of another model that this one is compared with; None = estimated.
    """
    total = np.sum([np.nansum(r * r, axis=0) for r in residuals], axis=0)
    rows = np.sum([np.isfinite(r).sum(axis=0) for r in residuals], axis=0)
    return Noise(
        total / np.maximum(rows, 1),
        scatter * autocorrelation_times([r.T for r in residuals]) if autocorrelation_time is None else autocorrelation_time,
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
    """Return how many times more than expected the runs differ in where they pull the numbers, by their normal equations.

    The runs' gradients at their common best fit should scatter as their curvature says (White's information equality); the mean
    ratio over the directions that the data are informative about; None where there is none.
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


def autocorrelation_times(series: Sequence[Array]) -> Array:
    """Integrated autocorrelation (channels) in rows of residuals (channels, rows) per run, over measured rows only.

    It is summed until it first falls below 0.05.
    """
    edges = np.cumsum([0, *(part.shape[1] for part in series)])
    return _integrated(np.concatenate(series, axis=1, dtype=np.float64), edges, LONGEST)


@compiled(fastmath={"reassoc"})
def _lagged(values: Any, first: Any, last: Any, lag: Any) -> Any:
    """Sum of products of values a lag apart, side by side in vector registers."""
    late, early = values[first:last], values[first - lag : last - lag]
    total = 0.0
    for k in range(len(late)):
        total += late[k] * early[k]
    return total


@compiled
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


# ---- the model -------------------------------------------------------------------------------------------------------

#: Step of finite differences in a quantity, in tolerances.
STEP = 0.5
#: A number whose information in the data is below this share of that in its tolerance hardly moves: its first columns suffice.
IDLE = 1.0


@dataclass(frozen=True, eq=False)
class FittedModel:
    """Quantities of a problem, and effects with the values of their unknowns.

    Its numbers are the quantities, then the unknowns of each effect. Scaled, quantities count in tolerances and unknowns in
    their steps.
    """

    problem: Problem = field(repr=False)
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

    def with_effect(self, candidate: Candidate, values: Sequence[float]) -> FittedModel:
        """Return the model with one effect more."""
        return replace(self, effects=(*self.effects, (candidate, tuple(values))))

    def without_effect(self, index: int) -> FittedModel:
        """Return the model with one effect less."""
        effects = list(self.effects)
        del effects[index]
        return replace(self, effects=tuple(effects))

    def untouched(self) -> FittedModel:
        """Return the model with its effects, and its quantities as the file says, but for those that drift."""
        drifts = np.array([quantity.drifts for quantity in self.problem.quantities])
        return replace(self, quantities=np.where(drifts, self.quantities, nominal_model(self.problem).quantities))

    def moved(self, change: Array) -> FittedModel:
        """Return the model moved by scaled numbers, kept within bounds and plausible ranges."""
        new = self._values + self.scales * change
        low, high = self._bounds
        at = len(self.quantities)
        quantities = np.clip(new[:at], low[:at], high[:at])
        effects = []
        for candidate, values in self.effects:
            effects.append((candidate, candidate.kept(new[at : at + len(values)].tolist())))
            at += len(values)
        return replace(self, quantities=quantities, effects=tuple(effects))

    def _each(self, of_quantity: Callable[[Quantity], float], of_unknown: Callable[[Unknown], float]) -> Array:
        unknowns = [unknown for candidate, _ in self.effects for unknown in candidate.unknowns]
        return np.array([*map(of_quantity, self.problem.quantities), *map(of_unknown, unknowns)])

    @property
    def _values(self) -> Array:
        return np.array([*self.quantities, *(value for _, values in self.effects for value in values)])

    @property
    def _bounds(self) -> tuple[Array, Array]:
        return self._each(lambda q: q.low, lambda u: u.bounds[0]), self._each(lambda q: q.high, lambda u: u.bounds[1])

    @property
    def scales(self) -> Array:
        """What one scaled number is worth (numbers)."""
        return self._each(lambda q: q.sigma, lambda u: u.step)

    @property
    def scaled(self) -> Array:
        """All numbers (numbers), scaled."""
        return self._values / self.scales

    @property
    def nominal(self) -> Array:
        """Nominal or neutral values of all numbers (numbers), scaled."""
        return self._each(lambda q: q.nominal, lambda u: u.neutral) / self.scales

    @property
    def room(self) -> tuple[Array, Array]:
        """How far each scaled number may still move down and up (numbers)."""
        low, high = (bound / self.scales for bound in self._bounds)
        return low - self.scaled, high - self.scaled

    @property
    def on_bounds(self) -> NDArray[np.bool_]:
        """Which quantities (numbers) calibration has moved as far as it may; unknowns of effects do not count."""
        here, nominal, (low, high) = self.scaled, self.nominal, (bound / self.scales for bound in self._bounds)
        known = np.arange(self.size) < len(self.quantities)
        return known & (((here <= low + 1e-9) & (low != nominal)) | ((here >= high - 1e-9) & (high != nominal)))

    @property
    def tightness_once(self) -> Array:
        """Weight (numbers) of what is known beforehand, scaled: tolerances; unknowns lie within half their range of neutral."""
        return self._each(lambda q: 1.0, lambda u: 4.0 * (u.step / (u.high - u.low)) ** 2)

    @property
    def tightness(self) -> Array:
        """The same, counted ``problem.tempering`` times, but for numbers that drift."""
        tempering = self.problem.tempering
        return self._each(lambda q: 1.0 if q.drifts else tempering, lambda u: tempering) * self.tightness_once

    @property
    def prior_cost(self) -> float:
        """Squared distance of all numbers from nominal or neutral, in what is known beforehand."""
        return float(self.tightness @ (self.scaled - self.nominal) ** 2)

    def step(self, matrix: Array, vector: Array) -> Array:
        """Return the scaled step (numbers) that solves normal equations, tolerances added, within bounds."""
        gradient = vector + self.tightness * (self.scaled - self.nominal)
        return bounded_minimum(matrix + np.diag(self.tightness), gradient, *self.room)


def nominal_model(problem: Problem) -> FittedModel:
    """Return the model as its file says."""
    return FittedModel(problem, np.array([quantity.nominal for quantity in problem.quantities]))


@dataclass(frozen=True, eq=False)
class Replayed:
    """A model, and what it leaves in runs: residuals, one (rows, channels) array per run."""

    model: FittedModel
    runs: Sequence[int]
    residuals: list[Array] = field(repr=False)

    @property
    def problem(self) -> Problem:
        """Whose model and runs these are."""
        return self.model.problem

    def cost_under(self, autocorrelation_time: Array) -> float:
        """Return minus two log posterior, up to a constant that is the same for all models under one autocorrelation time."""
        return minus_two_log_likelihood(self.residuals, autocorrelation_time) + self.model.prior_cost


def replay(models: Sequence[FittedModel], runs: Sequence[int]) -> list[Replayed]:
    """Simulate runs with every model, as one batch."""
    found = models[0].problem.residuals([model.setting for model in models], runs)
    return [Replayed(model, runs, [r[k] for r in found]) for k, model in enumerate(models)]


def linearise(
    model: FittedModel, runs: Sequence[int], near: Columns | None = None, noise: Noise | None = None
) -> tuple[Replayed, list[NDArray[np.float32]]]:
    """Replay a model, and return also the columns of its numbers there.

    With ``near``, columns of the same numbers or of all but the last of them, and the noise there, idle numbers keep those: of
    which the data say little beside their tolerances. Unknowns of effects never are idle.
    """
    count = len(model.quantities)
    idle = np.zeros(model.size, bool)
    if near is not None and noise is not None:
        information = np.zeros(count)
        for column in near:
            known = column[:count].reshape(count, -1, len(noise.weight))
            information += np.einsum("krc,krc->kc", known, known) @ noise.weight
        idle[:count] = information < IDLE * model.tightness[:count]
    wanted = np.flatnonzero(~idle)
    models, taken = [model], np.zeros(len(wanted))
    for place, k in enumerate(wanted):
        step = STEP if k < count else 1.0
        for direction in (1.0, -1.0):  # at a bound the other way
            change = np.zeros(model.size)
            change[k] = direction * step
            other = model.moved(change)
            taken[place] = (other.scaled - model.scaled)[k]
            if abs(taken[place]) > 0.5 * step:
                break
        models.append(other)
    found = model.problem.residuals([one.setting for one in models], runs)
    taken[taken == 0.0] = np.inf

    def columns_of(run: tuple[int, Array]) -> NDArray[np.float32]:
        number, r = run
        own = np.zeros((model.size, r[0].size), np.float32)
        if near is not None:
            own[idle] = near[number][np.flatnonzero(idle)]
        own[wanted] = np.nan_to_num((r[1:] - r[0]) / taken[:, None, None]).reshape(len(wanted), r[0].size)
        return own

    columns = in_threads(model.problem.threads, columns_of, enumerate(found))
    return Replayed(model, runs, [r[0] for r in found]), columns


# ---- normal equations ------------------------------------------------------------------------------------------------


def normal_equations(columns: Columns, residuals: Sequence[Array], noise: Noise, threads: int = 1) -> tuple[Array, Array]:
    """Return ``C W C^T`` (numbers, numbers) and ``C W r`` (numbers) over all runs."""
    matrices, vectors = equations_by_run(columns, residuals, noise, threads)
    return matrices.sum(axis=0), vectors.sum(axis=0)


def equations_by_run(columns: Columns, residuals: Sequence[Array], noise: Noise, threads: int = 1) -> tuple[Array, Array]:
    """Return each run's own normal equations: (runs, numbers, numbers) and (runs, numbers), sums of single precision."""
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


@dataclass(frozen=True, eq=False)
class Fit(Replayed):
    """A fitted model: the best found, and what it leaves.

    Attributes:
        noise: of the residuals.
        cost: minus two log posterior under the noise's autocorrelation time.
        columns: at or near the model.
        hessian: (numbers, numbers) of half the cost, scaled numbers, tolerances included; numbers on their bounds are pinned.
        precision: (numbers, numbers) inverse covariance of the scaled numbers, tolerances counted once.
        converged: whether new columns would hardly lead any further.
    """

    noise: Noise
    cost: float
    columns: list[NDArray[np.float32]] = field(repr=False)
    hessian: Array = field(repr=False)
    precision: Array = field(repr=False)
    converged: bool = False

    def covariance(self) -> Array:
        """Covariance (numbers, numbers) of the scaled numbers: the likelihood tempered, tolerances counted once."""
        return np.asarray(np.linalg.inv(self.precision), np.float64)


def cheapest(fits: Sequence[Fit], autocorrelation_time: Array) -> Fit:
    """Return the fit with the lowest cost under one autocorrelation time: otherwise costs are not comparable."""
    return min(fits, key=lambda one: one.cost_under(autocorrelation_time))


def fit(
    model: FittedModel,
    runs: Sequence[int],
    *,
    autocorrelation_time: Array | None = None,
    scatter: float = 1.0,
    columns: list[NDArray[np.float32]] | None = None,
    near: Fit | None = None,
    steps: int | None = None,
    renew: bool = True,
    tell: Tell = quiet,
) -> Fit:
    """Fit a model to runs.

    Args:
        model: where to start, with the effects to be fitted.
        runs: of its problem.
        autocorrelation_time: of the models that this one is compared with; None = estimated where each descent begins.
        scatter: of the runs; see :class:`Noise`. Without ``autocorrelation_time`` the most of it: runs that differ by what the
            model's numbers can explain scatter less.
        columns: responses near ``model`` where they are known.
        near: a fit of the same numbers, or of all but the last of them, whose columns serve for idle ones.
        steps: at most this many Gauss-Newton steps; None = the problem's.
        renew: simulate the columns, but idle ones, anew at every step; otherwise only once, where ``columns`` are missing.
        tell: called with progress.
    """
    problem = model.problem
    steps = problem.steps if steps is None else steps
    if columns is not None:
        (now,) = replay([model], runs)
    elif near is not None:
        now, columns = linearise(model, runs, near.columns, near.noise)
    else:
        now, columns = linearise(model, runs)
    gained, most, tau = np.inf, scatter, autocorrelation_time
    for step in range(steps):
        tau = autocorrelation_time
        if tau is None:  # the same cost in all steps of a descent
            reachable = _noise_within_reach(now, columns, most)
            tau, scatter = reachable.autocorrelation_time, reachable.scatter
        now, gained = _descend(now, columns, tau, scatter)
        tell(f"step {step + 1} of {steps}: {gained:.0f} better")
        if gained < RENEWED or not renew or step == steps - 1:
            break
        now, columns = linearise(now.model, runs, columns, estimate_noise(now.residuals, autocorrelation_time, scatter))
    now = _relaxed(now, columns, tau, scatter)
    noise = estimate_noise(now.residuals, autocorrelation_time, scatter)
    matrix, _ = normal_equations(columns, now.residuals, noise, problem.threads)
    pinned = np.diag(PINNED * now.model.on_bounds)
    hessian = matrix + np.diag(now.model.tightness) + pinned
    precision = matrix / problem.tempering + np.diag(now.model.tightness_once) + pinned
    cost = now.cost_under(noise.autocorrelation_time)
    return Fit(now.model, runs, now.residuals, noise, cost, columns, hessian, precision, bool(gained < RENEWED))


def _step(now: Replayed, columns: Columns, noise: Noise) -> Array:
    """The Gauss-Newton step (numbers), scaled, within bounds."""
    return now.model.step(*normal_equations(columns, now.residuals, noise, now.problem.threads))


def _descend(now: Replayed, columns: Columns, autocorrelation_time: Array, scatter: float) -> tuple[Replayed, float]:
    """Go downhill with the columns that were simulated there; return also how far it went."""
    secant, cost = list(columns), now.cost_under(autocorrelation_time)
    top = cost
    for _ in range(CHORDS):
        change = _step(now, secant, estimate_noise(now.residuals, autocorrelation_time, scatter))
        tries = replay([now.model.moved(share * change) for share in SHARES], now.runs)
        costs = [one.cost_under(autocorrelation_time) for one in tries]
        best = int(np.argmin(costs))
        gained = cost - costs[best]
        if not gained > 0.0:
            break
        before, now, cost = now, tries[best], costs[best]
        if gained < CONVERGED:
            break
        taken = now.model.scaled - before.model.scaled
        parts = zip(secant, before.residuals, now.residuals, strict=True)
        secant = [corrected(column, taken, old, new) for column, old, new in parts]
    return now, top - cost


def _noise_within_reach(now: Replayed, columns: Columns, scatter: float) -> Noise:
    """Return the noise of what the model's numbers would leave if they moved, to first order.

    An error that they can remove lasts until they do: with it, a constant error of any size counts as few readings, too few to
    move a number against its tolerance (a supply that is measured 0.3 V lower than assumed). So with the runs: they differ as
    long as the model lacks what some of them show, and what differs counts little. ``scatter``: the most that is assumed.
    """
    every_row = np.full(now.residuals[0].shape[1], scatter)  # as if every row were independent
    noise = estimate_noise(now.residuals, every_row, scatter)
    for _ in range(ROUNDS):
        change = _step(now, columns, noise).astype(np.float32)
        left = [r + (change @ c).reshape(r.shape) for r, c in zip(now.residuals, columns, strict=True)]
        own = autocorrelation_times([r.T for r in left])
        noise = estimate_noise(left, scatter * own, scatter)
        less = min(scatter, _scatter(replace(now, residuals=left), columns, noise))
        noise = replace(noise, autocorrelation_time=less * own, scatter=less)
    return noise


def _scatter(now: Replayed, columns: Columns, noise: Noise) -> float:
    """Return the scatter of the runs, times what the simulator errs; that of ``noise`` where the data do not tell."""
    problem, free = now.problem, ~now.model.on_bounds
    matrices, vectors = equations_by_run(columns, now.residuals, noise, problem.threads)
    differ = run_scatter(matrices[:, free][:, :, free], vectors[:, free])
    return noise.scatter if differ is None else max(problem.tempering * noise.scatter * differ, 1.0)


def _relaxed(now: Replayed, columns: Columns, autocorrelation_time: Array | None, scatter: float) -> Replayed:
    """Take full steps that a rough cost hides: where the data cannot distinguish numbers, tolerances alone decide."""
    for _ in range(RELAXATIONS):
        noise = estimate_noise(now.residuals, autocorrelation_time, scatter)
        (other,) = replay([now.model.moved(_step(now, columns, noise))], now.runs)
        if other.cost_under(noise.autocorrelation_time) > now.cost_under(noise.autocorrelation_time) + ROUGH:
            break
        now = other
    return now


def widened(found: Fit) -> Fit:
    """Return the fit with a likelihood as wide as the runs differ and the simulator errs; its numbers follow."""
    scatter = _scatter(found, found.columns, found.noise)
    return fit(found.model, found.runs, scatter=scatter, columns=found.columns, steps=1)


# ---- 95 % intervals --------------------------------------------------------------------------------------------------

TWO_SIDED_95 = 1.96
#: Least degrees of freedom of a spread. Two runs have one (Student's t is 12.7): the curvature counts as another.
LEAST_DEGREES = 2


def two_sided_95(degrees: int) -> float:
    """Return Student's t: half the width of a 95 % interval, in standard errors with ``degrees`` degrees of freedom."""
    return float(stdtrit(degrees, 0.975))


def _covariance(fit: Fit) -> Array:
    """Return the covariance (numbers, numbers) of all numbers, in their units, as wide as 1.96 of its sigmas must be for 95 %.

    From the curvature of the likelihood; where leaving out one run after the other (jackknife, one Newton step each) shows more
    spread, which is what differs from run to run, the number's row and column are widened to that. A spread of a few runs
    is known to a few degrees of freedom only: it is multiplied by Student's t over 1.96; that of two runs is averaged
    with the curvature, which knows from all numbers together how much runs scatter.
    """
    model, curvature = fit.model, fit.covariance()
    matrices, vectors = equations_by_run(fit.columns, fit.residuals, fit.noise)
    pull = model.tightness * (model.scaled - model.nominal)
    stiff = np.diag(model.tightness + PINNED * model.on_bounds)
    whole, vector, runs = matrices.sum(axis=0), vectors.sum(axis=0), len(vectors)
    shifts = [
        -np.linalg.solve(whole - matrix + stiff, vector - own + pull) for matrix, own in zip(matrices, vectors, strict=True)
    ]
    spread = np.stack(shifts) - np.mean(shifts, axis=0)
    jackknife = (runs - 1) / runs * (spread**2).sum(axis=0)
    wider = jackknife / np.maximum(np.diag(curvature), 1e-300)
    missing = max(LEAST_DEGREES - (runs - 1), 0)
    weighed = np.sqrt((missing + (runs - 1) * wider) / (missing + runs - 1))
    few = two_sided_95(missing + runs - 1) / TWO_SIDED_95
    scale = model.scales * np.where(wider > 1.0, few * weighed, 1.0)
    return curvature * np.outer(scale, scale)


def half_widths(fit: Fit) -> Array:
    """Return half of the 95 % interval of every number (numbers), in its unit.

    A calibrated parameter is never known less than by its prior, to 1.96 tolerances, unless it drifts; on its bound no better.
    """
    halves = TWO_SIDED_95 * np.sqrt(np.diag(_covariance(fit)))
    beforehand = TWO_SIDED_95 * fit.model.scales
    drifts = np.array([quantity.drifts for quantity in fit.problem.quantities])
    held = np.concatenate([~drifts, np.zeros(len(halves) - len(drifts), bool)])
    return np.where(fit.model.on_bounds, beforehand, np.where(held, np.minimum(halves, beforehand), halves))


def estimates(fit: Fit) -> list[dict[str, ParameterEstimate]]:
    """Return the parameters of each of the model's effects with 95 % intervals.

    Added to the uncertainty of the fit is the disagreement of two simulators of one system (``problem.disagreement``), the same
    share of all unknowns that say how large an effect is. An unknown that adds to calibrated parameters is known no better than
    they are: only the sum is identifiable, up to the small errors of simulated responses, to the variance of their mean.
    """
    spread, problem = _covariance(fit), fit.problem
    found, at = [], len(problem.quantities)
    for candidate, values in fit.model.effects:
        own = slice(at, at + len(values))
        sizes = [(v - u.neutral) * u.is_size for u, v in zip(candidate.unknowns, values, strict=True)]
        away = problem.disagreement * np.array(sizes)
        met = candidate.tolerances or (None,) * len(values)
        summed = [0.0 if one is None or one.replaces else one.size**2 / len(one.quantities) for one in met]
        hidden = np.diag(np.maximum(np.array(summed) - np.diag(spread)[own], 0.0))
        found.append(_with_intervals(candidate, np.array(values), spread[own, own] + np.outer(away, away) + hidden))
        at += len(values)
    return found


def _with_intervals(candidate: Candidate, values: Array, spread: Array) -> dict[str, ParameterEstimate]:
    """Parameters of one effect: their slopes in the fitted values carry the covariance over."""
    here = candidate.parameters(values.tolist())
    errors = np.sqrt(np.maximum(np.diag(spread), 0.0))
    slopes = {name: np.zeros(len(values)) for name in here}
    own = np.eye(len(values))
    for k, error in enumerate(errors):
        step = 0.1 * error + 1e-9
        if candidate.kept((values + step * own[k]).tolist())[k] < values[k] + 0.5 * step:  # at the edge of its range: inwards
            step = -step
        beside = candidate.parameters((values + step * own[k]).tolist())
        for name in here:
            slopes[name][k] = (beside[name] - here[name]) / step
    units = {unknown.name: unknown.unit for unknown in candidate.unknowns}
    units |= {name: spec.unit for name, spec in candidate.vocabulary.items()}
    found = {}
    for name, value in here.items():
        half = TWO_SIDED_95 * float(np.sqrt(max(slopes[name] @ spread @ slopes[name], 0.0)))
        found[name] = ParameterEstimate(value, value - half, value + half, units.get(name, "-"))
    return found
