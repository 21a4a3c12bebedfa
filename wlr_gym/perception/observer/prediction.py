"""Prediction over one control step: the gyroscope turns, the accelerometer drives, the uncertainty grows."""

from __future__ import annotations

import math
from typing import Any

from numba import njit

from wlr_gym.perception.observer import kalman
from wlr_gym.perception.observer.contacts import carry
from wlr_gym.perception.observer.layout import SENSOR

# What the prediction takes for granted; 1 sigma where it is an uncertainty. Chosen on simulated runs: docs/slip_observer.md.
#: Share of the change of an IMU reading from step to step that one sample per step misses.
_ALIAS = 0.25
#: rad/s per root second: random walk of the gyroscope's bias.
_GYRO_WANDER = 1e-5
#: s: how fast the tilt follows the legs.
_SETTLE = 1.5
#: s: low-pass of the friction demand.
_SMOOTH = 0.06


@njit(cache=True, nogil=True)
def rate_noise(robot: Any, changed: Any) -> Any:
    """Variance (rad2/s2) of a gyroscope's reading that has changed by so much, rad/s."""
    missed = _ALIAS * changed
    return robot.gyro_noise**2 + missed * missed


@njit(cache=True, nogil=True)
def shaking(robot: Any, changed: Any, square: Any) -> Any:
    """Variance (m2/s4) of what one reading of the specific force per step misses.

    Args:
        robot: how much, learned. changed: by how much it has changed, m/s2. square: mean square of the legs' rates.
    """
    return (robot.alias * changed) ** 2 + robot.velocity_legs**2 * square


@njit(cache=True, nogil=True)
def leak_noise(robot: Any, square: Any) -> Any:
    """Variance per s (m2/s5) of the walk of the accelerometer's leak; ``square``: mean square of the legs' rates."""
    return robot.leak_wander**2 + robot.leak_legs**2 * square


@njit(cache=True, nogil=True)
def turn(robot: Any, r: Any) -> None:
    """Turn floor normal and heading with the gyroscope."""
    before, dt = r.yaw_rate, robot.period
    wx, wy, wz = r.rate[0], r.rate[1], r.rate[2]
    for k in range(3):
        r.last_rate[k] = r.rate[k]
        r.rate[k] = r.seen[SENSOR.gyro + k]
    mx, my, mz = (0.5 * dt * (r.rate[0] + wx), 0.5 * dt * (r.rate[1] + wy), 0.5 * dt * (r.rate[2] + wz))
    nx, ny, nz = r.normal[0], r.normal[1], r.normal[2]
    x, y, z = nx - (my * nz - mz * ny), ny - (mz * nx - mx * nz), nz - (mx * ny - my * nx)
    set_normal(r, x, y, z)
    r.yaw_rate = r.normal[0] * r.rate[0] + r.normal[1] * r.rate[1] + r.normal[2] * r.rate[2] - r.gyro_bias
    turned = dt * ((0.5 - robot.lag) * before + (0.5 + robot.lag) * r.yaw_rate)
    r.yaw += turned
    r.turned = turned
    c = r.yaw_covariance
    c[0] += dt * (dt * c[2] - 2.0 * c[1]) + dt * dt * rate_noise(robot, r.yaw_rate - before)
    c[1] -= dt * c[2]
    c[2] += _GYRO_WANDER**2 * dt


@njit(cache=True, nogil=True)
def set_normal(r: Any, x: float, y: float, z: float) -> None:
    scale = 1.0 / math.sqrt(x * x + y * y + z * z)
    r.normal[0], r.normal[1], r.normal[2] = x * scale, y * scale, z * scale


@njit(cache=True, nogil=True)
def measure_force(r: Any) -> None:
    """Turn the accelerometer's reading into the heading frame: ``r.last_force``."""
    x, y, z = r.seen[SENSOR.accelerometer], r.seen[SENSOR.accelerometer + 1], r.seen[SENSOR.accelerometer + 2]
    r.last_force[0] = r.heading[0] * x + r.heading[2] * z
    r.last_force[1] = r.left[0] * x + r.left[1] * y + r.left[2] * z
    r.last_force[2] = r.normal[0] * x + r.normal[1] * y + r.normal[2] * z


@njit(cache=True, nogil=True)
def sense_force(robot: Any, r: Any) -> None:
    """Mean specific force over the step, how much it changed along the floor, and friction demand."""
    x, y, z = r.last_force[0], r.last_force[1], r.last_force[2]
    measure_force(r)
    old, new = 0.5 - robot.lag, 0.5 + robot.lag
    r.force[0] = old * x + new * r.last_force[0]
    r.force[1] = old * y + new * r.last_force[1]
    r.force[2] = old * z + new * r.last_force[2]
    along = math.sqrt((r.force[0] - r.leak[0]) ** 2 + (r.force[1] - r.leak[1]) ** 2)
    demand = along / max(r.force[2], 0.2 * robot.gravity)
    r.demand += (1.0 - math.exp(-robot.period / _SMOOTH)) * (demand - r.demand)
    r.shaken = math.sqrt((r.last_force[0] - x) ** 2 + (r.last_force[1] - y) ** 2)


@njit(cache=True, nogil=True)
def move(robot: Any, r: Any) -> None:
    """Carry pose and velocity over the step."""
    dt, turned = robot.period, r.turned
    # in the frame of the step's middle: turned by half, kicked, turned by half
    ch, sh = math.cos(0.5 * turned), math.sin(0.5 * turned)
    c, s = ch * ch - sh * sh, 2.0 * ch * sh
    gx, gy = r.slope[0], r.slope[1]
    r.slope[0], r.slope[1] = c * gx + s * gy, c * gy - s * gx
    ax = r.force[0] - r.leak[0] - 0.5 * (gx + r.slope[0])
    ay = r.force[1] - r.leak[1] - 0.5 * (gy + r.slope[1])
    r.kick[0], r.kick[1] = ax, ay
    r.pointing[0], r.pointing[1] = math.cos(r.yaw), math.sin(r.yaw)
    cm, sm = ch * r.pointing[0] + sh * r.pointing[1], ch * r.pointing[1] - sh * r.pointing[0]
    vx, vy = r.velocity[0], r.velocity[1]
    r.last_velocity[0], r.last_velocity[1] = vx, vy
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
def spread(robot: Any, r: Any) -> None:
    """Carry the uncertainty over the step."""
    dt = robot.period
    square = 0.0
    for i in range(4):
        square += 0.25 * r.seen[SENSOR.joint_velocity + i] ** 2
    r.legs = math.sqrt(square)
    # how bias and slope share what the accelerometer read at first is a guess, which shows as the robot turns
    guess = (robot.leak_turn * r.guess * r.turned) ** 2
    r.inclined = min(1.0, (r.slope[0] ** 2 + r.slope[1] ** 2) / robot.accel_bias**2)
    wander = leak_noise(robot, square) * dt + guess
    velocity_noise = dt * dt * (robot.accel_noise**2 + r.wander[0] * shaking(robot, r.shaken, square))
    for k in range(2):
        kalman.predict(r.covariance[k], dt, velocity_noise, r.wander[1] * wander)


@njit(cache=True, nogil=True)
def settle(robot: Any, r: Any) -> None:
    """Loads of the wheels; let the tilt follow the legs."""
    b, c = carry(robot, r)
    share = robot.period / _SETTLE
    b, c = share * b, share * c
    set_normal(
        r,
        r.normal[0] - b * r.heading[0] - c * r.left[0],
        r.normal[1] - c * r.left[1],
        r.normal[2] - b * r.heading[2] - c * r.left[2],
    )
