"""The robot as MuJoCo draws it: the model of :mod:`wlr_gym.physics.plants.mujoco.mjcf` without contacts, dressed up.

Only shapes and joints are used; poses come from a plant's truth, so every plant looks the same. Beside the robot there are
marks: the floor where it is not flat, areas of other friction, paths, arrows of slip and force. Nothing here needs OpenGL.
"""

# pyright: reportAttributeAccessIssue=false
# (MuJoCo fills its namespace when it is imported.)
from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, fields
from functools import partial
from itertools import pairwise
from typing import Any, NamedTuple, assert_never

import numpy as np
from numpy.typing import ArrayLike, NDArray

from wlr_gym.physics.plants.base import Contacts, Truth
from wlr_gym.physics.plants.contacts import ContactsOf, contacts_at
from wlr_gym.physics.plants.mujoco import mujoco
from wlr_gym.physics.plants.mujoco.mjcf import build_model
from wlr_gym.render import surface
from wlr_gym.render.surface import REACH, Relief, Surface
from wlr_gym.render.view import FORCE, LOAD, Colour, friction_colour, magnification, slip_colour
from wlr_gym.robot import JOINTS, LEGS, WHEELS, Robot
from wlr_gym.robot.parameter_table import PATCHES
from wlr_gym.robot.parameters import Parameters

Array = NDArray[np.float64]

#: Parameters that decide how the robot and the bare floor look.
SHAPING = ("hip.position", "leg.length", "wheel.radius", "payload.mass", "payload.position", "ground.mu_x", "ground.mu_y")
#: Arrays of the model that follow from them.
_SHAPES = ("body_pos", "body_quat", "geom_pos", "geom_quat", "geom_size", "geom_rbound", "geom_aabb", "geom_rgba", "qpos0")
PAYLOAD_DENSITY = 2500.0  # kg/m3, for its size only
SPOKES = 3
SQUARE = 0.2  # m; width of the floor's squares
DARK_SQUARE, SQUARE_LINE = 0.90, 0.62  # brightness of every second one, and of the lines between them
EDGE = (0.36, 0.37, 0.38)  # lines along the edges of pieces
#: Meshes of a floor that is not flat: of the bare floor, of areas of other friction, of levels of its map, and of edges of
#: pieces.
MESHES = tuple(f"surface_{number}" for number in range(2 + len(PATCHES) + surface.LEVELS))
# Colours (red, green, blue, opacity), 0 to 1.
METAL = (0.72, 0.74, 0.78, 1.0)
DARK = (0.16, 0.17, 0.19, 1.0)
ACCENT = (1.0, 0.45, 0.05, 1.0)
WHITE = (0.95, 0.95, 0.95, 1.0)


class ContactFrames(NamedTuple):
    """Contacts of the wheels, (n, 3) each, floor frame: the first four are those of the wheels, where each is deepest.

    Attributes:
        points: m. heading, left, normal: unit vectors. force: along these three, N.
    """

    points: Array
    heading: Array
    left: Array
    normal: Array
    force: Array


