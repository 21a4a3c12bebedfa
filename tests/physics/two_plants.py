"""The same robots on either simulator, for tests that hold on both."""

from collections.abc import Callable

import numpy as np

from wlr_gym.physics.plants import make_plant
from wlr_gym.physics.plants.base import Plant, PlantOptions, PlantState, standing_state
from wlr_gym.robot import load_robot
from wlr_gym.robot.parameters import Parameters

BACKENDS = ("gibbs_appell", "mujoco")
ROBOT = load_robot()
HOME = np.concatenate([np.full(4, np.pi / 2), np.zeros(4)])


def make(
    backend: str,
    count: int,
    edit: Callable[[Parameters], None] | None = None,
    place: Callable[[PlantState], None] | None = None,
    *,
    step: float = 1e-3,
    period: float = 0.02,
) -> Plant:
    """Return ``count`` robots with ``edit`` applied to their parameters and ``place`` to their standing state."""
    parameters = Parameters.nominal(ROBOT, count)
    if edit is not None:
        edit(parameters)
    state = standing_state(ROBOT, parameters)
    if place is not None:
        place(state)
    options = PlantOptions(control_period=period, physics_step=step, sensor_noise=False)
    plant = make_plant(backend, ROBOT, count, options)
    plant.reset(parameters=parameters, state=state)
    return plant


def drive(plant: Plant, seconds: float, setpoints=HOME, torque_on=None) -> np.ndarray:
    """Hold ``setpoints`` (8,) or (N, 8) for ``seconds``; return a copy of the linear velocities in the body (N, 3)."""
    setpoints = np.array(np.broadcast_to(setpoints, (plant.count, 8)))
    for _ in range(round(seconds / plant.options.control_period)):
        plant.step(setpoints, torque_on)
    return plant.truth().linear_velocity_in_body.copy()
