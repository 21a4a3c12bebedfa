"""What the sensors of a replayed batch would have read at the rows' times."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from wlr_gym.data.format import CHANNELS
from wlr_gym.gap.robot.clock import CLOCK, RunClock
from wlr_gym.physics.plants.base import SENSOR_LAYOUT, TRUTH_LAYOUT, PlantState, Sensors, Truth
from wlr_gym.robot import FIRST_WHEEL, WHEEL_SLICE
from wlr_gym.robot.parameters import Parameters

Array = NDArray[np.float64]

#: Ticks between two stored poses, from which the camera's are interpolated.
POSE_TICKS = 3
#: Truth channels that residuals are mapped over.
TRUTH = (
    "joint_position",
    "joint_velocity",
    "motor_torque",
    "contact_force",
    "slip_velocity",
    "position",
    "quaternion",
    "linear_velocity_in_body",
    "angular_velocity_in_body",
)
#: Channels begin as the sensors do: joint positions and speeds, then what only motors and IMU know; the camera follows.
_MOVED = SENSOR_LAYOUT.slices["joint_velocity"].stop
_READ = SENSOR_LAYOUT.slices["accelerometer"].stop
_SENSED_VOLT = SENSOR_LAYOUT.slices["supply_voltage"].start
_VOLT = CHANNELS.index("volt")
_CAMERA = slice(CHANNELS.index("cam_x"), CHANNELS.index("cam_pitch") + 1)
#: The leading columns of the truth layout: position and quaternion.
_POSE = TRUTH_LAYOUT.slices["quaternion"].stop


@dataclass(frozen=True, eq=False)
class Replays:
    """One run under every setting.

    Attributes:
        values: (settings, rows, len(CHANNELS)) what the sensors would have read.
        truth: (settings, rows, columns) of :data:`TRUTH`, or None.
    """

    values: Array
    truth: Array | None = None


class Recorder:
    """Readings at the rows' times, on a straight line through two ticks; poses on a coarser clock, for the camera's delay."""

    def __init__(self, clocks: Sequence[RunClock], settings: int, first: PlantState, delay: Array, with_truth: bool) -> None:
        self._soonest = delay.min(axis=1)
        self.clocks, self.settings, self.with_truth = clocks, settings, with_truth
        count = settings * len(clocks)
        self.idle_setpoints = np.zeros((count, 8))
        self._wheels = first.joint_position[:, WHEEL_SLICE]
        self._values = [np.zeros((settings, len(clock.t), len(CHANNELS))) for clock in clocks]
        width = sum(len(TRUTH_LAYOUT.channels[name].elements) for name in TRUTH) if with_truth else 0
        self._truths = [np.zeros((settings, len(clock.t), width)) for clock in clocks]
        self._place = [(clock.t - clock.begin) / CLOCK for clock in clocks]
        self._next = [0] * len(clocks)
        ticks = max(clock.ticks for clock in clocks) + 2
        self._poses = np.zeros((ticks // POSE_TICKS + 2, count, _POSE))
        self._recent = np.zeros((3, count, len(CHANNELS)))  # readings of this tick and the two before it, by tick modulo 3
        self._anchored = [-1] * len(clocks)
        self._torque = _torque_changes(clocks, ticks + POSE_TICKS, settings)
        self._torque_on: NDArray[np.bool_] | None = None

    def start(self, readings: Sensors) -> None:
        """Count the wheel angles from where the robots stand."""
        self._shift = self._wheels - readings.joint_position[:, WHEEL_SLICE]

    def start_anew(self, r: int, tick: int, readings: Sensors, truth: Truth) -> None:
        """Count the wheel angles of one run on after an anchor; what was read before it says nothing about what follows."""
        mine = self._mine(r)
        self._shift[mine] = truth.joint_position[mine, WHEEL_SLICE] - readings.joint_position[mine, WHEEL_SLICE]
        self._anchored[r] = tick

    def _mine(self, r: int) -> slice:
        return slice(r * self.settings, (r + 1) * self.settings)

    def torque_on(self, tick: int) -> NDArray[np.bool_] | None:
        """Which motors are on; switching the torque is not delayed."""
        if tick in self._torque:
            self._torque_on = self._torque[tick]
        return self._torque_on

    def see(self, tick: int, readings: Sensors, truth: Truth) -> None:
        """Take what is read at a tick; every tick must be seen."""
        if tick % POSE_TICKS == 0:
            self._poses[tick // POSE_TICKS] = truth.values[:, :_POSE]
        _store(readings.values, self._shift, self._recent[tick % 3])
        for r, place in enumerate(self._place):
            while self._next[r] < len(place) and place[self._next[r]] <= tick:
                self._take(r, tick, truth)

    def _take(self, r: int, tick: int, truth: Truth) -> None:
        row, mine = self._next[r], self._mine(r)
        share = self._place[r][row] - (tick - 1)
        if tick == 0 or share > 1.0 - 1e-9:
            self._values[r][:, row] = self._recent[tick % 3, mine]
        else:
            # what an anchor kept of motors and IMU is the model's before it
            only_moved = self._anchored[r] >= tick - 1
            early = np.inf if only_moved or tick == 1 else (1.0 - share) * CLOCK
            now, last, before = (self._recent[(tick - ago) % 3, mine] for ago in range(3))
            _interpolate(share, now, last, before, self._soonest[mine], early, only_moved, self._values[r][:, row])
        if self.with_truth:
            self._truths[r][:, row] = np.concatenate([truth[name][mine] for name in TRUTH], axis=1)
        self._next[r] += 1

    def result(self, r: int, parameters: Parameters) -> Replays:
        """What was read of run ``r`` under every setting; ``parameters`` (settings) are its robots'."""
        offset = np.asarray(self.clocks[r].run.meta.marker_offset, np.float64)
        late = self._place[r][None, :] - parameters["camera.delay"][:, None] / CLOCK
        places = np.maximum(late / POSE_TICKS, 0.0)
        mount, scale = parameters["camera.mount_yaw"], parameters["camera.scale"]
        _show(self._poses[:, self._mine(r)], offset, places, mount, scale, self._values[r][:, :, _CAMERA])
        return Replays(self._values[r], self._truths[r] if self.with_truth else None)


