"""Where a robot went by its wheels and its gyroscope: for runs, and stretches of runs, that no camera saw."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from wlr_gym.data.read import Run
from wlr_gym.data.run_states import camera_pose, has_camera
from wlr_gym.robot import CORNER_SIGNS, LEGS, WHEELS, Robot

Array = NDArray[np.float64]


def rolled_poses(run: Run, robot: Robot) -> Array:
    """Return x, y (m) and yaw (rad) of a robot that rolls without slip, (rows, 3); through each frame of the camera it passes.

    Between frames it moves as the wheels roll, along the heading that the gyroscope has turned to; without a gyroscope, that
    the wheels of both sides turn to, as if they did not skid.
    """
    t = run["t"]
    steps, turns = _rolled(run, robot).mean(axis=1), _turns(run, robot)
    poses = np.zeros((len(t), 3))
    poses[:, 2] = np.cumsum(turns)
    heading = poses[:, 2] - 0.5 * turns
    poses[:, :2] = np.cumsum(steps[:, None] * np.stack([np.cos(heading), np.sin(heading)], axis=1), axis=0)
    if not has_camera(run):
        return poses
    frames = np.flatnonzero(np.isfinite(run["cam_x"] + run["cam_y"] + run["cam_yaw"]))
    seen = camera_pose(run).T
    last = np.maximum(np.searchsorted(frames, np.arange(len(t)), side="right") - 1, 0)
    anchors = frames[last]  # before the first frame: that one
    turned = seen[anchors, 2] - poses[anchors, 2]
    moved = poses[:, :2] - poses[anchors, :2]
    cosine, sine = np.cos(turned), np.sin(turned)
    x, y = cosine * moved[:, 0] - sine * moved[:, 1], sine * moved[:, 0] + cosine * moved[:, 1]
    return np.stack([seen[anchors, 0] + x, seen[anchors, 1] + y, poses[:, 2] + turned], axis=1)


def _rolled(run: Run, robot: Robot) -> Array:
    """Return how far each wheel has rolled against the body in each row's step (rows, 4), m."""
    angles = np.stack([run[f"pos_{wheel}"] + run[f"pos_{leg}"] for wheel, leg in zip(WHEELS, LEGS, strict=True)], axis=1)
    return robot.wheel.radius * np.diff(angles, axis=0, prepend=angles[:1])


def _turns(run: Run, robot: Robot) -> Array:
    if "gyro_z" in run and np.isfinite(run["gyro_z"]).any():
        known = np.isfinite(run["gyro_z"])
        rate = np.interp(run["t"], run["t"][known], run["gyro_z"][known])
        return rate * np.diff(run["t"], prepend=run["t"][0])
    sides = np.array([sign for _, sign in CORNER_SIGNS])
    return -(sides * _rolled(run, robot)).mean(axis=1) / robot.hip_position.y
