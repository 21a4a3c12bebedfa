"""What a robot's sensors put into a run: their columns, one row of them from a plant's readings, and their noise."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from wlr_gym.data.format import CHANNELS, COLUMNS, FLOW
from wlr_gym.physics.plants.base import Sensors
from wlr_gym.physics.servo import effort_counts
from wlr_gym.robot import JOINTS, LEGS, Robot

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


# ---- noise: what even a perfect model cannot predict -----------------------------------------------------------------


def channel_noise(robot: Robot) -> dict[str, float]:
    """Return one sigma of every channel in its unit: analogue noise and rounding to register counts, sqrt(s^2 + c^2/12).

    Constant biases are not part of it.
    """
    return {name: math.sqrt(sigma**2 + count**2 / 12) for name, (sigma, count) in noise_parts(robot).items()}


def noise_parts(robot: Robot) -> dict[str, tuple[float, float]]:
    """Return one sigma of the analogue noise of every channel, and its register count (0 = not rounded), in its unit."""
    sensors = robot.sensors
    effort = dict(zip(JOINTS, effort_counts(robot), strict=True))
    by_group = {
        "gyro": (sensors.imu.gyro_noise, 0.0),
        "acc": (sensors.imu.accel_noise, 0.0),
        "cam_xy": (sensors.camera.position_noise, 0.0),
        "cam_z": (sensors.camera.position_noise, 0.0),
        "cam_yaw": (sensors.camera.yaw_noise, 0.0),
        "cam_pitch": (sensors.camera.yaw_noise, 0.0),
        "volt": (sensors.volt_noise, sensors.volt_count),
    }
    parts = {}
    for name in CHANNELS:
        kind, _, joint = name.partition("_")
        if joint not in JOINTS:
            sigma, count = by_group[COLUMNS[name].group]
        elif kind == "eff":
            sigma, count = (sensors.effort.leg_noise if joint in LEGS else sensors.effort.wheel_noise), effort[joint]
        else:
            sigma, count = 0.0, sensors.encoder.position if kind == "pos" else sensors.encoder.velocity
        parts[name] = (sigma, count)
    return parts
