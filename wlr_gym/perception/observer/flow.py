"""The optical-flow sensor's readings in the filter: a velocity, with a scale and a rotation that are learned on the way."""

from __future__ import annotations

import math
from typing import Any

from numba import njit

from wlr_gym.perception.observer import kalman
from wlr_gym.perception.observer.correction import correct
from wlr_gym.perception.observer.layout import SENSOR

# What the sensor's scale and mounting are taken for, 1 sigma.
SCALE = 0.03
ROTATION = 0.03
#: Squared normalised innovation beyond which a reading is refused.
GATE = 16.0
#: s of refused readings, moving as the IMU says, after which it is the estimate that may be wrong.
_PATIENCE = 0.5
#: Readings in a row, the same to the last bit, after which the sensor counts as stuck.
_REPEATS = 8.0
#: s without a reading after which nothing is said about the last one.
_SILENCE = 0.5
#: m: shortest distance from lens to floor that is taken for one.
_LEAST_HEIGHT = 0.02


@njit(cache=True, nogil=True)
def see_flow(robot: Any, sensors: Any, r: Any) -> None:
    """Take in a flow reading where there is a new one: flow_x = v_x/h - w_y, flow_y = v_y/h + w_x of the lens, body frame."""
    r.flow_time += robot.period
    x, y = sensors[SENSOR.flow], sensors[SENSOR.flow + 1]
    if robot.flow == 0.0 or not r.seen[SENSOR.flow_is_new] > 0.5 or not math.isfinite(x + y):
        if r.flow_time > _SILENCE:
            r.flow_off = r.flow_rejected = r.flow_refused = 0.0
        return
    r.repeats = r.repeats + 1.0 if x == r.reading[0] and y == r.reading[1] else 0.0
    stuck = r.repeats >= _REPEATS
    r.reading[0], r.reading[1] = x, y
    mean_x, mean_y, height = _seen_velocity(robot, x, y, r)
    if height < _LEAST_HEIGHT:
        return
    age = max(r.seen[SENSOR.flow_age], 0.0) + 0.5 * robot.period  # of the middle of its interval
    poor = max(robot.flow_quality / max(r.seen[SENSOR.flow_quality], 1e-3), 1.0)
    noise = (height * poor * robot.flow_noise) ** 2
    blur = (poor * robot.flow_speed_noise) ** 2
    off, ahead = 0.0, r.velocity[0] - age * r.kick[0]
    for k in range(2):
        mean = mean_x if k == 0 else mean_y
        r.flow_variance[k] = noise + blur * mean * mean
        r.flow_error[k] = mean - (r.velocity[k] - age * r.kick[k])
        spread = kalman.see_velocity(r.covariance[k], age, ahead, r.column)
        off = max(off, r.flow_error[k] ** 2 / (spread + r.flow_variance[k]))
    r.flow_off = math.sqrt(off)
    if off > GATE or stuck:
        r.flow_rejected = 1.0 if off > 1.0 else 0.0
        r.flow_refused = 0.0 if stuck else r.flow_refused + min(r.flow_time, 2.0 * robot.period)
        if r.flow_refused > _PATIENCE:
            for k in range(2):
                r.covariance[k, 1, 1] += r.flow_error[k] ** 2
            r.flow_refused = 0.0
    else:
        r.flow_rejected = r.flow_refused = 0.0
        for k in range(2):
            total = kalman.see_velocity(r.covariance[k], age, ahead, r.column) + r.flow_variance[k]
            correct(r, k, r.flow_error[k], total)
    r.flow_time = 0.0


@njit(cache=True, nogil=True)
def _seen_velocity(robot: Any, x: float, y: float, r: Any) -> Any:
    """Return the body origin's velocity along heading and left by a reading, and the lens's distance to the floor."""
    n, lens = r.normal, robot.lens
    floor, carried, rise = 0.0, 1e-12, 0.0
    for i in range(4):
        floor += r.load[i] * r.point[i, 2]
        rise += r.load[i] * r.lift[i]
        carried += r.load[i]
    floor, rise = floor / carried, rise / carried
    height = (n[0] * lens[0] + n[1] * lens[1] + n[2] * lens[2] - floor) / n[2]
    c, s = math.cos(r.lens[1]), math.sin(r.lens[1])
    x, y = (1.0 + r.lens[0]) * (c * x - s * y), (1.0 + r.lens[0]) * (s * x + c * y)
    wx, wy = 0.5 * (r.rate[0] + r.last_rate[0]), 0.5 * (r.rate[1] + r.last_rate[1])
    wz = 0.5 * (r.rate[2] + r.last_rate[2])
    bx = height * (x + wy) - (wy * lens[2] - wz * lens[1]) - rise * n[0]
    by = height * (y - wx) - (wz * lens[0] - wx * lens[2]) - rise * n[1]
    along = bx / r.heading[0]
    return along, (by - along * r.heading[1]) / r.left[1], height
