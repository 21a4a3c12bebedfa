"""Pictures of a robot from the truth of any plant, with text and a legend; a portrait with its dimensions.

They are drawn into memory by an OpenGL context that opens with the first picture, never before. ``mujoco`` picks its context
class once, when it is first imported, from ``MUJOCO_GL``. Here it is picked when it is needed, so a headless machine draws
through EGL without any setting, whatever was imported before. ``MUJOCO_GL`` still decides where it is set.
"""

# pyright: reportAttributeAccessIssue=false
# (MuJoCo fills its namespace when it is imported.)
from __future__ import annotations

import functools
import importlib
import os
import platform
import sys
import threading
from collections.abc import Mapping, Sequence
from contextlib import closing
from pathlib import Path
from typing import Any, TypedDict, Unpack

import numpy as np
from numpy.typing import ArrayLike, NDArray
from PIL import Image, ImageDraw, ImageFont

from wlr_gym.base.errors import InputError
from wlr_gym.base.files import replace_file
from wlr_gym.physics.floor import Floor
from wlr_gym.physics.plants.base import TRUTH_LAYOUT, PlantState, Truth, settle, standing_state
from wlr_gym.physics.plants.mujoco import mujoco
from wlr_gym.physics.plants.relief import map_of
from wlr_gym.render import stage as marks
from wlr_gym.render.stage import Area, ContactsOf, Mark, Stage, Trail
from wlr_gym.render.view import (
    CAMERAS,
    LOOK_HEIGHT,
    View,
    aim,
    friction_colour,
    has_display,
    magnification,
    project,
    up_direction,
)
from wlr_gym.robot import Robot
from wlr_gym.robot.parameters import Parameters

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
        self._thread = threading.get_ident()
        self._drawing: mujoco.MjrContext | None = None
        self._context, self._drawing = _open_context(model, size)
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN.value, self._drawing)
        self._rectangle = mujoco.MjrRect(0, 0, *size)
        self._upside_down = np.empty((size[1], size[0], 3), np.uint8)

    def take_floor(self, model: mujoco.MjModel) -> None:
        """Take the meshes of a floor that is not flat; the model is the one that it was made with."""
        self._take_turn()
        for name in marks.MESHES:
            mujoco.mjr_uploadMesh(model, self._drawing, model.mesh(name).id)

    def draw(self, scene: mujoco.MjvScene) -> NDArray[np.uint8]:
        """Return the picture (H, W, 3) of a scene."""
        self._take_turn()
        mujoco.mjr_render(self._rectangle, scene, self._drawing)
        mujoco.mjr_readPixels(self._upside_down, None, self._rectangle, self._drawing)
        return self._upside_down[::-1].copy()

    @property
    def closed(self) -> bool:
        """Whether the context has been given back."""
        return self._drawing is None

    def close(self) -> None:
        """Give the context and its memory back; closing again does nothing."""
        if self._drawing is not None and self._thread == threading.get_ident():  # only this one can
            self._context.make_current()
            self._drawing.free()
            self._context.free()
        self._drawing = None

    def _take_turn(self) -> None:
        """Draw into this context from now on."""
        if self._thread != threading.get_ident():
            raise InputError("an earlier picture was drawn in another thread: draw in one, or make an environment for each")
        self._context.make_current()

    def __del__(self) -> None:
        if self._drawing is not None and not sys.is_finalizing():  # then the drivers may be gone, and all is taken back
            self.close()


def _open_context(model: mujoco.MjModel, size: tuple[int, int]) -> tuple[Any, mujoco.MjrContext]:
    failures = []
    for name in context_names():
        try:
            context = importlib.import_module(f"mujoco.{name}").GLContext(*size)
            if not getattr(context, "_context", True):  # GLFW's: MuJoCo would end the process
                raise RuntimeError("no window opens here")
            context.make_current()
            return context, mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_100.value)
        except Exception as error:  # drivers fail in every way there is: missing libraries, attributes, devices
            failures.append(f"{name}: {str(error).strip().splitlines()[0] if str(error).strip() else type(error).__name__}")
    remedy = "unset MUJOCO_GL, or " if os.environ.get("MUJOCO_GL") else ""
    remedy += _REMEDY.get(platform.system(), "install an OpenGL driver")
    raise InputError(f"no OpenGL to draw pictures with ({'; '.join(failures) or 'no context to try'}): {remedy}")


