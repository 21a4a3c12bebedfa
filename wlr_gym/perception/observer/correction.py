"""Corrections of one control step: how the wheels roll, joints at rest."""

from __future__ import annotations

import math
from typing import Any

from numba import njit

from wlr_gym.perception.observer import kalman
from wlr_gym.perception.observer.layout import SENSOR

#: m/s: noise of a wheel's rolling speed from step to step.
_QUIET = 0.0005
#: Squared normalised innovation beyond which what all wheels say counts for less: they have jumped away from the IMU.
_GATE = 16.0
#: s: how long the wheels are doubted once a camera has contradicted them and no longer does.
_DOUBT = 3.0
#: Relative error of one wheel's radius.
RADIUS = 0.005
#: m/s: slip below which a wheel counts as gripping.
_SOFT = 0.003


@njit(cache=True, nogil=True)
def guess_velocity(r: Any) -> None:
    """Begin with the geometric median of the wheels' rolling velocities: some spin while a robot is put down."""
    for _ in range(4):
        total, x, y = 1e-12, 0.0, 0.0
        for i in range(4):
            dx, dy = r.rolling[i, 0] - r.velocity[0], r.rolling[i, 1] - r.velocity[1]
            weight = 1.0 / math.sqrt(dx * dx + dy * dy + _SOFT**2)
            total += weight
            x += weight * r.rolling[i, 0]
            y += weight * r.rolling[i, 1]
        r.velocity[0], r.velocity[1] = x / total, y / total


@njit(cache=True, nogil=True)
def see_rolling(robot: Any, r: Any) -> None:
    """Take in how the wheels roll, each as far as it is trusted: their weighted mean is a measurement of the velocity."""
    speed, share = 0.0, 1.0 - robot.period / _DOUBT
    for i in range(4):
        speed += 0.25 * r.rolling[i, 0]
    for k in range(2):
        precision, moment = 0.0, 0.0
        for i in range(4):
            lead = r.lead[i] if k == 0 else 0.0
            precision += r.trust[i, k]
            moment += r.trust[i, k] * (r.rolling[i, k] - r.velocity[k] - lead)
        innovation = moment / precision
        if abs(innovation) < 0.5 * r.doubt:
            r.doubt *= share
        variance = 1.0 / precision + _QUIET**2 + (0.5 * RADIUS * speed) ** 2 + r.doubt**2
        total = kalman.see_velocity(r.covariance[k], 0.0, 0.0, r.column) + variance
        correct(r, k, innovation, max(total, innovation * innovation / _GATE))


@njit(cache=True, nogil=True)
def see_rest(robot: Any, r: Any) -> None:
    """While every joint rests, the gyroscope reads its bias."""
    for k in range(8):
        if abs(r.seen[SENSOR.joint_velocity + k]) > 0.5 * robot.velocity_count:
            return
    total = r.yaw_covariance[2] + robot.gyro_noise**2
    if r.yaw_rate * r.yaw_rate < 16.0 * total:
        correct_yaw(r, 0.0, 1.0, r.yaw_rate, total)


@njit(cache=True, nogil=True)
def correct(r: Any, k: int, innovation: float, total: float) -> None:
    """Correct direction ``k`` by the measurement whose P h' is in ``r.column``."""
    kalman.correct(r.covariance[k], r.column, innovation, total, r.change)
    c, s = r.pointing[0], r.pointing[1]
    r.position[0] += (c if k == 0 else -s) * r.change[0]
    r.position[1] += (s if k == 0 else c) * r.change[0]
    r.velocity[k] += r.change[kalman.VELOCITY]
    r.leak[k] += r.change[kalman.LEAK]
    r.lens[k] += r.change[kalman.LENS]


@njit(cache=True, nogil=True)
def correct_yaw(r: Any, of_yaw: float, of_bias: float, innovation: float, total: float) -> None:
    """Correct yaw and gyroscope bias by a measurement of of_yaw yaw + of_bias bias; ``total``: the innovation's variance."""
    p = r.yaw_covariance
    yaw, bias = of_yaw * p[0] + of_bias * p[1], of_yaw * p[1] + of_bias * p[2]
    r.yaw += yaw / total * innovation
    r.gyro_bias += bias / total * innovation
    p[0] -= yaw * yaw / total
    p[1] -= yaw * bias / total
    p[2] -= bias * bias / total
