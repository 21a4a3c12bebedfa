"""What a simulated run knows of itself, so that it can be simulated again, bit for bit.

It stands beside the run, ``run_01.simulation.yaml`` beside ``run_01.parquet``, and not in the run: what a robot could not
measure is no part of the measured-run format, and whoever is to find it out must not be handed it.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import yaml
from numpy.typing import NDArray
from pydantic import Field

from wlr_gym.base.errors import InputError
from wlr_gym.base.files import replace_file
from wlr_gym.base.settings import SettingsModel, parse_config, read_yaml
from wlr_gym.data.format import COMMANDS
from wlr_gym.physics.effects import load_patch
from wlr_gym.physics.plants import make_plant
from wlr_gym.physics.plants.base import PlantOptions, PlantState, Sensors
from wlr_gym.robot import JOINTS, Robot
from wlr_gym.robot.parameter_table import ELEMENTS
from wlr_gym.robot.parameters import Parameters

if TYPE_CHECKING:
    from wlr_gym.data.read import Run

Array = NDArray[np.float64]

SUFFIX = ".simulation.yaml"
#: Columns of a simulated run that its sensors fill, in the order of :func:`channels`.
SENSED = (
    *(f"{kind}_{joint}" for kind in ("pos", "vel", "eff") for joint in JOINTS),
    *(f"{kind}_{axis}" for kind in ("gyro", "acc") for axis in "xyz"),
    *("cam_x", "cam_y", "cam_yaw", "volt"),
)


class ParameterChange(SettingsModel):
    """Parameters that changed after the sensors of ``row`` were read: they act from that row's goals on."""

    row: int = Field(ge=0)
    parameters: dict[str, float]


class Simulation(SettingsModel):
    """How a run was simulated.

    Attributes:
        backend, control_period, physics_step, precision, sensor_noise: the plant and its options; s.
        seed: of the sensors' noise.
        parameters: elements of the parameter table that differ from the nominal robot's: randomisation, effects, overrides.
        changes: what changed on the way, in order of rows.
        formulas: effects that are no parameters: formula forces, as in a patch file.
        start: fields of :class:`wlr_gym.physics.plants.base.PlantState` of the first row.
    """

    backend: str
    control_period: float
    physics_step: float
    precision: str = "float64"
    sensor_noise: bool = True
    seed: int = Field(ge=0)
    parameters: dict[str, float] = Field(default_factory=dict)
    changes: tuple[ParameterChange, ...] = ()
    formulas: list[dict[str, Any]] = Field(default_factory=list)
    start: dict[str, float | list[float]]


def simulation_path(run: Path) -> Path:
    """Return where the simulation record of a run stands."""
    return run.with_name(run.stem + SUFFIX)


def read_simulation(run: Path) -> Simulation | None:
    """Read the record beside a run; None where there is none.

    Raises:
        InputError: broken YAML, unknown key, or a value of the wrong kind.
    """
    path = simulation_path(run)
    return parse_config(Simulation, read_yaml(path), str(path)) if path.is_file() else None


def write_simulation(run: Path, simulation: Simulation | None) -> None:
    """Write the record beside a run; None removes one that is there."""
    path = simulation_path(run)
    if simulation is None:
        path.unlink(missing_ok=True)
        return
    text = yaml.safe_dump(simulation.model_dump(mode="json"), sort_keys=False, default_flow_style=None, width=120)
    replace_file(path, lambda temporary: temporary.write_text(text, encoding="utf-8"))


def departures(values: Array, reference: Array) -> dict[str, float]:
    """Return the elements of one row of the parameter table that differ from ``reference``, with their values."""
    return {ELEMENTS[column]: float(values[column]) for column in np.flatnonzero(values != reference)}


def simulated_parameters(run: Run, robot: Robot) -> Parameters:
    """Return the parameters (1 robot) that a simulated run began with.

    Raises:
        InputError: no record beside the run, or a parameter that is unknown or out of bounds.
    """
    parameters = Parameters.nominal(robot)
    _set(parameters, _record_of(run).parameters)
    return parameters


def simulate_again(run: Run, robot: Robot, backend: str | None = None) -> dict[str, Array]:
    """Simulate a run as it was: same plant, start, noise, parameters and goals; same bits on the same kind of machine.

    Args:
        run: a run with its record.
        robot: the robot it is of.
        backend: another plant than the record's.

    Returns:
        The channels of :data:`SENSED`, each (rows,).

    Raises:
        InputError: no record beside the run, or one that does not fit the table or the plant.
    """
    record = _record_of(run)
    names = ("control_period", "physics_step", "precision", "sensor_noise")
    options = PlantOptions(**{name: getattr(record, name) for name in names})
    goals = np.stack([run[name] for name in COMMANDS], axis=1)
    parameters = simulated_parameters(run, robot)
    changes = {change.row: change.parameters for change in record.changes}
    rows = np.empty((len(goals), len(SENSED)))
    forces = load_patch(record.formulas).forces
    plant = make_plant(record.backend if backend is None else backend, robot, 1, options, forces)
    try:
        sensors = plant.reset(np.array([record.seed], np.uint64), parameters, state=_state(record, run))
        for row, goal in enumerate(goals):
            rows[row] = channels(sensors, 0)
            if row in changes:
                _set(parameters, changes[row])
                plant.set_parameters(parameters)
            torque_on = np.isfinite(goal)
            sensors = plant.step(np.nan_to_num(goal)[None], None if torque_on.all() else torque_on[None])
    finally:
        plant.close()
    return dict(zip(SENSED, rows.T, strict=True))


def channels(sensors: Sensors, robot: int) -> Array:
    """Return what a log shows of one robot's readings: :data:`SENSED`; no camera pose on ticks without a new frame."""
    camera = sensors.camera_pose[robot] if sensors.camera_is_new[robot] else np.full(3, np.nan)
    joints = (sensors.joint_position[robot], sensors.joint_velocity[robot], sensors.joint_effort[robot])
    return np.concatenate([*joints, sensors.gyro[robot], sensors.accelerometer[robot], camera, [sensors.supply_voltage[robot]]])


def start_of(state: PlantState, robot: int) -> dict[str, float | list[float]]:
    """Return one robot's state as the record holds it."""
    return {name: value[robot].tolist() for name, value in vars(state).items() if value is not None}


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
