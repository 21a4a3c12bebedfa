"""What stands on the page: a robot with its arrows, a ghost of it, and the floor with its friction."""

# pyright: reportAttributeAccessIssue=false
# (MuJoCo fills its namespace when it is imported.)
from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import mujoco
import numpy as np

from wlr_gym.physics.plants.base import Truth
from wlr_gym.render import stage as marks
from wlr_gym.render.stage import SQUARE, Stage
from wlr_gym.render.view import CAMERAS, Colour, View, friction_colour, up_direction
from wlr_gym.render.web.page import floor_pose
from wlr_gym.robot import Robot
from wlr_gym.robot.parameters import Parameters

if TYPE_CHECKING:
    import viser

#: The node that everything stands on; it moves, so that the robot stays where eyes look at.
FLOOR = "/floor"
#: Colour and opacity of a ghost.
GHOST: Colour = (0.20, 0.35, 0.85)
GHOST_OPACITY = 0.35
#: m; width of the floor.
_WIDE = 60.0
#: m; heads of arrows.
_HEAD, _HEAD_LENGTH = 2.2 * marks.SHAFT, 6.0 * marks.SHAFT
#: m; where an arrow lies that is not shown: viser keeps their number.
_BELOW = np.array([[0.0, 0.0, -9.0], [0.0, 0.0, -8.9]])
_ARROWS = 12
#: Sides of what is round.
_SIDES = 32
#: Geoms of this group are hidden: what touches the floor, not what is drawn.
_HIDDEN = 3


def rgb(colour: Colour) -> tuple[int, int, int]:
    """Return a colour in 0 to 255."""
    red, green, blue = (round(255 * part) for part in colour)
    return red, green, blue


class Figure:
    """A robot on the page, and the arrows at its wheels.

    Args:
        server: of the page.
        name: of its node.
        robot: supplies the sizes that are no parameters.
        ghost: drawn in one colour that the floor shines through, without arrows.
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

    def pose(self, truth: Truth, parameters: Parameters, row: int = 0) -> Stage:
        """Put it where row ``row`` of a plant's truth is, in the sizes that row of its parameters gives it."""
        self._stage = stage = self._stage or Stage(self.robot, parameters, row)
        stage.pose(truth, parameters, row)
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
    """The floor on the page: its colour is its friction, areas and pads of other friction lie on it."""

    def __init__(self, server: viser.ViserServer) -> None:
        self._server = server
        self._frame: Any = server.scene.add_frame(FLOOR, show_axes=False)
        self._colour: Colour | None = None
        self._areas: list[marks.Area] = []
        self._shown: list[Any] = []
        self._pads: list[Any] = []

    def show(self, stage: Stage, truth: Truth, parameters: Parameters, row: int, view: View) -> None:
        """Draw the floor around the robot that is posed in ``stage``, and move it so that ``view``'s camera sees the robot."""
        up = up_direction(parameters["ground.slope"][row])
        self._frame.wxyz, self._frame.position = floor_pose(truth.position[row], stage.yaw(), up, CAMERAS[view.camera])
        scene = self._server.scene
        if (colour := marks.floor_colour(parameters, row)) != self._colour:
            scene.add_grid(
                f"{FLOOR}/plane", _WIDE, _WIDE, cell_size=SQUARE, section_size=5 * SQUARE, cell_color=(170, 170, 170),
                section_color=(140, 140, 140), plane_color=rgb(colour), plane_opacity=1.0, shadow_opacity=0.3,
                fade_distance=12.0,
            )  # fmt: skip
            self._colour = colour
        # Far around, so that areas need not be drawn anew at each step.
        middle = np.round(truth.position[row] / marks.REACH) * marks.REACH
        areas = marks.areas(parameters, row, middle) if view.friction else []
        if areas != self._areas:
            for node in self._shown:
                node.remove()
            self._shown = [node for k, area in enumerate(areas) for node in self._area(k, area)]
            self._areas = areas
        spots = marks.spots(stage, parameters, row) if view.friction else []
        if len(spots) != len(self._pads):
            for node in self._pads:
                node.remove()
            names = [f"{FLOOR}/pad_{k}" for k in range(len(spots))]
            self._pads = [scene.add_cylinder(name, 0.06, 10 * marks.LAYER, cast_shadow=False) for name in names]
        for node, spot in zip(self._pads, spots, strict=True):
            node.position, colour = spot.centre * [1.0, 1.0, 0.0], rgb(friction_colour(spot.mu))
            if tuple(node.color) != colour:
                node.color = colour

    def _area(self, k: int, area: marks.Area) -> list[Any]:
        (x, y), scene = area.low, self._server.scene
        size = (area.high[0] - x, area.high[1] - y, 2.0 * area.height)
        middle = (x + 0.5 * size[0], y + 0.5 * size[1], 0.0)
        box = scene.add_box(f"{FLOOR}/area_{k}", rgb(friction_colour(area.mu)), size, position=middle, cast_shadow=False)
        return [box, scene.add_label(f"{FLOOR}/label_{k}", f"µ {area.mu:.2g}", position=(x, y, 0.01))]


def arrows_of(stage: Stage, truth: Truth, parameters: Parameters, row: int, view: View) -> list[marks.Arrow]:
    """Return the arrows of a posed robot: slip, and the floor's friction and normal force, where the view has them."""
    arrows = marks.slip_arrows(stage, truth, parameters, row) if view.slip else []
    if view.forces:
        arrows += marks.force_arrows(stage, truth, parameters, row) + marks.load_arrows(stage, truth, parameters, row)
    return arrows


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
