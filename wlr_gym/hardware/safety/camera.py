"""Which poses of the camera are believed: none at all, and a wrong one, are two things.

No pose (covered, lost markers, a process that hangs) is a dropout: the estimates go on without. A pose that contradicts
gyroscope, wheels or legs is wrong, and is kept back; a camera that goes on like that is not believed until it has agreed with
them for a while, longer each time. Neither stops the robot. No I/O, no clock.
"""

from __future__ import annotations

import math
from collections import Counter, deque
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from wlr_gym.hardware.camera.reading import CameraReading
from wlr_gym.hardware.safety.status import CameraStatus
from wlr_gym.hardware.timing import percentiles
from wlr_gym.robot import CORNER_SIGNS, LEG_SLICE, WHEEL_SLICE, Robot

Array = NDArray[np.float64]

#: s that a pose may be old when it arrives.
LARGEST_AGE = 0.3
#: s without a frame after which that is a dropout: a few frames of 30 Hz.
SILENCE = 0.15
#: m and rad, 1 sigma, beyond which a pose is no use.
LARGEST_SIGMA = (0.01, 0.05)
#: s of motion that is remembered.
MEMORY = 1.2
#: Ages (s) of believed poses that a new one is held against, besides the last.
_AGAINST = (0.15, 0.5, 1.0)
# How far a true pose may differ from what gyroscope, wheels and legs say; chosen on simulated drives (docs/camera.md).
#: rad: at once, per s, of what was turned, and per rad/s by which the yaw rate has changed (a lag of the pictures, s).
_TURN = (0.015, 0.02, 0.02, 0.06)
#: m: at once, and per s of sliding along and across.
_ALONG, _ACROSS = (0.004, 0.02), (0.004, 0.08)
#: s for which a body may go on as its wheels went before.
_COAST = 0.4
#: m between the body's height and that of its legs.
_HEIGHT = 0.03
#: Contradictions in a row from which on the camera itself is not believed.
_DOUBTED = 3
#: s for which poses must agree before they are believed: at the start and after a gap; after contradictions, each time twice
#: as long, up to the last.
_AGREES, _AGREES_AGAIN, _LONGEST = 0.12, 0.5, 8.0
#: m and rad, and both per s of a gap, by which the pose may differ from dead reckoning after it; beyond, and after
#: contradictions, the camera's frame is taken to have moved, and the pose goes on from dead reckoning.
_GAP = ((0.03, 0.1), (0.03, 0.03))
#: Least sum of squared changes of the yaw rate (rad/s)^2 from which the lag of the pictures is known.
_LEAST_TURNS = 2.0
#: s, 1 sigma, from which on the lag is allowed for, and what is the most of it.
_LAG_SIGMA, _LARGEST_LAG = 0.004, 0.15

# Reasons of its own; the others are those of the readings.
STALLED = "no frame comes"
TOO_OLD = "the frame is too old"
FUTURE = "the time stamp is ahead of time"
BACKWARD = "the time stamp goes backward"
UNCERTAIN = "the pose is uncertain"
SETTLING = "poses must agree for a while first"
CONTRADICTIONS = ("contradicts the gyroscope", "contradicts the wheels", "contradicts the legs' height")


class _Seen(NamedTuple):
    """A pose in the floor frame; what the robot's own sensors counted until then: turn, way along (least, most); the yaw rate.

    ``stamped`` is the time that the reading names; ``time`` allows for the pictures' lag, as far as it is known.
    """

    time: float
    stamped: float
    pose: Array
    turn: float
    least: float
    most: float
    rate: float


#: What is known of the robot's own motion at a control step: time (s); dead reckoning (m, rad); turn (rad) and way along (m)
#: that the sensors counted, the latter at least and at most; the body's height (m); slowest and fastest wheel (m/s).
_MOTION = ("time", "x", "y", "yaw", "turn", "least", "most", "height", "slowest", "fastest")


