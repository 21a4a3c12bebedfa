"""What is left of a task on a real robot, which has sensors and no truth: the terms that can be measured."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wlr_gym.base.errors import InputError
from wlr_gym.envs.tasks.signals import signals_of
from wlr_gym.envs.tasks.task import Task
from wlr_gym.envs.tasks.terms import COMPUTED, SCALARS
from wlr_gym.physics.plants.base import SENSOR_LAYOUT, TRUTH_LAYOUT, Sensors

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


def measurable(task: Task, has_camera: bool) -> tuple[Task, tuple[str, ...]]:
    """Return the task with the rewards, terminations and measures that a robot can measure, and the names of those it cannot.

    A robot does not know its speed over the floor, its slip, or the height of its body. The safety rules watch its tilt.
    The slip observer runs on its sensors, and on the camera's poses where there is one.

    Raises:
        InputError: an observation that needs the true state, or a camera where there is none.
    """
    for column in task.policy:
        if column.device == "camera" and not has_camera:
            raise InputError(f"observation '{column.term}': this robot has no camera; see docs/camera.md")
        if column.source == "truth" or (column.source == "computed" and not _is_known(COMPUTED[column.term].function)):
            raise InputError(f"observation '{column.term}': only a simulator knows the true state")
    kept, left_out = {}, []
    for group, registry in SCALARS.items():
        chosen = getattr(task.config, group)
        kept[group] = {name: values for name, values in chosen.items() if _is_known(registry[name].function)}
        left_out += [name for name in chosen if name not in kept[group]]
    kept["success"] = {name: limits for name, limits in task.config.success.items() if name in kept["measures"]}
    config = task.config.model_copy(update=kept)
    return replace(task, config=config, privileged=()), tuple(dict.fromkeys(left_out))


def require_flow(task: Task, has_flow: bool) -> None:
    """Refuse a task that observes optical flow on a robot without the sensor, unless it is one that does without at times.

    Raises:
        InputError: names the observation.
    """
    always = task.config.sensors.flow is None or task.config.sensors.flow >= 1.0
    for column in task.policy:
        if column.device == "flow" and always and not has_flow:
            raise InputError(f"observation '{column.term}': this robot has no optical-flow sensor; see docs/optical_flow.md")


def _is_known(function: Callable[..., Any]) -> bool:
    """Whether all signals that a term reads can be measured."""
    return all(name in _KNOWN for name in signals_of(function) if name.startswith(("truth.", "start[")))
