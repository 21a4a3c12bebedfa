"""Helpers of the tests of vision: a small rendered scene, so that the truth is known."""

import math

import numpy as np

from wlr_gym.perception.markers.camera import Camera
from wlr_gym.perception.markers.targets import load_target
from wlr_gym.perception.scene import (
    Facet,
    Look,
    Renderer,
    ScenePose,
    floor_facets,
    plate_facet,
    robot_facets,
    rotation_of,
    view,
)
from wlr_gym.perception.vision.tracking import VideoFrame
from wlr_gym.robot import load_robot


class Studio:
    """A camera over a floor, and a robot to put there."""

    def __init__(self, camera: Camera, tilt: float = 0.0, distance: float = 2.0) -> None:
        self.body, self.floor, self.robot = load_target("body"), load_target("floor"), load_robot()
        self.camera, self.tilt, self.distance = camera, tilt, distance
        self.renderer = Renderer(camera, view(tilt, distance), floor_facets(self.floor), samples=8)

    def frame(
        self,
        pose: ScenePose | None,
        index: int = 0,
        look: Look | None = None,
        extra: tuple[Facet, ...] = (),
        blind: bool = False,
    ) -> VideoFrame:
        """A frame with the robot at ``pose`` (None = no robot); ``blind`` leaves its markers out."""
        facets = list(extra)
        if pose is not None:
            parts = robot_facets(self.robot, pose.legs) + ([] if blind else [plate_facet(self.body)])
            facets += [facet.moved(pose.position, pose.rotation) for facet in parts]
        return VideoFrame(index, index / 30, self.renderer.frame([facets], look or Look(), index))


def pose_of(x: float = 0.05, y: float = -0.02, yaw: float = 0.4, pitch: float = 0.0, height: float = 0.169) -> ScenePose:
    """A pose of the body."""
    return ScenePose(np.array([x, y, height]), rotation_of(yaw, pitch))


def hand(x: float, y: float, size: float = 0.05, height: float = 0.35) -> Facet:
    """Something grey held over the floor."""
    return Facet(np.array([x, y, height]), np.eye(3)[:2], (size, size), 90.0)


def wrapped(angle: float) -> float:
    """The angle in (-pi, pi]."""
    return math.remainder(angle, 2 * math.pi)
