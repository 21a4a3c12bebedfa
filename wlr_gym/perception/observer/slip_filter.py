"""One control step of the observer: a small Kalman filter per robot, compiled; every robot on its own.

Frames: *start* (the floor frame as the body stood at the reset: x along its heading), *heading* (turns with the body about the
floor's normal; x along the wheels, y to the left in the floor), *body*. Velocities are estimated in the heading frame, each
direction by a filter of its own (:mod:`wlr_gym.perception.observer.kalman`), heading and gyroscope bias by a third.
"""

from __future__ import annotations

import math
from typing import Any

from numba import njit

from wlr_gym.perception.observer import kalman
from wlr_gym.perception.observer.camera import see_camera
from wlr_gym.perception.observer.contacts import LEAST_LOAD, carry, look, pull
from wlr_gym.perception.observer.correction import RADIUS, guess_velocity, see_rest, see_rolling
from wlr_gym.perception.observer.flow import ROTATION, SCALE, see_flow
from wlr_gym.perception.observer.layout import ESTIMATE, SENSOR
from wlr_gym.perception.observer.prediction import measure_force, move, sense_force, settle, spread, turn
from wlr_gym.perception.observer.trust import gather, judge

#: m, 1 sigma at the start.
_START_PLACE = 1e-4


@njit(cache=True, nogil=True)
def reset(robot: Any, states: Any, mask: Any, sensors: Any, values: Any) -> None:
    """Start masked robots anew; see :class:`wlr_gym.perception.observer.observer.SlipObserver`."""
    for i in range(mask.shape[0]):
        if mask[i]:
            _start(robot[0], sensors[i], states[i])
            _report(robot[0], states[i], values[i])


@njit(cache=True, nogil=True)
def update(robot: Any, states: Any, mask: Any, sensors: Any, values: Any, work: Any) -> None:
    """Advance masked robots by one control step."""
    for i in range(mask.shape[0]):
        if mask[i]:
            _advance(robot[0], sensors[i], states[i], work[0])
            _report(robot[0], states[i], values[i])


@njit(cache=True, nogil=True)
def _start(robot: Any, sensors: Any, r: Any) -> None:
    """Begin level and at rest; what the accelerometer reads along the floor is bias or, where it is much, a slope."""
    r.seen[:] = 0.0
    r.seen[SENSOR.accelerometer + 2] = robot.gravity
    _take(sensors, r)
    r.tick = r.yaw = r.turned = r.gyro_bias = r.demand = r.shaken = r.legs = 0.0
    r.camera_off = r.camera_rejected = r.refused = r.frame_time = r.doubt = 0.0
    r.flow_off = r.flow_rejected = r.flow_refused = r.flow_time = r.repeats = 0.0
    r.anchor[:] = 0.0
    r.off[:] = 0.0
    r.first_off[:] = 0.0
    r.frame[:] = math.inf  # as none will be
    r.reading[:] = math.inf
    r.lens[:] = 0.0
    r.memory[:] = 0.0
    r.wander[:] = 1.0
    r.normal[0], r.normal[1], r.normal[2] = 0.0, 0.0, 1.0
    r.raw[:] = 0.0
    r.yaw_covariance[0], r.yaw_covariance[1], r.yaw_covariance[2] = 0.0, 0.0, robot.gyro_bias**2
    for k in range(3):
        r.rate[k] = r.last_rate[k] = r.seen[SENSOR.gyro + k]
    r.yaw_rate = r.rate[2]
    look(robot, r.seen, r)
    measure_force(r)
    for k in range(3):
        r.force[k] = r.last_force[k]
    pull(robot, r.seen, r)
    r.traction[:] = 0.0
    carry(robot, r)
    r.covariance[:] = 0.0
    r.guess = math.sqrt(r.force[0] ** 2 + r.force[1] ** 2)
    for k in range(2):
        total = r.force[k]
        bias = total / (1.0 + (total / (3.0 * robot.accel_bias)) ** 4)  # more than that is a slope
        r.leak[k], r.slope[k] = bias, total - bias
        r.position[k] = r.velocity[k] = r.raw_velocity[k] = r.last_velocity[k] = r.kick[k] = 0.0
        r.covariance[k, 0, 0] = _START_PLACE**2
        r.covariance[k, kalman.VELOCITY, kalman.VELOCITY] = robot.start_speed**2
        r.covariance[k, kalman.LEAK, kalman.LEAK] = robot.start_leak**2
        r.covariance[k, kalman.LENS, kalman.LENS] = (SCALE if k == 0 else ROTATION) ** 2


