"""The robot as MuJoCo draws it: the model of :mod:`wlr_gym.physics.plants.mujoco.mjcf` without contacts, dressed up.

Only shapes and joints are used; poses come from a plant's truth, so every plant looks the same. Nothing here needs OpenGL.
"""

# pyright: reportAttributeAccessIssue=false
# (MuJoCo fills its namespace when it is imported.)
from __future__ import annotations

import functools
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from wlr_gym.physics.plants.base import Truth
from wlr_gym.physics.plants.mujoco.mjcf import build_model
from wlr_gym.render.colours import friction_colour
from wlr_gym.robot import JOINTS, LEGS, WHEELS, Robot
from wlr_gym.robot.parameters import Parameters

Array = NDArray[np.float64]

#: Parameters that decide how the robot and the bare floor look.
SHAPING = ("hip.position", "leg.length", "wheel.radius", "payload.mass", "payload.position", "ground.mu_x", "ground.mu_y")
#: Arrays of the model that follow from them.
_SHAPES = ("body_pos", "body_quat", "geom_pos", "geom_quat", "geom_size", "geom_rbound", "geom_aabb", "geom_rgba", "qpos0")
PAYLOAD_DENSITY = 2500.0  # kg/m3, for its size only
SPOKES = 3
#: m; width of the floor's squares.
SQUARE = 0.2
# Colours (red, green, blue, opacity), 0 to 1.
METAL = (0.72, 0.74, 0.78, 1.0)
DARK = (0.16, 0.17, 0.19, 1.0)
ACCENT = (1.0, 0.45, 0.05, 1.0)
WHITE = (0.95, 0.95, 0.95, 1.0)


class Stage:
    """One robot in the pose of a plant.

    Attributes:
        model, data: MuJoCo's; the model's structure never changes, so viewers and canvases may keep it.
        shape: changes when sizes or colours of the model do.
    """

    def __init__(self, robot: Robot, parameters: Parameters, row: int = 0, size: tuple[int, int] = (640, 480)) -> None:
        self.robot = robot
        self._extend = functools.partial(_dress, robot=robot, size=size)
        self.shape: bytes = self._shape_of(parameters, row)
        self.model: Any = self._build(parameters, row)
        self.data: Any = mujoco.MjData(self.model)
        self._addresses = [int(self.model.joint(joint).qposadr[0]) for joint in JOINTS]
        self.wheel_bodies: list[int] = [int(self.model.body(wheel).id) for wheel in WHEELS]

    def pose(self, truth: Truth, parameters: Parameters, row: int = 0) -> None:
        """Put the robot where row ``row`` of a plant's truth is, in the shape that row of its parameters gives it."""
        shape = self._shape_of(parameters, row)
        if shape != self.shape:
            other = self._build(parameters, row)
            for name in _SHAPES:
                getattr(self.model, name)[:] = getattr(other, name)
            self.shape = shape
        self.data.qpos[:3] = truth.position[row]
        self.data.qpos[3:7] = truth.quaternion[row]
        self.data.qpos[self._addresses] = truth.joint_position[row]
        mujoco.mj_kinematics(self.model, self.data)
        mujoco.mj_comPos(self.model, self.data)
        mujoco.mj_camlight(self.model, self.data)

    def contact_frames(self, parameters: Parameters, row: int = 0) -> tuple[Array, Array, Array]:
        """Return contact points, headings and axle directions in the floor, each (4, 3), of the pose drawn last."""
        centres = self.data.xpos[self.wheel_bodies]
        axles = self.data.xmat[self.wheel_bodies].reshape(4, 3, 3)[:, :, 1]
        left = axles * [1.0, 1.0, 0.0]
        left /= np.maximum(np.linalg.norm(left, axis=1, keepdims=True), 1e-9)
        heading = np.cross(left, [0.0, 0.0, 1.0])
        upwards = np.cross(heading, axles)  # in the disc, away from its lowest point
        return centres - parameters["wheel.radius"][row][:, None] * upwards, heading, left

    def yaw(self) -> float:
        """Return the heading of the body drawn last, rad."""
        ahead = self.data.body("body").xmat.reshape(3, 3)[:, 0]
        return float(np.arctan2(ahead[1], ahead[0]))

    def _shape_of(self, parameters: Parameters, row: int) -> bytes:
        return b"".join(np.asarray(parameters[name][row]).tobytes() for name in SHAPING)

    def _build(self, parameters: Parameters, row: int) -> mujoco.MjModel:
        shape = Parameters.nominal(self.robot)  # masses may be such that MuJoCo takes no model of them; they are not seen
        for name in SHAPING:
            shape[name] = parameters[name][row]
        model = build_model(self.robot, shape, contacts=False, wheel_shape="capsule", extend=self._extend)
        colour = friction_colour(float(np.mean([parameters[f"ground.mu_{axis}"][row] for axis in "xy"])))
        model.geom("floor").rgba = (*colour, 1.0)
        payload = model.geom("payload")
        payload.size = 0.5 * np.cbrt(parameters["payload.mass"][row] / PAYLOAD_DENSITY)
        payload.rgba[3] = float(parameters["payload.mass"][row] > 0)
        return model


