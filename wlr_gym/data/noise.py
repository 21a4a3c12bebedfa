"""Sensor noise per column: what even a perfect model cannot predict."""

from __future__ import annotations

import math

from wlr_gym.data.format import CHANNELS, COLUMNS
from wlr_gym.physics.servo import effort_counts
from wlr_gym.robot import JOINTS, LEGS, Robot


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