@njit(cache=True, nogil=True)
def _take(sensors: Any, r: Any) -> None:
    """Keep what is a number: ``r.seen``."""
    for k in range(sensors.shape[0]):
        if math.isfinite(sensors[k]):
            r.seen[k] = sensors[k]


@njit(cache=True, nogil=True)
def _advance(robot: Any, sensors: Any, r: Any, work: Any) -> None:
    """Predict with the IMU, then take in wheels, camera and flow."""
    _take(sensors, r)
    r.tick += 1.0
    for i in range(4):
        r.last_rolling[i, 0], r.last_rolling[i, 1] = r.rolling[i, 0], r.rolling[i, 1]
    turn(robot, r)
    look(robot, r.seen, r)
    sense_force(robot, r)
    move(robot, r)
    spread(robot, r)
    pull(robot, r.seen, r)
    settle(robot, r)
    if r.tick == 1.0:
        guess_velocity(r)
    gather(robot, r, work)
    judge(robot, r, work)
    see_rolling(robot, r)
    see_camera(robot, sensors, r)
    see_flow(robot, sensors, r)
    see_rest(robot, r)


@njit(cache=True, nogil=True)
def _report(robot: Any, r: Any, out: Any) -> None:
    """Write the estimates."""
    h, n, left = r.heading, r.normal, r.left
    rise, carried = 0.0, 1e-12
    for i in range(4):
        rise += r.load[i] * r.lift[i]
        carried += r.load[i]
    rise /= carried
    vx, vy = r.velocity[0], r.velocity[1]
    out[ESTIMATE.position], out[ESTIMATE.position + 1] = r.position[0], r.position[1]
    out[ESTIMATE.yaw], out[ESTIMATE.yaw_sigma] = r.yaw, math.sqrt(max(r.yaw_covariance[0], 0.0))
    out[ESTIMATE.linear_velocity_in_body] = vx * h[0] + vy * left[0] + rise * n[0]
    out[ESTIMATE.linear_velocity_in_body + 1] = vy * left[1] + rise * n[1]
    out[ESTIMATE.yaw_rate] = r.yaw_rate
    gx, gy = r.slope[0] / robot.gravity, r.slope[1] / robot.gravity
    gz = math.sqrt(max(0.0, 1.0 - gx * gx - gy * gy))
    for k in range(3):
        out[ESTIMATE.gravity_in_body + k] = -(gx * h[k] + gy * left[k] + gz * n[k])
    vote = (robot.velocity_count * robot.wheel_radius) ** 2 / 6.0
    for k in range(2):
        variance = max(r.covariance[k, kalman.VELOCITY, kalman.VELOCITY], 0.0)
        out[ESTIMATE.linear_velocity_sigma + k] = math.sqrt(variance)
        for i in range(4):
            own = vote + (RADIUS * r.rolling[i, 0]) ** 2 if k == 0 else (robot.gyro_noise * r.point[i, 0]) ** 2
            out[ESTIMATE.slip_velocity + 2 * i + k] = r.velocity[k] - r.rolling[i, k]
            out[ESTIMATE.slip_sigma + 2 * i + k] = math.sqrt(variance + own)
    for i in range(4):
        out[ESTIMATE.traction_force + i], out[ESTIMATE.normal_force + i] = r.traction[i], r.load[i]
        out[ESTIMATE.traction_use + i] = abs(r.traction[i]) / max(r.load[i], LEAST_LOAD)
    out[ESTIMATE.friction_demand] = r.demand
    out[ESTIMATE.camera_innovation], out[ESTIMATE.camera_rejected] = r.camera_off, r.camera_rejected
    out[ESTIMATE.flow_innovation], out[ESTIMATE.flow_rejected] = r.flow_off, r.flow_rejected
