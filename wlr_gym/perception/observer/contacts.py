"""Where the wheels touch the floor, how fast they roll, and what they carry."""

from __future__ import annotations

import math
from typing import Any

from numba import njit

from wlr_gym.perception.observer.layout import SENSOR
from wlr_gym.robot import FIRST_WHEEL

_WHEEL_RATE = SENSOR.joint_velocity + FIRST_WHEEL
_WHEEL_EFFORT = SENSOR.joint_effort + FIRST_WHEEL
#: N. Less than this counts as a wheel in the air when something is divided by its load.
LEAST_LOAD = 0.5


@njit(cache=True, nogil=True)
def look(robot: Any, sensors: Any, r: Any) -> None:
    """Find heading, left and contact points for the floor normal ``r.normal``, and how each wheel rolls.

    ``r.rolling[i]`` is the velocity of the body origin along heading and left with which wheel ``i`` would not slip;
    ``r.lift[i]`` that along the normal with which it would stay on the floor (equations of :mod:`wlr_gym.robot.slip`).

    Args:
        robot: geometry.
        sensors: (SENSOR_LAYOUT.width,) joint angles and rates are read.
        r: record of the robot; reads ``normal``, ``rate`` (body's angular velocity, body frame).
    """
    nx, ny, nz = r.normal[0], r.normal[1], r.normal[2]
    scale = 1.0 / math.sqrt(nx * nx + nz * nz + 1e-12)
    hx, hz = nz * scale, -nx * scale
    r.heading[0], r.heading[1], r.heading[2] = hx, 0.0, hz
    r.left[0], r.left[1], r.left[2] = ny * hz, nz * hx - nx * hz, -ny * hx
    wx, wy, wz = r.rate[0], r.rate[1], r.rate[2]
    reach = robot.wheel_radius * scale
    for i in range(4):
        leg_rate, wheel_rate = sensors[SENSOR.joint_velocity + i], sensors[_WHEEL_RATE + i]
        r.leg[i, 0], r.leg[i, 1] = math.cos(sensors[i]), math.sin(sensors[i])
        leg_x, leg_z = robot.leg_length * r.leg[i, 0], -robot.leg_length * r.leg[i, 1]
        rim_x, rim_z = -reach * nx, -reach * nz
        x = robot.hip[i, 0] + leg_x + rim_x
        y = robot.hip[i, 1]
        z = robot.hip[i, 2] + leg_z + rim_z
        ux = wy * z - wz * y + leg_rate * (leg_z + rim_z) + wheel_rate * rim_z
        uy = wz * x - wx * z
        uz = wx * y - wy * x - leg_rate * (leg_x + rim_x) - wheel_rate * rim_x
        r.point[i, 0] = hx * x + hz * z
        r.point[i, 1] = r.left[0] * x + r.left[1] * y + r.left[2] * z
        r.point[i, 2] = nx * x + ny * y + nz * z
        r.rolling[i, 0] = -(hx * ux + hz * uz)
        r.rolling[i, 1] = -(r.left[0] * ux + r.left[1] * uy + r.left[2] * uz)
        r.lift[i] = -(nx * ux + ny * uy + nz * uz)


@njit(cache=True, nogil=True)
def _centre_of_mass(robot: Any, r: Any) -> Any:
    """Centre of mass of the whole robot along heading, left and normal, m."""
    x, y, z = robot.body_mass * robot.body_com[0], robot.body_mass * robot.body_com[1], robot.body_mass * robot.body_com[2]
    assembly = robot.leg_mass + robot.wheel_mass
    moment = robot.leg_mass * robot.leg_com + robot.wheel_mass * robot.leg_length
    for i in range(4):
        x += assembly * robot.hip[i, 0] + moment * r.leg[i, 0]
        y += assembly * robot.hip[i, 1]
        z += assembly * robot.hip[i, 2] - moment * r.leg[i, 1]
    x, y, z = x / robot.mass, y / robot.mass, z / robot.mass
    return (
        r.heading[0] * x + r.heading[2] * z,
        r.left[0] * x + r.left[1] * y + r.left[2] * z,
        r.normal[0] * x + r.normal[1] * y + r.normal[2] * z,
    )


