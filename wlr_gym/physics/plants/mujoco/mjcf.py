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

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal
from xml.etree import ElementTree

import mujoco
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from wlr_gym.base.errors import InputError
from wlr_gym.physics.plants import relief
from wlr_gym.robot import CORNER_SIGNS, FIRST_WHEEL, JOINTS, LEGS, SHANK_RADIUS, WHEELS, Robot, standing_height
from wlr_gym.robot.interchange.recognition import LinkJoint, LinkShape, LinkTree, Placement, RigidLink
from wlr_gym.robot.parameters import Parameters

# pyright: reportAttributeAccessIssue=false
# (MuJoCo fills its namespace when it is imported.)


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
    _add_geom(leg, "CAPSULE", name=leg.name, fromto=[0, 0, 0, length, 0, 0], size=[SHANK_RADIUS, 0, 0], rgba=[0.6, 0.6, 0.6, 1])
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


def _add_contact(spec: mujoco.MjSpec, row: Parameters, wheel: int, floor: str = "floor") -> None:
    along_heading, along_axle = row["ground.mu_x"][0, wheel], row["ground.mu_y"][0, wheel]
    rolling = row["ground.rolling_resistance"][0, wheel] * row["wheel.radius"][0, wheel]
    # First tangent of a capsule: along its axle. Rolling about it is the wheel's own rolling.
    spec.add_pair(
        geomname1=floor,
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
        name = model.geom(geom).name
        group, index = ("ground", (0, WHEELS.index(name))) if name in WHEELS else ("body", 0)
        sharing = 2 if model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_CAPSULE and name in WHEELS else 1
        # MuJoCo: force = (K d pos + B vel) / R with K = solref0 / d^2, B = solref1 / d, R = (1 - d) / d / apparent mass.
        scale = (1.0 - CONTACT_IMPEDANCE) * model.body_invweight0[model.geom_bodyid[geom], 0] / sharing
        stiffness, damping = (row[f"{group}.{name}"][index] for name in ("normal_stiffness", "normal_damping"))
        model.pair_solref[pair] = -scale * stiffness, -scale * damping


# ---- files: the plant's model written in full digits, and models of others read as links and joints ------------------

# MuJoCo compiles what is read, so default classes, frames, includes, meshes and inertias from shapes mean what they mean there.


# pyright: reportAttributeAccessIssue=false
# (MuJoCo fills its namespace when it is imported.)


Array = NDArray[np.float64]

#: What of a robot file an MJCF cannot hold.
NOT_IN_MJCF = (
    "sensors", "tolerances", "dynamixel_ids", "servo gains, no-load speeds, currents, gear stiffness and supply voltage",
)  # fmt: skip
#: What a robot file says of an elastic tread. MuJoCo's contacts have none: it stands among an MJCF's custom numbers.
_TREAD = ("ground.slip_compliance", "ground.relaxation_length", "ground.tread_damping")
#: What of a floor's pieces an MJCF cannot hold.
NOT_IN_MJCF_FLOOR = ("edge radii of pieces", "direction of friction on pieces", "patches and maps of friction")
#: m; how far a piece of the floor reaches to both sides, and along its heading where it has no end.
REACH = 10.0
_GEOM = mujoco.mjtGeom
_JOINT = mujoco.mjtJoint
_SPAN = 1e-9


# ---- writing ---------------------------------------------------------------------------------------------------------


def mjcf_text(robot: Robot, parameters: Parameters | None = None) -> str:
    """Return the robot as MJCF (XML): the MuJoCo plant's model with the floor's contacts, leg limits and a motor per joint.

    Joint angles are those of the robot; the reference pose is its home pose. The motors take torques (N m): the servo's law is
    no part of the file. An elastic tread, which MuJoCo's contacts lack, stands in custom numbers that only this library reads.
    Pieces of the floor are boxes where their faces are upright, else convex meshes, :data:`REACH` m long.

    Args:
        robot: the robot.
        parameters: (1) it and its floor; None = nominal, on a plane.

    Raises:
        InputError: a floor of waves, bumps or a grid.
    """
    row = Parameters.nominal(robot) if parameters is None else parameters
    if relief.families(row) & relief.BASES:
        raise InputError("floor: base: MJCF has no waves, bumps or grids; expected a plane, with pieces where there are any")
    kept: list[Any] = []
    model = build_model(robot, row, extend=functools.partial(_complete, robot=robot, row=row, kept=kept))
    root = ElementTree.fromstring(kept[0].to_xml())
    _write_full_digits(root, model)
    ElementTree.indent(root)
    return ElementTree.tostring(root, encoding="unicode") + "\n"


def _complete(spec: Any, robot: Robot, row: Parameters, kept: list[Any]) -> None:
    """Add what the plant does not need, take away what only it needs."""
    kept.append(spec)
    _add_body_contacts(spec, row, "floor")
    for piece in np.flatnonzero(row["piece.height"][0] > 0.0):
        _add_piece(spec, row, int(piece))
    for name in _TREAD:
        spec.add_numeric(name=name, size=1, data=[row[name][0, 0]])
    spec.delete(spec.body("payload"))
    for leg in LEGS:
        joint = spec.joint(leg)
        joint.limited, joint.range = mujoco.mjtLimited.mjLIMITED_TRUE, robot.leg_limits
    for joint, torque in zip(JOINTS, Parameters.nominal(robot)["servo.stall_torque"][0], strict=True):
        spec.add_actuator(
            name=joint, target=joint, trntype=mujoco.mjtTrn.mjTRN_JOINT, ctrllimited=mujoco.mjtLimited.mjLIMITED_TRUE,
            ctrlrange=[-torque, torque],
        )  # fmt: skip


def _add_piece(spec: Any, row: Parameters, index: int) -> None:
    """Add a piece of the floor, and its contacts with the wheels. Its profile lies along x, its edges along y."""
    x, y, heading, height, length, front, rear = (
        float(row[f"piece.{name}"][0, index]) for name in ("x", "y", "heading", "height", "length", "front_slope", "rear_slope")
    )
    name, top = f"piece_{index + 1}", min(length, REACH)
    place = {"pos": [x, y, 0.0], "quat": [np.cos(heading / 2), 0.0, 0.0, np.sin(heading / 2)]}
    look = {"name": name, "contype": 0, "conaffinity": 0, "rgba": [0.7, 0.7, 0.7, 1.0]}
    if front == rear == np.pi / 2:
        middle = [x + top / 2 * np.cos(heading), y + top / 2 * np.sin(heading), height / 2]
        size = [top / 2, REACH, height / 2]
        spec.worldbody.add_geom(type=_GEOM.mjGEOM_BOX, size=size, **(place | {"pos": middle}), **look)
    else:
        crest = height / np.tan(front)
        profile = [(0.0, 0.0), (crest, height), (crest + top, height), (crest + top + height / np.tan(rear), 0.0)]
        corners = [(along, side, up) for along, up in profile for side in (-REACH, REACH)]
        spec.add_mesh(name=name, uservert=np.ravel(corners))
        spec.worldbody.add_geom(type=_GEOM.mjGEOM_MESH, meshname=name, **place, **look)
    for wheel in range(len(WHEELS)):
        _add_contact(spec, row, wheel, name)
    _add_body_contacts(spec, row, name)


def _add_body_contacts(spec: Any, row: Parameters, floor: str) -> None:
    """Add the contacts of body and legs with the floor or a piece of it."""
    mu = float(row["body.mu"][0])
    for name in ("body", *LEGS):
        spec.add_pair(
            geomname1=floor,
            geomname2=name,
            condim=3,
            friction=[mu, mu, 0.0, 0.0, 0.0],
            solimp=[CONTACT_IMPEDANCE, CONTACT_IMPEDANCE, 0.001, 0.5, 2.0],
            solreffriction=[-1.0, -FRICTION_DAMPING * CONTACT_IMPEDANCE],
        )


def _write_full_digits(root: ElementTree.Element, model: Any) -> None:
    """MuJoCo writes six digits: put the compiled model's numbers in their place."""
    for element in root.iter("body"):
        body = model.body(element.get("name")).id
        _write(element, pos=model.body_pos[body], quat=model.body_quat[body])
        for inertial in element.findall("inertial"):
            _write(inertial, mass=model.body_mass[body], pos=model.body_ipos[body], diaginertia=model.body_inertia[body])
        for offset, geom in enumerate(element.findall("geom")):
            index = model.body_geomadr[body] + offset
            _write(geom, size=model.geom_size[index], pos=model.geom_pos[index], quat=model.geom_quat[index])
        for joint in element.findall("joint"):
            if joint.get("type") != "free":
                _write_joint(joint, model)
    for index, element in enumerate(root.iter("numeric")):
        _write(element, data=model.numeric_data[model.numeric_adr[index] :][:1])
    names = [
        (model.geom(int(a)).name, model.geom(int(b)).name) for a, b in zip(model.pair_geom1, model.pair_geom2, strict=True)
    ]
    pairs = {frozenset(both): index for index, both in enumerate(names)}  # MuJoCo sorts them
    for element in root.iter("pair"):
        index = pairs[frozenset((element.get("geom1"), element.get("geom2")))]
        element.set("solref", "")  # set after compiling, so that it is not in the text
        _write(element, friction=model.pair_friction[index], solref=model.pair_solref[index])
    for element in root.iter("general"):  # as MuJoCo writes every actuator; with its defaults it is a motor
        element.tag = "motor"
        _write(element, ctrlrange=model.actuator(element.get("name")).ctrlrange)
    for option in root.iter("option"):
        _write(option, gravity=model.opt.gravity, timestep=model.opt.timestep)


def _write_joint(element: ElementTree.Element, model: Any) -> None:
    joint = model.joint(element.get("name"))
    _write(
        element, ref=joint.qpos0, armature=joint.armature, damping=joint.damping, frictionloss=joint.frictionloss,
        range=joint.range,
    )  # fmt: skip


def _write(element: ElementTree.Element, **numbers: Any) -> None:
    """Set those attributes that the element has."""
    for name, values in numbers.items():
        if name in element.attrib:
            count = len(element.get(name, "").split()) or None
            element.set(name, " ".join(repr(float(value)) for value in np.ravel(values)[:count]))


# ---- reading ---------------------------------------------------------------------------------------------------------


def read_mjcf(path: str | Path) -> LinkTree:
    """Return the links and joints of an MJCF file, as MuJoCo compiles it.

    Raises:
        InputError: MuJoCo cannot load it, or it holds no robot, several, or a coupling that the engine does not know.
    """
    try:
        model = mujoco.MjModel.from_xml_path(str(path))
    except (ValueError, OSError) as error:
        raise InputError(f"{path}: MuJoCo cannot load it: {' '.join(str(error).split())}") from None
    source = str(path)
    _refuse_couplings(model, source)
    members = _robot_bodies(model, source)
    links = {_name(model, "body", body): _link(model, body) for body in members}
    joints = tuple(_joint(model, body, members[0], source) for body in members[1:])
    numbers = _scene_numbers(model, members[0], source)
    notes = tuple(gain for actuator in range(model.nu) if (gain := _gain(model, actuator)))
    return LinkTree(mujoco.MjSpec.from_file(source).modelname, source, links, joints, numbers, notes)


def _gain(model: Any, actuator: int) -> str:
    """Return what an actuator's gains are, in words; nothing of a plain motor."""
    if model.actuator_biastype[actuator] == mujoco.mjtBias.mjBIAS_NONE:
        return ""
    _, on_angle, on_rate = (float(value) for value in model.actuator_biasprm[actuator, :3])
    gains = f"kp = {-on_angle:g}, kv = {-on_rate:g}"
    return f"actuator '{_name(model, 'actuator', actuator)}': {gains}: not used; servo gains are those of the base"


def _name(model: Any, kind: str, index: int) -> str:
    """Return the name of a part; parts may have none."""
    return getattr(model, kind)(index).name or f"{kind} {index}"


def _refuse_couplings(model: Any, source: str) -> None:
    couplings = (
        ("equality constraint", "equality", model.neq),
        ("tendon", "tendon", model.ntendon),
        ("flex", "flex", model.nflex),
    )
    for words, kind, count in couplings:
        if count:
            raise InputError(f"{source}: {words} '{_name(model, kind, 0)}': expected legs and wheels that move one by one")


def _robot_bodies(model: Any, source: str) -> list[int]:
    """Return the bodies of the one robot, its base first: all below the body of the world that has hinges below it."""
    tops = [body for body in range(1, model.nbody) if model.body_parentid[body] == 0]
    families = [[body for body in range(1, model.nbody) if _top(model, body) == top] for top in tops]
    moving = [family for family in families if any(model.body_jntnum[body] for body in family[1:])]
    if len(moving) != 1:
        names = ", ".join(f"'{_name(model, 'body', family[0])}'" for family in moving) or "none"
        raise InputError(f"{source}: expected one robot in the world, found {len(moving)}: {names}")
    base = moving[0][0]
    start, count = model.body_jntadr[base], model.body_jntnum[base]
    if any(model.jnt_type[joint] != _JOINT.mjJNT_FREE for joint in range(start, start + count)):
        joint = _name(model, "joint", start)
        raise InputError(
            f"{source}: body '{_name(model, 'body', base)}' hangs on joint '{joint}': expected a free joint, or none"
        )
    return moving[0]


def _top(model: Any, body: int) -> int:
    while model.body_parentid[body] != 0:
        body = model.body_parentid[body]
    return body


def _link(model: Any, body: int) -> RigidLink:
    rotation = _rotation(model.body_iquat[body])
    inertia = rotation @ np.diag(model.body_inertia[body]) @ rotation.T
    start = model.body_geomadr[body]
    shapes = [_shape(model, geom) for geom in range(start, start + model.body_geomnum[body])]
    return RigidLink(
        _name(model, "body", body), float(model.body_mass[body]), model.body_ipos[body].copy(), inertia,
        tuple(shape for shape in shapes if shape is not None),
    )  # fmt: skip


def _shape(model: Any, geom: int) -> LinkShape | None:
    kind, size = model.geom_type[geom], [float(value) for value in model.geom_size[geom]]
    placement = Placement(model.geom_pos[geom].copy(), _rotation(model.geom_quat[geom]))
    match kind:
        case _GEOM.mjGEOM_BOX:
            return LinkShape("box", tuple(2.0 * value for value in size), placement)
        case _GEOM.mjGEOM_CYLINDER | _GEOM.mjGEOM_CAPSULE:
            name = "cylinder" if kind == _GEOM.mjGEOM_CYLINDER else "capsule"
            return LinkShape(name, (size[0], 2.0 * size[1]), placement)
        case _GEOM.mjGEOM_SPHERE:
            return LinkShape("sphere", (size[0],), placement)
        case _GEOM.mjGEOM_MESH:
            start = model.mesh_vertadr[model.geom_dataid[geom]]
            corners = model.mesh_vert[start : start + model.mesh_vertnum[model.geom_dataid[geom]]]
            return LinkShape("mesh", (), placement, corners.astype(np.float64))
        case _:
            return None


def _joint(model: Any, body: int, base: int, source: str) -> LinkJoint:
    """The joint that a body hangs on, with the body's placement where its angle is 0."""
    parent, child = _name(model, "body", model.body_parentid[body]), _name(model, "body", body)
    placement = Placement(model.body_pos[body].copy(), _rotation(model.body_quat[body]))
    count, index = model.body_jntnum[body], model.body_jntadr[body]
    if count == 0:
        return LinkJoint(f"{child} (fixed)", "fixed", parent, child, placement, np.array([0.0, 0.0, 1.0]))
    if count > 1:
        names = ", ".join(f"'{_name(model, 'joint', joint)}'" for joint in range(index, index + count))
        raise InputError(f"{source}: body '{child}' moves by {count} joints ({names}): expected one hinge")
    name, kind = _name(model, "joint", index), model.jnt_type[index]
    if kind != _JOINT.mjJNT_HINGE:
        return LinkJoint(name, "slide" if kind == _JOINT.mjJNT_SLIDE else "ball", parent, child, placement, np.zeros(3))
    return _hinge(model, index, LinkJoint(name, "hinge", parent, child, placement, model.jnt_axis[index].copy()), source)


def _hinge(model: Any, index: int, joint: LinkJoint, source: str) -> LinkJoint:
    if model.jnt_stiffness[index].any():
        raise InputError(
            f"{source}: joint '{joint.name}': has a spring: no robot file holds one; add the effect 'leg_spring' instead"
        )
    if np.abs(model.jnt_pos[index]).max() > _SPAN:
        raise InputError(
            f"{source}: joint '{joint.name}': pos = {model.jnt_pos[index]}: expected the axis through its body's origin"
        )
    turn = _rotation(_turned(joint.axis, -float(model.qpos0[model.jnt_qposadr[index]])))
    rates, angle = model.jnt_dofadr[index], model.jnt_qposadr[index]
    limits = model.jnt_range[index] if model.jnt_limited[index] else None
    return replace(
        joint,
        placement=joint.placement @ Placement(rotation=turn),
        limits=None if limits is None else (float(limits[0]), float(limits[1])),
        effort=_effort(model, index, joint.name, source),
        damping=float(np.ravel(model.dof_damping[rates])[0]),
        friction=float(model.dof_frictionloss[rates]),
        armature=float(model.dof_armature[rates]),
        home=float(_home(model)[angle]),
    )


def _home(model: Any) -> Array:
    """Joint coordinates of the keyframe ``home``, else of the pose that the file is written in."""
    names = [model.key(index).name for index in range(model.nkey)]
    return model.key_qpos[names.index("home")] if "home" in names else model.qpos0


def _effort(model: Any, joint: int, name: str, source: str) -> float | None:
    """Largest torque of the joint's actuator, N m; None: nothing says it."""
    found = []
    for actuator in range(model.nu):
        if model.actuator_trntype[actuator] != mujoco.mjtTrn.mjTRN_JOINT or model.actuator_trnid[actuator, 0] != joint:
            continue
        gear = float(model.actuator_gear[actuator, 0])
        if gear <= 0.0:
            label = _name(model, "actuator", actuator)
            raise InputError(f"{source}: actuator '{label}' of joint '{name}': gear = {gear:g}: expected more than 0")
        found += _torques(model, actuator, gear)
    if model.jnt_actfrclimited[joint]:
        found.append(float(np.abs(model.jnt_actfrcrange[joint]).max()))
    return min(found) if found else None


def _torques(model: Any, actuator: int, gear: float) -> list[float]:
    """Limits (N m) that an actuator has: of its force, and, where it is a plain motor, of its control."""
    found = []
    if model.actuator_forcelimited[actuator]:
        found.append(gear * float(np.abs(model.actuator_forcerange[actuator]).max()))
    is_motor = model.actuator_biastype[actuator] == mujoco.mjtBias.mjBIAS_NONE
    if model.actuator_ctrllimited[actuator] and is_motor:
        gain = float(np.ravel(model.actuator_gainprm[actuator])[0])
        found.append(gear * gain * float(np.abs(model.actuator_ctrlrange[actuator]).max()))
    return found


def _rotation(quaternion: Sequence[float] | Array) -> Array:
    matrix = np.zeros(9)
    mujoco.mju_quat2Mat(matrix, np.asarray(quaternion, np.float64))
    return matrix.reshape(3, 3)


def _turned(axis: Array, angle: float) -> Array:
    quaternion = np.zeros(4)
    mujoco.mju_axisAngle2Quat(quaternion, np.asarray(axis, np.float64), angle)
    return quaternion


# ---- gravity, home pose, floor ---------------------------------------------------------------------------------------


def _scene_numbers(model: Any, base: int, source: str) -> dict[str, float | list[float]]:
    """What a model says of gravity, of contacts that are pairs of their own, as the plant's are, and of their treads."""
    gravity = float(np.linalg.norm(model.opt.gravity))
    numbers: dict[str, float | list[float]] = {"gravity": gravity}
    if gravity and abs(model.opt.gravity[1]) < 1e-9 * gravity:
        numbers["ground.slope"] = float(np.arcsin(-model.opt.gravity[0] / gravity)) + 0.0
    if model.npair >= len(WHEELS) and (model.pair_solref < 0.0).all() and (model.pair_solimp[:, 0] == CONTACT_IMPEDANCE).all():
        numbers |= _contact_numbers(model)
    custom = {model.numeric(k).name: float(model.numeric(k).data[0]) for k in range(model.nnumeric)}
    return numbers | {name: custom[name] for name in _TREAD if name in custom}


def _contact_numbers(model: Any) -> dict[str, float | list[float]]:
    """Friction and springs of the pairs that :func:`wlr_gym.physics.plants.mujoco.mjcf.build_model` writes, undone."""
    names = [model.geom(int(geom)).name for geom in model.pair_geom2]
    pair = next((k for k, name in enumerate(names) if name in WHEELS), 0)  # MuJoCo sorts pairs; those of the body may be first
    geom = int(model.pair_geom2[pair])
    sharing = 2 if model.geom_type[geom] == _GEOM.mjGEOM_CAPSULE else 1
    scale = (1.0 - CONTACT_IMPEDANCE) * float(model.body_invweight0[model.geom_bodyid[geom], 0]) / sharing
    stiffness, damping = (-float(value) / scale for value in model.pair_solref[pair])
    along_axle, along_heading = (float(value) for value in model.pair_friction[pair, :2])
    return {
        "ground.mu_x": along_heading,
        "ground.mu_y": along_axle,
        "ground.normal_stiffness": stiffness,
        "ground.normal_damping": damping,
    }
