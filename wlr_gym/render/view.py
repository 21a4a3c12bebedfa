"""What pictures show, and from where. Light: imports neither MuJoCo nor Pillow."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from numbers import Integral
from typing import Any

from wlr_gym.base.errors import InputError, unknown_name
from wlr_gym.render.camera import CAMERAS

#: Pixels; smallest width and height.
SMALLEST = 64
#: Pixels; largest width and height.
LARGEST = 4096


@dataclass(frozen=True)
class View:
    """What pictures show.

    Attributes:
        size: width and height, pixels.
        camera: ``follow`` (fixed direction), ``chase`` (behind the robot), ``side`` or ``top``.
        friction: areas of other friction in their colours, and the bar that says which colour is which.
        slip: an arrow per slipping wheel, along the velocity of its contact point over the floor.
        forces: an arrow per wheel, along the floor's friction force.
        path: of films: where the robot went, and, dashed, where its commands would have taken it from the same start.
        text: time, commands, speed, slip and the legend.
    """

    size: tuple[int, int] = (640, 480)
    camera: str = "follow"
    friction: bool = True
    slip: bool = True
    forces: bool = False
    path: bool = False
    text: bool = True

    def __post_init__(self) -> None:
        if self.camera not in CAMERAS:
            raise unknown_name("camera", str(self.camera), CAMERAS, "view")
        size = self.size
        if not (isinstance(size, Sequence) and len(size) == 2 and all(isinstance(n, Integral) and fits(int(n)) for n in size)):
            raise InputError(f"view: size = {size!r}: expected width and height, each {SMALLEST} to {LARGEST} pixels")
        object.__setattr__(self, "size", (int(size[0]), int(size[1])))
        for name in ("friction", "slip", "forces", "path", "text"):
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
    valid = [field.name for field in fields(View)]
    for key in given or {}:
        if key not in valid:
            raise unknown_name("key", str(key), valid, "view")
    return View(**(given or {}))