class Stage:
    """One robot in the pose of a plant.

    Attributes:
        model, data: MuJoCo's; viewers and canvases may keep them until :meth:`lay_floor` says otherwise.
        shape: changes when sizes or colours of the model do.
        truth, parameters: (1) of the robot as it was posed last.
        relief: its floor; None = flat.
        areas: of other friction, in the surface that was laid last.
    """

    truth: Truth
    relief: Relief | None

    def __init__(self, robot: Robot, parameters: Parameters, row: int = 0, size: tuple[int, int] = (640, 480)) -> None:
        self.robot = robot
        self._size = size
        self.parameters: Parameters = Parameters(parameters.values[[row]])
        self.shape: bytes = self._numbers(SHAPING)
        self.areas: list[Area] = []
        self._room = 0
        self.model: Any = self._build()
        self.data: Any = mujoco.MjData(self.model)
        self._addresses = [int(self.model.joint(joint).qposadr[0]) for joint in JOINTS]
        self.wheel_bodies: list[int] = [int(self.model.body(wheel).id) for wheel in WHEELS]
        self._floor, self._laid = b"", b""
        self._contacts: Contacts | None = None

    def pose(self, truth: Truth, parameters: Parameters, row: int = 0, contacts: ContactsOf | None = None) -> None:
        """Put the robot where row ``row`` of a plant's truth is, in the shape that row of its parameters gives it.

        Args:
            truth, parameters: of the same robots. row: which one.
            contacts: of the same robots, for the forces on wheels that touch the floor twice, on body and legs; None = those
                where each wheel is deepest, which the truth knows.
        """
        self.truth, self.parameters = Truth(truth.values[[row]]), Parameters(parameters.values[[row]])
        shape, floor = self._numbers(SHAPING), self._numbers(surface.SHAPING)
        if shape != self.shape:
            other = self._build()
            for name in _SHAPES:
                getattr(self.model, name)[:] = getattr(other, name)
            self.shape = shape
        if floor != self._floor:
            self.relief, self._floor = Relief.of(self.robot, self.parameters), floor
        self._contacts = self._contacts_of(row, contacts) if self.relief or contacts else None
        self._place()

    def _place(self) -> None:
        self.model.geom("floor").pos[2] = self.relief.lowest if self.relief else 0.0
        self.data.qpos[:3] = self.truth.position[0]
        self.data.qpos[3:7] = self.truth.quaternion[0]
        self.data.qpos[self._addresses] = self.truth.joint_position[0]
        mujoco.mj_kinematics(self.model, self.data)
        mujoco.mj_comPos(self.model, self.data)
        mujoco.mj_camlight(self.model, self.data)

    def lay_floor(self) -> bool:
        """Lay the surface of a floor that is not flat around the robot into the model's meshes.

        Returns:
            Whether they have changed. ``model`` and ``data`` are others where there was no room for them.
        """
        if self.relief is None:
            return False
        middle = surface.STEP * np.round(self.truth.position[0, :2] / surface.STEP)
        wanted = self._floor + middle.tobytes()
        if wanted == self._laid:
            return False
        self.areas = areas(self.parameters, middle)
        found = self.relief.surface(middle, [(area.low, area.high) for area in self.areas])
        needed = _room_for(found)
        if needed > self._room:
            self._room = round(1.2 * needed)
            self.model = self._build(self._room)
            self.data = mujoco.MjData(self.model)
            self._place()
        _fill_meshes(self.model, found)
        self._laid = wanted
        return True

    def height(self, points: Array) -> Array:
        """Return the floor's height (m) at points (N, 2 or more), m."""
        return np.zeros(len(points)) if self.relief is None else self.relief.height(points[:, 0], points[:, 1])

    def level(self, place: Array) -> float:
        """Return the floor's mean height (m) around a place (x, y), m."""
        return 0.0 if self.relief is None else self.relief.level(place)

    def contact_frames(self) -> ContactFrames:
        """Return where the wheels touch the floor, or are nearest to it."""
        if self._contacts is not None:
            found = self._contacts
            return ContactFrames(*(one[0] for one in (found.point, found.heading, found.lateral, found.normal, found.force)))
        centres = self.data.xpos[self.wheel_bodies]
        axles = self.data.xmat[self.wheel_bodies].reshape(4, 3, 3)[:, :, 1]
        left = axles * [1.0, 1.0, 0.0]
        left /= np.maximum(np.linalg.norm(left, axis=1, keepdims=True), 1e-9)
        heading = np.cross(left, [0.0, 0.0, 1.0])
        upwards = np.cross(heading, axles)  # in the disc, away from its lowest point
        points = centres - self.parameters["wheel.radius"][0][:, None] * upwards
        return ContactFrames(points, heading, left, np.tile([0.0, 0.0, 1.0], (4, 1)), self.truth.contact_force[0].reshape(4, 3))

    def yaw(self) -> float:
        """Return the heading of the body drawn last, rad."""
        ahead = self.data.body("body").xmat.reshape(3, 3)[:, 0]
        return float(np.arctan2(ahead[1], ahead[0]))

    def _contacts_of(self, row: int, contacts: ContactsOf | None) -> Contacts:
        if contacts is not None:
            found = contacts()
            return Contacts(**{field.name: getattr(found, field.name)[[row]] for field in fields(found)})
        force = np.zeros((1, 8, 3))
        force[:, :4] = self.truth.contact_force.reshape(1, 4, 3)
        return contacts_at(self.robot, self.parameters, self.truth, force)

    def _numbers(self, names: Sequence[str]) -> bytes:
        return b"".join(np.asarray(self.parameters[name]).tobytes() for name in names)

    def _build(self, room: int = 0) -> mujoco.MjModel:
        shape = Parameters.nominal(self.robot)  # masses may be such that MuJoCo takes no model of them; they are not seen
        for name in SHAPING:
            shape[name] = self.parameters[name]
        model = build_model(self.robot, shape, contacts=False, wheel_shape="capsule", extend=partial(self._dress, room=room))
        model.geom("floor").rgba = (*floor_colour(shape), 1.0)
        model.geom("floor").sameframe = 0  # else it stays at z = 0
        payload = model.geom("payload")
        payload.size = 0.5 * np.cbrt(shape["payload.mass"][0] / PAYLOAD_DENSITY)
        payload.rgba[3] = float(shape["payload.mass"][0] > 0)
        return model

    def _dress(self, spec: mujoco.MjSpec, room: int) -> None:
        _light_and_floor(spec, self._size)
        if room:
            _add_meshes(spec, room)
        _dress_platform(spec.body("body"), self.robot)
        for leg, wheel in zip(LEGS, WHEELS, strict=True):
            _geom(spec.body(leg), "CYLINDER", size=[0.022, 0.016, 0], quat=_AXLE, rgba=DARK)
            _geom(spec.body(leg), "CYLINDER", size=[0.009, 0.018, 0], quat=_AXLE, rgba=METAL)
            _dress_wheel(spec.body(wheel), self.robot)


