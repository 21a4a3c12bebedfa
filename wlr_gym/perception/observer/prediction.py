"""Prediction over one control step: the gyroscope turns, the accelerometer drives, the uncertainty grows."""

from __future__ import annotations

import math
from typing import Any

from numba import njit

from wlr_gym.perception.observer import kalman
from wlr_gym.perception.observer.contacts import carry
from wlr_gym.physics.plants.base import SENSOR_LAYOUT

# What the prediction takes for granted; 1 sigma where it is an uncertainty. Chosen on simulated runs: docs/slip_observer.md.
#: m/s2 per root second: gravity leaking into the accelerometer as the estimated tilt errs.
_ACCEL_WANDER = 0.03
#: Share of the change of an IMU reading from step to step that one sample per step misses.
_ALIAS = 0.25
#: rad/s per root second: random walk of the gyroscope's bias.
_GYRO_WANDER = 1e-5
#: m/s: slow error of a wheel's rolling speed while it does not slip.
ROLLING = 0.0015
#: How far a slip may change while it lasts, over its size.
_SLIP_CHANGE = 1.0
#: m/s: slip to be expected when the floor must hold much.
LIMIT_SLIP = 0.02
#: 1/s: how fast slip fades when it is small and the floor holds easily.
_FADE_FAST = 10.0
#: 1/s: how fast it fades when it is large or the floor holds barely.
_FADE_SLOW = 1.0
#: Friction demand below which slip is unlikely.
_EASY = 0.03
#: Friction demand above which slip is likely.
_HARD = 0.10
#: m/s: slip that certainly is one.
_CERTAIN_SLIP = 0.01
#: How much more than its load a wheel that grips may hold; twice that, it certainly does not.
_HOLDS = 0.8
#: s: how fast the tilt follows the legs.
_SETTLE = 1.5
#: s: low-pass of the friction demand.
_SMOOTH = 0.06

_GYRO = SENSOR_LAYOUT.slices["gyro"].start
_ACCEL = SENSOR_LAYOUT.slices["accelerometer"].start


@njit(cache=True, nogil=True)
def turn(robot: Any, r: Any) -> float:
    """Turn floor normal and heading with the gyroscope; return the angle turned about the normal."""
    before, dt = r.yaw_rate, robot.period
    wx, wy, wz = r.rate[0], r.rate[1], r.rate[2]
    for k in range(3):
        r.rate[k] = r.seen[_GYRO + k]
    mx, my, mz = (0.5 * dt * (r.rate[0] + wx), 0.5 * dt * (r.rate[1] + wy), 0.5 * dt * (r.rate[2] + wz))
    nx, ny, nz = r.normal[0], r.normal[1], r.normal[2]
    x, y, z = nx - (my * nz - mz * ny), ny - (mz * nx - mx * nz), nz - (mx * ny - my * nx)
    set_normal(r, x, y, z)
    r.yaw_rate = r.normal[0] * r.rate[0] + r.normal[1] * r.rate[1] + r.normal[2] * r.rate[2] - r.gyro_bias
    turned = dt * ((0.5 - robot.lag) * before + (0.5 + robot.lag) * r.yaw_rate)
    r.yaw += turned
    c = r.yaw_covariance
    missed = _ALIAS * (r.yaw_rate - before)
    c[0] += dt * (dt * c[2] - 2.0 * c[1]) + dt * dt * (robot.gyro_noise**2 + missed * missed)
    c[1] -= dt * c[2]
    c[2] += _GYRO_WANDER**2 * dt
    return turned


@njit(cache=True, nogil=True)
def set_normal(r: Any, x: float, y: float, z: float) -> None:
    scale = 1.0 / math.sqrt(x * x + y * y + z * z)
    r.normal[0], r.normal[1], r.normal[2] = x * scale, y * scale, z * scale


@njit(cache=True, nogil=True)
def measure_force(r: Any) -> None:
    """Turn the accelerometer's reading into the heading frame: ``r.last_force``."""
    x, y, z = r.seen[_ACCEL], r.seen[_ACCEL + 1], r.seen[_ACCEL + 2]
    r.last_force[0] = r.heading[0] * x + r.heading[2] * z
    r.last_force[1] = r.left[0] * x + r.left[1] * y + r.left[2] * z
    r.last_force[2] = r.normal[0] * x + r.normal[1] * y + r.normal[2] * z


@njit(cache=True, nogil=True)
def sense_force(robot: Any, r: Any) -> float:
    """Mean specific force over the step; friction demand, and how far all wheels may slip alike, ``r.limit`` 0 to 1.

    Returns:
        How much the specific force changed along the floor, m/s2.
    """
    x, y, z = r.last_force[0], r.last_force[1], r.last_force[2]
    measure_force(r)
    old, new = 0.5 - robot.lag, 0.5 + robot.lag
    r.force[0] = old * x + new * r.last_force[0]
    r.force[1] = old * y + new * r.last_force[1]
    r.force[2] = old * z + new * r.last_force[2]
    along = math.sqrt((r.force[0] - r.leak[0]) ** 2 + (r.force[1] - r.leak[1]) ** 2)
    demand = along / max(r.force[2], 0.2 * robot.gravity)
    r.demand += (1.0 - math.exp(-robot.period / _SMOOTH)) * (demand - r.demand)
    share = min(1.0, max(0.0, (max(r.demand, demand) - _EASY) / (_HARD - _EASY)))
    r.limit = max(share * share * (3.0 - 2.0 * share), r.doubt)
    return math.sqrt((r.last_force[0] - x) ** 2 + (r.last_force[1] - y) ** 2)


