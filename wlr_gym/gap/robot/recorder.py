"""What the sensors of a replayed batch would have read at the rows' times."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numba import njit
from numpy.typing import NDArray

from wlr_gym.model.dynamics import rotation_matrix
from wlr_gym.parameters import Parameters
from wlr_gym.plants.base import SENSOR_LAYOUT, TRUTH_LAYOUT, PlantState, Sensors, Truth
from wlr_gym.runs.anchor import euler_angles
from wlr_gym.runs.format import CHANNELS
from wlr_gym.runs.read import Run

Array = NDArray[np.float64]

#: s; the plant's tick.
CLOCK = 0.004
#: Ticks between two stored poses, from which the camera's are interpolated.
POSE_TICKS = 3
DIRECT = tuple(name for name in CHANNELS if not name.startswith("cam_"))
CAMERA = tuple(name for name in CHANNELS if name.startswith("cam_"))
#: Truth channels that residuals are mapped over.
TRUTH = ("joint_position", "joint_velocity", "motor_torque", "contact_force", "slip_velocity", "position")
#: The leading columns of the sensor layout are those of DIRECT: joint positions and speeds, then what only motors and IMU know.
_READ, _MOVED = SENSOR_LAYOUT.slices["supply_voltage"].stop, SENSOR_LAYOUT.slices["joint_velocity"].stop
assert len(DIRECT) == _READ
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


class Clock(Protocol):
    """Where the rows of a run lie on the plant's clock."""

    run: Run
    t: Array
    begin: float
    ticks: int
    torque_on: NDArray[np.bool_]


class Recorder:
    """Readings at the rows' times, on a straight line through two ticks; poses on a coarser clock, for the camera's delay."""

    def __init__(self, clocks: Sequence[Clock], settings: int, first: PlantState, delay: Array, with_truth: bool) -> None:
        self._soonest = delay.min(axis=1)
        self.clocks, self.settings, self.with_truth = clocks, settings, with_truth
        count = settings * len(clocks)
        self.idle_goals = np.zeros((count, 8))
        self._wheels = first.joint_position[:, 4:]
        self._rows = [np.zeros((settings, len(clock.t), _READ)) for clock in clocks]
        self._truths = [np.zeros((settings, len(clock.t), 0)) for clock in clocks]
        self._place = [(clock.t - clock.begin) / CLOCK for clock in clocks]
        self._next = [0] * len(clocks)
        ticks = max(clock.ticks for clock in clocks) + 2
        self._poses = np.zeros((ticks // POSE_TICKS + 2, count, _POSE))
        self._recent = np.zeros((3, count, _READ))  # readings of this tick and the two before it, by tick modulo 3
        self._anchored = [-1] * len(clocks)
        self._torque = _torque_changes(clocks, ticks + POSE_TICKS, settings)
        self._torque_on: NDArray[np.bool_] | None = None

    def start(self, readings: Sensors) -> None:
        """Count the wheel angles from where the robots stand."""
        self._shift = self._wheels - readings.joint_position[:, 4:]

    def start_anew(self, r: int, tick: int, readings: Sensors, truth: Truth) -> None:
        """Count the wheel angles of one run on after an anchor; what was read before it says nothing about what follows."""
        mine = self._mine(r)
        self._shift[mine] = truth.joint_position[mine, 4:] - readings.joint_position[mine, 4:]
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
            self._rows[r][:, row] = self._recent[tick % 3, mine]
        else:
            # what an anchor kept of motors and IMU is the model's before it
            only_moved = self._anchored[r] >= tick - 1
            early = np.inf if only_moved or tick == 1 else (1.0 - share) * CLOCK
            now, last, before = (self._recent[(tick - ago) % 3, mine] for ago in range(3))
            _interpolate(share, now, last, before, self._soonest[mine], early, only_moved, self._rows[r][:, row])
        if self.with_truth:
            seen = np.concatenate([truth[name][mine] for name in TRUTH], axis=1)
            if not self._truths[r].shape[2]:
                self._truths[r] = np.zeros((self.settings, len(self._place[r]), seen.shape[1]))
            self._truths[r][:, row] = seen
        self._next[r] += 1

    def result(self, r: int, parameters: Parameters) -> Replays:
        """What was read of run ``r`` under every setting, whose parameters are given."""
        values = np.zeros((*self._rows[r].shape[:2], len(CHANNELS)))
        values[:, :, [CHANNELS.index(name) for name in DIRECT]] = self._rows[r]
        poses = _marker_poses(self._poses[:, self._mine(r)], np.asarray(self.clocks[r].run.meta.marker_offset))
        poses = _interpolated(poses, self._place[r][None, :] - parameters["camera.delay"][:, None] / CLOCK)
        _turn(poses, parameters)
        values[:, :, [CHANNELS.index(name) for name in CAMERA]] = poses
        return Replays(values, self._truths[r] if self.with_truth else None)


def _torque_changes(clocks: Sequence[Clock], ticks: int, settings: int) -> dict[int, NDArray[np.bool_]]:
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
    """Copy the readings of a tick, wheel angles counted from where the robots stood."""
    for i in range(len(out)):
        for c in range(_READ):
            out[i, c] = readings[i, c]
        for k in range(4):
            out[i, 4 + k] += shift[i, k]


@njit(cache=True, nogil=True)
def _interpolate(share: Any, now: Any, last: Any, before: Any, soonest: Any, early: Any, only_moved: Any, out: Any) -> None:
    """Readings between the last tick and this one.

    A row's own goal acts after its reading: where it would act before this tick (``soonest`` below ``early``; infinite = the
    ticks before tell nothing), the line is that of the two ticks before.
    """
    for i in range(len(out)):
        ahead = early < np.inf and soonest[i] < early
        for c in range(_READ):
            if only_moved and c >= _MOVED:
                out[i, c] = now[i, c]
            elif ahead:
                out[i, c] = last[i, c] + share * (last[i, c] - before[i, c])
            else:
                out[i, c] = last[i, c] + share * (now[i, c] - last[i, c])


def _marker_poses(stored: Array, offset: Array) -> Array:
    """x, y, heading, z and pitch (times, settings, 5) of the marker, from body positions and quaternions."""
    flat = stored.reshape(-1, _POSE)
    yaw, pitch, _ = euler_angles(flat[:, 3:])
    marker = flat[:, :3] + rotation_matrix(flat[:, 3:]) @ offset
    return np.column_stack([marker[:, 0], marker[:, 1], yaw, marker[:, 2], pitch]).reshape(*stored.shape[:2], len(CAMERA))


def _interpolated(poses: Array, places: Array) -> Array:
    """Interpolate stored poses (times, settings, 5) at ``places`` (settings, rows) in ticks."""
    poses[:, :, 2] = np.unwrap(poses[:, :, 2], axis=0)
    places = np.maximum(places / POSE_TICKS, 0.0)
    before = np.minimum(places.astype(int), len(poses) - 2)
    share = (places - before)[:, :, None]
    settings = np.arange(poses.shape[1])[:, None]
    return (1 - share) * poses[before, settings] + share * poses[before + 1, settings]


def _turn(poses: Array, parameters: Parameters) -> None:
    """From the floor frame into the camera's, in place."""
    mount, scale = parameters["camera.mount_yaw"][:, None], parameters["camera.scale"][:, None]
    cosine, sine = scale * np.cos(mount), scale * np.sin(mount)
    x, y = poses[:, :, 0].copy(), poses[:, :, 1].copy()
    poses[:, :, 0], poses[:, :, 1] = cosine * x + sine * y, cosine * y - sine * x
