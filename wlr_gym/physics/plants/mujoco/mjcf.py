"""The robot as a MuJoCo model, built from the same parameters as the Gibbs-Appell engine.

Nothing here uses :mod:`wlr_gym.physics.model`, so the two can check each other.

Choices, and why:

- Joint angles are those of :mod:`wlr_gym.robot`; ``qpos0`` is the home pose, standing on the floor. ``qvel[:3]`` is the
  velocity of the body origin in the floor frame, ``qvel[3:6]`` the angular velocity in the body frame.
- A slope turns gravity, not the floor. The payload is a body of its own, welded to the platform.
- There are no servos: apply torques with ``qfrc_applied``. Rotors are joint armatures; gear friction is joint damping and
  friction loss.
- A wheel on the floor is an explicit contact pair, so its coefficients are its own and no combination rule (MuJoCo takes the
  larger of two geoms' coefficients) can hide a change. Nothing else collides.
- Wheel shape: on a plane, the tangent frame of a sphere or cylinder is fixed in the WORLD, so mu_x != mu_y would be wrong as
  soon as the robot yaws; only a capsule's turns with its axle. A sphere has one contact point, like the engine's wheel, and
  costs least; it is used where direction does not matter. A capsule is used where it does: its cylinder is so short (0.1 mm)
  that its two contacts share one point and one load.
- Contact springs are the physical stiffness and damping at the wheel: MuJoCo scales ``solref`` by the constraint's apparent
  mass, which is divided out after compiling.
"""

# pyright: reportAttributeAccessIssue=false
# (MuJoCo fills its namespace when it is imported.)
from __future__ import annotations

from collections.abc import Callable
from typing import Any, Literal

import mujoco
import numpy as np
from scipy.spatial.transform import Rotation

from wlr_gym.base.errors import InputError
from wlr_gym.robot import CORNER_SIGNS, FIRST_WHEEL, JOINTS, LEGS, WHEELS, Robot, standing_height
from wlr_gym.robot.parameters import Parameters

WheelShape = Literal["sphere", "capsule"]

#: MuJoCo's impedance d adds the virtual mass d / (1 - d) times the apparent mass to every contact. At 0.1 that already makes
#: a robot that brakes with locked wheels jump off the floor; at 0.001 the contact is a spring and damper. ``impratio`` makes up
#: for it where stiffness is wanted: friction creeps by less than 0.1 mm/s under half its limit.
CONTACT_IMPEDANCE = 0.001
IMPEDANCE_RATIO = 100.0 / CONTACT_IMPEDANCE
FRICTION_DAMPING = 500.0
CAPSULE_HALF_LENGTH = 5e-5


def build_model(
    robot: Robot,
    parameters: Parameters,
    index: int = 0,
    *,
    contacts: bool = True,
    physics_step: float = 0.001,
    wheel_shape: WheelShape | None = None,
    extend: Callable[[mujoco.MjSpec], None] | None = None,
) -> mujoco.MjModel:
    """Return the MuJoCo model of row ``index`` of ``parameters``.

    Args:
        robot: supplies what is no parameter: names, drawn sizes, home pose.
        parameters: batch of parameters.
        index: which robot of the batch.
        contacts: False leaves the wheels' contacts out (the floor is only drawn).
        physics_step: s.
        wheel_shape: None = "sphere" where friction has no direction and rolling no resistance, else "capsule".
        extend: adds to the specification (actuators, cameras) before it is compiled.

    Raises:
        InputError: an index outside the batch, or spheres for friction that has a direction.
    """
    if not 0 <= index < len(parameters):
        raise InputError(f"index = {index}: the batch has robots 0 to {len(parameters) - 1}")
    row = Parameters(parameters.values[index : index + 1])
    shape = wheel_shape or ("capsule" if _has_direction(row) else "sphere")
    if shape == "sphere" and _has_direction(row):
        raise InputError("wheel_shape = 'sphere': mu_x != mu_y or rolling resistance needs 'capsule', whose axes turn with it")
    spec = _new_spec(robot, row, physics_step)
    floor = spec.worldbody.add_geom(
        name="floor", type=mujoco.mjtGeom.mjGEOM_PLANE, size=[10, 10, 0.1], contype=0, conaffinity=0
    )
    floor.rgba = [0.8, 0.8, 0.8, 1.0]
    body = _add_platform(spec, robot, row)
    for corner in range(4):
        _add_assembly(body, robot, row, corner, shape)
    if contacts:
        for wheel in range(4):
            _add_contact(spec, row, wheel)
    if extend is not None:
        extend(spec)
    model = spec.compile()
    if row["payload.inertia"].any():
        _set_payload_inertia(model, row)
    if contacts:
        _set_contact_springs(model, row)
    return model


