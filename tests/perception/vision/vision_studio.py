"""Helpers of the tests of vision: a small rendered scene, and samples of a simulated drive, so that the truth is known."""

import math

import numpy as np

from studies.bench.vision import pose_at
from wlr_gym.data import Run
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
from wlr_gym.perception.vision.slip import measure_slip
from wlr_gym.perception.vision.tracking import LOST, OK, Sample, VideoFrame, angles
from wlr_gym.robot import load_robot
from wlr_gym.robot.parameters import Parameters

STD = np.array([5e-5, 5e-5, 1.4e-4, 5e-5, 7e-4, 7e-4])  # of a pose from 2 m above
OFFSET = 0.137


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


def samples_of(drive, offset=OFFSET, seed=0, gap=()):
    """Samples with the poses of a drive, in which frames err by :data:`STD`; none within gaps (s, s)."""
    rng, result = np.random.default_rng(seed), []
    for index in range(int((drive.time[-1] - 0.1) * 30)):
        time = 0.011 + index / 30
        pose = pose_at(drive, time)
        values = np.concatenate([pose.position, angles(pose.rotation)]) + STD * rng.standard_normal(6)
        seen = not any(start < time < stop for start, stop in gap)
        values, covariance = (values, np.diag(STD**2)) if seen else (np.full(6, np.nan), np.full((6, 6), np.nan))
        result.append(Sample(index, time - offset, OK if seen else LOST, values, covariance, 4 * seen, 0.02, np.zeros((4, 2))))
    return result


def with_table(run, table):
    """The run with another table."""
    return Run(table.reset_index(drop=True), run.meta, run.path)


def measured(drive, samples=None, *known, run=None, robot=None, offset=OFFSET):
    """Slip of a drive from samples of it; ``known``: sigmas of the offset and of the layout."""
    robot = robot or drive.robot
    return measure_slip(samples or samples_of(drive), offset, run or drive.run, robot, Parameters.nominal(robot), *known)