def floor_colour(parameters: Parameters) -> Colour:
    """Return the colour of a robot's bare floor, by its mean friction."""
    return friction_colour(float(np.mean([parameters[f"ground.mu_{axis}"][0] for axis in "xy"])))


# --- dressing ---------------------------------------------------------------------------------------------------------


_AXLE = [np.sqrt(0.5), -np.sqrt(0.5), 0.0, 0.0]  # turns a cylinder, whose own axis is z, to y


def _light_and_floor(spec: mujoco.MjSpec, size: tuple[int, int]) -> None:
    spec.stat.extent, spec.stat.center = 1.0, [0.0, 0.0, 0.1]
    visual = spec.visual
    visual.global_.offwidth, visual.global_.offheight = size
    visual.global_.fovy = 42.0
    visual.map.znear, visual.map.zfar = 0.05, 25.0
    visual.map.fogstart, visual.map.fogend = 3.0, 14.0
    visual.map.shadowclip = 5.0  # nearer, the map's edge is seen as dark dots on the floor
    visual.quality.shadowsize = 4096
    visual.rgba.fog = [0.86, 0.90, 0.95, 1.0]
    visual.rgba.haze = [0.86, 0.90, 0.95, 1.0]
    visual.headlight.ambient, visual.headlight.diffuse = [0.42] * 3, [0.14] * 3
    visual.headlight.specular = [0.0] * 3
    texture = mujoco.mjtTexture
    spec.add_texture(
        name="sky", type=texture.mjTEXTURE_SKYBOX, builtin=mujoco.mjtBuiltin.mjBUILTIN_GRADIENT, width=256, height=1536,
        rgb1=[0.62, 0.74, 0.90], rgb2=[0.90, 0.93, 0.97],
    )  # fmt: skip
    # Two by two squares as a shade (red, green, blue, opacity) to be laid over floors of any colour.
    shades = np.zeros((256, 256, 4), np.uint8)
    # What shines through twice: MuJoCo draws once for the light that casts shadows, once for all others.
    dark, line = (round(255 * (1.0 - np.sqrt(share))) for share in (DARK_SQUARE, SQUARE_LINE))
    shades[:128, :128, 3] = shades[128:, 128:, 3] = dark
    shades[[0, -1], :, 3] = shades[:, [0, -1], 3] = line
    spec.add_texture(name="squares", type=texture.mjTEXTURE_2D, width=256, height=256, nchannel=4, data=shades.ravel())
    squares = spec.add_material(name="squares", texuniform=True, texrepeat=[1 / SQUARE] * 2, reflectance=0.0, specular=0.0)
    squares.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = "squares"
    shade = squares_picture()
    spec.add_texture(name="shade", type=texture.mjTEXTURE_2D, width=256, height=256, nchannel=3, data=shade.ravel())
    shaded = spec.add_material(name="shade", texuniform=True, texrepeat=[1 / SQUARE] * 2, reflectance=0.0, specular=0.0)
    shaded.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = "shade"
    spec.add_material(name="floor", reflectance=0.0, specular=0.0)
    plane = spec.geom("floor")
    plane.size, plane.material = [0.0, 0.0, 0.05], "floor"  # without end


