"""A window that shows a plant while it runs, in real time.

All that needs a display is in :func:`open_window`; the rest can be driven by any object with the same few methods.
"""

# pyright: reportAttributeAccessIssue=false
# (MuJoCo fills its namespace when it is imported.)
from __future__ import annotations

import importlib
import platform
import time
from collections.abc import Callable
from typing import Any, Unpack

import numpy as np

from wlr_gym.base.errors import InputError
from wlr_gym.physics.plants.base import Truth
from wlr_gym.physics.plants.mujoco import mujoco
from wlr_gym.render.scene import Texts, describe, marks_of
from wlr_gym.render.stage import MESHES, ContactsOf, Stage, add_marks, areas
from wlr_gym.render.view import CAMERAS, LOOK_HEIGHT, View, magnification, require_display
from wlr_gym.robot import Robot
from wlr_gym.robot.parameters import Parameters

KeyCallback = Callable[[int], None]


def open_window(model: mujoco.MjModel, data: mujoco.MjData, on_key: KeyCallback | None) -> Any:
    """Open MuJoCo's viewer without its side panels, and return its handle.

    Raises:
        InputError: no display, or a Python that cannot have one.
    """
    require_display()
    try:
        viewer = importlib.import_module("mujoco.viewer")
        return viewer.launch_passive(model, data, key_callback=on_key, show_left_ui=False, show_right_ui=False)
    except (RuntimeError, ImportError, mujoco.FatalError) as error:
        remedy = "start Python as mjpython (it comes with mujoco)" if platform.system() == "Darwin" else "check the display"
        raise InputError(f"MuJoCo's viewer does not open ({error}): {remedy}, or make a video instead") from None


class Pace:
    """Waits for the next tick, in real time."""

    def __init__(self) -> None:
        self._next = -np.inf

    def wait(self, period: float) -> None:
        """Wait until ``period`` s after the last tick; after a hold-up of more than a few, continue from now."""
        now = time.monotonic()
        if now > self._next + 5 * period:
            self._next = now
        self._next += period
        if self._next > now:
            time.sleep(self._next - now)


class Viewer:
    """Shows one robot, drawn like :class:`wlr_gym.render.scene.Scene`, no faster than real time.

    The camera starts as ``view.camera`` says and goes along with the robot; the mouse turns it. On a slope gravity is
    inclined in the window (MuJoCo's camera keeps the floor's normal upright); the text says how much.

    Args:
        robot: supplies the sizes that are no parameters. view: what to show; the size is the window's own affair.
        on_key: called with GLFW's key code, from the window's thread.
    """

    def __init__(self, robot: Robot, view: View | None = None, on_key: KeyCallback | None = None) -> None:
        self.robot = robot
        self.view: View = view or View()
        self._on_key, self._pace = on_key, Pace()
        self._stage: Stage | None = None
        self._window: Any = None
        self._model: mujoco.MjModel | None = None

    @property
    def is_open(self) -> bool:
        """False before the first picture, and once the user has closed the window."""
        return self._window is not None and self._window.is_running()

    def show(
        self,
        truth: Truth,
        parameters: Parameters,
        *,
        period: float,
        contacts: ContactsOf | None = None,
        **texts: Unpack[Texts],
    ) -> bool:
        """Show the first robot and wait until its control period is over.

        Args:
            truth, parameters, contacts, texts: as in :meth:`wlr_gym.render.scene.Scene.draw`.
            period: s that this picture stands for.

        Returns:
            Whether the window is open. Once the user has closed it, nothing is shown and nothing waits.

        Raises:
            InputError: no display.
        """
        self._stage = stage = self._stage or Stage(self.robot, parameters, size=self.view.size)
        stage.pose(truth, parameters, contacts=contacts)
        has_new_floor = stage.lay_floor()
        if self.is_open and self._model is not stage.model:
            self.close()
        if self._window is None:
            self._window, self._model = open_window(stage.model, stage.data, self._on_key), stage.model
            start, eye = CAMERAS[self.view.camera], self._window.cam
            eye.type = mujoco.mjtCamera.mjCAMERA_FREE
            eye.distance, eye.elevation = 1.2 * magnification(self.robot) * start.distance, np.degrees(start.elevation)
            eye.azimuth = np.degrees(start.azimuth + (stage.yaw() if start.turns else 0.0))
        elif has_new_floor and self._window.is_running():
            for name in MESHES:
                self._window.update_mesh(stage.model.mesh(name).id)
        if not self._window.is_running():
            return False
        with self._window.lock():
            middle = truth.position[0, :2]
            self._window.cam.lookat[:] = [*middle, magnification(self.robot) * LOOK_HEIGHT + stage.level(middle)]
            scene = self._window.user_scn
            scene.ngeom = 0
            floor = areas(stage.parameters, truth.position[0]) if self.view.friction else []
            add_marks(scene, marks_of(stage, floor, self.view))
        if self.view.text:
            lines = describe(stage, slip=self.view.slip, **texts)
            self._window.set_texts([(None, mujoco.mjtGridPos.mjGRID_TOPLEFT, "\n".join(lines).replace("°", " deg"), "")])
        self._window.sync()
        self._pace.wait(period)
        return True

    def close(self) -> None:
        """Close the window; closing again does nothing."""
        if self._window is not None:
            self._window.close()
        self._window = None
