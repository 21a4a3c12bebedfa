"""The model that is fitted: its numbers, their scales, bounds and priors, and its cost."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from wlr_gym.gap.estimation.likelihood import minus_two_log_likelihood
from wlr_gym.gap.problem import Candidate, Problem, Setting
from wlr_gym.physics.effects import PatchEffect

Array = NDArray[np.float64]


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
