"""Pages: a plant while it runs, in real time, with the keys that drive it; and recordings, with a time axis and a ghost.

Both have robots with their arrows, the floor with its friction, what is to be said, and plots of any channel.
"""

# pyright: reportAttributeAccessIssue=false
# (MuJoCo fills its namespace when it is imported.)
from __future__ import annotations

import threading
import time as clock
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Protocol, Unpack

import numpy as np
from numpy.typing import NDArray

from wlr_gym.physics.plants.base import TRUTH_LAYOUT, Truth
from wlr_gym.physics.plants.mujoco import mujoco
from wlr_gym.render import stage as marks
from wlr_gym.render import surface
from wlr_gym.render.scene import Texts, describe, legend
from wlr_gym.render.stage import SQUARE, ContactsOf, Stage
from wlr_gym.render.teleop import DOWN, LEFT, RESET, RIGHT, SPACE, UP
from wlr_gym.render.view import CAMERAS, Colour, View, friction_colour, up_direction
from wlr_gym.render.viewer import KeyCallback, Pace
from wlr_gym.render.web import page
from wlr_gym.render.web.page import HOST, PORT, Curve
from wlr_gym.robot import Robot
from wlr_gym.robot.parameters import Parameters

if TYPE_CHECKING:
    import viser


#: The node that everything stands on; it moves, so that the robot stays where eyes look at.
FLOOR = "/floor"
GHOST, GHOST_OPACITY = (0.20, 0.35, 0.85), 0.35
_WIDE = 60.0  # m; width of the floor
_HEAD, _HEAD_LENGTH = 2.2 * marks.SHAFT, 6.0 * marks.SHAFT  # m; heads of arrows
#: m; where an arrow lies that is not shown: viser keeps their number.
_BELOW = np.array([[0.0, 0.0, -9.0], [0.0, 0.0, -8.9]])
_ARROWS = 24
#: m; a surface is sent anew when the robot has gone so far. Its grid is coarser than that of pictures: it must be sent.
_SURFACE_STEP, _COARSENESS = 0.8, 1.5
_SIDES = 32  # sides of what is round
_HIDDEN = 3  # geoms of this group are hidden: what touches the floor, not what is drawn


def rgb(colour: Colour) -> tuple[int, int, int]:
    """Return a colour in 0 to 255."""
    red, green, blue = (round(255 * part) for part in colour)
    return red, green, blue


class Figure:
    """A robot on the page, and the arrows at its wheels.

    Args:
        server: of the page. name: of its node. robot: supplies the sizes that are no parameters.
        ghost: drawn in one colour that the floor shines through.
    """

    def __init__(self, server: viser.ViserServer, name: str, robot: Robot, ghost: bool = False) -> None:
        self.robot, self.ghost = robot, ghost
        self._server, self._root = server, f"{FLOOR}/{name}"
        self._stage: Stage | None = None
        self._shape = b""
        self._nodes: list[tuple[int, Any]] = []
        self._arrows: Any = None
        self._frame: Any = server.scene.add_frame(self._root, show_axes=False, visible=False)

    def hide(self) -> None:
        """Take it off the page until it is posed again."""
        if self._frame.visible:
            self._frame.visible = False

    def pose(self, truth: Truth, parameters: Parameters, contacts: ContactsOf | None = None) -> Stage:
        """Put it where the first robot of a plant's truth is, in the sizes that its parameters give it."""
        self._stage = stage = self._stage or Stage(self.robot, parameters)
        stage.pose(truth, parameters, contacts=contacts)
        if stage.shape != self._shape:
            self._nodes = [(body.index, self._add(body)) for body in bodies(stage)]
            self._shape = stage.shape
        for index, node in self._nodes:
            node.position, node.wxyz = stage.data.xpos[index], stage.data.xquat[index]
        if not self._frame.visible:
            self._frame.visible = True
        return stage

    def point(self, arrows: Sequence[marks.Arrow]) -> None:
        """Show arrows; those of the time before go."""
        points, colours = np.tile(_BELOW, (_ARROWS, 1, 1)).astype(np.float32), np.zeros((_ARROWS, 3), np.uint8)
        for k, arrow in enumerate(arrows[:_ARROWS]):
            points[k], colours[k] = (arrow.start, arrow.end), rgb(arrow.colour)
        if self._arrows is None:
            self._arrows = self._server.scene.add_arrows(
                f"{self._root}/arrows", points, colours, shaft_radius=marks.SHAFT, head_radius=_HEAD, head_length=_HEAD_LENGTH
            )
        elif not np.array_equal(points, self._arrows.points):
            self._arrows.points, self._arrows.colors = points, colours

    def _add(self, body: BodyShape) -> Any:
        name, scene = f"{self._root}/{body.name}", self._server.scene
        node = scene.add_frame(name, show_axes=False)
        surfaces, opacity = ([(body.whole, GHOST)], GHOST_OPACITY) if self.ghost else (body.surfaces, None)
        for k, (mesh, colour) in enumerate(surfaces):
            scene.add_mesh_simple(
                f"{name}/{k}", np.asarray(mesh.vertices), np.asarray(mesh.faces), color=rgb(colour), opacity=opacity,
                flat_shading=True, cast_shadow=False, receive_shadow=False,
            )  # fmt: skip
        return node


