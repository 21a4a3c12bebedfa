"""URDF: the text of a robot as one, and a tree of links of one. Read and written as XML, without ROS.

What URDF has no place for is said by :data:`NOT_IN_URDF`. Rotor inertia stands in the extension that Drake reads
(``drake:rotor_inertia`` of an actuator); other readers pass over it.
"""

from __future__ import annotations

import math
from collections import Counter
from xml.etree import ElementTree

import numpy as np
from numpy.typing import NDArray

from wlr_gym.base.errors import InputError
from wlr_gym.robot.description import Robot
from wlr_gym.robot.interchange.recognition import JointKind, LinkJoint, LinkShape, LinkTree, Placement, RigidLink
from wlr_gym.robot.parameter_table import CORNER_SIGNS, LEGS, SHANK_RADIUS, WHEELS
from wlr_gym.robot.parameters import Parameters

Array = NDArray[np.float64]

DRAKE = "http://drake.mit.edu"
#: What of a robot file a URDF cannot hold.
NOT_IN_URDF = (
    "gravity", "ground", "home", "sensors", "tolerances", "dynamixel_ids",
    "servo gains, currents, gear stiffness and supply voltage",
)  # fmt: skip
_KINDS: dict[str, JointKind] = {
    "fixed": "fixed", "revolute": "hinge", "continuous": "hinge", "prismatic": "slide", "floating": "free",
}  # fmt: skip
ElementTree.register_namespace("drake", DRAKE)


# ---- writing ---------------------------------------------------------------------------------------------------------


def urdf_text(robot: Robot) -> str:
    """Return the robot as URDF (XML).

    Links ``base_link``, ``leg_lf_link``, ``wheel_lf_link``, ...; joints are those of the robot, with its angles: 0 is a leg
    that points forward. Frames are as in REP-103: x forward, y left, z up; a leg's frame has x along the leg.
    """
    nominal = Parameters.nominal(robot)
    numbers = {name: nominal[name][0] for name in nominal}
    root = ElementTree.Element("robot", name=robot.name)
    extension = ElementTree.SubElement(root, "mujoco")  # what MuJoCo leaves out otherwise; other readers pass over it
    ElementTree.SubElement(extension, "compiler", fusestatic="false", discardvisual="false")
    base = _link(root, "base_link", float(numbers["body.mass"]), numbers["body.com_offset"], numbers["body.inertia"])
    _shape(base, "box", {"size": _text(robot.body.size)})
    for corner, signs in enumerate(CORNER_SIGNS):
        _write_leg(root, robot, numbers, corner, signs)
    ElementTree.indent(root)
    return f'<?xml version="1.0"?>\n{ElementTree.tostring(root, encoding="unicode")}\n'


def _write_leg(
    root: ElementTree.Element, robot: Robot, numbers: dict[str, Array], corner: int, signs: tuple[float, float]
) -> None:
    leg, wheel = LEGS[corner], WHEELS[corner]
    length, radius = float(numbers["leg.length"][corner]), float(numbers["wheel.radius"][corner])
    across_x, pitch, along = numbers["leg.inertia"].reshape(4, 3)[corner]
    com = np.array([numbers["leg.com_along_leg"][corner], 0.0, 0.0])
    link = _link(root, f"{leg}_link", float(numbers["leg.mass"][corner]), com, np.array([along, pitch, across_x]))
    rod = {"radius": repr(SHANK_RADIUS), "length": repr(length)}
    _shape(link, "cylinder", rod, f"{length / 2!r} 0 0", f"0 {math.pi / 2!r} 0")
    hip = numbers["hip.position"] * np.array([*signs, 1.0])
    _joint(root, leg, "revolute", "base_link", f"{leg}_link", hip, numbers, corner, robot.leg_limits)
    across = float(numbers["wheel.transverse_inertia"][corner])
    inertia = np.array([across, numbers["wheel.spin_inertia"][corner], across])
    link = _link(root, f"{wheel}_link", float(numbers["wheel.mass"][corner]), np.zeros(3), inertia)
    disc = {"radius": repr(radius), "length": repr(robot.wheel.width)}
    _shape(link, "cylinder", disc, "0 0 0", f"{math.pi / 2!r} 0 0")
    _joint(root, wheel, "continuous", f"{leg}_link", f"{wheel}_link", np.array([length, 0.0, 0.0]), numbers, 4 + corner, None)


def _link(root: ElementTree.Element, name: str, mass: float, com: Array, moments: Array) -> ElementTree.Element:
    link = ElementTree.SubElement(root, "link", name=name)
    inertial = ElementTree.SubElement(link, "inertial")
    ElementTree.SubElement(inertial, "origin", xyz=_text(com), rpy="0 0 0")
    ElementTree.SubElement(inertial, "mass", value=repr(mass))
    xx, yy, zz = (repr(float(value)) for value in moments)
    ElementTree.SubElement(inertial, "inertia", ixx=xx, ixy="0", ixz="0", iyy=yy, iyz="0", izz=zz)
    return link


