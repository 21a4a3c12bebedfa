"""The model that is fitted: its numbers, their scales, bounds and priors; and how probable it is.

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
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from wlr_gym.gap.problem import Candidate, Problem, Setting
from wlr_gym.physics.effects import PatchEffect

Array = NDArray[np.float64]

#: Rows: the longest lag of an autocorrelation.
LONGEST = 100
#: Rows: runs that measured a channel no more often say nothing about its autocorrelation.
LEAST_SERIES = 8


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
    """Return level and autocorrelation time of residuals, one (rows, channels) array per run.

    Args:
        residuals: noise units, NaN where not measured.
        autocorrelation_time: (channels) of another model that this one is compared with; None = estimated.
        scatter: of the runs; see :class:`Noise`.
    """
    total = np.sum([np.nansum(r * r, axis=0) for r in residuals], axis=0)
    rows = np.sum([np.isfinite(r).sum(axis=0) for r in residuals], axis=0)
    return Noise(
        total / np.maximum(rows, 1),
        scatter * autocorrelation_times(residuals) if autocorrelation_time is None else autocorrelation_time,
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
    """Return how many times more than expected the runs differ in where they pull the numbers.

    The runs' gradients at their common best fit should scatter as their curvature says (White's information equality); the mean
    ratio over the directions that the data are informative about; None where there is none.

    Args:
        matrices, vectors: (runs, numbers, numbers), (runs, numbers) normal equations of each run.
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


def autocorrelation_times(residuals: Sequence[Array]) -> Array:
    """Integrated autocorrelation (channels) in rows: summed until it first falls below 0.05, over measured rows only."""
    return series_times([residual.T for residual in residuals])


def series_times(series: Sequence[Array]) -> Array:
    """The same of residuals (channels, rows)."""
    edges = np.cumsum([0, *(part.shape[1] for part in series)])
    return _integrated(np.concatenate(series, axis=1, dtype=np.float64), edges, LONGEST)


@njit(cache=True, nogil=True, fastmath={"reassoc"})
def _lagged(values: Any, first: Any, last: Any, lag: Any) -> Any:
    """Sum of products of values a lag apart, side by side in vector registers."""
    late, early = values[first:last], values[first - lag : last - lag]
    total = 0.0
    for k in range(len(late)):
        total += late[k] * early[k]
    return total


@njit(cache=True, nogil=True)
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


@dataclass(frozen=True, eq=False)
class FittedModel:
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

    def with_effect(self, candidate: Candidate, values: Sequence[float]) -> FittedModel:
        """Return the model with one effect more."""
        return replace(self, effects=(*self.effects, (candidate, tuple(values))))

    def without_effect(self, index: int) -> FittedModel:
        """Return the model with one effect less."""
        effects = list(self.effects)
        del effects[index]
        return replace(self, effects=tuple(effects))


def nominal_model(problem: Problem) -> FittedModel:
    """Return the model as its file says."""
    return FittedModel(np.array([quantity.nominal for quantity in problem.quantities]))


def untouched(problem: Problem, model: FittedModel) -> FittedModel:
    """Return the model with its effects, and its numbers as the file says, but for those that drift."""
    drifts = np.array([quantity.drifts for quantity in problem.quantities])
    return replace(model, quantities=np.where(drifts, model.quantities, nominal_model(problem).quantities))


def scales(problem: Problem, model: FittedModel) -> Array:
    """Return what one scaled number is worth (numbers): tolerances, then steps of the unknowns."""
    steps = [unknown.step for candidate, _ in model.effects for unknown in candidate.unknowns]
    return np.array([*(quantity.sigma for quantity in problem.quantities), *steps])


def scaled_numbers(problem: Problem, model: FittedModel) -> Array:
    """Values of all numbers, scaled."""
    values = np.array([*model.quantities, *(v for _, values in model.effects for v in values)])
    return values / scales(problem, model)


def scaled_nominal(problem: Problem, model: FittedModel) -> Array:
    """Nominal values of all numbers, scaled; effects' unknowns at neutral."""
    neutral = [u.neutral for candidate, _ in model.effects for u in candidate.unknowns]
    return np.array([*(q.nominal for q in problem.quantities), *neutral]) / scales(problem, model)


def moved(problem: Problem, model: FittedModel, change: Array) -> FittedModel:
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
    return FittedModel(quantities, tuple(effects))


def room(problem: Problem, model: FittedModel) -> tuple[Array, Array]:
    """Return how far each scaled number may still move down and up (numbers)."""
    low, high = _bounds(problem, model)
    here = scaled_numbers(problem, model)
    return low - here, high - here


def on_bounds(problem: Problem, model: FittedModel) -> NDArray[np.bool_]:
    """Which quantities (numbers) calibration has moved as far as it may; unknowns of effects do not count."""
    low, high = _bounds(problem, model)
    here = scaled_numbers(problem, model)
    known = np.arange(model.size) < len(problem.quantities)
    nominal = scaled_nominal(problem, model)
    return known & (((here <= low + 1e-9) & (low != nominal)) | ((here >= high - 1e-9) & (high != nominal)))


def _bounds(problem: Problem, model: FittedModel) -> tuple[Array, Array]:
    unknowns = [u for candidate, _ in model.effects for u in candidate.unknowns]
    scale = scales(problem, model)
    low = np.array([*(q.low for q in problem.quantities), *(u.bounds[0] for u in unknowns)]) / scale
    high = np.array([*(q.high for q in problem.quantities), *(u.bounds[1] for u in unknowns)]) / scale
    return low, high


def prior_tightness(problem: Problem, model: FittedModel) -> Array:
    """Weight (numbers) of what is known beforehand, scaled: tolerances; unknowns lie within half their range of neutral.

    It counts ``problem.tempering`` times, but for numbers that drift.
    """
    drifts = [quantity.drifts for quantity in problem.quantities]
    tempering = np.where([*drifts, *(False,) * (model.size - len(drifts))], 1.0, problem.tempering)
    return tempering * tightness_once(problem, model)


def tightness_once(problem: Problem, model: FittedModel) -> Array:
    """The same without tempering."""
    unknowns = [4.0 * (u.step / (u.high - u.low)) ** 2 for candidate, _ in model.effects for u in candidate.unknowns]
    return np.array([1.0] * len(problem.quantities) + unknowns)


def prior_cost(problem: Problem, model: FittedModel) -> float:
    """Return the squared distance of all numbers from nominal or neutral, in what is known beforehand."""
    away = scaled_numbers(problem, model) - scaled_nominal(problem, model)
    return float(prior_tightness(problem, model) @ away**2)


def total_cost(problem: Problem, model: FittedModel, residuals: Sequence[Array], autocorrelation_time: Array) -> float:
    """Return minus two log posterior."""
    return minus_two_log_likelihood(residuals, autocorrelation_time) + prior_cost(problem, model)