# --- dressing ---------------------------------------------------------------------------------------------------------


def _dress(spec: mujoco.MjSpec, robot: Robot, size: tuple[int, int]) -> None:
    _light_and_floor(spec, size)
    body = spec.body("body")
    _dress_platform(body, robot)
    for leg, wheel in zip(LEGS, WHEELS, strict=True):
        _dress_leg(spec.body(leg))
        _dress_wheel(spec.body(wheel), robot)


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
    shades = _shades()
    spec.add_texture(
        name="squares",
        type=texture.mjTEXTURE_2D,
        width=shades.shape[1],
        height=shades.shape[0],
        nchannel=4,
        data=shades.ravel(),
    )
    squares = spec.add_material(name="squares", texuniform=True, texrepeat=[1 / SQUARE] * 2, reflectance=0.0, specular=0.0)
    squares.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = "squares"
    spec.add_material(name="floor", reflectance=0.0, specular=0.0)
    plane = spec.geom("floor")
    plane.size, plane.material = [0.0, 0.0, 0.05], "floor"  # without end


def _shades() -> NDArray[np.uint8]:
    """Return two by two squares as a shade (red, green, blue, opacity) to be laid over floors of any colour."""
    shades = np.zeros((256, 256, 4), np.uint8)
    # What shines through twice: MuJoCo draws once for the light that casts shadows, once for all others.
    dark, line = (round(255 * (1.0 - np.sqrt(share))) for share in (0.90, 0.62))
    shades[:128, :128, 3] = shades[128:, 128:, 3] = dark
    shades[[0, -1], :, 3] = shades[:, [0, -1], 3] = line
    return shades


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


def _dress_leg(leg: mujoco.MjsBody) -> None:
    axle = [np.sqrt(0.5), -np.sqrt(0.5), 0.0, 0.0]  # a cylinder's own axis is z
    _geom(leg, "CYLINDER", size=[0.022, 0.016, 0], quat=axle, rgba=DARK)
    _geom(leg, "CYLINDER", size=[0.009, 0.018, 0], quat=axle, rgba=METAL)


def _dress_wheel(wheel: mujoco.MjsBody, robot: Robot) -> None:
    """Spokes on both faces, and one orange mark: turning is seen, and how far."""
    radius, half_width = robot.wheel.radius, robot.wheel.width / 2
    axle = [np.sqrt(0.5), -np.sqrt(0.5), 0.0, 0.0]
    for index in range(SPOKES):
        half = 0.5 * np.pi * index / SPOKES
        turn = [np.cos(half), 0.0, np.sin(half), 0.0]
        _geom(wheel, "BOX", size=[0.80 * radius, half_width + 0.0008, 0.0028], quat=turn, rgba=METAL)
    _geom(wheel, "CYLINDER", size=[0.30 * radius, half_width + 0.0016, 0], quat=axle, rgba=METAL)
    _geom(wheel, "BOX", size=[0.10 * radius, half_width + 0.002, 0.005], pos=[0.72 * radius, 0, 0], rgba=ACCENT)
    _geom(wheel, "BOX", size=[0.02 * radius, half_width + 0.0003, 0.004], pos=[0.99 * radius, 0, 0], rgba=ACCENT)


def _geom(body: mujoco.MjsBody, kind: str, **properties: Any) -> None:
    body.add_geom(type=getattr(mujoco.mjtGeom, f"mjGEOM_{kind}"), contype=0, conaffinity=0, mass=0.0, **properties)