@njit(cache=True, nogil=True)
def move(robot: Any, turned: float, r: Any) -> None:
    """Carry pose and velocity over the step."""
    dt = robot.period
    c, s = math.cos(turned), math.sin(turned)
    gx, gy = r.slope[0], r.slope[1]
    r.slope[0], r.slope[1] = c * gx + s * gy, c * gy - s * gx
    ax = r.force[0] - r.leak[0] - 0.5 * (gx + r.slope[0])
    ay = r.force[1] - r.leak[1] - 0.5 * (gy + r.slope[1])
    middle = r.yaw - 0.5 * turned
    cm, sm = math.cos(middle), math.sin(middle)
    vx, vy = r.velocity[0], r.velocity[1]
    # in the frame of the step's middle: turned by half, kicked, turned by half
    ch, sh = math.cos(0.5 * turned), math.sin(0.5 * turned)
    bx, by = ch * vx + sh * vy, ch * vy - sh * vx
    ex, ey = bx + dt * ax, by + dt * ay
    r.velocity[0], r.velocity[1] = ch * ex + sh * ey, ch * ey - sh * ex
    mx, my = 0.5 * dt * (bx + ex), 0.5 * dt * (by + ey)
    r.position[0] += cm * mx - sm * my
    r.position[1] += sm * mx + cm * my
    kick_x, kick_y = dt * (cm * ax - sm * ay), dt * (sm * ax + cm * ay)
    length = r.raw.shape[0]
    now, last = int(r.tick) % length, int(r.tick - 1.0) % length
    r.raw[now, 0] = r.raw[last, 0] + dt * (r.raw_velocity[0] + 0.5 * kick_x)
    r.raw[now, 1] = r.raw[last, 1] + dt * (r.raw_velocity[1] + 0.5 * kick_y)
    r.raw[now, 2] = r.raw[last, 2] + turned
    r.raw_velocity[0] += kick_x
    r.raw_velocity[1] += kick_y


@njit(cache=True, nogil=True)
def spread(robot: Any, turned: float, change: float, r: Any) -> None:
    """Carry the uncertainty over the step, and let slip fade."""
    dt = robot.period
    split = min(1.0, (r.slope[0] ** 2 + r.slope[1] ** 2) / robot.accel_bias**2)
    common = LIMIT_SLIP * r.limit
    r.noise[0] = 0.0
    r.noise[1] = dt * dt * (robot.accel_noise**2 + (_ALIAS * change) ** 2)
    # how bias and slope share what the accelerometer read at first is a guess, which shows as the robot turns
    r.noise[2] = _ACCEL_WANDER**2 * dt + (1.4 * robot.accel_bias * turned) ** 2 * (0.3 + 0.7 * split)
    _grip(r)
    for i in range(4):
        size = r.slip[0, i] ** 2 + r.slip[1, i] ** 2 + r.loose * r.mean_square
        r.decay[i] = math.exp(-dt * (_FADE_FAST + max(r.limit, r.loose, 1.0 - r.grips[i]) * (_FADE_SLOW - _FADE_FAST)))
        r.noise[kalman.SLIP + i] = (1.0 - r.decay[i] ** 2) * (ROLLING**2 + common * common + _SLIP_CHANGE**2 * size)
    for k in range(2):
        for i in range(4):
            r.slip[k, i] *= r.decay[i]
        kalman.predict(r.covariance[k], dt, r.decay, r.noise)


@njit(cache=True, nogil=True)
def _grip(r: Any) -> None:
    """Judge which wheels grip, ``r.grips`` (4,) 0 to 1, and whether they can: ``r.loose`` 0 to 1, else.

    Wheels that grip must hold against those that slip: |sum of N_j s_j/|s_j|| over these, at most sum N_i over those where all
    are on one floor. Where they would have to hold much more, the robot skid-steers on all four.
    """
    held_x, held_y, holds, r.mean_square = 0.0, 0.0, 1e-12, 0.0
    for i in range(4):
        cx, cy = r.slip[0, i], r.slip[1, i]
        square = cx * cx + cy * cy
        r.mean_square += 0.25 * square
        size = math.sqrt(square) + 1e-12
        x = min(1.0, size / _CERTAIN_SLIP)
        r.grips[i] = 1.0 - x * x * (3.0 - 2.0 * x)
        holds += r.grips[i] * r.load[i]
        held_x += (1.0 - r.grips[i]) * r.load[i] * cx / size
        held_y += (1.0 - r.grips[i]) * r.load[i] * cy / size
    ratio = math.sqrt(held_x * held_x + held_y * held_y) / holds
    r.loose = min(1.0, max(0.0, (ratio - _HOLDS) / _HOLDS))


@njit(cache=True, nogil=True)
def settle(robot: Any, r: Any) -> None:
    """Loads of the wheels; let the tilt follow the legs."""
    b, c = carry(robot, r.seen, r)
    share = robot.period / _SETTLE
    b, c = share * b, share * c
    set_normal(
        r,
        r.normal[0] - b * r.heading[0] - c * r.left[0],
        r.normal[1] - c * r.left[1],
        r.normal[2] - b * r.heading[2] - c * r.left[2],
    )
