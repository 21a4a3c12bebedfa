"""Pictures of a robot from the truth of any plant."""

# pyright: reportAttributeAccessIssue=false
# (MuJoCo fills its namespace when it is imported.)
from __future__ import annotations

from collections.abc import Mapping, Sequence

import mujoco
import numpy as np
from numpy.typing import ArrayLike, NDArray

from wlr_gym.base.errors import InputError
from wlr_gym.physics.plants.base import Truth
from wlr_gym.render import camera, marks, overlay
from wlr_gym.render.gl import Canvas
from wlr_gym.render.stage import Stage
from wlr_gym.render.view import View
from wlr_gym.robot import Robot
from wlr_gym.robot.parameters import Parameters

Picture = NDArray[np.uint8]

#: Areas, pads and arrows a scene has room for.
MAX_MARKS = 400
#: Degrees; a smaller slope is not written.
LEAST_SLOPE = 0.5


class Scene:
    """Draws one robot at a time; OpenGL is opened by the first picture and given back by :meth:`close`.

    A picture is a function of what is passed to :meth:`draw`: there is no memory from one to the next.

    Args:
        robot: supplies the sizes that are no parameters.
        view: what to show.
    """

    def __init__(self, robot: Robot, view: View | None = None) -> None:
        self.robot = robot
        self.view: View = view or View()
        self._stage: Stage | None = None
        self._canvas: Canvas | None = None
        self._scene: mujoco.MjvScene | None = None

    def draw(
        self,
        truth: Truth,
        parameters: Parameters,
        row: int = 0,
        *,
        time: float | None = None,
        command: Mapping[str, float] | None = None,
        title: str = "",
        result: str = "",
        look_at: ArrayLike | None = None,
        trails: Sequence[marks.Trail] = (),
    ) -> Picture:
        """Return the picture (H, W, 3), uint8, of one robot.

        Args:
            truth: of a plant, any number of robots; nothing in it is changed.
            parameters: of the same robots: sizes of wheels and legs, payload, friction of the floor, slope.
            row: which robot.
            time: s, written into the picture.
            command: name -> value in SI units, written into the picture beside what the robot does.
            title: first line of the text.
            result: last line of the text.
            look_at: (x, y) of the floor in the middle of the picture, m; None = the robot.
            trails: paths over the floor to draw.

        Raises:
            InputError: no OpenGL on this machine; the message says what to install or set.
        """
        if self._stage is None:
            self._stage = Stage(self.robot, parameters, row, self.view.size)
        stage = self._stage
        stage.pose(truth, parameters, row)
        if self._canvas is None or self._scene is None:
            self._canvas = Canvas(stage.model, self.view.size)
            self._scene = mujoco.MjvScene(stage.model, maxgeom=stage.model.ngeom + MAX_MARKS)
        scene, eye = self._scene, mujoco.MjvCamera()
        middle = truth.position[row] if look_at is None else np.asarray(look_at)
        up = camera.up_direction(parameters["ground.slope"][row])
        place = (camera.CAMERAS[self.view.camera], middle, stage.yaw(), up, camera.magnification(self.robot))
        # The endless floor is laid out around the camera the scene had before, so it gets its own first.
        mujoco.mjv_updateCamera(stage.model, stage.data, eye, scene)
        camera.aim(scene, *place)
        everything = mujoco.mjtCatBit.mjCAT_ALL.value
        mujoco.mjv_updateScene(stage.model, stage.data, mujoco.MjvOption(), None, eye, everything, scene)
        camera.aim(scene, *place)
        floor = marks.areas(parameters, row, truth.position[row]) if self.view.friction else []
        marks.add_marks(scene, marks_of(stage, truth, parameters, row, floor, self.view))
        marks.add_marks(scene, [piece for trail in trails for piece in marks.pieces(trail)])
        picture = self._canvas.draw(scene)
        if not self.view.text:
            return picture
        lines = describe(truth, parameters, row, time, command, title, slip=self.view.slip) + [result] * bool(result)
        return overlay.write(
            picture, lines, legend(parameters, row, self.view), self.view.friction, self._labels(floor, truth.position[row])
        )

    def pixels(self, points: object) -> NDArray[np.float64]:
        """Return where points (..., 3) of the floor frame are in the last picture: (..., 2) column and row, NaN if behind."""
        if self._scene is None:
            raise InputError("nothing has been drawn yet")
        return camera.project(self._scene, np.asarray(points, np.float64), self.view.size)

    def close(self) -> None:
        """Give OpenGL back; the next picture opens it again."""
        if self._canvas is not None:
            self._canvas.close()
        self._canvas = self._scene = None

    def _labels(self, floor: list[marks.Area], position: NDArray[np.float64]) -> list[overlay.Note]:
        """Write the friction of each area on it, beside the robot and clear of the other text."""
        width, height = self.view.size
        scale = camera.magnification(self.robot)
        middle = np.array([*position[:2], scale * camera.LOOK_HEIGHT])
        around = middle + 0.32 * scale * np.vstack([np.eye(3), -np.eye(3)[:2]])
        robot = self.pixels(middle)
        clear = np.linalg.norm(self.pixels(around) - robot, axis=1).max() + 0.02 * width
        notes = []
        for area in floor:
            places = self.pixels(area.points(position))
            inside = (np.abs(places[:, 0] / width - 0.5) < 0.44) & (np.abs(places[:, 1] / height - 0.5) < 0.46)
            text = (places[:, 0] < 0.48 * width) & ((places[:, 1] < 0.27 * height) | (places[:, 1] > 0.76 * height))
            good = inside & ~text & (np.linalg.norm(places - robot, axis=1) > clear)
            if good.any():
                notes.append(overlay.Note(f"µ {area.mu:.2g}", marks.pair(places[np.argmax(good)])))
        return notes


