"""What an environment shows of its robots: pictures, or a window."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from wlr_gym.base.errors import InputError
from wlr_gym.envs.core import Core
from wlr_gym.render.display import has_display, require_display

if TYPE_CHECKING:
    from wlr_gym.render import Scene, Viewer

Picture = NDArray[np.uint8]

RENDER_MODES = ("human", "rgb_array")


class RenderModeError(InputError, TypeError):
    """A render mode that does not exist. Also a TypeError: that is what Stable-Baselines3 probes for."""


def check_render_mode(render_mode: str | None) -> None:
    """Refuse a render mode that does not exist, or a window where there is no display.

    Raises:
        InputError: the message says what is valid, or what to do instead.
    """
    if render_mode is not None and render_mode not in RENDER_MODES:
        raise RenderModeError(f"render_mode = {render_mode!r}: expected None, 'human' or 'rgb_array'")
    if render_mode == "human":
        require_display()


def metadata(control_period: float) -> dict[str, Any]:
    """Return an environment's metadata: the render modes that work on this machine, and pictures per second."""
    modes = [mode for mode in RENDER_MODES if mode != "human" or has_display()]
    return {"render_modes": modes, "render_fps": round(1.0 / control_period)}


class Pictures:
    """Draws the robots of a core. Nothing is opened before the first picture.

    Args:
        core: whose plant's truth is drawn, whatever the plant.
        render_mode: None, ``human`` or ``rgb_array``.
    """

    def __init__(self, core: Core, render_mode: str | None) -> None:
        if render_mode is not None and not core.plant.capabilities.has_truth:
            raise InputError(f"render_mode = {render_mode!r}: where a real robot stands is not known; look at it")
        self.core = core
        self.render_mode = render_mode
        self._scene: Scene | None = None
        self._viewer: Viewer | None = None

    def after_step(self) -> None:
        """Show the present state where there is a window."""
        if self.render_mode == "human":
            self.show()

    def warn_without_mode(self) -> None:
        """Say, as Gymnasium's own environments do, that there is no render mode."""
        gym.logger.warn("render() without a render mode shows nothing: make the environment with render_mode='rgb_array'")

    def frame(self, row: int) -> Picture:
        """Return the picture of one robot, (H, W, 3) uint8.

        Raises:
            InputError: no OpenGL on this machine.
        """
        self.core.episodes.require_begun("render()")
        if self._scene is None:
            from wlr_gym.render import Scene

            self._scene = Scene(self.core.task.robot, self.core.settings.picture_view)
        return self._scene.draw(self.core.plant.truth(), self.core.parameters, row, **self._texts(row))

    def show(self) -> None:
        """Show the first robot in a window, in real time. Once the user has closed it, nothing happens."""
        self.core.episodes.require_begun("render()")
        if self._viewer is None:
            from wlr_gym.render import Viewer

            self._viewer = Viewer(self.core.task.robot, self.core.settings.picture_view)
        period = self.core.task.config.control_period
        self._viewer.show(self.core.plant.truth(), self.core.parameters, 0, period=period, **self._texts(0))

    def close(self) -> None:
        """Close the window and give OpenGL back."""
        for drawer in (self._scene, self._viewer):
            if drawer is not None:
                drawer.close()

    def _texts(self, row: int) -> dict[str, Any]:
        core = self.core
        command = dict(zip(core.task.commands, core.command[row].tolist(), strict=True))
        return {"time": float(core.time[row]), "command": command}