# --- pictures -----------------------------------------------------------------------------------------------------------


Picture = NDArray[np.uint8]

MAX_MARKS = 400  # areas, pads and arrows a scene has room for
LEAST_SLOPE = 0.5  # degrees; a smaller slope is not written


class Scene:
    """Draws one robot at a time; OpenGL is opened by the first picture and given back by :meth:`close`.

    A picture is a function of what is passed to :meth:`draw`: there is no memory from one to the next.

    Args:
        robot: supplies the sizes that are no parameters. view: what to show.
    """

    def __init__(self, robot: Robot, view: View | None = None) -> None:
        self.robot = robot
        self.view: View = view or View()
        self._stage: Stage | None = None
        self._canvas: Canvas | None = None
        self._scene: mujoco.MjvScene | None = None
        self._model: mujoco.MjModel | None = None

    def draw(
        self,
        truth: Truth,
        parameters: Parameters,
        row: int = 0,
        *,
        result: str = "",
        look_at: ArrayLike | None = None,
        trails: Sequence[Trail] = (),
        contacts: ContactsOf | None = None,
        **texts: Unpack[Texts],
    ) -> Picture:
        """Return the picture (H, W, 3), uint8, of one robot.

        Args:
            truth: of a plant, any number of robots; nothing in it is changed. row: which robot.
            parameters: of the same robots: sizes of wheels and legs, payload, friction of the floor, slope.
            result: last line of the text.
            look_at: (x, y) of the floor in the middle of the picture, m; None = the robot.
            trails: paths over the floor to draw.
            contacts: ``plant.contacts``, for the forces on wheels that touch the floor twice; None = where each is deepest.
            texts: what else is written into the picture.

        Raises:
            InputError: no OpenGL on this machine; the message says what to install or set.
        """
        self._stage = stage = self._stage or Stage(self.robot, parameters, row, self.view.size)
        stage.pose(truth, parameters, row, contacts)
        has_new_floor = stage.lay_floor()
        if self._model is not stage.model:
            self.close()
        if self._canvas is None or self._scene is None:
            self._canvas, self._model = Canvas(stage.model, self.view.size), stage.model
            self._scene = mujoco.MjvScene(stage.model, maxgeom=stage.model.ngeom + MAX_MARKS)
        elif has_new_floor:
            self._canvas.take_floor(stage.model)
        scene, eye = self._scene, mujoco.MjvCamera()
        middle = truth.position[row] if look_at is None else np.asarray(look_at)
        up = up_direction(stage.parameters["ground.slope"][0])
        place = (CAMERAS[self.view.camera], middle, stage.yaw(), up, magnification(self.robot), stage.level(middle))
        # The endless floor is laid out around the camera the scene had before, so it gets its own first.
        mujoco.mjv_updateCamera(stage.model, stage.data, eye, scene)
        aim(scene, *place)
        everything = mujoco.mjtCatBit.mjCAT_ALL.value
        mujoco.mjv_updateScene(stage.model, stage.data, mujoco.MjvOption(), None, eye, everything, scene)
        aim(scene, *place)
        floor = marks.areas(stage.parameters, truth.position[row]) if self.view.friction else []
        marks.add_marks(scene, marks_of(stage, floor, self.view))
        marks.add_marks(scene, [piece for trail in trails for piece in marks.pieces(trail, stage)])
        picture = self._canvas.draw(scene)
        if not self.view.text:
            return picture
        lines = describe(stage, slip=self.view.slip, **texts) + [result] * bool(result)
        notes = self._labels(stage, floor)
        means = legend(stage.parameters, self.view, marks.force_scale(self.robot))
        return annotate(picture, lines, means, self.view.friction, notes)

    def pixels(self, points: object) -> NDArray[np.float64]:
        """Return where points (..., 3) of the floor frame are in the last picture: (..., 2) column and row, NaN if behind."""
        if self._scene is None:
            raise InputError("nothing has been drawn yet")
        return project(self._scene, np.asarray(points, np.float64), self.view.size)

    def close(self) -> None:
        """Give OpenGL back; the next picture opens it again."""
        if self._canvas is not None:
            self._canvas.close()
        self._canvas = self._scene = None

    def _labels(self, stage: Stage, floor: list[Area]) -> list[Note]:
        """Write the friction of each area on it, beside the robot and clear of the other text."""
        width, height = self.view.size
        scale, position = magnification(self.robot), stage.truth.position[0]
        middle = np.array([*position[:2], scale * LOOK_HEIGHT + stage.level(position)])
        around = middle + 0.32 * scale * np.vstack([np.eye(3), -np.eye(3)[:2]])
        robot = self.pixels(middle)
        clear = np.linalg.norm(self.pixels(around) - robot, axis=1).max() + 0.02 * width
        notes = []
        for area in floor:
            points = area.points(position)
            places = self.pixels(points + stage.height(points)[:, None] * [0.0, 0.0, 1.0])
            inside = (np.abs(places[:, 0] / width - 0.5) < 0.44) & (np.abs(places[:, 1] / height - 0.5) < 0.46)
            text = (places[:, 0] < 0.48 * width) & ((places[:, 1] < 0.27 * height) | (places[:, 1] > 0.76 * height))
            good = inside & ~text & (np.linalg.norm(places - robot, axis=1) > clear)
            if good.any():
                column, row = places[np.argmax(good)]
                notes.append((f"µ {area.mu:.2g}", (float(column), float(row))))
        return notes