@njit(cache=True, nogil=True)
def carry(robot: Any, r: Any) -> Any:
    """Find the normal forces that hold the robot: ``r.load`` (4,) N; return the tilt of the floor they imply.

    Four feet on a floor are one too many for statics; their springs decide. The body sinks into the springs as a plane:
    N_i = k max(0, a + b x_i + c y_i - z_i), with a, b, c such that force and both moments about the centre of mass balance
    those of the measured acceleration (the robot is taken not to tumble). It is the engine's own rest state. Corrected
    equations (16), (17) of the paper are its level case with legs pairwise equal.

    Returns:
        b, c: slope of the true floor over the assumed one along heading and left; 0, 0 when fewer than three wheels carry.
    """
    fx, fy, fz = r.force[0], r.force[1], max(r.force[2], 1.0)
    cx, cy, cz = _centre_of_mass(robot, r)
    height = cz - 0.25 * (r.point[0, 2] + r.point[1, 2] + r.point[2, 2] + r.point[3, 2])
    weight = robot.mass * fz / robot.stiffness
    mx = weight * cx - robot.mass * height * fx / robot.stiffness
    my = weight * cy - robot.mass * height * fy / robot.stiffness
    r.carries[:] = 1.0
    a, b, c = 0.0, 0.0, 0.0
    for _ in range(4):
        n, sx, sy, sxx, sxy, syy, sz, sxz, syz = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
        for i in range(4):
            on = r.carries[i]
            x, y, z = r.point[i, 0], r.point[i, 1], r.point[i, 2]
            n += on
            sx += on * x
            sy += on * y
            sxx += on * x * x
            sxy += on * x * y
            syy += on * y * y
            sz += on * z
            sxz += on * x * z
            syz += on * y * z
        if n < 2.5:
            break
        p, q, s = weight + sz, mx + sxz, my + syz
        k00, k01, k02 = sxx * syy - sxy * sxy, sy * sxy - sx * syy, sx * sxy - sy * sxx
        k11, k12, k22 = n * syy - sy * sy, sx * sy - n * sxy, n * sxx - sx * sx
        inverse = 1.0 / (n * k00 + sx * k01 + sy * k02)
        a = (k00 * p + k01 * q + k02 * s) * inverse
        b = (k01 * p + k11 * q + k12 * s) * inverse
        c = (k02 * p + k12 * q + k22 * s) * inverse
        changed = False
        for i in range(4):
            on = 1.0 if a + b * r.point[i, 0] + c * r.point[i, 1] > r.point[i, 2] else 0.0
            changed = changed or on != r.carries[i]
            r.carries[i] = on
        if not changed:
            break
    total = 0.0
    for i in range(4):
        r.load[i] = max(0.0, robot.stiffness * (a + b * r.point[i, 0] + c * r.point[i, 1] - r.point[i, 2]))
        total += r.load[i]
    share = robot.mass * fz / max(total, LEAST_LOAD)
    for i in range(4):
        r.load[i] *= share
    return b, c


@njit(cache=True, nogil=True)
def pull(robot: Any, sensors: Any, r: Any) -> None:
    """Find the traction of every wheel, ``r.traction`` (4,) N: effort less gear friction and spin inertia, over the radius.

    Equations (25) to (28) of the paper as corrected.
    """
    for i in range(4):
        rate = sensors[_WHEEL_RATE + i]
        spin = rate + sensors[SENSOR.joint_velocity + i] + r.rate[1]
        spin_up = (spin - r.spin[i]) / robot.period
        dry = robot.gear_friction * math.tanh(rate / robot.velocity_count)
        torque = sensors[_WHEEL_EFFORT + i] - dry - robot.spin_inertia * spin_up
        r.traction[i] = torque / robot.wheel_radius
        r.spin[i] = spin
