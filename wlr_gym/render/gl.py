"""An OpenGL context that draws into memory: opened when the first picture is drawn, never before.

``mujoco`` picks its context class once, when it is first imported, from ``MUJOCO_GL``. Here it is picked when it is needed, so
a headless machine draws through EGL without any setting, whatever was imported before. ``MUJOCO_GL`` still decides where it is
set.
"""

# pyright: reportAttributeAccessIssue=false
# (MuJoCo fills its namespace when it is imported.)
from __future__ import annotations

import importlib
import os
import platform
import sys
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from wlr_gym.base.errors import InputError
from wlr_gym.render.view import has_display

#: System -> contexts that can draw into memory there, the preferred first. On Linux EGL needs no display.
CONTEXTS = {"Linux": ("egl", "glfw", "osmesa"), "Darwin": ("cgl", "glfw"), "Windows": ("glfw",)}
_SAME = {"glx": "glfw", "wgl": "glfw", "on": "", "enable": "", "enabled": "", "true": "", "1": ""}
_OFF = ("off", "disable", "disabled", "false", "0")
_REMEDY = {
    "Linux": "install the system's EGL with a software driver (Debian, Ubuntu: apt install libegl1 libgl1-mesa-dri), or set "
    "MUJOCO_GL=osmesa and install libosmesa6",
    "Darwin": "run on a machine with a graphics session",
    "Windows": "install the graphics driver of this machine",
}


def context_names() -> tuple[str, ...]:
    """Return the contexts to try: what ``MUJOCO_GL`` asks for, else those that need nothing from the user.

    Raises:
        InputError: ``MUJOCO_GL`` switches pictures off, or names what this system does not have.
    """
    valid = CONTEXTS.get(platform.system(), ("glfw",))
    asked = os.environ.get("MUJOCO_GL", "").lower().strip()
    if asked in _OFF:
        raise InputError(f"MUJOCO_GL={asked} switches pictures off: unset it, or set it to one of {', '.join(valid)}")
    asked = _SAME.get(asked, asked)
    if asked and asked not in valid:
        raise InputError(f"MUJOCO_GL={asked}: expected one of {', '.join(valid)}")
    return (asked,) if asked else tuple(name for name in valid if name != "osmesa" and (name != "glfw" or has_display()))


class Canvas:
    """Memory of fixed size that a MuJoCo scene is drawn into.

    Args:
        model: its textures go to the graphics card; models of the same structure can be drawn as well.
        size: width and height in pixels, at most the model's offscreen buffer.

    Raises:
        InputError: no OpenGL here; the message says what to install or set.
    """

    def __init__(self, model: mujoco.MjModel, size: tuple[int, int]) -> None:
        self._drawing: mujoco.MjrContext | None = None
        self._context = _open_context(*size)
        self._context.make_current()
        self._drawing = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_100.value)
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN.value, self._drawing)
        self._rectangle = mujoco.MjrRect(0, 0, *size)
        self._upside_down = np.empty((size[1], size[0], 3), np.uint8)

    def draw(self, scene: mujoco.MjvScene) -> NDArray[np.uint8]:
        """Return the picture (H, W, 3) of a scene."""
        self._context.make_current()
        mujoco.mjr_render(self._rectangle, scene, self._drawing)
        mujoco.mjr_readPixels(self._upside_down, None, self._rectangle, self._drawing)
        return self._upside_down[::-1].copy()

    @property
    def closed(self) -> bool:
        """Whether the context has been given back."""
        return self._drawing is None

    def close(self) -> None:
        """Give the context and its memory back; closing again does nothing."""
        if self._drawing is not None:
            self._context.make_current()
            self._drawing.free()
            self._context.free()
        self._drawing = None

    def __del__(self) -> None:
        if self._drawing is not None and not sys.is_finalizing():  # then the drivers may be gone, and all is taken back
            self.close()


def _open_context(width: int, height: int) -> Any:
    failures = []
    for name in context_names():
        try:
            return importlib.import_module(f"mujoco.{name}").GLContext(width, height)
        except Exception as error:  # drivers fail in every way there is: missing libraries, attributes, devices
            failures.append(f"{name}: {str(error).strip().splitlines()[0] if str(error).strip() else type(error).__name__}")
    remedy = _REMEDY.get(platform.system(), "install an OpenGL driver")
    raise InputError(f"no OpenGL to draw pictures with ({'; '.join(failures) or 'no context to try'}): {remedy}")