def squares_picture() -> NDArray[np.uint8]:
    """Return two by two squares (256, 256, 3) that the colour of a floor is multiplied by."""
    shades = np.full((256, 256, 3), 255, np.uint8)
    shades[:128, :128] = shades[128:, 128:] = round(255 * DARK_SQUARE)
    shades[[127, 128]] = shades[:, [127, 128]] = round(255 * SQUARE_LINE)
    return shades


def _add_meshes(spec: mujoco.MjSpec, room: int) -> None:
    """Add meshes whose numbers :func:`_fill_meshes` replaces; the first has room for a grid of ``room`` lines a side."""
    for name in MESHES:
        lines = np.arange(float(room if name == MESHES[0] else 2))
        grid = np.stack(np.meshgrid(lines, lines, [0.0], indexing="ij"), axis=-1).reshape(-1, 3)
        corner = np.arange(len(grid)).reshape(len(lines), len(lines))
        a, b, c, d = (part.ravel() for part in (corner[:-1, :-1], corner[1:, :-1], corner[1:, 1:], corner[:-1, 1:]))
        faces = np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)]).ravel()
        upwards = np.tile([0.0, 0.0, 1.0], len(grid))
        spec.add_mesh(
            name=name, uservert=grid.ravel(), userface=faces, usernormal=upwards, userfacenormal=faces,
            inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL,
        )  # fmt: skip


def _room_for(found: Surface) -> int:
    """Return how many lines a grid must have each way to have as many vertices and triangles as a surface."""
    triangles = sum(map(len, found.faces))
    return 1 + max(int(np.sqrt(len(found.vertices))), int(np.sqrt(triangles / 2))) + 1


def _fill_meshes(model: Any, found: Surface) -> None:
    """Write a surface into the model: all its meshes have the vertices of the first, and triangles one after the other."""
    numbers = [int(model.mesh(name).id) for name in MESHES]
    vertex, normal, face = (int(getattr(model, f"mesh_{kind}adr")[numbers[0]]) for kind in ("vert", "normal", "face"))
    count = len(found.vertices)
    model.mesh_vert[vertex : vertex + count], model.mesh_normal[normal : normal + count] = found.vertices, found.normals
    *floors, edges = found.faces
    filled = [*floors, *([edges[:0]] * (len(MESHES) - len(found.faces))), edges]
    for number, faces in zip(numbers, filled, strict=True):
        model.mesh_vertadr[number], model.mesh_vertnum[number] = vertex, count
        model.mesh_normaladr[number], model.mesh_normalnum[number] = normal, count
        model.mesh_faceadr[number], model.mesh_facenum[number] = face, len(faces)
        model.mesh_face[face : face + len(faces)] = model.mesh_facenormal[face : face + len(faces)] = faces
        face += len(faces)


