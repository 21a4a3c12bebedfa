"""Where a run's rows, setpoints and windows lie on the replaying plant's clock, and what was measured where windows begin."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from wlr_gym.data.format import COMMANDS
from wlr_gym.data.read import Run
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
from wlr_gym.gap.robot.windows import WINDOW, window_rows
from wlr_gym.physics.plants.base import PlantState
from wlr_gym.robot import JOINTS, LEG_SLICE, LEGS, Robot
from wlr_gym.robot.parameters import Parameters

Array = NDArray[np.float64]

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