def _shape(link: ElementTree.Element, kind: str, size: dict[str, str], xyz: str = "0 0 0", rpy: str = "0 0 0") -> None:
    for use in ("visual", "collision"):
        element = ElementTree.SubElement(link, use)
        ElementTree.SubElement(element, "origin", xyz=xyz, rpy=rpy)
        ElementTree.SubElement(ElementTree.SubElement(element, "geometry"), kind, size)


def _joint(
    root: ElementTree.Element, name: str, kind: str, parent: str, child: str, place: Array, numbers: dict[str, Array],
    index: int, limits: tuple[float, float] | None,
) -> None:  # fmt: skip
    joint = ElementTree.SubElement(root, "joint", name=name, type=kind)
    ElementTree.SubElement(joint, "parent", link=parent)
    ElementTree.SubElement(joint, "child", link=child)
    ElementTree.SubElement(joint, "origin", xyz=_text(place), rpy="0 0 0")
    ElementTree.SubElement(joint, "axis", xyz="0 1 0")
    drive = {key: repr(float(numbers[f"servo.{key}"][index])) for key in
             ("stall_torque", "no_load_speed", "viscous_friction", "coulomb_friction", "armature")}  # fmt: skip
    span = {} if limits is None else {"lower": repr(limits[0]), "upper": repr(limits[1])}
    ElementTree.SubElement(joint, "limit", span, effort=drive["stall_torque"], velocity=drive["no_load_speed"])
    ElementTree.SubElement(joint, "dynamics", damping=drive["viscous_friction"], friction=drive["coulomb_friction"])
    transmission = ElementTree.SubElement(root, "transmission", name=f"{name}_transmission")
    ElementTree.SubElement(transmission, "type").text = "transmission_interface/SimpleTransmission"
    ElementTree.SubElement(transmission, "joint", name=name)
    actuator = ElementTree.SubElement(transmission, "actuator", name=f"{name}_motor")
    ElementTree.SubElement(actuator, "mechanicalReduction").text = "1"
    ElementTree.SubElement(actuator, f"{{{DRAKE}}}rotor_inertia", value=drive["armature"])
    ElementTree.SubElement(actuator, f"{{{DRAKE}}}gear_ratio", value="1")


def _text(values: object) -> str:
    return " ".join(repr(float(value)) for value in np.asarray(values, np.float64).ravel())


# ---- reading ---------------------------------------------------------------------------------------------------------


def parse_urdf(text: str, source: str) -> LinkTree:
    """Return the links and joints of a URDF.

    Args:
        text: of the file.
        source: its path, as messages name it.

    Raises:
        InputError: no URDF, an unexpanded xacro, or a missing or bad value; the message names link or joint.
    """
    try:
        root = ElementTree.fromstring(text)
    except ElementTree.ParseError as error:
        raise InputError(f"{source}: broken XML: {error}") from None
    if root.tag != "robot":
        raise InputError(f"{source}: expected a URDF, with <robot> at its top, found <{root.tag}>")
    if "<xacro:" in text:
        raise InputError(f"{source}: holds xacro macros: expand them first, such as: xacro {source} > robot.urdf")
    for tag in ("link", "joint"):
        if repeated := [name for name, count in Counter(_name(one, source) for one in root.findall(tag)).items() if count > 1]:
            raise InputError(f"{source}: two {tag}s are called '{repeated[0]}': expected names that occur once")
    links = {link.name: link for link in (_read_link(element, source) for element in root.findall("link"))}
    rotors = _rotor_inertias(root, source)
    joints = tuple(_read_joint(element, rotors, source) for element in root.findall("joint"))
    return LinkTree(root.get("name", ""), source, links, joints)


def _read_link(element: ElementTree.Element, source: str) -> RigidLink:
    name = _name(element, source)
    where = f"{source}: link '{name}'"
    shapes = tuple(
        shape for use in ("collision", "visual") for one in element.findall(use) if (shape := _read_shape(one, where))
    )
    inertial = element.find("inertial")
    if inertial is None:
        return RigidLink(name, shapes=shapes)
    frame = _placement(inertial.find("origin"), where)
    moments = inertial.find("inertia")
    xx, yy, zz, xy, xz, yz = (_number(moments, f"i{axes}", where, 0.0) for axes in ("xx", "yy", "zz", "xy", "xz", "yz"))
    matrix = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    mass = _number(inertial.find("mass"), "value", f"{where}: mass", None)
    return RigidLink(name, mass, frame.position, frame.rotation @ matrix @ frame.rotation.T, shapes)


