"""Where a run's rows, setpoints and windows lie on the plant's clock; residuals that do not depend on where a window starts.

Pose and wheel angles are integrals: an error, once made, stays in them. The residuals of a run are therefore taken window by
window, and each window's own pose (x, y, heading) is fitted and removed, and so are the wheel angles of each of its parts. What
is left says what went wrong within the window.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from wlr_gym.data.format import CHANNELS, COMMANDS
from wlr_gym.data.replay import held_setpoints
from wlr_gym.data.run_states import (
    CAMERA_WINDOW,
    JOINT_WINDOW,
    camera_pose,
    frame_near,
    has_camera,
    local_fit,
    start_state,
    starts_at_rest,
)
from wlr_gym.data.runs import Run
from wlr_gym.gap.problem import Array
from wlr_gym.physics.plants.base import PlantState
from wlr_gym.robot import JOINTS, LEG_SLICE, LEGS, WHEELS, Robot
from wlr_gym.robot.parameters import Parameters

#: s; length of a window.
WINDOW = 2.0
#: s; length over which wheel angles are compared: what wheels that work against each other on one floor slip depends on forces
#: between them that nothing measures well, and beyond this such errors would outweigh all else.
WHEEL_WINDOW = 0.5
#: s; beginning of a window in which the camera's frames are not compared.
BLIND = 0.05
_X, _Y, _YAW, _PITCH = (CHANNELS.index(f"cam_{name}") for name in ("x", "y", "yaw", "pitch"))
#: Rows (0.14 s at 50 Hz) over which bouncing is averaged, and the channels that show it.
BOUNCE = 7
_BOUNCING = [CHANNELS.index(name) for name in ("gyro_x", "gyro_y", "acc_z")]
_CAMERA = [CHANNELS.index(name) for name in CHANNELS if name.startswith("cam_")]
_WHEELS = [CHANNELS.index(f"pos_{joint}") for joint in WHEELS]
#: s; the plant's tick.
CLOCK = 0.004
#: s; the robot stands this long before the first row.
LEAD = 0.3
#: s before and after an anchor that are near it, and the row on each side at least.
NEAR = 0.065


@dataclass(frozen=True, eq=False)
class Anchors:
    """What was measured at the start of each window: values and rates, one row per window.

    Attributes:
        tick: of the plant's clock.
        legs: (W, 4) leg readings, rad.
        swing: (W, 4) range of a leg's readings or setpoints nearby, rad.
        effort: (W, 4) mean of the legs' efforts nearby, N m; NaN where not measured or the motor is off.
        pose, pose_rate: (W, 3) what the camera shows (x, y, heading), and its rate; NaN where not measured.
    """

    tick: NDArray[np.intp]
    legs: Array
    swing: Array
    effort: Array
    pose: Array
    pose_rate: Array


class RunClock:
    """When the setpoints of one run arrive at the servos, where its rows lie on the plant's clock, and its windows."""

    def __init__(self, run: Run, window: float = WINDOW) -> None:
        self.run = run
        self.windows = window_rows(run["t"], window)
        self.t: Array = run["t"]
        commands = np.stack([run[name] for name in COMMANDS], axis=1)
        self.setpoints: Array = held_setpoints(run)
        self.torque_on = np.isfinite(commands)
        #: s that it stands before the first row.
        self.lead: float = LEAD if starts_at_rest(run) else 0.0
        self.begin = self.t[0] - self.lead
        #: (rows, 8) N m; NaN where not measured or the motor is off.
        self.efforts: Array = run.table.reindex(columns=[f"eff_{joint}" for joint in JOINTS]).to_numpy(float).copy()
        self.efforts[~self.torque_on] = np.nan
        self.ticks: int = int(np.ceil((self.t[-1] - self.begin) / CLOCK)) + 1
        self.anchors: Anchors = self._anchors([window.start for window in self.windows[1:]])
        self.start: Anchors = self._anchors([0])
        self._started: tuple[Robot, PlantState] | None = None

    def measured_start(self, robot: Robot, nominal: Parameters) -> PlantState:
        """Return the robot's state at the first row, as it was measured; kept, as every replay begins with it."""
        if self._started is None or self._started[0] is not robot:
            self._started = (robot, start_state(self.run, robot, nominal))
        return self._started[1]

    def _anchors(self, rows: list[int]) -> Anchors:
        run, times = self.run, self.t[rows]
        legs = [local_fit(self.t, run[f"pos_{joint}"], times, JOINT_WINDOW)[0] for joint in LEGS]
        edges = np.searchsorted(self.t, [times - NEAR, times + NEAR]).T
        near = [slice(max(min(a, row - 1), 0), max(b, row + 2)) for row, (a, b) in zip(rows, edges.tolist(), strict=True)]
        angles = np.array([[run[f"pos_{joint}"], run[f"cmd_{joint}"]] for joint in LEGS])
        swing = np.array([np.fmax.reduce(np.ptp(angles[:, :, part], axis=2), axis=1) for part in near]).reshape(len(rows), 4)
        effort = np.array([self.efforts[part, LEG_SLICE].mean(axis=0) for part in near]).reshape(len(rows), 4)
        pose = np.full((2, 3, len(rows)), np.nan)
        if has_camera(run):
            fits = [local_fit(self.t, seen, times, CAMERA_WINDOW) for seen in camera_pose(run)]
            pose = np.where(frame_near(run, times), np.stack(fits, axis=1), np.nan)
        tick = np.floor((times - self.begin) / CLOCK + 1e-9).astype(int)
        return Anchors(tick, np.transpose(legs), swing, effort, pose[0].T, pose[1].T)