def _dress_platform(body: mujoco.MjsBody, robot: Robot) -> None:
    length, width, height = robot.body.size
    body.add_light(
        name="sun", type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL, mode=mujoco.mjtCamLight.mjCAMLIGHT_TRACK,
        pos=[-0.2, -0.24, 0.8], dir=[0.25, 0.3, -1.0], diffuse=[0.50] * 3, specular=[0.15] * 3, castshadow=True,
    )  # fmt: skip
    _geom(body, "BOX", size=[0.42 * length, 0.42 * width, 0.006], pos=[0, 0, height / 2], rgba=DARK)
    # The front: an orange bar, and an arrow of two bars on the top plate.
    _geom(body, "BOX", size=[0.006, 0.46 * width, 0.018], pos=[length / 2, 0, 0], rgba=ACCENT)
    top = height / 2 + 0.0065
    for side in (-1.0, 1.0):
        turn = side * np.radians(40)
        _geom(
            body, "BOX", size=[0.035, 0.006, 0.002], pos=[0.36 * length - 0.025, side * 0.021, top], rgba=ACCENT,
            quat=[np.cos(-turn / 2), 0, 0, np.sin(-turn / 2)],
        )  # fmt: skip
    _geom(body, "BOX", size=[0.045, 0.045, 0.002], pos=[-0.1 * length, 0, top], rgba=WHITE)
    _geom(body, "BOX", size=[0.032, 0.032, 0.0025], pos=[-0.1 * length, 0, top], rgba=DARK)
    payload = next(child for child in body.bodies if child.name == "payload")
    _geom(payload, "BOX", name="payload", size=[0.02, 0.02, 0.02], rgba=[0.55, 0.35, 0.15, 1.0])


def _dress_wheel(wheel: mujoco.MjsBody, robot: Robot) -> None:
    """Spokes on both faces, and one orange mark: turning is seen, and how far."""
    radius, half_width = robot.wheel.radius, robot.wheel.width / 2
    for index in range(SPOKES):
        half = 0.5 * np.pi * index / SPOKES
        turn = [np.cos(half), 0.0, np.sin(half), 0.0]
        _geom(wheel, "BOX", size=[0.80 * radius, half_width + 0.0008, 0.0028], quat=turn, rgba=METAL)
    _geom(wheel, "CYLINDER", size=[0.30 * radius, half_width + 0.0016, 0], quat=_AXLE, rgba=METAL)
    _geom(wheel, "BOX", size=[0.10 * radius, half_width + 0.002, 0.005], pos=[0.72 * radius, 0, 0], rgba=ACCENT)
    _geom(wheel, "BOX", size=[0.02 * radius, half_width + 0.0003, 0.004], pos=[0.99 * radius, 0, 0], rgba=ACCENT)


def _geom(body: mujoco.MjsBody, kind: str, **properties: Any) -> None:
    body.add_geom(type=getattr(mujoco.mjtGeom, f"mjGEOM_{kind}"), contype=0, conaffinity=0, mass=0.0, **properties)


# ---- what is drawn besides the robot: areas of other friction, paths, slip and force arrows ---------------------------


SLIP_SCALE = 2.0  # m of arrow per m/s of slip
SLIP_FLOOR = 0.003  # m/s; less slip is not drawn
FORCE_SCALE = 0.025  # m of arrow per N of friction, of robots up to LIGHT
LIGHT = 32.0  # N; weight of a robot
FORCE_FLOOR = 0.2  # N; less friction is not drawn
LONGEST_ARROW = 0.4  # m, of robots of usual size
SHAFT = 0.006  # m; half the width of an arrow
#: m; slip arrows start this far outside the wheel's middle plane, beside the tyre, where they can be seen.
SLIP_BESIDE = 0.022
FORCE_BESIDE = 0.040  # m; force arrows start outside of them
LAYER = 4e-4
#: m; the floor's squares are drawn this far around the robot, and this high: over areas and pads.
SQUARES_REACH = 40.0
SQUARES_HEIGHT = 6 * LAYER
#: Away from the body along the axle (left): corners are lf, rf, lr, rr.
OUTWARDS = np.array([[1.0], [-1.0], [1.0], [-1.0]])
LINE = 0.004  # m; half the width of a trail
PIECE = 0.03  # m; length of its pieces


