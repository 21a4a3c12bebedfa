"""Corrections of one control step: how the wheels roll, friction that balances, the camera's pose, joints at rest."""

from __future__ import annotations

import math
from typing import Any

from numba import njit

from wlr_gym.perception.observer import kalman
from wlr_gym.perception.observer.prediction import LIMIT_SLIP, ROLLING
from wlr_gym.physics.plants.base import SENSOR_LAYOUT

# What the corrections take for granted; 1 sigma where it is an uncertainty. Chosen on simulated runs: docs/slip_observer.md.
#: m/s: noise of a wheel's rolling speed from step to step.
_QUIET = 0.0005
#: Relative error of the wheels' radius.
RADIUS = 0.005
#: m/s: slip below which a wheel counts as gripping.
_SOFT = 0.003
#: Error of the balance of friction over the spread of the slips.
_UNEVEN = 0.7
#: s over which that error lasts.
_MEMORY = 0.3
#: Squared normalised innovation beyond which a wheel has slipped.
_WHEEL_GATE = 4.0
#: Squared normalised innovation beyond which a camera frame may be wrong.
_CAMERA_GATE = 25.0
#: Such frames in a row, then it is the estimate that is wrong.
_PATIENCE = 3
#: Camera frames over which a lasting disagreement shows.
_FRAMES = 8.0
#: Twice its mean normalised innovation from which on the wheels are doubted.
_DOUBT = 1.5

_VELOCITY = SENSOR_LAYOUT.slices["joint_velocity"].start
_CAMERA = SENSOR_LAYOUT.slices["camera_pose"].start
_CAMERA_AGE = SENSOR_LAYOUT.slices["camera_age"].start


@njit(cache=True, nogil=True)
def guess_velocity(r: Any) -> None:
    """Begin with the geometric median of the wheels' rolling velocities: some spin while a robot is put down."""
    for _ in range(8):
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
    """Take in how the wheels roll: wheel ``i`` rolls at v + c_i."""
    for k in range(2):
        p = r.covariance[k]
        for i in range(4):  # one that jumps away from the IMU's prediction has slipped
            innovation = r.rolling[i, k] - r.velocity[k] - r.slip[k, i]
            noise = _QUIET**2 + (RADIUS * r.rolling[i, k]) ** 2
            excess = innovation * innovation - _WHEEL_GATE * (kalman.see_wheel(p, i, r.column) + noise)
            if excess > 0.0:
                p[kalman.SLIP + i, kalman.SLIP + i] += excess
        for i in range(4):
            total = kalman.see_wheel(p, i, r.column) + _QUIET**2 + (RADIUS * r.rolling[i, k]) ** 2
            _correct(r, k, r.rolling[i, k] - r.velocity[k] - r.slip[k, i], total)


@njit(cache=True, nogil=True)
def see_friction_balance(robot: Any, r: Any) -> None:
    """Take in that the floor's friction on the wheels nearly cancels out where it must hold little.

    Coulomb friction of wheels under loads N_i that slip by s_i on an even floor balances where sum N_i s_i/|s_i| = 0: at the
    weighted geometric median of the wheels' rolling velocities. One step of Weiszfeld's iteration for it is the measurement
    sum w_i c_i = 0, w_i ~ N_i/|s_i|: wheels that grip decide, and wheels that slip must slip against each other. How uneven the
    floor is, is not known: the more the wheels differ, the less this says.
    """
    common = LIMIT_SLIP * r.limit
    total = 1e-12
    for i in range(4):
        r.weight[i] = r.load[i] / math.sqrt(r.slip[0, i] ** 2 + r.slip[1, i] ** 2 + _SOFT**2 + 0.1 * r.loose * r.mean_square)
        total += r.weight[i]
    for k in range(2):
        mean, spread = 0.0, 0.0
        for i in range(4):
            mean += r.weight[i] / total * r.slip[k, i]
        for i in range(4):
            spread += r.weight[i] / total * (r.slip[k, i] - mean) ** 2
        for i in range(4):
            r.share[i] = r.weight[i] / total
        together = r.limit * r.limit * mean
        variance = (ROLLING**2 + common**2 + together**2 + _UNEVEN**2 * spread) * _MEMORY / robot.period
        _correct(r, k, -mean, kalman.see_balance(r.covariance[k], r.share, r.column) + variance)