def marks_of(stage: Stage, floor: list[Area], view: View) -> list[Mark]:
    """Return all that is drawn besides the robot, posed in ``stage``."""
    drawn = marks.ground(stage, floor, friction=view.friction)
    if view.friction:
        drawn += marks.spots(stage)
    if view.forces:
        drawn += marks.force_arrows(stage)
    if view.loads:
        drawn += marks.load_arrows(stage)
    if view.slip:
        drawn += marks.slip_arrows(stage)
    return drawn


def legend(parameters: Parameters, view: View, force_scale: float = marks.FORCE_SCALE) -> list[str]:
    """Return what the colours and arrows of one robot's picture mean, line by line; ``force_scale``: m of arrow per N."""
    mu = 0.5 * (parameters["ground.mu_x"][0] + parameters["ground.mu_y"][0])
    low, high = f"{mu.min():.2f}", f"{mu.max():.2f}"
    floor = f"floor µ {low}" if low == high else f"floors µ {low} to {high}"
    if parameters["friction_map.number"][0]:
        mapped = parameters["friction_map.scale"][0] * map_of(parameters["friction_map.number"][0])
        floor += f", mapped {mapped.min():.2f} to {mapped.max():.2f}"
    lines = [f"{floor}, squares 0.2 m" if view.friction else "squares 0.2 m"]
    if view.slip:
        lines.append(f"slip: 0.1 m of arrow = {0.1 / marks.SLIP_SCALE:g} m/s")
    lines += [relief] if (relief := _relief(parameters)) else []
    if arrows := ["friction (green)"] * view.forces + ["load (light green)"] * view.loads:
        lines.append(f"{', '.join(arrows)}: 0.1 m = {0.1 / force_scale:.3g} N")
    if view.path:
        lines.append("path: pink; as commanded: dashed")
    return lines


def _relief(parameters: Parameters) -> str:
    """Return how high one robot's floor is where it is not flat; nothing where it is."""
    heights = {
        "waves ±": parameters["wave.height"][0].sum(),
        "bumps up to ": parameters["bumps.height"][0],
        "pieces up to ": parameters["piece.height"][0].max(),
    }
    if parameters["grid.number"][0]:
        heights["grid up to "] = parameters["grid.scale"][0] * map_of(parameters["grid.number"][0]).max()
    return ", ".join(f"{what}{1e3 * height:.3g} mm" for what, height in heights.items() if height > 0.0)