@dataclass(frozen=True)
class Area:
    """A rectangle of floor with a friction of its own: corners (x, y) in m, colour, height of its surface."""

    low: tuple[float, float]
    high: tuple[float, float]
    mu: float
    height: float

    def points(self, near: Array) -> Array:
        """Return a grid of points (49, 3) on what of it is within 0.9 m of a place (x, y), the innermost first."""
        reach, count = 0.9, 7
        low = np.maximum(np.minimum(near[:2] - reach, self.high), self.low)
        high = np.minimum(np.maximum(near[:2] + reach, self.low), self.high)
        share = (np.arange(count) + 0.5) / count
        share = share[np.argsort(np.abs(share - 0.5), kind="stable")]
        grid = np.stack(np.meshgrid(share, share, indexing="ij"), axis=-1).reshape(-1, 2)
        order = np.argsort(np.abs(grid - 0.5).sum(axis=1), kind="stable")
        return np.column_stack([low + grid[order] * (high - low), np.full(len(grid), self.height)])


@dataclass(frozen=True)
class Arrow:
    """An arrow in the floor frame, m; of a path, a piece without a head."""

    start: Array
    end: Array
    colour: Colour
    has_head: bool = True


@dataclass(frozen=True)
class Trail:
    """A path over the floor: points (N, 2), m, and colour; dashed = every second piece is left out."""

    points: Array
    colour: Colour
    dashed: bool = False


@dataclass(frozen=True)
class Spot:
    """A round pad under a wheel that has a floor friction of its own; ``normal`` to the floor."""

    centre: Array
    normal: Array
    mu: float


@dataclass(frozen=True)
class Squares:
    """The floor's squares, a shade over floor and areas alike: middle (x, y), m, and number of their material."""

    middle: Array
    material: int


@dataclass(frozen=True)
class Mesh:
    """One of :data:`MESHES`, of a floor that is not flat: its number, its colour, and number of the material of its squares."""

    number: int
    colour: Colour
    material: int


Mark = Squares | Area | Mesh | Spot | Arrow


def ground(stage: Stage, floor: Sequence[Area], *, friction: bool = True) -> list[Mark]:
    """Return the floor around the robot, with its squares; ``floor`` are the areas, whose colours ``friction`` shows."""
    if stage.relief is None:
        return [squares(stage), *(floor if friction else ())]
    *colours, _ = surface_colours(stage, stage.areas, friction=friction)
    colours += colours[:1] * (len(MESHES) - 1 - len(colours))
    material = int(stage.model.material("shade").id)
    numbers = [int(stage.model.mesh(name).id) for name in MESHES]
    drawn = [Mesh(number, colour, material) for number, colour in zip(numbers, (*colours, EDGE), strict=True)]
    return [mesh for mesh in drawn if stage.model.mesh_facenum[mesh.number]]


def surface_colours(stage: Stage, areas: Sequence[Area], *, friction: bool) -> list[Colour]:
    """Return the colours of a surface's faces: of the bare floor, of areas and levels where ``friction`` is shown, of edges."""
    levels = [] if stage.relief is None else friction_share(stage.parameters) * stage.relief.levels
    bare, others = floor_colour(stage.parameters), [*(area.mu for area in areas), *levels]
    return [bare, *(friction_colour(float(mu)) if friction else bare for mu in others), EDGE]


def friction_share(parameters: Parameters) -> float:
    """Return the mean of one robot's friction along heading and axle over that along the heading."""
    mu_x, mu_y = parameters["ground.mu_x"][0].mean(), parameters["ground.mu_y"][0].mean()
    return float(0.5 * (1.0 + (mu_y / mu_x if mu_x > 0 else 1.0)))


def squares(stage: Stage) -> Squares:
    """Return the squares around the robot; they stay where they are when it moves."""
    pattern = 2.0 * SQUARE
    return Squares(pattern * np.round(stage.truth.position[0, :2] / pattern), int(stage.model.material("squares").id))