def _has_direction(row: Parameters) -> bool:
    return bool((row["ground.mu_x"] != row["ground.mu_y"]).any() or (row["ground.rolling_resistance"] > 0).any())


def _new_spec(robot: Robot, row: Parameters, physics_step: float) -> mujoco.MjSpec:
    spec = mujoco.MjSpec()
    spec.modelname = robot.name
    spec.compiler.degree = False
    option = spec.option
    option.timestep = physics_step
    option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    option.jacobian = mujoco.mjtJacobian.mjJAC_DENSE  # MuJoCo 4.0.0 has a wrong Hessian in its sparse Newton path (#3767)
    option.impratio = IMPEDANCE_RATIO
    pitch, roll = np.sin(row["ground.slope"][0])
    option.gravity = -row["gravity"][0] * np.array([pitch, roll, np.sqrt(1.0 - pitch**2 - roll**2)])
    return spec


def _add_platform(spec: mujoco.MjSpec, robot: Robot, row: Parameters) -> mujoco.MjsBody:
    body = spec.worldbody.add_body(name="body", pos=[0.0, 0.0, standing_height(robot, robot.home.leg_angle)])
    body.add_freejoint(name="floating_base")
    _set_inertia(body, row["body.mass"][0], row["body.com_offset"][0], row["body.inertia"][0])
    body.add_geom(
        name="body",
        type=mujoco.mjtGeom.mjGEOM_BOX,
        size=np.array(robot.body.size) / 2,
        contype=0,
        conaffinity=0,
        rgba=[0.3, 0.4, 0.6, 1],
    )
    payload = body.add_body(name="payload", pos=row["payload.position"][0])
    _set_inertia(payload, row["payload.mass"][0], np.zeros(3), np.zeros(3))
    return body