class PageFloor:
    """The floor on the page: its colour is its friction, areas and pads of other friction lie on it.

    Where it is not flat, it is triangles with squares, and the plane lies below.
    """

    def __init__(self, server: viser.ViserServer) -> None:
        self._server = server
        self._frame: Any = server.scene.add_frame(FLOOR, show_axes=False)
        self._colour: Colour | None = None
        self._plane: Any = None
        self._seen: tuple[Any, ...] = ()  # what the areas and triangles that are shown follow from
        self._shown: list[Any] = []
        self._pads: list[Any] = []

    def show(self, stage: Stage, view: View) -> None:
        """Draw the floor around the robot that is posed in ``stage``, and move it so that ``view``'s camera sees the robot."""
        parameters, place = stage.parameters, stage.truth.position[0]
        up = up_direction(parameters["ground.slope"][0])
        middle = np.array([*place[:2], stage.level(place)])
        self._frame.wxyz, self._frame.position = page.floor_pose(middle, stage.yaw(), up, CAMERAS[view.camera])
        scene = self._server.scene
        if (colour := marks.floor_colour(parameters)) != self._colour:
            self._plane = scene.add_grid(
                f"{FLOOR}/plane", _WIDE, _WIDE, cell_size=SQUARE, section_size=5 * SQUARE, cell_color=(170, 170, 170),
                section_color=(140, 140, 140), plane_color=rgb(colour), plane_opacity=1.0, shadow_opacity=0.3,
                fade_distance=12.0,
            )  # fmt: skip
            self._colour = colour
        depth = 0.0 if stage.relief is None else stage.relief.lowest
        if self._plane.position[2] != depth:
            self._plane.position = (0.0, 0.0, depth)
        # Far around, so that areas need not be drawn anew at each step; triangles are too many for that.
        step = marks.REACH if stage.relief is None else _SURFACE_STEP
        middle = np.round(place / step) * step
        areas = marks.areas(parameters, middle) if view.friction else []
        seen = (areas, view.friction, stage.relief and (stage.relief, *middle[:2], colour))
        if seen != self._seen:
            for node in self._shown:
                node.remove()
            self._shown = self._boxes(areas) if stage.relief is None else self._triangles(stage, view, areas, middle)
            self._shown += self._labels(stage, areas)
            self._seen = seen
        spots = marks.spots(stage) if view.friction else []
        if len(spots) != len(self._pads):
            for node in self._pads:
                node.remove()
            names = [f"{FLOOR}/pad_{k}" for k in range(len(spots))]
            self._pads = [scene.add_cylinder(name, 0.06, 10 * marks.LAYER, cast_shadow=False) for name in names]
        for node, spot in zip(self._pads, spots, strict=True):
            node.position, colour = spot.centre, rgb(friction_colour(spot.mu))
            if stage.relief is not None:
                node.wxyz = page.quaternion(marks.turn_to(spot.normal))
            if tuple(node.color) != colour:
                node.color = colour

    def _boxes(self, areas: Sequence[marks.Area]) -> list[Any]:
        boxes = []
        for k, area in enumerate(areas):
            (x, y), (right, top) = area.low, area.high
            size, middle = (right - x, top - y, 2.0 * area.height), (0.5 * (x + right), 0.5 * (y + top), 0.0)
            colour = rgb(friction_colour(area.mu))
            boxes.append(self._server.scene.add_box(f"{FLOOR}/area_{k}", colour, size, position=middle, cast_shadow=False))
        return boxes

    def _labels(self, stage: Stage, areas: Sequence[marks.Area]) -> list[Any]:
        corners = np.array([area.low for area in areas]).reshape(-1, 2)
        return [
            self._server.scene.add_label(f"{FLOOR}/label_{k}", f"µ {area.mu:.2g}", position=(*area.low, 0.01 + height))
            for k, (area, height) in enumerate(zip(areas, stage.height(corners), strict=True))
        ]

    def _triangles(self, stage: Stage, view: View, areas: Sequence[marks.Area], middle: NDArray[np.float64]) -> list[Any]:
        """Add what can be seen of a floor that is not flat from a place, as one mesh per colour."""
        assert stage.relief is not None
        found = stage.relief.surface(middle, [(area.low, area.high) for area in areas], _COARSENESS)
        colours = marks.surface_colours(stage, areas, friction=view.friction)
        return [
            self._server.scene.add_mesh_trimesh(
                f"{FLOOR}/surface_{k}", squared_mesh(found, faces, colour), cast_shadow=False, receive_shadow=False
            )
            for k, (faces, colour) in enumerate(zip(found.faces, colours, strict=True))
            if len(faces)
        ]