def marks_of(
    stage: Stage, truth: Truth, parameters: Parameters, row: int, floor: list[marks.Area], view: View
) -> list[marks.Mark]:
    """Return all that is drawn besides the robot, posed in ``stage``."""
    drawn: list[marks.Mark] = [marks.squares(stage, truth.position[row]), *floor]
    if view.friction:
        drawn += marks.spots(stage, parameters, row)
    if view.forces:
        drawn += marks.force_arrows(stage, truth, parameters, row)
    if view.slip:
        drawn += marks.slip_arrows(stage, truth, parameters, row)
    return drawn


def legend(parameters: Parameters, row: int, view: View) -> list[str]:
    """Return what the colours and arrows of a picture mean, line by line."""
    mu = 0.5 * (parameters["ground.mu_x"][row] + parameters["ground.mu_y"][row])
    low, high = f"{mu.min():.2f}", f"{mu.max():.2f}"
    floor = f"floor µ {low}" if low == high else f"floors µ {low} to {high}"
    lines = [f"{floor}, squares 0.2 m" if view.friction else "squares 0.2 m"]
    if view.slip:
        lines.append(f"slip: 0.1 m of arrow = {0.1 / marks.SLIP_SCALE:g} m/s")
    if view.forces:
        lines.append(f"friction (green): 0.1 m = {0.1 / marks.FORCE_SCALE:g} N")
    if view.path:
        lines.append("path: pink; as commanded: dashed")
    return lines


#: Command -> label, unit, and the truth that answers it.
_ANSWERS = {
    "linear_velocity_x": ("speed", "m/s", "linear_velocity_in_body", 0),
    "yaw_rate": ("yaw rate", "rad/s", "angular_velocity_in_body", 2),
}


def describe(
    truth: Truth,
    parameters: Parameters,
    row: int,
    time: float | None = None,
    command: Mapping[str, float] | None = None,
    title: str = "",
    *,
    slip: bool = True,
) -> list[str]:
    """Return the lines of text of a picture."""
    lines = [title] if title else []
    if time is not None:
        lines.append(f"t {time:.2f} s")
    command = command or {}
    for name, (label, unit, channel, axis) in _ANSWERS.items():
        asked = f" of {command[name]:.2f}" if name in command else ""
        value = round(float(truth[channel][row, axis]), 2) + 0.0  # no minus before zero
        lines.append(f"{label} {value:.2f}{asked} {unit}")
    if slip:
        pairs = truth.slip_velocity[row].reshape(4, 2)
        lines.append(f"slip {np.hypot(pairs[:, 0], pairs[:, 1]).max():.3f} m/s (fastest wheel)")
    pitch, roll = np.degrees(parameters["ground.slope"][row])
    slopes = [f"{angle:.1f}° along {axis}" for angle, axis in ((pitch, "x"), (roll, "y")) if abs(angle) >= LEAST_SLOPE]
    return [*lines, f"slope {', '.join(slopes)}"] if slopes else lines
