"""Where a picture is taken from, and where a point of the scene lands in it."""

# pyright: reportAttributeAccessIssue=false
# (MuJoCo fills its namespace when it is imported.)
from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

if TYPE_CHECKING:
    import mujoco

    from wlr_gym.robot import Robot

Array = NDArray[np.float64]

#: m above the floor: what every camera looks at, below or beside the body origin. It does not bounce with the body.
LOOK_HEIGHT = 0.09


@dataclass(frozen=True)
class FollowCamera:
    """A camera that goes along with the robot.

    Attributes:
        azimuth: rad, horizontal direction of view from the floor's x axis (or the robot's heading) to the left.
        elevation: rad, negative looks down.
        distance: m from the robot.
        turns: the azimuth counts from the robot's heading; else the camera keeps its direction.
    """

    azimuth: float
    elevation: float
    distance: float
    turns: bool = False


CAMERAS = {
    "follow": FollowCamera(math.radians(62), math.radians(-30), 1.25),
    "chase": FollowCamera(math.radians(0), math.radians(-28), 1.25, turns=True),
    "side": FollowCamera(math.radians(90), math.radians(-12), 1.1),
    "top": FollowCamera(math.radians(90), math.radians(-89.9), 1.5),
}


#: m; front to rear wheels with all legs stretched out, up to which the cameras stay where :data:`CAMERAS` says.
REACH = 0.65


def magnification(robot: Robot) -> float:
    """Return the factor on a camera's distance and on the height it looks at, so that a large robot is in the picture."""
    return max(1.0, 2.0 * (robot.hip_position.x + robot.leg.length) / REACH)


def up_direction(slope: Array) -> Array:
    """Return the direction against gravity in the floor frame for ``ground.slope`` (pitch, roll), rad."""
    pitch, roll = np.sin(slope)
    return np.array([pitch, roll, math.sqrt(max(0.0, 1.0 - pitch**2 - roll**2))])


def aim(scene: mujoco.MjvScene, camera: FollowCamera, place: Array, yaw: float, up: Array, scale: float = 1.0) -> None:
    """Point the scene's camera at a robot, with gravity pulling down in the picture: a slope is seen as a slope.

    Args:
        scene: its frustum stays as it is.
        camera: from where.
        place: (x, y, ...) of the robot in the floor frame, m.
        yaw: heading of the robot, rad.
        up: (3,) unit vector against gravity in the floor frame.
        scale: factor on distance and height; see :func:`magnification`.
    """
    azimuth = camera.azimuth + (yaw if camera.turns else 0.0)
    flat, rise = math.cos(camera.elevation), math.sin(camera.elevation)
    forward = np.array([flat * math.cos(azimuth), flat * math.sin(azimuth), rise])
    above = np.array([-rise * math.cos(azimuth), -rise * math.sin(azimuth), flat])
    tilt = _rotation_from_z_to(up)
    target = np.array([place[0], place[1], scale * LOOK_HEIGHT])
    for eye in scene.camera:
        eye.forward, eye.up = tilt @ forward, tilt @ above
        eye.pos = target - scale * camera.distance * (tilt @ forward)


def project(scene: mujoco.MjvScene, points: ArrayLike, size: tuple[int, int]) -> Array:
    """Return the pixels (..., 2) as (column, row) of points (..., 3) in the floor frame; NaN behind the camera."""
    eye = scene.camera[0]
    forward, up = np.array(eye.forward, np.float64), np.array(eye.up, np.float64)
    seen = np.asarray(points, np.float64) - np.array(eye.pos, np.float64)
    depth = seen @ forward
    depth = np.where(depth > eye.frustum_near, depth, np.nan)
    scale = 0.5 * size[1] / (0.5 * (eye.frustum_top - eye.frustum_bottom) / eye.frustum_near)
    column = 0.5 * size[0] + scale * (seen @ np.cross(forward, up)) / depth
    return np.stack([column, 0.5 * size[1] - scale * (seen @ up) / depth], axis=-1)


def _rotation_from_z_to(up: Array) -> Array:
    """Return the smallest rotation (3, 3) that takes z to ``up``."""
    x, y, z = up
    skew = np.array([[0.0, 0.0, x], [0.0, 0.0, y], [-x, -y, 0.0]])
    return np.eye(3) + skew + skew @ skew / (1.0 + z)