class CameraWatch:
    """Judges the camera's readings, control step by control step, and shows poses in the frame of the run.

    Args:
        robot: its geometry. doubt: of the camera, see :class:`wlr_gym.hardware.camera.reading.CameraFile`.

    Attributes:
        status: what is known now.
        frames, poses: readings that came, and those of them that were believed. reasons: of all others.
        latencies: s from exposure to the control step, of believed ones. work: s from a picture to its pose, of all.
    """

    def __init__(self, robot: Robot, doubt: str = "") -> None:
        hip = robot.hip_position
        self._side = np.array([sign * hip.y for _, sign in CORNER_SIGNS])
        self._hip_height, self._leg, self._radius = hip.z, robot.leg.length, robot.wheel.radius
        self.status: CameraStatus = CameraStatus(doubt=doubt)
        self.frames = self.poses = 0
        self.reasons: Counter[str] = Counter()
        self.latencies: list[float] = []
        self.work: list[float] = []
        self._motion = np.zeros((0, len(_MOTION)))
        self._believed: deque[_Seen] = deque(maxlen=64)
        self._agreeing: deque[_Seen] = deque(maxlen=512)
        self._frame: tuple[float, float, float] | None = None  # turn and shift from the floor frame to the run's
        self._doubts, self._agree_time = 0, _AGREES_AGAIN
        self._began, self._before = 0.0, 0  # of the run, and frames until then
        self._heard, self._last_time = -math.inf, -math.inf
        self._lag = [0.0, 0.0, 0.0, 0]  # sums of squared changes of the rate, of products, of squared errors; count
        self._offset = 0.0
        self._filter_delay = 1.0 / (2.0 * math.pi * robot.sensors.imu.bandwidth)

    @property
    def rate(self) -> float:
        """Frames per second of the run, until the last."""
        return (self.frames - self._before) / span if (span := self._heard - self._began) > 0.0 else 0.0

    # ---- the run ----

    def begin_run(self) -> None:
        """Let the present pose be zero."""
        if not len(self._motion):
            return
        self._began, self._before, self._frame = float(self._motion[-1, 0]), self.frames, None
        self._correct(self._began, np.zeros(3))
        if self._believed:
            self._place(self._believed[-1])
        self.status = replace(self.status, pose=np.zeros(3), time=self._began, is_new=False)

    def next(
        self, now: float, joints: tuple[Array, Array], gyro: Array, reading: CameraReading | None, trouble: str
    ) -> CameraStatus:
        """Take a control step.

        Args:
            now: s. joints: positions (8,) and velocities (8,), rad and rad/s. gyro: (3,) rad/s.
            reading: that came since the last step. trouble: why none will come.
        """
        self._move(now, *joints, gyro)
        if self._heard == -math.inf:
            self._heard = now
        reason, is_wrong = self.status.reason, self.status.is_wrong
        if reading is not None:
            self._heard = now
            self.frames += 1
            self.work.append(reading.found - reading.arrival)
            reason = self._judge(reading, now)
            if not reason:
                pose, exposed = self._shown(reading.pose[[0, 1, 3]]), self._believed[-1].time
                self._correct(exposed, pose)
                self.poses += 1
                self.latencies.append(now - exposed)
                self.status = replace(self.status, pose=pose, time=exposed, is_new=True, reason="", is_wrong=False)
                return self.status
            self.reasons[reason] += 1
            is_wrong = reason in CONTRADICTIONS or (is_wrong and reason == SETTLING)
        elif trouble or now - self._heard > SILENCE:
            reason = trouble or STALLED
        self.status = replace(self.status, is_new=False, reason=reason, is_wrong=is_wrong)
        return self.status

    # ---- the robot's own motion ----

    def _move(self, now: float, position: Array, velocity: Array, gyro: Array) -> None:
        """Go on by dead reckoning."""
        reach = self._leg * np.sin(position[LEG_SLICE])
        rolling = (
            self._radius * velocity[WHEEL_SLICE]
            + velocity[LEG_SLICE] * (reach + self._radius)
            + gyro[2] * self._side
            - gyro[1] * (self._hip_height - reach - self._radius)
        )
        row = np.zeros(len(_MOTION))
        row[0], row[7] = now, float(reach.mean()) + self._radius - self._hip_height
        slowest, fastest = float(rolling.min()), float(rolling.max())
        row[8:] = slowest, fastest
        if len(rows := self._motion):
            last, x, y, yaw, turn, least, most = rows[-1, :7].tolist()
            if (step := now - last) <= 0.0:
                return
            turned, ahead = float(gyro[2]) * step, float(np.median(rolling)) * step
            recent = rows[rows[:, 0] >= now - _COAST]
            least += min(0.0, slowest, *recent[:, 8].tolist()) * step
            most += max(0.0, fastest, *recent[:, 9].tolist()) * step
            middle = yaw + turned / 2
            row[1:7] = x + math.cos(middle) * ahead, y + math.sin(middle) * ahead, yaw + turned, turn + turned, least, most
        self._motion = np.vstack([rows[rows[:, 0] >= now - MEMORY], row])

    def _at(self, time: float) -> Array:
        """What was known at a time: x, y, yaw, turn, least, most, height."""
        times, *columns = self._motion[:, :8].T
        return np.array([np.interp(time, times, column) for column in columns])

    # ---- judging ----

    def _judge(self, reading: CameraReading, now: float) -> str:
        """Return why a reading is not believed; empty = it is."""
        if reading.time > now + 0.002:
            return FUTURE
        if now - reading.time > LARGEST_AGE:
            return TOO_OLD
        if reading.time <= self._last_time:
            return BACKWARD
        if reading.reason:
            return reading.reason
        sigma = np.sqrt(np.diag(reading.covariance))
        if max(sigma[0], sigma[1]) > LARGEST_SIGMA[0] or sigma[3] > LARGEST_SIGMA[1]:
            return UNCERTAIN
        self._last_time = reading.time
        moment = reading.time - self._offset
        _, _, _, turn, least, most, height = self._at(moment).tolist()
        seen = _Seen(moment, reading.time, reading.pose[[0, 1, 3]], turn, least, most, self._rate(moment))
        if abs(reading.pose[2] - height) > _HEIGHT:
            return self._doubt(CONTRADICTIONS[2], seen)
        return self._judge_motion(seen, now)

    def _judge_motion(self, seen: _Seen, now: float) -> str:
        while self._believed and self._believed[0].time < now - MEMORY:
            self._believed.popleft()
        is_followed = bool(self._believed) and self._doubts < _DOUBTED
        if is_followed:
            if wrong := _contradiction(seen, self._believed):
                return self._doubt(wrong, seen)
            self._doubts = 0
            self._agreeing.clear()
            self._note_lag(seen)
            self._believed.append(seen)
            return ""
        if wrong := _contradiction(seen, self._agreeing):
            self._agreeing.clear()
            return self._doubt(wrong, seen)
        self._agreeing.append(seen)
        needed = _AGREES if self._doubts < _DOUBTED else self._agree_time
        if seen.time - self._agreeing[0].time < needed:
            return SETTLING
        if self._doubts >= _DOUBTED:
            self._agree_time = min(_LONGEST, 2.0 * self._agree_time)
        self._trust(seen)
        return ""

    def _doubt(self, reason: str, seen: _Seen) -> str:
        self._doubts += 1
        if self._doubts >= _DOUBTED:
            self._believed.clear()
        if reason == CONTRADICTIONS[2]:
            self._agreeing.clear()
        else:
            self._agreeing.append(seen)
        return reason

    def _trust(self, seen: _Seen) -> None:
        """Believe the camera, at the start or again."""
        was_doubted, self._doubts = self._doubts >= _DOUBTED, 0
        self._believed = deque([*self._agreeing][-32:], maxlen=64)
        self._agreeing.clear()
        known = self._at(seen.time)
        if self._frame is not None and not was_doubted:
            gap = seen.time - self.status.time
            shown = self._shown(seen.pose)
            off = math.hypot(*(shown[:2] - known[:2])), abs(math.remainder(shown[2] - known[2], 2 * math.pi))
            if all(error <= at_once + rate * gap for error, (at_once, rate) in zip(off, _GAP, strict=True)):
                return
        self._place(seen)

    def _place(self, seen: _Seen) -> None:
        """Lay the floor frame so that a pose is where dead reckoning is."""
        known = self._at(seen.time)
        turn = known[2] - seen.pose[2]
        cosine, sine = math.cos(turn), math.sin(turn)
        x, y = seen.pose[:2]
        self._frame = (turn, known[0] - (cosine * x - sine * y), known[1] - (sine * x + cosine * y))

    def _shown(self, pose: Array) -> Array:
        """Return a pose of the floor frame in the run's; yaw is the turn nearest to dead reckoning's."""
        if self._frame is None:
            return np.zeros(3)
        turn, x, y = self._frame
        cosine, sine = math.cos(turn), math.sin(turn)
        around = float(self._motion[-1, 3])
        yaw = around + math.remainder(pose[2] + turn - around, 2 * math.pi)
        return np.array([x + cosine * pose[0] - sine * pose[1], y + sine * pose[0] + cosine * pose[1], yaw])

    def _correct(self, time: float, pose: Array) -> None:
        """Let dead reckoning have had this pose (3,) at a time, and go on from there."""
        x, y, yaw = self._at(time)[:3].tolist()
        turn = pose[2] - yaw
        cosine, sine = math.cos(turn), math.sin(turn)
        rows = self._motion
        dx, dy = rows[:, 1] - x, rows[:, 2] - y
        rows[:, 1], rows[:, 2] = pose[0] + cosine * dx - sine * dy, pose[1] + sine * dx + cosine * dy
        rows[:, 3] += turn

    # ---- the lag of the pictures ----

    def _note_lag(self, seen: _Seen) -> None:
        """Hold how the camera's yaw trails the gyroscope's against how the rate of turning changes; allow for what is found."""
        before = next((other for other in reversed(self._believed) if other.time < seen.time - _AGAINST[0]), None)
        if before is None:
            return
        change = self._rate(seen.stamped) - self._rate(before.stamped)
        turned = self._at(seen.stamped)[3] - self._at(before.stamped)[3]
        error = math.remainder(seen.pose[2] - before.pose[2] - turned, 2 * math.pi)
        for k, value in enumerate((change**2, -change * error, error**2, 1)):
            self._lag[k] += value
        if (lag := self.lag) is not None and lag[1] < _LAG_SIGMA:
            self._offset = min(max(lag[0], 0.0), _LARGEST_LAG)

    def _rate(self, time: float) -> float:
        """Yaw rate (rad/s) of the gyroscope at a time."""
        rows = self._motion
        if len(rows) < 2:
            return 0.0
        k = min(max(1, int(np.searchsorted(rows[:, 0], time))), len(rows) - 1)
        return float((rows[k, 4] - rows[k - 1, 4]) / (rows[k, 0] - rows[k - 1, 0]))

    @property
    def lag(self) -> tuple[float, float] | None:
        """By how much (s) pictures are older than their time stamps say, by the gyroscope, and 1 sigma; None = not known."""
        squares, products, errors, count = self._lag
        if squares < _LEAST_TURNS:
            return None
        lag = products / squares + self._filter_delay
        return lag, math.sqrt(max(errors - products**2 / squares, 0.0) / max(count - 1, 1) / squares) + 1e-4