def areas(parameters: Parameters, around: Array) -> list[Area]:
    """Return one robot's non-empty friction patches, cut to what can be seen from ``around`` (x, y); later ones lie on top.

    The colour is that of the friction along the heading and the axle on average (along the axle: times mu_y/mu_x).
    """
    found, share = [], friction_share(parameters)
    for index in range(len(PATCHES)):
        box = [parameters[f"patch.{side}"][0, index] for side in ("x_min", "x_max", "y_min", "y_max")]
        if not (box[0] < box[1] and box[2] < box[3]):
            continue
        low = np.maximum([box[0], box[2]], around[:2] - REACH)
        high = np.minimum([box[1], box[3]], around[:2] + REACH)
        if (low < high).all():
            mu = float(parameters["patch.mu"][0, index]) * share
            found.append(Area((float(low[0]), float(low[1])), (float(high[0]), float(high[1])), mu, LAYER * (index + 1)))
    return found


def spots(stage: Stage) -> list[Spot]:
    """Return a pad under every wheel where the wheels have different floors, none where they share one."""
    mu = 0.5 * (stage.parameters["ground.mu_x"][0] + stage.parameters["ground.mu_y"][0])
    if np.ptp(mu) < 1e-9:
        return []
    frames = stage.contact_frames()
    centres = frames.points[:4] * ([1.0, 1.0, 0.0] if stage.relief is None else 1.0)
    return [Spot(*one) for one in zip(centres, frames.normal[:4], mu.tolist(), strict=True)]


def pieces(trail: Trail, stage: Stage | None = None) -> list[Arrow]:
    """Return a trail as straight pieces of at least :data:`PIECE`, over the floor of a stage; None = over z = 0."""
    corners = list(trail.points[:1])
    for point in trail.points[1:]:
        if np.hypot(*(point - corners[-1])) >= PIECE:
            corners.append(point)
    corners = np.array([*corners, *trail.points[1:][-1:]]).reshape(-1, 2)
    height = 0.0 if stage is None else stage.height(corners)
    places = np.column_stack([corners, np.full(len(corners), 2.0 * LINE) + height])
    parts = list(pairwise(places))[:: 2 if trail.dashed else 1]
    return [Arrow(a, b, trail.colour, has_head=False) for a, b in parts if np.hypot(*(b - a)[:2]) > 1e-6]


def slip_arrows(stage: Stage) -> list[Arrow]:
    """Return one arrow per slipping wheel: where its contact point skids to over the floor."""
    slip = stage.truth.slip_velocity[0].reshape(4, 2)
    speed = np.hypot(slip[:, 0], slip[:, 1])
    colours = [slip_colour(float(value)) for value in speed]
    return _arrows(stage, SLIP_SCALE * slip, SLIP_SCALE * SLIP_FLOOR, SLIP_BESIDE, colours)


def force_scale(robot: Robot) -> float:
    """Return m of arrow per N: of heavier robots less, so that a wheel's share of the weight is as long in the picture."""
    return FORCE_SCALE * min(1.0, magnification(robot) * LIGHT / (robot.total_mass * robot.gravity))


def force_arrows(stage: Stage) -> list[Arrow]:
    """Return one arrow per contact: the floor's friction force on the wheel."""
    force, scale = stage.contact_frames().force[:, :2], force_scale(stage.robot)
    return _arrows(stage, scale * force, scale * FORCE_FLOOR, FORCE_BESIDE, [FORCE] * len(force))


def load_arrows(stage: Stage) -> list[Arrow]:
    """Return one arrow per loaded contact: the floor's normal force on the wheel, along the normal, beside the wheel."""
    frames = stage.contact_frames()
    load = frames.force[:, 2]
    starts = frames.points + FORCE_BESIDE * _outwards(frames.points) * frames.left
    length = np.minimum(force_scale(stage.robot) * load, magnification(stage.robot) * LONGEST_ARROW)
    ends = starts + length[:, None] * frames.normal
    return [Arrow(starts[contact], ends[contact], LOAD) for contact in np.flatnonzero(load >= FORCE_FLOOR)]