def arrows_of(stage: Stage, view: View) -> list[marks.Arrow]:
    """Return the arrows of a posed robot: slip, and the floor's friction and normal force, where the view has them."""
    arrows = marks.slip_arrows(stage) if view.slip else []
    if view.forces:
        arrows += marks.force_arrows(stage) + marks.load_arrows(stage)
    return arrows


def squared_mesh(found: surface.Surface, faces: surface.Faces, colour: Colour) -> Any:
    """Return some triangles of a floor as a ``trimesh.Trimesh`` of a colour, with the floor's squares."""
    import trimesh
    from PIL import Image

    used, numbers = np.unique(faces, return_inverse=True)
    vertices = found.vertices[used]
    linear = (((part + 0.055) / 1.055) ** 2.4 for part in colour)  # glTF's colours are no sRGB
    material = trimesh.visual.material.PBRMaterial(
        baseColorTexture=Image.fromarray(marks.squares_picture()), baseColorFactor=[*linear, 1.0],
        metallicFactor=0.0, roughnessFactor=1.0,
    )  # fmt: skip
    return trimesh.Trimesh(
        vertices,
        numbers.reshape(-1, 3),
        vertex_normals=found.normals[used],
        visual=trimesh.visual.TextureVisuals(vertices[:, :2] / (2.0 * SQUARE), material=material),
        process=False,
    )


# ---- the robot's bodies as triangles ----------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class BodyShape:
    """A body in its own frame.

    Attributes:
        name, index: in the model.
        surfaces: triangles (a ``trimesh.Trimesh``, m) and colour (0 to 1) of each of its colours.
    """

    name: str
    index: int
    surfaces: list[tuple[Any, Colour]]

    @property
    def whole(self) -> Any:
        """All of it as one ``trimesh.Trimesh``."""
        import trimesh

        return trimesh.util.concatenate([mesh for mesh, _ in self.surfaces])