def _read_shape(element: ElementTree.Element, where: str) -> LinkShape | None:
    """One shape; None: a mesh, or nothing."""
    geometry = element.find("geometry")
    placement = _placement(element.find("origin"), where)
    if geometry is None:
        return None
    if (box := geometry.find("box")) is not None:
        return LinkShape("box", tuple(_numbers(box, "size", where, (0.0, 0.0, 0.0))), placement)
    for kind in ("cylinder", "capsule"):
        if (round_one := geometry.find(kind)) is not None:
            size = _number(round_one, "radius", where, None), _number(round_one, "length", where, None)
            return LinkShape(kind, size, placement)
    if (sphere := geometry.find("sphere")) is not None:
        return LinkShape("sphere", (_number(sphere, "radius", where, None),), placement)
    return None


def _read_joint(element: ElementTree.Element, rotors: dict[str, float], source: str) -> LinkJoint:
    name = _name(element, source)
    where, kind = f"{source}: joint '{name}'", element.get("type", "")
    if kind not in _KINDS:
        raise InputError(f"{where}: type '{kind}': expected one of {', '.join(_KINDS)}")
    if element.find("mimic") is not None:
        raise InputError(f"{where}: mimics another joint: expected legs and wheels that are driven one by one")
    ends = [element.find(role) for role in ("parent", "child")]
    parent, child = (end.get("link", "") if end is not None else "" for end in ends)
    direction = _numbers(element.find("axis") if kind not in ("fixed", "floating") else None, "xyz", where, (1.0, 0.0, 0.0))
    if not any(direction):
        raise InputError(f"{where}: axis = {direction}: expected a direction")
    axis = np.array(direction) / float(np.linalg.norm(direction))
    limit, dynamics = element.find("limit"), element.find("dynamics")
    span = None
    if kind == "revolute":
        span = _number(limit, "lower", where, 0.0), _number(limit, "upper", where, 0.0)
        if span[0] > span[1]:
            raise InputError(f"{where}: limit: lower = {span[0]:g} is above upper = {span[1]:g} rad")
    return LinkJoint(
        name, _KINDS[kind], parent, child, _placement(element.find("origin"), where), axis, span,
        effort=_optional(limit, "effort", where), velocity=_optional(limit, "velocity", where),
        damping=_optional(dynamics, "damping", where), friction=_optional(dynamics, "friction", where),
        armature=rotors.get(name),
    )  # fmt: skip


def _rotor_inertias(root: ElementTree.Element, source: str) -> dict[str, float]:
    """Joint -> rotor inertia at the joint, of the transmissions that state it."""
    found = {}
    for transmission in root.findall("transmission"):
        joint, actuator = transmission.find("joint"), transmission.find("actuator")
        if joint is None or actuator is None or (rotor := actuator.find("{*}rotor_inertia")) is None:
            continue
        where = f"{source}: transmission of joint '{joint.get('name', '')}'"
        ratio = _number(actuator.find("{*}gear_ratio"), "value", where, 1.0)
        found[joint.get("name", "")] = _number(rotor, "value", where, None) * ratio**2
    return found


def _name(element: ElementTree.Element, source: str) -> str:
    if not (name := element.get("name")):
        raise InputError(f"{source}: a <{element.tag}> has no name")
    return name


def _placement(origin: ElementTree.Element | None, where: str) -> Placement:
    position = np.array(_numbers(origin, "xyz", where, (0.0, 0.0, 0.0)))
    return Placement(position, rotation_of(*_numbers(origin, "rpy", where, (0.0, 0.0, 0.0))))


def rotation_of(roll: float, pitch: float, yaw: float) -> Array:
    """Return Rz(yaw) Ry(pitch) Rx(roll), (3, 3)."""
    (sr, cr), (sp, cp), (sy, cy) = ((math.sin(angle), math.cos(angle)) for angle in (roll, pitch, yaw))
    return np.array(
        [
            [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
            [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
            [-sp, cp * sr, cp * cr],
        ]
    )


def _numbers(element: ElementTree.Element | None, key: str, where: str, default: tuple[float, ...]) -> list[float]:
    text = None if element is None else element.get(key)
    if text is None:
        return list(default)
    try:
        values = [float(word) for word in text.split()]
    except ValueError:
        values = []
    if len(values) != len(default) or not np.isfinite(values).all():
        raise InputError(f"{where}: {key} = '{text}': expected {len(default)} numbers")
    return values


def _number(element: ElementTree.Element | None, key: str, where: str, default: float | None) -> float:
    if default is None and (element is None or element.get(key) is None):
        raise InputError(f"{where}: '{key}' is missing")
    return _numbers(element, key, where, (default or 0.0,))[0]


def _optional(element: ElementTree.Element | None, key: str, where: str) -> float | None:
    return None if element is None or element.get(key) is None else _number(element, key, where, None)