def _outwards(points: Array) -> Array:
    """Return which side of each contact is away from the body: 1 = the left one, (n, 1)."""
    return np.tile(OUTWARDS, (len(points) // 4, 1))


def _arrows(stage: Stage, vectors: Array, shortest: float, beside: float, colours: list[Colour]) -> list[Arrow]:
    """Return an arrow in the floor per contact with a vector (n, 2) along heading and left, m, that is not too short."""
    points, heading, left, normal, _ = (one[: len(vectors)] for one in stage.contact_frames())
    starts = points + beside * _outwards(points) * left + (SHAFT + LAYER * 5) * normal
    length = np.hypot(vectors[:, 0], vectors[:, 1])
    scale = np.minimum(1.0, magnification(stage.robot) * LONGEST_ARROW / np.maximum(length, 1e-12))[:, None]
    ends = starts + scale * (vectors[:, :1] * heading + vectors[:, 1:] * left)
    drawn = np.flatnonzero((length >= shortest) & np.isfinite(length))
    return [Arrow(starts[contact], ends[contact], colours[contact]) for contact in drawn]


# --- into MuJoCo's scene ----------------------------------------------------------------------------------------------


def add_marks(scene: mujoco.MjvScene, marks: Iterable[Mark]) -> None:
    """Append marks to a scene; what does not fit in is left out."""
    for mark in marks:
        if scene.ngeom >= scene.maxgeom:
            return
        _draw(scene.geoms[scene.ngeom], mark)
        scene.ngeom += 1


def _draw(geom: mujoco.MjvGeom, mark: Mark) -> None:
    match mark:
        case Area():
            low, high = np.array(mark.low), np.array(mark.high)
            size, middle = [*(0.5 * (high - low)), mark.height], [*(0.5 * (low + high)), 0.0]
            _start(geom, "BOX", size, middle, friction_colour(mark.mu))
        case Squares(middle, material):
            _start(geom, "PLANE", [SQUARES_REACH, SQUARES_REACH, 0.0], [*middle, SQUARES_HEIGHT], (1.0, 1.0, 1.0))
            geom.matid = material
            geom.rgba[3] = 0.99  # only what is not quite opaque is blended with what lies below
        case Mesh(number, colour, material):
            _start(geom, "MESH", [1.0, 1.0, 1.0], [0.0, 0.0, 0.0], colour)
            geom.dataid, geom.matid, geom.specular = 2 * number, material, 0.0
        case Spot(centre, normal, mu):
            _start(geom, "CYLINDER", [0.06, LAYER * 5, 0.0], centre, friction_colour(mu), turn_to(normal))
        case Arrow(start, end, colour, has_head):
            kind, width = ("ARROW", SHAFT) if has_head else ("CAPSULE", LINE)
            _start(geom, kind, [width] * 3, start, colour)
            mujoco.mjv_connector(geom, getattr(mujoco.mjtGeom, f"mjGEOM_{kind}"), width, start, end)
            geom.emission = 0.5 if has_head else geom.emission
        case _:
            assert_never(mark)


def turn_to(normal: Array) -> Array:
    """Return the smallest rotation (3, 3) that takes z to a normal."""
    cross = np.array([[0.0, 0.0, normal[0]], [0.0, 0.0, normal[1]], [-normal[0], -normal[1], 0.0]])
    return np.eye(3) + cross + cross @ cross / (1.0 + normal[2])


def _start(
    geom: mujoco.MjvGeom, kind: str, size: Sequence[float], position: ArrayLike, colour: Colour, turn: Array | None = None
) -> None:
    shape, paint = getattr(mujoco.mjtGeom, f"mjGEOM_{kind}"), np.array([*colour, 1.0], np.float32)
    sizes, place = np.array(size, np.float64), np.array(position, np.float64)
    mujoco.mjv_initGeom(geom, shape, sizes, place, (np.eye(3) if turn is None else turn).ravel(), paint)
    geom.category = mujoco.mjtCatBit.mjCAT_DECOR.value