#: Command -> label, unit, and the truth that answers it.
_ANSWERS = {
    "linear_velocity_x": ("speed", "m/s", "linear_velocity_in_body", 0),
    "yaw_rate": ("yaw rate", "rad/s", "angular_velocity_in_body", 2),
}


class Texts(TypedDict, total=False):
    """What is written into a picture besides what the robot does; absent or None = nothing."""

    title: str  #: first line
    time: float | None  #: s
    command: Mapping[str, float] | None  #: name -> value in SI units


def describe(stage: Stage, *, slip: bool = True, **texts: Unpack[Texts]) -> list[str]:
    """Return the lines of text of a picture."""
    lines = [title] if (title := texts.get("title")) else []
    if (time := texts.get("time")) is not None:
        lines.append(f"t {time:.2f} s")
    truth, command = stage.truth, texts.get("command") or {}
    for name, (label, unit, channel, axis) in _ANSWERS.items():
        asked = f" of {command[name]:.2f}" if name in command else ""
        value = round(float(truth[channel][0, axis]), 2) + 0.0  # no minus before zero
        lines.append(f"{label} {value:.2f}{asked} {unit}")
    if slip:
        pairs = truth.slip_velocity[0].reshape(4, 2)
        lines.append(f"slip {np.hypot(pairs[:, 0], pairs[:, 1]).max():.3f} m/s (fastest wheel)")
    pitch, roll = np.degrees(stage.parameters["ground.slope"][0])
    slopes = [f"{angle:.1f}° along {axis}" for angle, axis in ((pitch, "x"), (roll, "y")) if abs(angle) >= LEAST_SLOPE]
    return [*lines, f"slope {', '.join(slopes)}"] if slopes else lines


# ---- text and a legend -----------------------------------------------------------------------------------------------


# Colours (red, green, blue, opacity), 0 to 255.
PAPER = (255, 255, 255, 205)
INK = (25, 28, 32, 255)
BAR = 120  # pixels; width of the friction bar
BAR_RANGE = (0.0, 1.0)  # friction coefficients at its ends
MARGIN = 8  # pixels


#: A short text, and its place in the picture (column, row).
Note = tuple[str, tuple[float, float]]


@functools.cache
def font(height: int) -> ImageFont.FreeTypeFont:
    """Return DejaVu Sans, which Matplotlib carries along, in pixels of height."""
    import matplotlib

    return ImageFont.truetype(f"{matplotlib.get_data_path()}/fonts/ttf/DejaVuSans.ttf", height)


def annotate(
    picture: Picture, lines: Sequence[str], legend: Sequence[str] = (), bar: bool = True, notes: Sequence[Note] = ()
) -> Picture:
    """Return the picture with lines at the top left, a friction bar and a legend at the bottom left, and notes in the scene."""
    image = Image.fromarray(picture)
    draw = ImageDraw.Draw(image, "RGBA")
    size = max(9, round(picture.shape[0] / 34))  # pixels; height of the letters
    step, letters, (width, height) = round(1.35 * size), font(size), image.size
    for text, (column, row) in notes:
        half = 0.5 * letters.getlength(text)
        if half <= column <= width - half and size <= row <= height - size:
            around = {"stroke_width": 2, "stroke_fill": (255, 255, 255, 200)}
            draw.text((column, row), text, font=letters, fill=INK, anchor="mm", **around)
    if lines:
        wide = max(letters.getlength(line) for line in lines)
        draw.rounded_rectangle((MARGIN, MARGIN, wide + 3 * MARGIN, step * len(lines) + 2 * MARGIN), 4, fill=PAPER)
        for index, line in enumerate(lines):
            draw.text((2 * MARGIN, 1.5 * MARGIN + step * index), line, font=letters, fill=INK)
    if bar or legend:
        wide = max([letters.getlength(line) for line in legend] + [BAR + letters.getlength("µ 0  1") + MARGIN] * bar)
        top = height - 1.5 * MARGIN - step * (len(legend) + bar)
        draw.rounded_rectangle((MARGIN, top - MARGIN / 2, 3 * MARGIN + wide, height - MARGIN), 4, fill=PAPER)
        if bar:
            _draw_bar(draw, top, size)
        for index, line in enumerate(legend, start=int(bar)):
            draw.text((2 * MARGIN, top + step * index), line, font=letters, fill=INK)
    return np.asarray(image)


