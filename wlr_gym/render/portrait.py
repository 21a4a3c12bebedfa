"""One picture of a robot: four views, standing at home and with its legs at their limits, with its dimensions."""

from __future__ import annotations

from contextlib import closing
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from wlr_gym.base.files import replace_file
from wlr_gym.physics.plants.base import TRUTH_LAYOUT, Truth, standing_state
from wlr_gym.render import overlay
from wlr_gym.render.scene import Scene
from wlr_gym.render.view import View
from wlr_gym.robot import Robot
from wlr_gym.robot.parameters import Parameters

Picture = NDArray[np.uint8]

#: Pixels; of one of the four views.
SIZE = (640, 480)


def draw_portrait(path: Path, robot: Robot) -> None:
    """Write the picture (.png, .jpg, ...).

    Args:
        path: of the file.
        robot: what stands in it.

    Raises:
        InputError: no OpenGL on this machine, or the file cannot be written.
    """
    low, high = robot.leg_limits
    home = robot.home.leg_angle
    x, y, z = robot.body.size
    sizes = [
        f"{robot.name}: {robot.total_mass:.3g} kg",
        f"body {x:g} x {y:g} x {z:g} m, {robot.body.mass:g} kg",
        f"legs {robot.leg.length:g} m, wheels of radius {robot.wheel.radius:g} m",
        "squares 0.2 m",
    ]
    panels = (
        _view(robot, "follow", home, sizes),
        _view(robot, "side", home, [f"home: legs at {home:.3g} rad"]),
        _view(robot, "side", low, [f"lower limit: legs at {low:.3g} rad"]),
        _view(robot, "side", high, [f"upper limit: legs at {high:.3g} rad"]),
    )
    picture = np.vstack([np.hstack(panels[:2]), np.hstack(panels[2:])])
    replace_file(path, lambda temporary: Image.fromarray(picture).save(temporary))


def _view(robot: Robot, camera: str, leg_angle: float, lines: list[str]) -> Picture:
    parameters = Parameters.nominal(robot)
    state = standing_state(robot, parameters, leg_angle)
    truth = Truth(np.zeros((1, TRUTH_LAYOUT.width)))
    for name in ("position", "quaternion", "joint_position"):
        truth[name][:] = getattr(state, name)
    with closing(Scene(robot, View(size=SIZE, camera=camera, friction=False, slip=False, text=False))) as scene:
        return overlay.write(scene.draw(truth, parameters), lines, bar=False)
