"""The camera's poses in the filter: late frames, frames that are not believed, a camera that has been moved."""

from __future__ import annotations

import math
from typing import Any

from numba import njit

from wlr_gym.perception.observer import kalman
from wlr_gym.perception.observer.correction import correct, correct_yaw
from wlr_gym.perception.observer.layout import SENSOR

#: Squared normalised innovation beyond which a frame is refused.
GATE = 20.0
#: s: refused frames that are off by the same for so long say that the camera has been moved.
_PATIENCE = 0.25
#: s: frames that steadily move away for so long say that the robot does, whatever wheels and IMU say.
_LONG_PATIENCE = 0.5
#: m, rad: what counts as the same.
_SAME = 0.006
_SAME_YAW = 0.03
#: s without a frame after which nothing is said about the last one.
_SILENCE = 0.5


@njit(cache=True, nogil=True)
def see_camera(robot: Any, sensors: Any, r: Any) -> None:
    """Take in a camera pose where there is a new one; it shows where the robot was ``camera_age`` ago.

    Frames come in two ways: as they are, and in the frame of a camera that has been moved (``r.anchor``). A frame that fits
    neither is refused. When frames have been off by the same for a while, it is the camera that has been moved: a robot does
    not jump. The estimate then stays, and only motion is learned from the camera. When they steadily move away, it is the
    robot that slides. A frame that repeats the last one to the last bit is no new picture.
    """
    r.frame_time += robot.period
    x, y, yaw = sensors[SENSOR.camera_pose], sensors[SENSOR.camera_pose + 1], sensors[SENSOR.camera_pose + 2]
    if robot.camera == 0.0 or not r.seen[SENSOR.camera_is_new] > 0.5 or not math.isfinite(x + y + yaw):
        if r.frame_time > _SILENCE:
            r.camera_off = r.camera_rejected = r.refused = 0.0
        return
    repeated = x == r.frame[0] and y == r.frame[1] and yaw == r.frame[2]
    r.frame[0], r.frame[1], r.frame[2] = x, y, yaw
    age = min(max(r.seen[SENSOR.camera_age], 0.0), r.tick * robot.period, (r.raw.shape[0] - 2) * robot.period)
    then_x, then_y, then_yaw = _pose_before(robot, age, r)
    off = _off(robot, age, x - then_x, y - then_y, yaw - then_yaw, r)
    dx, dy, dyaw = x - then_x, y - then_y, yaw - then_yaw
    if off <= GATE:
        r.anchor[:] = 0.0
    elif r.anchor[0] != 0.0 or r.anchor[1] != 0.0 or r.anchor[2] != 0.0:
        c, s = math.cos(r.anchor[2]), math.sin(r.anchor[2])
        dx = r.anchor[0] + c * x - s * y - then_x
        dy = r.anchor[1] + s * x + c * y - then_y
        dyaw = yaw + r.anchor[2] - then_yaw
        off = _off(robot, age, dx, dy, dyaw, r)
    r.camera_off = math.sqrt(off)
    if off > GATE or (repeated and off > 1.0):
        r.camera_rejected = 1.0
        if not repeated:
            _refuse(x, y, yaw, then_x, then_y, then_yaw, dx, dy, dyaw, r)
    elif not repeated:
        r.camera_rejected = r.refused = 0.0
        _believe(robot, age, dx, dy, dyaw, r)
    r.frame_time = 0.0


@njit(cache=True, nogil=True)
def _pose_before(robot: Any, age: float, r: Any) -> Any:
    """Return where the robot was ``age`` s ago, start frame: its estimate less the IMU's way since."""
    length = r.raw.shape[0]
    back = r.tick - age / robot.period
    whole = math.floor(back)
    part = back - whole
    now, a = int(r.tick) % length, int(whole) % length
    b = (a + 1) % length if part > 0.0 else a
    c, s = r.pointing[0], r.pointing[1]
    # what the corrections since then have added to the velocity
    ex = c * r.velocity[0] - s * r.velocity[1] - r.raw_velocity[0]
    ey = s * r.velocity[0] + c * r.velocity[1] - r.raw_velocity[1]
    x = r.position[0] - (r.raw[now, 0] - r.raw[a, 0] - part * (r.raw[b, 0] - r.raw[a, 0])) - ex * age
    y = r.position[1] - (r.raw[now, 1] - r.raw[a, 1] - part * (r.raw[b, 1] - r.raw[a, 1])) - ey * age
    return x, y, r.yaw - (r.raw[now, 2] - r.raw[a, 2] - part * (r.raw[b, 2] - r.raw[a, 2]))


@njit(cache=True, nogil=True)
def _yaw_variance(robot: Any, age: float, r: Any) -> float:
    p = r.yaw_covariance
    return p[0] + 2.0 * age * p[1] + age * age * p[2] + robot.camera_yaw_noise**2


@njit(cache=True, nogil=True)
def _off(robot: Any, age: float, dx: float, dy: float, dyaw: float, r: Any) -> float:
    """Return the largest squared normalised innovation of a frame that is off by so much in the start frame."""
    c, s = r.pointing[0], r.pointing[1]
    off = dyaw * dyaw / _yaw_variance(robot, age, r)
    for k in range(2):
        along = c * dx + s * dy if k == 0 else c * dy - s * dx
        off = max(off, along * along / (kalman.see_position(r.covariance[k], age, r.column) + robot.camera_noise**2))
    return off


@njit(cache=True, nogil=True)
def _believe(robot: Any, age: float, dx: float, dy: float, dyaw: float, r: Any) -> None:
    c, s = r.pointing[0], r.pointing[1]
    for k in range(2):
        along = c * dx + s * dy if k == 0 else c * dy - s * dx
        correct(r, k, along, kalman.see_position(r.covariance[k], age, r.column) + robot.camera_noise**2)
    correct_yaw(r, 1.0, age, dyaw, _yaw_variance(robot, age, r))


@njit(cache=True, nogil=True)
def _refuse(
    x: float, y: float, yaw: float, then_x: float, then_y: float, then_yaw: float, dx: float, dy: float, dyaw: float, r: Any
) -> None:
    """Follow how refused frames are off: by the same, then the camera has been moved; or steadily moving away."""
    if r.refused == 0.0:
        r.first_off[0], r.first_off[1], r.first_off[2] = dx, dy, dyaw
        r.off[0], r.off[1], r.off[2] = dx, dy, dyaw
        r.refused = 1e-9
        return
    before = r.refused
    r.refused += r.frame_time
    ahead = r.frame_time / before if before > r.frame_time else 0.0
    jump_x = dx - r.off[0] - ahead * (r.off[0] - r.first_off[0])
    jump_y = dy - r.off[1] - ahead * (r.off[1] - r.first_off[1])
    if abs(jump_x) > _SAME or abs(jump_y) > _SAME or abs(dyaw - r.off[2]) > _SAME_YAW:
        r.refused = 0.0
        return
    r.off[0], r.off[1], r.off[2] = dx, dy, dyaw
    moved = max(abs(dx - r.first_off[0]), abs(dy - r.first_off[1]))
    if r.refused >= _PATIENCE and moved < _SAME:
        turned = then_yaw - yaw
        c, s = math.cos(turned), math.sin(turned)
        r.anchor[0], r.anchor[1], r.anchor[2] = then_x - c * x + s * y, then_y - s * x - c * y, turned
        r.refused = 0.0
    elif r.refused >= _LONG_PATIENCE:
        for k in range(2):
            p = r.covariance[k]
            p[0, 0] += dx * dx + dy * dy
            p[1, 1] += (moved / r.refused) ** 2
        r.doubt = moved / r.refused
        r.refused = 0.0
