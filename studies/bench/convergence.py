"""Accuracy of the engine: position after one second against a reference at 10 us. No timing."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from studies.bench.measure import Size
from wlr_gym.physics.plants.base import PlantOptions, standing_state
from wlr_gym.physics.plants.gibbs_appell.plant import SWEEPS, GibbsAppellPlant
from wlr_gym.robot import LEG_SLICE, load_robot
from wlr_gym.robot.parameters import Parameters

Array = NDArray[np.float64]

CASES = {
    "skid": "legs at home, every wheel at its own constant speed, each with its own friction",
    "legs": "as skid, with every leg stepped to its own angle",
    "profile": "two such poses in turn every 0.3 s, with servo profiles",
    "drop": "as legs, from 10 mm above the floor",
    "random": "new random setpoints every tick",
}
STEPS = (2.5e-4, 5e-4, 1e-3, 2e-3, 4e-3)


@dataclass(frozen=True)
class Deviation:
    """Distance (m) between body positions after the run: median, 90 % and worst of the robots.

    Attributes:
        case: of :data:`CASES`. quantity: ``step`` (s), against 10 us; ``sweeps`` (at 1 ms), against 300; ``precision``,
        float32 against float64.
    """

    case: str
    quantity: str
    value: float | str
    median: float
    percentile_90: float
    worst: float

    def as_dict(self) -> dict[str, Any]:
        """Return plain JSON types."""
        return asdict(self)


def measure_convergence(size: Size) -> list[Deviation]:
    """Return the deviations of all cases."""
    count, ticks = size(64, 2), size(50, 2)
    cases = ("drop",) if size.quick else tuple(CASES)
    return [deviation for case in cases for deviation in _case(case, count, ticks, size)]


def _case(case: str, count: int, ticks: int, size: Size) -> list[Deviation]:
    travel = partial(_travel, case, _goals(case, ticks, count))
    reference = travel(1e-4 if size.quick else 1e-5, 8)
    found = [_deviation(case, "step", step, travel(step, SWEEPS) - reference) for step in STEPS]
    exact = travel(1e-3, 300)
    found += [_deviation(case, "sweeps", sweeps, travel(1e-3, sweeps) - exact) for sweeps in (2, 3, 4, 6, 8)]
    rounding = travel(1e-3, SWEEPS, "float32") - travel(1e-3, SWEEPS)
    return [*found, _deviation(case, "precision", "float32", rounding)]


def _deviation(case: str, quantity: str, value: float | str, difference: Array) -> Deviation:
    distance = np.linalg.norm(difference, axis=1)
    return Deviation(
        case, quantity, value, float(np.median(distance)), float(np.percentile(distance, 90)), float(distance.max())
    )


def _goals(case: str, ticks: int, count: int) -> list[Array]:
    rng = np.random.default_rng(5)
    first, second = _pose(rng, count), _pose(rng, count)
    if case == "random":
        return [_pose(rng, count) for _ in range(ticks)]
    if case == "profile":
        return [first if (tick // 15) % 2 == 0 else second for tick in range(ticks)]
    if case == "skid":
        first[:, LEG_SLICE] = np.pi / 2
    return [first] * ticks


def _pose(rng: np.random.Generator, count: int) -> Array:
    return np.c_[np.pi / 2 + rng.uniform(-0.3, 0.3, (count, 4)), rng.uniform(-6.0, 6.0, (count, 4))]


def _travel(case: str, setpoints: list[Array], step: float, sweeps: int, precision: str = "float64") -> Array:
    """Return how far the body of every robot moved (N, 3)."""
    robot, count = load_robot(), len(setpoints[0])
    parameters = Parameters.nominal(robot, count)
    friction = np.random.default_rng(1).uniform(0.2, 0.9, (count, 4))
    parameters["ground.mu_x"], parameters["ground.mu_y"] = friction, friction
    if case == "profile":
        parameters["servo.profile_velocity"] = 2.0
        parameters["servo.profile_acceleration"] = np.repeat([15.0, 10.0], 4)
    state = standing_state(robot, parameters)
    if case == "drop":
        state.position[:, 2] += 0.01
    plant = GibbsAppellPlant(robot, count, PlantOptions(physics_step=step, precision=precision), sweeps=sweeps)
    plant.reset(parameters=parameters, state=state)
    start = plant.truth().position.copy()
    for row in setpoints:
        plant.step(row)
    return plant.truth().position - start
