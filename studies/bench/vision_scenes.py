"""Camera, lens and poses of the scenes that the vision bench renders."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from wlr_gym.perception.markers.camera import Camera
from wlr_gym.perception.scene import Facet, ScenePose, robot_facets, rotation_of
from wlr_gym.perception.vision.tracking import angles
from wlr_gym.robot import Robot

Array = NDArray[np.float64]

CAMERA = Camera(width=1280, height=720, focal=(800.0, 800.0), centre=(639.5, 359.5))
#: Distortion (k1, k2, p1, p2, k3) of the camera in most scenes, and of two strong lenses.
LENS = (-0.1, 0.02, 0.001, -0.001, 0.0)
STRONG_LENSES = ((-0.3, 0.1, 0.0, 0.0, 0.0), (0.3, -0.05, 0.0, 0.0, 0.0))
#: m, the body's origin above the floor with the legs at home.
HOME_HEIGHT = 0.169


def random_pose(rng: np.random.Generator, height: float | None = None) -> ScenePose:
    """A pose in view; with a height the body is level."""
    position = np.array([rng.uniform(-0.45, 0.45), rng.uniform(-0.2, 0.2), height or HOME_HEIGHT + rng.uniform(-0.06, 0.0)])
    return ScenePose(position, rotation_of(rng.uniform(-math.pi, math.pi), rng.uniform(-0.1, 0.1) if height is None else 0.0))


def shown_robot(robot: Robot, plate: Facet, pose: ScenePose) -> list[Facet]:
    """The robot with a plate of markers or tags at a pose."""
    return [facet.moved(pose.position, pose.rotation) for facet in (*robot_facets(robot, pose.legs), plate)]


def pose_error(found: Array, pose: ScenePose) -> Array:
    """x, y (m) and yaw (rad) found, minus the truth."""
    yaw = angles(pose.rotation)[0]
    return np.array([*(found[:2] - pose.position[:2]), math.remainder(found[2] - yaw, 2 * math.pi)])
