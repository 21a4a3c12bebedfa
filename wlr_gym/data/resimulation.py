"""Simulate a run again from its record, bit for bit."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wlr_gym.base.errors import InputError
from wlr_gym.data.format import COMMANDS
from wlr_gym.data.read import Run
from wlr_gym.data.sensor_columns import channels, sensed_columns
from wlr_gym.data.simulation_record import Simulation, simulation_path
from wlr_gym.physics.effects import load_patch
from wlr_gym.physics.plants import make_plant
from wlr_gym.physics.plants.base import PlantOptions, PlantState, Truth
from wlr_gym.robot import Robot
from wlr_gym.robot.parameters import Parameters

Array = NDArray[np.float64]


def simulated_parameters(run: Run, robot: Robot) -> Parameters:
    """Return the parameters (1 robot) that a simulated run began with.

    Raises:
        InputError: no record beside the run, or a parameter that is unknown or out of bounds.
    """
    parameters = Parameters.nominal(robot)
    _set(parameters, _record_of(run).parameters)
    return parameters


def simulate_again(run: Run, robot: Robot) -> dict[str, Array]:
    """Simulate a run as it was: same plant, start, noise, parameters and setpoints; same bits on the same kind of machine.

    Args:
        run: a run with its record.
        robot: the robot it is of.

    Returns:
        The channels of the robot's sensors, each (rows,).

    Raises:
        InputError: no record beside the run, or one that does not fit the table or the plant.
    """
    rows = [values for _, _, values in simulated_rows(run, robot)]
    return dict(zip(sensed_columns(robot), np.array(rows).T, strict=True))


def simulated_rows(run: Run, robot: Robot) -> Iterator[tuple[Parameters, Truth, Array]]:
    """Yield what :func:`simulate_again` knows at each row of a run: parameters (1), truth (1), readings."""
    record = _record_of(run)
    names = ("control_period", "physics_step", "precision", "sensor_noise")
    options = PlantOptions(**{name: getattr(record, name) for name in names})
    setpoints = np.stack([run[name] for name in COMMANDS], axis=1)
    parameters, columns = simulated_parameters(run, robot), sensed_columns(robot)
    changes = {change.row: change.parameters for change in record.changes}
    forces = load_patch(record.formulas).forces
    plant = make_plant(record.backend, robot, 1, options, forces)
    try:
        sensors = plant.reset(np.array([record.seed], np.uint64), parameters, state=_state(record, run))
        for row, wanted in enumerate(setpoints):
            yield parameters, plant.truth(), channels(sensors, 0, columns)
            if row in changes:
                _set(parameters, changes[row])
                plant.set_parameters(parameters)
            torque_on = np.isfinite(wanted)
            sensors = plant.step(np.nan_to_num(wanted)[None], None if torque_on.all() else torque_on[None])
    finally:
        plant.close()


def _record_of(run: Run) -> Simulation:
    if run.simulation is None:
        raise InputError(f"{run.path}: no {simulation_path(run.path).name} beside it: not a simulated run, or not a whole one")
    return run.simulation


def _state(record: Simulation, run: Run) -> PlantState:
    try:
        return PlantState(**{name: np.array([value]) for name, value in record.start.items()})
    except TypeError as error:
        raise InputError(f"{simulation_path(run.path)}: start: {error}") from None


def _set(parameters: Parameters, values: Mapping[str, Any]) -> None:
    for name, value in values.items():
        parameters[name] = value
    parameters.validate()