def principal_inertia(inertia: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return principal moments (N, 3) and their axes as quaternions (N, 4), w first, of inertias (N, 6).

    Args:
        inertia: xx, yy, zz, xy, xz, yz with xy = -integral of x y dm.
    """
    xx, yy, zz, xy, xz, yz = inertia.T
    matrix = np.stack([xx, xy, xz, xy, yy, yz, xz, yz, zz], axis=1).reshape(-1, 3, 3)
    moments, axes = np.linalg.eigh(matrix)
    axes[:, :, 2] *= np.sign(np.linalg.det(axes))[:, None]  # a rotation, not a reflection
    return np.maximum(moments, 0.0), Rotation.from_matrix(axes).as_quat(scalar_first=True)


def _set_payload_inertia(model: mujoco.MjModel, row: Parameters) -> None:
    """After compiling: the compiler refuses, by rounding, loads that all lie in one plane."""
    payload = model.body("payload").id
    moments, axes = principal_inertia(row["payload.inertia"])
    model.body_inertia[payload], model.body_iquat[payload] = moments[0], axes[0]
    mujoco.mj_setConst(model, mujoco.MjData(model))


def _set_inertia(body: mujoco.MjsBody, mass: float, com: np.ndarray, inertia: np.ndarray) -> None:
    """Give a body its mass and principal inertia about its centre of mass, along its own axes."""
    body.explicitinertial = True
    body.mass, body.ipos, body.inertia = mass, com, inertia


def _add_assembly(body: mujoco.MjsBody, robot: Robot, row: Parameters, corner: int, shape: WheelShape) -> None:
    sign_x, sign_y = CORNER_SIGNS[corner]
    hip = row["hip.position"][0] * np.array([sign_x, sign_y, 1.0])
    length, radius = row["leg.length"][0, corner], row["wheel.radius"][0, corner]
    across_x, pitch, along = row["leg.inertia"][0].reshape(4, 3)[corner]
    # The leg's frame has x along the leg: at angle 0 it is the body's frame.
    home = robot.home.leg_angle
    leg = body.add_body(name=LEGS[corner], pos=hip, quat=[np.cos(home / 2), 0.0, np.sin(home / 2), 0.0])
    com = np.array([row["leg.com_along_leg"][0, corner], 0.0, 0.0])
    _set_inertia(leg, row["leg.mass"][0, corner], com, np.array([along, pitch, across_x]))
    _add_joint(leg, row, corner, home)
    _add_geom(leg, "CAPSULE", fromto=[0, 0, 0, length, 0, 0], size=[0.008, 0, 0], rgba=[0.6, 0.6, 0.6, 1])
    wheel = leg.add_body(name=WHEELS[corner], pos=[length, 0.0, 0.0])
    transverse = row["wheel.transverse_inertia"][0, corner]
    inertia = np.array([transverse, row["wheel.spin_inertia"][0, corner], transverse])
    _set_inertia(wheel, row["wheel.mass"][0, corner], np.zeros(3), inertia)
    _add_joint(wheel, row, FIRST_WHEEL + corner, 0.0)
    _add_wheel_geoms(wheel, robot, radius, shape)


def _add_wheel_geoms(wheel: mujoco.MjsBody, robot: Robot, radius: float, shape: WheelShape) -> None:
    """The wheel that is drawn (a disc) and the one that touches the floor (hidden in the viewer: group 3)."""
    half_width = robot.wheel.width / 2
    _add_geom(wheel, "CYLINDER", fromto=[0, -half_width, 0, 0, half_width, 0], size=[radius, 0, 0], rgba=[0.1, 0.1, 0.1, 1])
    axle = [np.sqrt(0.5), -np.sqrt(0.5), 0.0, 0.0]  # a capsule's own axis is z
    _add_geom(wheel, shape.upper(), name=wheel.name, size=[radius, CAPSULE_HALF_LENGTH, 0], quat=axle, group=3)


def _add_geom(body: mujoco.MjsBody, kind: str, **properties: Any) -> None:
    """Add a geom that collides only where a contact pair says so."""
    body.add_geom(type=getattr(mujoco.mjtGeom, f"mjGEOM_{kind}"), contype=0, conaffinity=0, **properties)


def _add_joint(body: mujoco.MjsBody, row: Parameters, joint: int, home: float) -> None:
    body.add_joint(
        name=JOINTS[joint],
        type=mujoco.mjtJoint.mjJNT_HINGE,
        axis=[0, 1, 0],
        ref=home,
        armature=row["servo.armature"][0, joint],
        damping=row["servo.viscous_friction"][0, joint],
        frictionloss=row["servo.coulomb_friction"][0, joint],
    )


def _add_contact(spec: mujoco.MjSpec, row: Parameters, wheel: int) -> None:
    along_heading, along_axle = row["ground.mu_x"][0, wheel], row["ground.mu_y"][0, wheel]
    rolling = row["ground.rolling_resistance"][0, wheel] * row["wheel.radius"][0, wheel]
    # First tangent of a capsule: along its axle. Rolling about it is the wheel's own rolling.
    spec.add_pair(
        geomname1="floor",
        geomname2=WHEELS[wheel],
        condim=6 if rolling > 0 else 3,
        friction=[along_axle, along_heading, 0.0, rolling, 0.0],
        solimp=[CONTACT_IMPEDANCE, CONTACT_IMPEDANCE, 0.001, 0.5, 2.0],
        solreffriction=[-1.0, -FRICTION_DAMPING * CONTACT_IMPEDANCE],
    )


def _set_contact_springs(model: mujoco.MjModel, row: Parameters) -> None:
    """Set ``solref`` so that a wheel's contacts together are the spring and damper of the parameters."""
    for pair in range(model.npair):
        geom = model.pair_geom2[pair]
        wheel = WHEELS.index(model.geom(geom).name)
        sharing = 2 if model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_CAPSULE else 1
        # MuJoCo: force = (K d pos + B vel) / R with K = solref0 / d^2, B = solref1 / d, R = (1 - d) / d / apparent mass.
        scale = (1.0 - CONTACT_IMPEDANCE) * model.body_invweight0[model.geom_bodyid[geom], 0] / sharing
        stiffness, damping = row["ground.normal_stiffness"][0, wheel], row["ground.normal_damping"][0, wheel]
        model.pair_solref[pair] = -scale * stiffness, -scale * damping
