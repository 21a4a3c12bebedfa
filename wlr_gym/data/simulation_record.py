"""The record of how a run was simulated: what is needed to simulate it again, bit for bit.

It stands beside the run, ``run_01.simulation.yaml`` beside ``run_01.parquet``, and not in the run: what a robot could not
measure is no part of the measured-run format: a workflow that has to identify it must not read it there.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray
from pydantic import Field

from wlr_gym.base.files import write_text
from wlr_gym.base.settings import SettingsModel, parse_config, read_yaml
from wlr_gym.physics.plants.base import PlantState
from wlr_gym.robot.parameter_table import ELEMENTS

Array = NDArray[np.float64]

SUFFIX = ".simulation.yaml"


class ParameterChange(SettingsModel):
    """Parameters that changed after the sensors of ``row`` were read: they act from that row's setpoints on."""

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
    write_text(path, text)


def departures(values: Array, reference: Array) -> dict[str, float]:
    """Return the elements of one row of the parameter table that differ from ``reference``, with their values."""
    return {ELEMENTS[column]: float(values[column]) for column in np.flatnonzero(values != reference)}


def start_of(state: PlantState, robot: int) -> dict[str, float | list[float]]:
    """Return one robot's state as the record holds it."""
    return {name: value[robot].tolist() for name, value in vars(state).items() if value is not None}