def _draw_bar(draw: ImageDraw.ImageDraw, top: float, size: int) -> None:
    """Draw which colour stands for which friction, with letters of ``size``."""
    low, high = BAR_RANGE
    start = 2 * MARGIN + font(size).getlength(f"µ {low:g} ")
    draw.text((2 * MARGIN, top), f"µ {low:g}", font=font(size), fill=INK)
    for column in range(BAR):
        red, green, blue = friction_colour(low + (high - low) * column / (BAR - 1))
        colour = (round(255 * red), round(255 * green), round(255 * blue), 255)
        draw.line((start + column, top + 2, start + column, top + size), fill=colour)
    draw.text((start + BAR + MARGIN / 2, top), f"{high:g}", font=font(size), fill=INK)


def banner(width: int, text: str, height: int) -> Picture:
    """Return a white strip (height, width, 3) with a centred text, made smaller where it would not fit."""
    image = Image.new("RGB", (width, height), "white")
    size = round(0.6 * height)
    while size > 7 and font(size).getlength(text) > width - 2 * MARGIN:
        size -= 1
    ImageDraw.Draw(image).text((width / 2, height / 2), text, font=font(size), fill=INK[:3], anchor="mm")
    return np.asarray(image)


# ---- portraits ----------------------------------------------------------------------------------------------------


SIZE = (640, 480)  # pixels; of one of the four views


def draw_portrait(path: Path, robot: Robot) -> None:
    """Write a picture (.png, .jpg, ...) of a robot at home from two sides, and with its legs at both limits.

    Raises:
        InputError: no OpenGL on this machine, or the file cannot be written.
    """
    parameters, home, (low, high) = Parameters.nominal(robot), robot.home.leg_angle, robot.leg_limits
    x, y, z = robot.body.size
    sizes = [
        f"{robot.name}: {robot.total_mass:.3g} kg",
        f"body {x:g} x {y:g} x {z:g} m, {robot.body.mass:g} kg",
        f"legs {robot.leg.length:g} m, wheels of radius {robot.wheel.radius:g} m",
        "squares 0.2 m",
    ]
    panels = []
    for camera, angle, lines in (
        ("follow", home, sizes),
        ("side", home, [f"home: legs at {home:.3g} rad"]),
        ("side", low, [f"lower limit: legs at {low:.3g} rad"]),
        ("side", high, [f"upper limit: legs at {high:.3g} rad"]),
    ):
        truth = _truth_of(standing_state(robot, parameters, angle))
        with closing(Scene(robot, View(size=SIZE, camera=camera, friction=False, slip=False, text=False))) as scene:
            panels.append(annotate(scene.draw(truth, parameters), lines, bar=False))
    picture = np.vstack([np.hstack(panels[:2]), np.hstack(panels[2:])])
    replace_file(path, lambda temporary: Image.fromarray(picture).save(temporary))


def floor_portrait(
    robot: Robot, floor: Floor, view: View | None = None, place: tuple[float, float] = (0.0, 0.0), seed: int = 0
) -> Picture:
    """Return a picture of a robot that stands on a floor.

    Args:
        robot: which.
        floor: which. seed: of the episode that draws what of it is randomised.
        view: what to show. place: where the robot stands, heading along x, m.

    Raises:
        InputError: a floor that the robot cannot be simulated on, or no OpenGL on this machine.
    """
    floor.check(robot)
    parameters = Parameters.nominal(robot)
    floor.write(parameters, np.array([seed], np.uint64))
    state = standing_state(robot, parameters)
    state.position[:, :2] = place
    settle(robot, parameters, state)
    with closing(Scene(robot, view)) as scene:
        return scene.draw(_truth_of(state), parameters)


def _truth_of(state: PlantState) -> Truth:
    truth = Truth(np.zeros((1, TRUTH_LAYOUT.width)))
    for name in ("position", "quaternion", "joint_position"):
        truth[name][:] = getattr(state, name)
    return truth
