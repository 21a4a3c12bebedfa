"""The columns of a run that the sensors fill, and one row of them from a plant's readings."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from wlr_gym.physics.plants.base import Sensors
from wlr_gym.robot import JOINTS

Array = NDArray[np.float64]

#: Columns that the sensors fill, in the order of :func:`channels`.
SENSED = (
    *(f"{kind}_{joint}" for kind in ("pos", "vel", "eff") for joint in JOINTS),
    *(f"{kind}_{axis}" for kind in ("gyro", "acc") for axis in "xyz"),
    *("cam_x", "cam_y", "cam_yaw", "volt"),
)
#: Besides, of a robot with a live camera.
LIVE_CAMERA = ("cam_age",)


def channels(sensors: Sensors, robot: int) -> Array:
    """Return one robot's readings as :data:`SENSED`; NaN for the camera pose on control steps without a new frame."""
    camera = sensors.camera_pose[robot] if sensors.camera_is_new[robot] else np.full(3, np.nan)
    joints = (sensors.joint_position[robot], sensors.joint_velocity[robot], sensors.joint_effort[robot])
    return np.concatenate([*joints, sensors.gyro[robot], sensors.accelerometer[robot], camera, [sensors.supply_voltage[robot]]])
