"""The columns of a run that the sensors fill, and one row of them from a plant's readings."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from wlr_gym.data.format import FLOW
from wlr_gym.physics.plants.base import Sensors
from wlr_gym.robot import JOINTS, Robot

Array = NDArray[np.float64]

#: Columns that the sensors of every robot fill, in the order of :func:`channels`.
SENSED = (
    *(f"{kind}_{joint}" for kind in ("pos", "vel", "eff") for joint in JOINTS),
    *(f"{kind}_{axis}" for kind in ("gyro", "acc") for axis in "xyz"),
    *("cam_x", "cam_y", "cam_yaw", "volt"),
)
#: Besides, of a robot with a live camera.
LIVE_CAMERA = ("cam_age",)


def sensed_columns(robot: Robot) -> tuple[str, ...]:
    """Return the columns that a robot's sensors fill: :data:`SENSED`, and optical flow where its file has such a sensor."""
    return SENSED if robot.sensors.flow is None else (*SENSED, *FLOW)


def channels(sensors: Sensors, robot: int, columns: tuple[str, ...] = SENSED) -> Array:
    """Return one robot's readings as ``columns`` (:func:`sensed_columns`); NaN for the camera's pose on control steps without
    a new frame, and for optical flow without a new valid reading."""
    camera = sensors.camera_pose[robot] if sensors.camera_is_new[robot] else np.full(3, np.nan)
    joints = (sensors.joint_position[robot], sensors.joint_velocity[robot], sensors.joint_effort[robot])
    always = [*joints, sensors.gyro[robot], sensors.accelerometer[robot], camera, [sensors.supply_voltage[robot]]]
    if len(columns) == len(SENSED):
        return np.concatenate(always)
    is_new = bool(sensors.flow_is_new[robot])
    flow = [*sensors.flow[robot], sensors.flow_quality[robot]] if is_new else np.full(len(FLOW) - 1, np.nan)
    return np.concatenate([*always, flow, [sensors.flow_age[robot]]])