def window_rows(t: Array, length: float = WINDOW) -> list[slice]:
    """Cut a run into windows of equal length near ``length``; where the log has a hole there is none."""
    count = max(1, round(float(t[-1] - t[0]) / length))  # one window where the length is infinite
    edges = np.searchsorted(t, np.linspace(t[0], t[-1] + 1e-9, count + 1))
    edges[-1] = len(t)  # of seconds since 1970 a nanosecond is rounded away
    return [slice(int(a), int(b)) for a, b in itertools.pairwise(edges) if a < b]


def anchored_residuals(t: Array, measured: Array, simulated: Array, noise: Array, windows: list[slice]) -> Array:
    """Return (measured - simulated) / noise with every window's own pose and wheel angles taken out.

    Args:
        t: (rows,) s.
        measured: (rows, len(CHANNELS)); NaN where not measured.
        simulated: (settings, rows, len(CHANNELS)).
        noise: (len(CHANNELS)) one sigma.
        windows: rows of each window.
    """
    measured = measured.copy()
    for window in windows:  # frames shown in a window's first rows were exposed before it
        early = np.flatnonzero(t[window] < t[window.start] + BLIND) + window.start
        measured[np.ix_(early, _CAMERA)] = np.nan
    residual = measured - simulated
    residual[:, :, _PITCH] = _wrapped(residual[:, :, _PITCH])
    for window in windows:
        for part in window_rows(t[window], WHEEL_WINDOW):
            part = slice(window.start + part.start, window.start + part.stop)
            wheels = np.ascontiguousarray(residual[:, part, _WHEELS[0] : _WHEELS[-1] + 1])
            residual[:, part, _WHEELS[0] : _WHEELS[-1] + 1] = wheels - np.nanmean(wheels, axis=1, keepdims=True)
        _calm(residual[:, window])
        _take_out_pose(measured[window], simulated[:, window], residual[:, window], noise)
    residual /= noise
    return residual


def _calm(residual: Array) -> None:
    """Average the channels in which a robot bounces on its tyres over a bounce, in place; white noise keeps its size.

    How it bounces depends on tyre, chassis and floor in ways that no simulator here has; the slow part says what the masses do.
    """
    rows = np.arange(residual.shape[1])
    first, last = np.maximum(rows - BOUNCE // 2, 0), np.minimum(rows + BOUNCE // 2 + 1, len(rows))
    for c in _BOUNCING:
        known = np.isfinite(residual[:, :, c])
        sums = (np.cumsum(values, axis=1) for values in (np.where(known, residual[:, :, c], 0.0), known))
        total, count = (np.pad(each, ((0, 0), (1, 0))) for each in sums)
        seen = count[:, last] - count[:, first]
        mean = (total[:, last] - total[:, first]) / np.sqrt(np.maximum(seen, 1.0))
        residual[:, :, c] = np.where(known, mean, np.nan)


def _take_out_pose(measured: Array, simulated: Array, residual: Array, noise: Array) -> None:
    """Move each simulated window rigidly onto the measured one, and write what is left of x, y and heading."""
    seen = np.flatnonzero(np.isfinite(measured[:, [_X, _Y, _YAW]]).all(axis=1))
    residual[:, :, [_X, _Y, _YAW]] = np.nan
    if seen.size < 2:
        return
    x, y = (np.ascontiguousarray(simulated[:, seen, c]) for c in (_X, _Y))
    x, y = x - x.mean(axis=1, keepdims=True), y - y.mean(axis=1, keepdims=True)
    mx, my = measured[seen, _X] - measured[seen, _X].mean(), measured[seen, _Y] - measured[seen, _Y].mean()
    yaw = np.ascontiguousarray(np.unwrap(_wrapped(measured[seen, _YAW] - simulated[:, seen, _YAW]), axis=1))
    turn = yaw.mean(axis=1, keepdims=True)
    path, heading = 1.0 / noise[_X] ** 2, 1.0 / noise[_YAW] ** 2

    def turned() -> tuple[Array, Array]:
        return np.cos(turn) * x - np.sin(turn) * y, np.sin(turn) * x + np.cos(turn) * y

    for _ in range(2):  # Gauss-Newton for one angle; the second pass is already exact to 1e-6
        tx, ty = turned()
        slope = path * ((mx - tx) * -ty + (my - ty) * tx).sum(axis=1) + heading * (yaw - turn).sum(axis=1)
        curve = path * (tx * tx + ty * ty).sum(axis=1) + heading * seen.size
        turn = turn + (slope / curve)[:, None]
    tx, ty = turned()
    ex, ey = mx - tx, my - ty
    # residuals in the window's own axes, along the heading it starts with: numbers that mean the same in every window
    start = measured[seen[0], _YAW]
    residual[:, seen, _X] = np.cos(start) * ex + np.sin(start) * ey
    residual[:, seen, _Y] = -np.sin(start) * ex + np.cos(start) * ey
    residual[:, seen, _YAW] = yaw - turn


def _wrapped(angle: Array) -> Array:
    return np.angle(np.exp(1j * angle))
