"""Kalman filter of one horizontal direction, and what corrects it: how the wheels roll, joints at rest.

State (p, v, l, e): position, velocity, leak of the accelerometer, error of the flow sensor. p' = v; v' = a - l with the
measured acceleration a; l, what leaks into the accelerometer (bias, and gravity on a slope that is not known), a random walk;
e, ahead the scale of the optical flow less 1, to the side its rotation. Covariances only: the means live in frames that turn,
see :mod:`wlr_gym.perception.observer.slip_filter`.
"""

from __future__ import annotations

import math
from typing import Any

from numba import njit

from wlr_gym.perception.observer.layout import SENSOR

# Where the state's elements stand; the position is first.
VELOCITY = 1
LEAK = 2
LENS = 3
#: Number of elements.
DIRECTION_SIZE = 4


@njit(cache=True, nogil=True)
def predict_direction(p: Any, step: float, velocity_noise: float, leak_noise: float) -> None:
    """P = F P F' + diag(0, velocity_noise, leak_noise, 0) over ``step`` s; ``p`` (4, 4) is changed."""
    half = 0.5 * step * step
    for k in range(DIRECTION_SIZE):
        p[0, k] += step * p[1, k] - half * p[2, k]
        p[1, k] -= step * p[2, k]
    for k in range(DIRECTION_SIZE):
        p[k, 0] += step * p[k, 1] - half * p[k, 2]
        p[k, 1] -= step * p[k, 2]
    p[VELOCITY, VELOCITY] += velocity_noise
    p[LEAK, LEAK] += leak_noise


@njit(cache=True, nogil=True)
def see_velocity(p: Any, age: float, flow: float, column: Any) -> float:
    """Put P h' of the measurement of the velocity ``age`` s ago less e ``flow`` into ``column`` (4,); return h P h'.

    ``flow``: m/s, that the flow sensor measures; 0 = the wheels measure.
    """
    for k in range(DIRECTION_SIZE):
        column[k] = p[k, VELOCITY] + age * p[k, LEAK] - flow * p[k, LENS]
    return column[VELOCITY] + age * column[LEAK] - flow * column[LENS]


@njit(cache=True, nogil=True)
def see_position(p: Any, age: float, column: Any) -> float:
    """Put P h' of the measurement of the position ``age`` s ago into ``column`` (4,); return h P h'."""
    half = 0.5 * age * age
    for k in range(DIRECTION_SIZE):
        column[k] = p[k, 0] - age * p[k, VELOCITY] - half * p[k, LEAK]
    return column[0] - age * column[VELOCITY] - half * column[LEAK]


@njit(cache=True, nogil=True)
def correct_direction(p: Any, column: Any, innovation: float, total: float, change: Any) -> None:
    """Take in a measurement that came out ``innovation`` above its prediction.

    Args:
        p: covariance (4, 4), changed; it stays symmetric and positive.
        column: (4,) P h'.
        total: variance of the innovation, h P h' and the measurement's own.
        change: (4,) becomes what the state changes.
    """
    share = 1.0 / total
    for j in range(DIRECTION_SIZE):
        gain = column[j] * share
        change[j] = gain * innovation
        for k in range(j + 1):
            value = p[j, k] - gain * column[k]
            p[j, k] = value
            p[k, j] = value


# --- corrections of one control step ----------------------------------------------------------------------------------


#: m/s: noise of a wheel's rolling speed from step to step.
_QUIET = 0.0005
#: Squared normalised innovation beyond which what all wheels say counts for less: they have jumped away from the IMU.
_ROLLING_GATE = 16.0
#: s: how long the wheels are doubted once a camera has contradicted them and no longer does.
_DOUBT = 3.0
#: Relative error of one wheel's radius.
RADIUS = 0.005
#: m/s: slip below which a wheel counts as gripping.
_GRIPPING_SLIP = 0.003


@njit(cache=True, nogil=True)
def guess_velocity(r: Any) -> None:
    """Begin with the geometric median of the wheels' rolling velocities: some spin while a robot is put down."""
    for _ in range(4):
        total, x, y = 1e-12, 0.0, 0.0
        for i in range(4):
            dx, dy = r.rolling[i, 0] - r.velocity[0], r.rolling[i, 1] - r.velocity[1]
            weight = 1.0 / math.sqrt(dx * dx + dy * dy + _GRIPPING_SLIP**2)
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
        total = see_velocity(r.covariance[k], 0.0, 0.0, r.column) + variance
        correct(r, k, innovation, max(total, innovation * innovation / _ROLLING_GATE))


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
    correct_direction(r.covariance[k], r.column, innovation, total, r.change)
    c, s = r.pointing[0], r.pointing[1]
    r.position[0] += (c if k == 0 else -s) * r.change[0]
    r.position[1] += (s if k == 0 else c) * r.change[0]
    r.velocity[k] += r.change[VELOCITY]
    r.leak[k] += r.change[LEAK]
    r.lens[k] += r.change[LENS]


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