def bodies(stage: Stage) -> list[BodyShape]:
    """Return the bodies of a stage that have something to draw; the floor is none of them."""
    import trimesh

    model, found = stage.model, []
    for index in range(1, model.nbody):
        first = int(model.body_geomadr[index])
        colours: dict[Colour, list[Any]] = {}
        for geom in range(first, first + int(model.body_geomnum[index])):
            red, green, blue, opacity = (float(part) for part in model.geom_rgba[geom])
            if int(model.geom_group[geom]) != _HIDDEN and opacity > 0.0:
                colours.setdefault((red, green, blue), []).append(_mesh_of(model, geom))
        if colours:
            surfaces = [(trimesh.util.concatenate(meshes), colour) for colour, meshes in colours.items()]
            found.append(BodyShape(model.body(index).name, index, surfaces))
    return found


def _mesh_of(model: Any, geom: int) -> Any:
    """Return the triangles of one geom in the body's frame."""
    import trimesh
    from scipy.spatial.transform import Rotation

    kind, size, shapes = int(model.geom_type[geom]), np.asarray(model.geom_size[geom]), mujoco.mjtGeom
    if kind == shapes.mjGEOM_BOX:
        mesh = trimesh.creation.box(extents=2.0 * size)
    elif kind == shapes.mjGEOM_CYLINDER:
        mesh = trimesh.creation.cylinder(radius=size[0], height=2.0 * size[1], sections=_SIDES)
    elif kind == shapes.mjGEOM_CAPSULE:
        mesh = trimesh.creation.capsule(height=2.0 * size[1], radius=size[0], count=[_SIDES // 2, _SIDES // 2])
        mesh.apply_translation([0.0, 0.0, -mesh.bounds.mean(axis=0)[2]])
    else:
        raise ValueError(f"geom {geom} of the model has a shape that is not drawn: {kind}")
    place = np.eye(4)
    place[:3, :3] = Rotation.from_quat(model.geom_quat[geom], scalar_first=True).as_matrix()
    place[:3, 3] = model.geom_pos[geom]
    return mesh.apply_transform(place)


# --- pages -------------------------------------------------------------------------------------------------------------
# Both have the robot and its floor, what is to be said, and plots of any channel.


class _Page:
    """A page of the browser: its server, the robots on the floor, and when its texts are due."""

    def __init__(self, label: str, view: View, host: str, port: int) -> None:
        self.view = view
        self.server = page.open_server(host, port, label)
        self._address = page.how_to_open(host, int(self.server.get_port()))
        position, look_at = page.eye(CAMERAS[view.camera])
        self.server.initial_camera.position = tuple(position)
        self.server.initial_camera.look_at = tuple(look_at)
        self._ground = PageFloor(self.server)
        self._told = -np.inf

    def _show(
        self,
        figure: Figure,
        truth: Truth,
        parameters: Parameters,
        view: View,
        arrows: View,
        contacts: ContactsOf | None = None,
    ) -> Stage:
        """Pose the robot that the page goes along with, with the arrows that a view has, and the floor under it."""
        stage = figure.pose(truth, parameters, contacts)
        figure.point(arrows_of(stage, arrows))
        self._ground.show(stage, view)
        return stage

    def _texts_are_due(self) -> bool:
        now = clock.monotonic()
        due = now >= self._told + 1.0 / page.TEXTS
        self._told = now if due else self._told
        return due

    def close(self) -> None:
        """End the page."""
        page.close_server(self.server)


# ---- a plant while it runs -------------------------------------------------------------------------------------------


#: Key of the page -> key code, as the window reports it, and what it does. Arrow keys turn the eye of the page.
KEYS = {
    "I": (UP, "faster"),
    "K": (DOWN, "slower, backwards"),
    "J": (LEFT, "turn left"),
    "L": (RIGHT, "turn right"),
    "space": (SPACE, "stop"),
    "R": (RESET, "start anew"),
}
HELP = "keys on the page: I K speed, J L turning, space: stop, R: start anew; the mouse turns and moves the view"
WINDOW = 20.0  # s of the past that plots show
#: What plots can show: channels of the truth, by element or all of a kind in one plot.
_TITLES = {
    name: channel.unit
    for channel in TRUTH_LAYOUT.channels.values()
    for name in dict.fromkeys((channel.name, *channel.elements))
}
_FIRST = ("linear_velocity_in_body[x]", "slip_velocity", "contact_force")
_MOST = 12  # curves of one plot at most: of a kind with more elements, the first ones


class WebViewer(_Page):
    """Shows one robot on a page of the browser, no faster than real time; as :class:`wlr_gym.render.viewer.Viewer`.

    Args:
        robot: supplies the sizes that are no parameters. view: what to show; the size is the browser's own affair.
        on_key: called with the key codes of :mod:`wlr_gym.render.teleop`, from a thread of the server; None = nobody drives.
        host, port: where the page is served, see :func:`wlr_gym.render.web.page.open_server`.
    """

    def __init__(
        self,
        robot: Robot,
        view: View | None = None,
        on_key: KeyCallback | None = None,
        host: str = HOST,
        port: int = PORT,
    ) -> None:
        super().__init__("wlr play", view or View(forces=True), host, port)
        self._pace = Pace()
        self._figure = Figure(self.server, "robot", robot)
        self._text: Any = self.server.gui.add_html("")
        if on_key is not None:
            self._add_keys(on_key)
        self._look = page.ViewControls(self.server, self.view)
        self._past: deque[tuple[float, NDArray[np.float64]]] = deque()  # time and truth
        self._plots = page.Plots(self.server, page.plot_panel(self.server), _TITLES, _FIRST)
        print(self._address, flush=True)

    def show(
        self,
        truth: Truth,
        parameters: Parameters,
        *,
        period: float,
        contacts: ContactsOf | None = None,
        **texts: Unpack[Texts],
    ) -> bool:
        """Show the first robot and wait until its control period is over; the arguments are those of the window's viewer.

        Returns:
            True: browsers come and go, the page stays.
        """
        view = self._look.view
        self._note(truth, texts.get("time") or 0.0)
        with self.server.atomic():
            stage = self._show(self._figure, truth, parameters, view, view, contacts)
        if self._texts_are_due():
            lines = describe(stage, slip=view.slip, **texts)
            self._text.content = page.html_lines([*lines, *legend(stage.parameters, view, marks.force_scale(stage.robot))])
            if len(self._past) > 1:
                curves = {name: self.curves(name) for name in self._plots.chosen if name in _TITLES}
                begin, now = self._past[0][0], self._past[-1][0]
                self._plots.draw(curves, begin, max(now, begin + 1.0), now)
        self._pace.wait(period)
        return True

    def _note(self, truth: Truth, time: float) -> None:
        """Keep the present and the last :data:`WINDOW` seconds; a time that goes back begins anew."""
        if self._past and time <= self._past[-1][0]:
            self._past.clear()
        self._past.append((time, truth.values[0].copy()))
        while time - self._past[0][0] > WINDOW:
            self._past.popleft()

    def curves(self, name: str) -> list[Curve]:
        """Return the past of a channel of the truth, element by element, or of one element of it."""
        t, values = np.array([time for time, _ in self._past]), np.array([values for _, values in self._past])
        elements = TRUTH_LAYOUT.channels[name].elements if name in TRUTH_LAYOUT.channels else [name]
        columns = {one: values[:, TRUTH_LAYOUT.elements.index(one)] for one in elements[:_MOST]}
        return [Curve(one, t, column, colour=n) for n, (one, column) in enumerate(columns.items())]

    def _add_keys(self, on_key: KeyCallback) -> None:
        lock = threading.Lock()

        def press(code: int) -> None:
            with lock:
                on_key(code)

        with self.server.gui.add_folder("Drive"):
            for key, (code, what) in KEYS.items():
                self.server.gui.add_command(what, hotkey=key).on_trigger(lambda _, code=code: press(code))  # pyright: ignore
                self.server.gui.add_button(f"{what}  [{key}]").on_click(lambda _, code=code: press(code))


# ---- recordings ------------------------------------------------------------------------------------------------------


#: Times real time that a recording can be played at.
SPEEDS = ("0.1", "0.25", "0.5", "1", "2", "5", "10")
#: s that plots show around the present; the whole recording is drawn less often, for it is more to send.
WINDOWS = {"4 s": 4.0, "20 s": 20.0, "all": np.inf}
_ALL_PER_SECOND = 2.0


@dataclass(frozen=True, eq=False)
class Moment:
    """A robot at one time.

    Attributes:
        truth, parameters: (1).
        slip, forces: whether the truth knows them; what it does not is not drawn.
    """

    truth: Truth
    parameters: Parameters
    slip: bool = True
    forces: bool = True


class Playable(Protocol):
    """What is played. Times are s since its beginning.

    Attributes:
        name: of the recording. robot: supplies the sizes that are no parameters. length: s.
        titles: what can be plotted -> its unit; ``curves`` are what is known of one.

    ``at`` is the robot, ``ghost_at`` its ghost (None = there is none, or none yet), ``lines`` what is to be said: what both
    are, and how far they have been worked out; ``close`` gives up what is being worked out.
    """

    @property
    def name(self) -> str: ...
    @property
    def robot(self) -> Robot: ...
    @property
    def length(self) -> float: ...
    @property
    def titles(self) -> Mapping[str, str]: ...

    def at(self, time: float) -> Moment: ...
    def ghost_at(self, time: float) -> Moment | None: ...
    def curves(self, title: str) -> Sequence[Curve]: ...
    def lines(self, time: float) -> list[str]: ...
    def close(self) -> None: ...


class Player(_Page):
    """Plays recordings on a page of the browser.

    Args:
        names: of the recordings. open: return a recording by its place in ``names``; called when it is chosen.
        first: titles that are plotted at the beginning.
        host, port: where the page is served, see :func:`wlr_gym.render.web.page.open_server`.
    """

    def __init__(
        self, names: Sequence[str], open: Callable[[int], Playable], first: Sequence[str], host: str = HOST, port: int = PORT
    ) -> None:
        self._open, self._chosen = open, 0
        self.recording: Playable = open(0)
        super().__init__("wlr view", View(forces=True), host, port)
        self._lock = threading.Lock()
        self._time, self._drawn, self._plotted = 0.0, -1.0, -np.inf
        self._add_controls(names, first)
        self._add_figures()
        print(self._address, flush=True)

    # ---- time -------------------------------------------------------------------------------------------------------

    @property
    def time(self) -> float:
        """s since the beginning of the recording."""
        return self._time

    def seek(self, time: float) -> None:
        """Go to a time, as far as the recording has it."""
        with self._lock:
            self._time = float(np.clip(time, 0.0, self.recording.length))

    def advance(self, seconds: float) -> None:
        """Let real time pass: while it plays, the recording goes on, from its end to its beginning."""
        if self._playing:
            later = self._time + seconds * float(self._speed.value)
            self.seek(later if self._time < self.recording.length else 0.0)

    def run(self, stop: Callable[[], bool] = lambda: False) -> None:
        """Play until ``stop``, asked before each update, says so."""
        pace, last = Pace(), clock.monotonic()
        try:
            while not stop():
                now = clock.monotonic()
                self.advance(now - last)
                last = now
                self.update()
                pace.wait(1.0 / page.UPDATES)
        finally:
            self.close()

    def close(self) -> None:
        """End the page, and what is being worked out for it."""
        self.recording.close()
        super().close()

    # ---- what is shown ----------------------------------------------------------------------------------------------

    def update(self) -> None:
        """Bring the page to the present time; a scene that has not changed is not sent again, but by the texts' rate."""
        if (chosen := self._run.options.index(self._run.value)) != self._chosen:
            self._change_to(chosen)
        time, texts = self._time, self._texts_are_due()
        if time != self._drawn or texts:
            self._draw(time, texts)
            self._drawn = time
        if texts:
            self._slider.value = round(time, 2)
            self._plot(time)

    def _draw(self, time: float, texts: bool) -> None:
        recording, view = self.recording, self._look.view
        moment, ghost = recording.at(time), recording.ghost_at(time) if self._show_ghost.value else None
        arrows = replace(view, slip=view.slip and moment.slip, forces=view.forces and moment.forces)
        with self.server.atomic():
            stage = self._show(self._robot, moment.truth, moment.parameters, view, arrows)
            if ghost is None:
                self._ghost.hide()
            else:  # it has arrows only where the robot has none of its own
                arrows = replace(view, slip=False, forces=view.forces and not moment.forces)
                self._ghost.point(arrows_of(self._ghost.pose(ghost.truth, ghost.parameters), arrows))
        if texts:
            lines = describe(stage, slip=moment.slip, time=time, title=recording.name)
            means = legend(moment.parameters, view, marks.force_scale(stage.robot))
            self._text.content = page.html_lines([*lines, *recording.lines(time), *means])

    def _plot(self, time: float) -> None:
        width, length, now = WINDOWS[str(self._window.value)], self.recording.length, clock.monotonic()
        begin, end = 0.0, length
        if np.isfinite(width):
            begin = float(np.clip(time - 0.5 * width, 0.0, max(length - width, 0.0)))
            end = min(begin + width, length)
        elif now < self._plotted + 1.0 / _ALL_PER_SECOND:
            return
        self._plotted = now
        titles = [title for title in self._plots.chosen if title in self.recording.titles]
        self._plots.draw({title: self.recording.curves(title) for title in titles}, begin, end, time)

    # ---- controls ---------------------------------------------------------------------------------------------------

    def _add_controls(self, names: Sequence[str], first: Sequence[str]) -> None:
        gui = self.server.gui
        self._run: Any = gui.add_dropdown("run", tuple(names), initial_value=names[0])
        self._text: Any = gui.add_html("")
        self._playing = True
        self._button: Any = gui.add_button("pause  [space]")
        self._slider: Any = gui.add_slider("time (s)", 0.0, max(round(self.recording.length, 2), 0.01), 0.01, 0.0)
        self._speed: Any = gui.add_dropdown("speed", SPEEDS, initial_value="1")
        self._show_ghost: Any = gui.add_checkbox("ghost: replayed", True)
        self._look = page.ViewControls(self.server, self.view)
        place = page.plot_panel(self.server)
        with place:
            self._window: Any = gui.add_dropdown("shown", tuple(WINDOWS), initial_value="20 s")
        self._plots = page.Plots(self.server, place, self.recording.titles, first)
        self._button.on_click(lambda _: self._turn())
        gui.add_command("play or pause", hotkey="space").on_trigger(lambda _: self._turn())
        gui.add_command("1 s back", hotkey="J").on_trigger(lambda _: self.seek(self._time - 1.0))
        gui.add_command("1 s on", hotkey="L").on_trigger(lambda _: self.seek(self._time + 1.0))
        self._slider.on_update(lambda event: self.seek(float(event.target.value)) if event.client is not None else None)

    def _turn(self) -> None:
        self._playing = not self._playing
        self._button.label = "pause  [space]" if self._playing else "play  [space]"

    def _add_figures(self) -> None:
        self._robot = Figure(self.server, "robot", self.recording.robot)
        self._ghost = Figure(self.server, "ghost", self.recording.robot, ghost=True)

    def _change_to(self, chosen: int) -> None:
        """Open another recording."""
        self._chosen = chosen
        self.recording.close()
        self.recording = self._open(chosen)
        self._add_figures()
        self._plots.offer(self.recording.titles)
        self._slider.max = max(round(self.recording.length, 2), 0.01)
        self._drawn = -1.0
        self.seek(0.0)
