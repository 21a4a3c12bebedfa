"""What pictures show, from where and in which colours, and whether a window can be opened. Light: no MuJoCo, no Pillow."""

# pyright: reportAttributeAccessIssue=false
# (MuJoCo fills its namespace when it is imported.)
from __future__ import annotations

import math
import os
import platform
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from numbers import Integral
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from wlr_gym.base.errors import InputError, check_name

if TYPE_CHECKING:
    import mujoco

    from wlr_gym.robot import Robot

SMALLEST = 64  # pixels; smallest width and height
LARGEST = 4096  # pixels; largest width and height


@dataclass(frozen=True)
class View:
    """What pictures show.

    Attributes:
        size: width and height, pixels.
        camera: ``follow`` (fixed direction), ``chase`` (behind the robot), ``side`` or ``top``.
        friction: areas of other friction in their colours, and the bar that says which colour is which.
        slip: an arrow per slipping wheel, along the velocity of its contact point over the floor.
        forces: an arrow per contact of a wheel, along the floor's friction force.
        loads: an arrow per contact of a wheel, along the floor's normal force.
        path: of films: where the robot went, and, dashed, where its commands would have taken it from the same start.
        text: time, commands, speed, slip and the legend.
    """

    size: tuple[int, int] = (640, 480)
    camera: str = "follow"
    friction: bool = True
    slip: bool = True
    forces: bool = False
    loads: bool = False
    path: bool = False
    text: bool = True

    def __post_init__(self) -> None:
        check_name("camera", self.camera, CAMERAS, "view")
        size = self.size
        if not (isinstance(size, Sequence) and len(size) == 2 and all(isinstance(n, Integral) and fits(int(n)) for n in size)):
            raise InputError(f"view: size = {size!r}: expected width and height, each {SMALLEST} to {LARGEST} pixels")
        object.__setattr__(self, "size", (int(size[0]), int(size[1])))
        for name in ("friction", "slip", "forces", "loads", "path", "text"):
            if not isinstance(getattr(self, name), bool):
                raise InputError(f"view: {name} = {getattr(self, name)!r}: expected True or False")


def fits(pixels: int) -> bool:
    """Whether a picture may be so wide or high."""
    return SMALLEST <= pixels <= LARGEST


def read_view(given: View | Mapping[str, Any] | None) -> View:
    """Return a view from what users pass as ``view=``: a :class:`View`, a mapping of its attributes, or None.

    Raises:
        InputError: unknown key (with the nearest valid one) or a bad value.
    """
    if isinstance(given, View):
        return given
    for key in given or {}:
        check_name("key", key, [field.name for field in fields(View)], "view")
    return View(**(given or {}))


# ---- where a picture is taken from, and where a point of the scene lands in it ---------------------------------------


Array = NDArray[np.float64]

#: m above the floor: what every camera looks at, below or beside the body origin. It does not bounce with the body.
LOOK_HEIGHT = 0.09


@dataclass(frozen=True)
class FollowCamera:
    """A camera that goes along with the robot.

    Attributes:
        azimuth: rad, horizontal direction of view from the floor's x axis (or the robot's heading) to the left.
        elevation: rad, negative looks down. distance: m from the robot.
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


def aim(
    scene: mujoco.MjvScene, camera: FollowCamera, place: Array, yaw: float, up: Array, scale: float = 1.0, level: float = 0.0
) -> None:
    """Point the scene's camera at a robot, with gravity pulling down in the picture: a slope is seen as a slope.

    Args:
        scene: its frustum stays as it is. camera: from where.
        place: (x, y, ...) of the robot in the floor frame, m. yaw: its heading, rad.
        up: (3,) unit vector against gravity in the floor frame.
        scale: factor on distance and height; see :func:`magnification`.
        level: height of the floor about there, m.
    """
    skew = np.array([[0.0, 0.0, up[0]], [0.0, 0.0, up[1]], [-up[0], -up[1], 0.0]])
    tilt = np.eye(3) + skew + skew @ skew / (1.0 + up[2])  # the smallest rotation that takes z to ``up``
    forward, above = (tilt @ direction for direction in directions(camera, yaw))
    target = np.array([place[0], place[1], scale * LOOK_HEIGHT + level])
    for eye in scene.camera:
        eye.forward, eye.up = forward, above
        eye.pos = target - scale * camera.distance * forward


def directions(camera: FollowCamera, yaw: float = 0.0) -> tuple[Array, Array]:
    """Return where a camera looks and what is up in its picture, both (3,), for a robot that heads along ``yaw`` (rad)."""
    azimuth = camera.azimuth + (yaw if camera.turns else 0.0)
    flat, rise = math.cos(camera.elevation), math.sin(camera.elevation)
    c, s = math.cos(azimuth), math.sin(azimuth)
    return np.array([flat * c, flat * s, rise]), np.array([-rise * c, -rise * s, flat])


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


# ---- whether a window can be opened here -----------------------------------------------------------------------------


def has_display() -> bool:
    """Whether this process has a display; on macOS and Windows it is taken to have one."""
    return platform.system() != "Linux" or bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))


def require_display() -> None:
    """Raise :class:`InputError` where no window can be opened; the message says what to do instead."""
    if not has_display():
        raise InputError(
            "no display here (neither DISPLAY nor WAYLAND_DISPLAY is set), so no window: make a video instead "
            "(wlr play --video FILE.webp, or render_mode='rgb_array'), or log in with a display (ssh -X)"
        )


# ---- which colour stands for which friction coefficient and slip speed; RGB in 0..1 ----------------------------------


Colour = tuple[float, float, float]

#: Friction coefficient -> colour: ice is blue (not the sky's), the nominal floor (0.6) light grey, a very rough floor brown.
FRICTION = ((0.0, (0.22, 0.54, 0.74)), (0.3, (0.62, 0.82, 0.90)), (0.6, (0.80, 0.80, 0.78)), (1.0, (0.72, 0.50, 0.30)))
#: Slip speed (m/s) -> colour of its arrow.
SLIP = ((0.0, (1.0, 0.85, 0.10)), (0.05, (1.0, 0.55, 0.05)), (0.2, (0.90, 0.08, 0.08)))
FORCE: Colour = (0.10, 0.45, 0.15)  # arrows of friction on a wheel
LOAD: Colour = (0.45, 0.62, 0.45)  # of normal force
WANTED: Colour = (0.10, 0.10, 0.12)  # paths over the floor: as commanded
DRIVEN: Colour = (0.95, 0.10, 0.55)  # and as driven


def friction_colour(mu: float) -> Colour:
    """Return the colour of a floor with friction coefficient ``mu``."""
    return _between(FRICTION, mu)


def slip_colour(speed: float) -> Colour:
    """Return the colour of a slip arrow; ``speed`` in m/s."""
    return _between(SLIP, speed)


def _between(table: tuple[tuple[float, Colour], ...], value: float) -> Colour:
    places = [place for place, _ in table]
    red, green, blue = (float(np.interp(value, places, [colour[k] for _, colour in table])) for k in range(3))
    return red, green, blue