@njit(cache=True, nogil=True)
def see_camera(robot: Any, r: Any) -> None:
    """Take in a camera pose: it shows where the robot was ``camera_age`` ago."""
    age = min(max(r.seen[_CAMERA_AGE], 0.0), r.tick * robot.period, (r.raw.shape[0] - 2) * robot.period)
    length = r.raw.shape[0]
    back = r.tick - age / robot.period
    whole = math.floor(back)
    part = back - whole
    now, a = int(r.tick) % length, int(whole) % length
    b = (a + 1) % length if part > 0.0 else a
    c, s = math.cos(r.yaw), math.sin(r.yaw)
    # what the corrections since then have added to the velocity
    ex = c * r.velocity[0] - s * r.velocity[1] - r.raw_velocity[0]
    ey = s * r.velocity[0] + c * r.velocity[1] - r.raw_velocity[1]
    x = r.position[0] - (r.raw[now, 0] - r.raw[a, 0] - part * (r.raw[b, 0] - r.raw[a, 0])) - ex * age
    y = r.position[1] - (r.raw[now, 1] - r.raw[a, 1] - part * (r.raw[b, 1] - r.raw[a, 1])) - ey * age
    yaw = r.yaw - (r.raw[now, 2] - r.raw[a, 2] - part * (r.raw[b, 2] - r.raw[a, 2]))
    dx, dy = r.seen[_CAMERA] - x, r.seen[_CAMERA + 1] - y
    strange = False
    for k in range(2):
        innovation = c * dx + s * dy if k == 0 else c * dy - s * dx
        total = kalman.see_position(r.covariance[k], age, r.column) + robot.camera_noise**2
        least = innovation * innovation / _CAMERA_GATE
        strange = strange or least > total
        r.surprise[k] += (innovation / math.sqrt(max(total, least)) - r.surprise[k]) / _FRAMES
        _correct(r, k, innovation, total if r.strange >= _PATIENCE else max(total, least))
    yaw_error = r.seen[_CAMERA + 2] - yaw
    p = r.yaw_covariance
    total = p[0] + 2.0 * age * p[1] + age * age * p[2] + robot.camera_yaw_noise**2
    least = yaw_error * yaw_error / _CAMERA_GATE
    _correct_yaw(r, 1.0, age, yaw_error, total if r.strange >= _PATIENCE else max(total, least))
    r.doubt = min(1.0, max(0.0, 2.0 * max(abs(r.surprise[0]), abs(r.surprise[1])) - _DOUBT))
    r.strange = r.strange + 1.0 if strange or least > total else 0.0


@njit(cache=True, nogil=True)
def see_rest(robot: Any, r: Any) -> None:
    """While every joint rests, the gyroscope reads its bias."""
    for k in range(8):
        if abs(r.seen[_VELOCITY + k]) > 0.5 * robot.velocity_count:
            return
    total = r.yaw_covariance[2] + robot.gyro_noise**2
    if r.yaw_rate * r.yaw_rate < 16.0 * total:
        _correct_yaw(r, 0.0, 1.0, r.yaw_rate, total)


@njit(cache=True, nogil=True)
def _correct(r: Any, k: int, innovation: float, total: float) -> None:
    """Correct direction ``k`` by the measurement whose P h' is in ``r.column``."""
    r.change[:] = 0.0
    kalman.correct(r.covariance[k], r.column, innovation, total, r.change)
    c, s = math.cos(r.yaw), math.sin(r.yaw)
    r.position[0] += (c if k == 0 else -s) * r.change[0]
    r.position[1] += (s if k == 0 else c) * r.change[0]
    r.velocity[k] += r.change[kalman.VELOCITY]
    r.leak[k] += r.change[kalman.LEAK]
    for i in range(4):
        r.slip[k, i] += r.change[kalman.SLIP + i]


@njit(cache=True, nogil=True)
def _correct_yaw(r: Any, of_yaw: float, of_bias: float, innovation: float, total: float) -> None:
    """Correct yaw and gyroscope bias by a measurement of of_yaw yaw + of_bias bias; ``total``: the innovation's variance."""
    p = r.yaw_covariance
    yaw, bias = of_yaw * p[0] + of_bias * p[1], of_yaw * p[1] + of_bias * p[2]
    r.yaw += yaw / total * innovation
    r.gyro_bias += bias / total * innovation
    p[0] -= yaw * yaw / total
    p[1] -= yaw * bias / total
    p[2] -= bias * bias / total
