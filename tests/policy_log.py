"""What a policy's log says: the columns of its file, and what a policy answers to what the log says the robot read."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wlr_gym.base.errors import InputError
from wlr_gym.data.runs import Run, read_run
from wlr_gym.envs.core import Core
from wlr_gym.physics.plants.base import SENSOR_LAYOUT, Sensors
from wlr_gym.policy import Policy
from wlr_gym.robot import JOINTS


class LoggedPlant:
    """Returns what a log says the robot read; for a :class:`Core` that is to see again what it saw."""

    def __init__(self, core: Core, run: Run) -> None:
        self.capabilities, self.parameters = core.plant.capabilities, core.plant.parameters
        self._rows = _sensor_rows(run)
        self._at = 0

    def reset(self, **_: object) -> Sensors:
        """Return the first row."""
        self._at = 0
        return self._rows[0]

    def step(self, *_: object) -> Sensors:
        """Return the next row."""
        self._at += 1
        return self._rows[self._at]

    def close(self) -> None:
        """Nothing to release."""


def _sensor_rows(run: Run) -> list[Sensors]:
    values = np.zeros((len(run.table), SENSOR_LAYOUT.width))
    places = {"joint_position": "pos", "joint_velocity": "vel", "joint_effort": "eff", "gyro": "gyro", "accelerometer": "acc"}
    for channel, prefix in places.items():
        names = [f"{prefix}_{label}" for label in SENSOR_LAYOUT.channels[channel].labels]
        values[:, SENSOR_LAYOUT.slices[channel]] = np.stack([run[name] for name in names], axis=1)
    values[:, SENSOR_LAYOUT.slices["supply_voltage"]] = run["volt"][:, None]
    if "flow_age" in run:
        _fill_held(values, run, ("flow_x", "flow_y", "flow_age"), ("flow", "flow_age", "flow_is_new"))
        quality = np.where(np.isfinite(run["flow_x"]), run["flow_quality"], 0.0)  # not held
        values[:, SENSOR_LAYOUT.slices["flow_quality"]] = quality[:, None]
    if "cam_age" in run:
        of_camera = ("camera_pose", "camera_age", "camera_is_new")
        _fill_held(values, run, ("cam_x", "cam_y", "cam_yaw", "cam_age"), of_camera)
    return [Sensors(row[None]) for row in values]


def _fill_held(values: NDArray[np.float64], run: Run, columns: Sequence[str], channels: Sequence[str]) -> None:
    """Write a sensor that does not read in every row: its reading, held until the next; its age; whether it is new."""
    *reading, age = (run[name] for name in columns)
    seen = np.stack(reading, axis=1)
    is_new = np.isfinite(seen[:, 0])
    last = np.maximum.accumulate(np.where(is_new, np.arange(len(seen)), -1))
    held = np.where(last[:, None] >= 0, seen[last], 0.0)
    for channel, found in zip(channels, (held, age[:, None], is_new[:, None]), strict=True):
        values[:, SENSOR_LAYOUT.slices[channel]] = found


def read_policy_log(run: Path) -> dict[str, NDArray[np.float64]]:
    """Return the columns of the ``policy.csv`` beside a run.

    Raises:
        InputError: there is none, or it is broken.
    """
    path = run.with_name(run.stem + ".policy.csv")
    try:
        with path.open(newline="", encoding="utf-8") as file:
            header, *rows = list(csv.reader(file))
        values = np.array(rows, np.float64).reshape(len(rows), len(header))
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: no log of a policy: {error}") from None
    return dict(zip(header, values.T, strict=True))


def act_again(core: Core, policy: Policy, run: Path) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Show a policy what a log says the robot read; return the actions (T, 8) of the log and those it answers now.

    They are the same, bit for bit, where policy, task and observation code are the ones that drove the robot.

    Args:
        core: as the one that drove it; its plant is not touched.
        policy: as the one that drove it.
        run: its log, with the ``policy.csv`` beside it.
    """
    log = read_policy_log(run)
    commands = np.stack([log[f"command_{name}"] for name in core.task.commands], axis=1)
    given = np.stack([log[f"action_{joint}"] for joint in JOINTS], axis=1).astype(np.float32)
    again: Any = LoggedPlant(core, read_run(run))
    plant, core.plant = core.plant, again
    answered = np.zeros_like(given)
    try:
        core.seed(0, 0)
        core.begin_episodes(core.everyone, {"command": dict(zip(core.task.commands, commands[0].tolist(), strict=True))})
        policy.reset(core.everyone)
        for k in range(len(given)):
            answered[k] = policy.act(core.observation)[0]
            if k + 1 < len(given):
                core.set_command(dict(zip(core.task.commands, commands[k + 1].tolist(), strict=True)))
                core.step(given[k][None], core.everyone)
    finally:
        core.plant = plant
    return given, answered