def camera_statistics(watch: CameraWatch) -> dict[str, Any]:
    """Return what came of a camera: frames, poses, rate (1/s), times (ms), and frames without a pose by reason."""
    found: dict[str, Any] = {"frames": watch.frames, "poses": watch.poses, "rate": round(watch.rate, 2)}
    for name, seconds in (("latency", watch.latencies), ("work", watch.work)):
        if seconds:
            found[name] = percentiles(1e3 * np.array(seconds))
    if (lag := watch.lag) is not None:
        found["lag"] = {"ms": round(1e3 * lag[0], 2), "std": round(1e3 * lag[1], 2)}
    if watch.status.doubt:
        found["doubt"] = watch.status.doubt
    return {**found, "without_pose": dict(watch.reasons)}


def _contradiction(seen: _Seen, others: deque[_Seen]) -> str:
    """Return what a pose contradicts, held against poses before it; empty = nothing."""
    if not others:
        return ""
    ages = iter(_AGAINST)
    due = 0.0
    for other in reversed(others):
        gap = seen.time - other.time
        if gap < due:
            continue
        due = next(ages, math.inf)
        turned = seen.turn - other.turn
        error = math.remainder(seen.pose[2] - other.pose[2] - turned, 2 * math.pi)
        if abs(error) > _TURN[0] + _TURN[1] * gap + _TURN[2] * abs(turned) + _TURN[3] * abs(seen.rate - other.rate):
            return CONTRADICTIONS[0]
        middle = other.pose[2] + turned / 2
        dx, dy = (seen.pose[:2] - other.pose[:2]).tolist()
        along, across = math.cos(middle) * dx + math.sin(middle) * dy, math.cos(middle) * dy - math.sin(middle) * dx
        slide = _ALONG[0] + _ALONG[1] * gap
        is_along = seen.least - other.least - slide <= along <= seen.most - other.most + slide
        if not is_along or abs(across) > _ACROSS[0] + _ACROSS[1] * gap:
            return CONTRADICTIONS[1]
    return ""