def _torque_changes(clocks: Sequence[RunClock], ticks: int, settings: int) -> dict[int, NDArray[np.bool_]]:
    """At which ticks motors are switched, and which are on from then on (robots, 8); nothing where all are always on."""
    if all(clock.torque_on.all() for clock in clocks):
        return {}
    now = (np.arange(ticks) + 0.5) * CLOCK
    rows = [np.maximum(np.searchsorted(clock.t - clock.begin, now, side="right") - 1, 0) for clock in clocks]
    on = np.stack([clock.torque_on[row] for clock, row in zip(clocks, rows, strict=True)], axis=1)
    changed = np.flatnonzero((on[1:] != on[:-1]).any(axis=(1, 2))) + 1
    return {tick: np.repeat(on[tick], settings, axis=0) for tick in [0, *changed.tolist()]}


@njit(cache=True, nogil=True)
def _store(readings: Any, shift: Any, out: Any) -> None:
    """Copy the readings of a tick (robots, SENSOR_LAYOUT.width) as channels, wheel angles counted from where robots stood.

    Args:
        readings: of all robots.
        shift: (robots, 4) rad, added to the wheel angles.
        out: (robots, len(CHANNELS)), filled but for the camera.
    """
    for i in range(len(out)):
        for c in range(_READ):
            out[i, c] = readings[i, c]
        for k in range(4):
            out[i, FIRST_WHEEL + k] += shift[i, k]
        out[i, _VOLT] = readings[i, _SENSED_VOLT]


@njit(cache=True, nogil=True)
def _interpolate(share: Any, now: Any, last: Any, before: Any, soonest: Any, early: Any, only_moved: Any, out: Any) -> None:
    """Fill readings between the last tick and this one, ``out`` (robots, channels).

    A row's own goal acts after its reading: where it would act before this tick, the line is that of the two ticks before.

    Args:
        share: of the tick that has passed at the row's time.
        now, last, before: (robots, channels) at this tick, the last and the one before.
        soonest: (robots) s; the soonest that a goal acts after its row.
        early: s; a goal that acts sooner acts before this tick. Infinite = the ticks before tell nothing.
        only_moved: whether only angles and speeds are on a line, the rest is this tick's.
    """
    for i in range(len(out)):
        ahead = early < np.inf and soonest[i] < early
        for c in range(out.shape[1]):
            if only_moved and c >= _MOVED:
                out[i, c] = now[i, c]
            elif ahead:
                out[i, c] = last[i, c] + share * (last[i, c] - before[i, c])
            else:
                out[i, c] = last[i, c] + share * (now[i, c] - last[i, c])


@njit(cache=True, nogil=True)
def _show(stored: Any, offset: Any, places: Any, mount: Any, scale: Any, out: Any) -> None:
    """Fill what the camera shows of the marker: x, y, heading, z and pitch (settings, rows, 5).

    Args:
        stored: (times, settings, 7) positions and quaternions of the body.
        offset: of the marker in the body frame, m.
        places: (settings, rows) where the rows lie among the times: whole numbers are times.
        mount, scale: (settings) heading of the camera, rad, and its scale.
        out: filled.
    """
    times = len(stored)
    poses = np.zeros((times, 5))
    for i in range(len(out)):
        for k in range(times):
            _pose(stored[k, i], offset, poses[k])
            if k > 0:  # the heading goes on where it was
                turn = poses[k, 2] - poses[k - 1, 2]
                poses[k, 2] -= 2.0 * np.pi * np.rint(turn / (2.0 * np.pi))
        cosine, sine = scale[i] * np.cos(mount[i]), scale[i] * np.sin(mount[i])
        for row in range(out.shape[1]):
            before = min(int(places[i, row]), times - 2)
            share = places[i, row] - before
            for c in range(5):
                out[i, row, c] = (1.0 - share) * poses[before, c] + share * poses[before + 1, c]
            x, y = out[i, row, 0], out[i, row, 1]  # from the floor frame into the camera's
            out[i, row, 0], out[i, row, 1] = cosine * x + sine * y, cosine * y - sine * x


@njit(cache=True, nogil=True)
def _pose(stored: Any, offset: Any, out: Any) -> None:
    """x, y, heading, z and pitch (5) of the marker of one body."""
    w, x, y, z = stored[3], stored[4], stored[5], stored[6]
    a, b, c = offset[0], offset[1], offset[2]
    out[0] = stored[0] + (1 - 2 * (y * y + z * z)) * a + 2 * (x * y - w * z) * b + 2 * (x * z + w * y) * c
    out[1] = stored[1] + 2 * (x * y + w * z) * a + (1 - 2 * (x * x + z * z)) * b + 2 * (y * z - w * x) * c
    out[3] = stored[2] + 2 * (x * z - w * y) * a + 2 * (y * z + w * x) * b + (1 - 2 * (x * x + y * y)) * c
    out[2] = np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
    out[4] = np.arcsin(min(max(2 * (w * y - x * z), -1.0), 1.0))
