"""What is left of a task on a real robot, which has sensors and no truth: the terms that can be measured."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from wlr_gym.codegen import Graph
from wlr_gym.envs.evaluation import matrix_columns
from wlr_gym.errors import InputError
from wlr_gym.plants.base import SENSOR_LAYOUT, TRUTH_LAYOUT, Sensors
from wlr_gym.tasks.signals import Signals
from wlr_gym.tasks.task import Task
from wlr_gym.tasks.terms import REWARDS, TERMINATIONS, ScalarTerm

Array = NDArray[np.float64]

#: Channel of the truth -> sensor that measures it.
MEASURED = {
    "joint_position": "joint_position",
    "joint_velocity": "joint_velocity",
    "angular_velocity_in_body": "gyro",
    "motor_torque": "joint_effort",
}
_KNOWN = {f"truth.{element}" for channel in MEASURED for element in TRUTH_LAYOUT.channels[channel].elements}


def measured_truth(sensors: Sensors) -> Array:
    """Return a truth matrix (N, W) filled with what sensors measure; NaN where there is no sensor."""
    truth = np.full((len(sensors.values), TRUTH_LAYOUT.width), np.nan)
    for channel, sensor in MEASURED.items():
        truth[:, TRUTH_LAYOUT.slices[channel]] = sensors.values[:, SENSOR_LAYOUT.slices[sensor]]
    return truth


def measurable(task: Task) -> tuple[Task, tuple[str, ...]]:
    """Return the task with the rewards and terminations that a robot can measure, and the names of those it cannot.

    A robot does not know its speed over the floor, its slip, or the height of its body. It is the safety gate that watches its
    tilt.

    Raises:
        InputError: an observation of the camera's, which the robot has not got.
    """
    for column in task.policy:
        if column.device == "camera":
            raise InputError(f"observation '{column.term}': the robot has no camera of its own")
    config = task.config
    rewards = {name: values for name, values in config.rewards.items() if _is_known(task, REWARDS[name])}
    terminations = {name: values for name, values in config.terminations.items() if _is_known(task, TERMINATIONS[name])}
    left_out = tuple(name for name in [*config.rewards, *config.terminations] if name not in rewards | terminations)
    return replace(task, config=config.model_copy(update={"rewards": rewards, "terminations": terminations})), left_out


def _is_known(task: Task, term: ScalarTerm) -> bool:
    """Whether all signals that a term reads can be measured."""
    return all(name in _KNOWN for name in _signals_of(task, term) if name.startswith("truth."))


def _signals_of(task: Task, term: ScalarTerm) -> set[str]:
    graph, names, columns = Graph(), set(), matrix_columns(task)

    def read(name: str) -> object:
        names.add(name)
        return graph.input(name) if name in columns else 1.0

    parameters: Mapping[str, float] = term.parameters
    term.function(Signals(read), **parameters)
    return names
