"""A robot as links and joints, as other programs' files describe it, and the robot file that says the same. SI units.

No file format is known here. Four legs of one hinge, each with a driven wheel, are found in a tree of links, or what differs is
named; then the numbers of a robot file are read off, and what has no number there is listed.
"""

from __future__ import annotations

import graphlib
import math
import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import yaml
from numpy.typing import NDArray

from wlr_gym.base.errors import InputError
from wlr_gym.base.settings import nested, overlay, parse_config
from wlr_gym.robot.description import Robot, load_robot
from wlr_gym.robot.parameter_table import CORNER_NAMES, CORNER_SIGNS, CORNERS, LEGS, WHEELS, spec_of

Array = NDArray[np.float64]
JointKind = Literal["hinge", "slide", "ball", "fixed", "free"]


@dataclass(frozen=True)
class Placement:
    """A frame seen from another one: its origin (3,) in m, and the rotation (3, 3) whose columns are its axes."""

    position: Array = field(default_factory=lambda: np.zeros(3))
    rotation: Array = field(default_factory=lambda: np.eye(3))

    def __matmul__(self, inner: Placement) -> Placement:
        """Return ``inner``, which is seen from this frame, as seen from the other one."""
        return Placement(self.position + self.rotation @ inner.position, self.rotation @ inner.rotation)

    def point(self, place: Array) -> Array:
        """Return a point of this frame as seen from the other one."""
        return self.position + self.rotation @ place


@dataclass(frozen=True)
class LinkShape:
    """One simple shape of a link.

    Attributes:
        kind: ``box``, ``cylinder``, ``capsule``, ``sphere`` or ``mesh``.
        size: m. Box: its three lengths; cylinder and capsule: radius and length along their own z axis; sphere: radius.
        placement: its centre and axes in the link's frame.
        points: (N, 3) corners of a mesh in its own axes, m; of other shapes none.
    """

    kind: str
    size: tuple[float, ...]
    placement: Placement
    points: Array = field(default_factory=lambda: np.zeros((0, 3)))


@dataclass(frozen=True)
class RigidLink:
    """One rigid body.

    Attributes:
        name: as in the file.
        mass: kg.
        com: (3,) centre of mass in the link's frame, m.
        inertia: (3, 3) about the centre of mass, axes of the link's frame, kg m2.
        shapes: of it; of a mesh only what the format's reader knows.
    """

    name: str
    mass: float = 0.0
    com: Array = field(default_factory=lambda: np.zeros(3))
    inertia: Array = field(default_factory=lambda: np.zeros((3, 3)))
    shapes: tuple[LinkShape, ...] = ()


@dataclass(frozen=True)
class LinkJoint:
    """One joint, and where its child is when its angle is 0. Numbers that the file does not have are None.

    Attributes:
        name: as in the file.
        kind: ``fixed``, ``hinge``, ``slide``, ``ball`` or ``free``.
        parent, child: names of links.
        placement: of the child's frame in the parent's at angle 0.
        axis: (3,) unit vector through the child's origin, in the child's frame.
        limits: rad.
        effort: N m, largest torque of its drive.
        velocity: rad/s, largest speed of its drive.
        damping: N m s/rad.
        friction: N m, of dry gears.
        armature: kg m2, inertia of the rotor at the joint.
        home: rad, its angle in the pose that the file is written in.
    """

    name: str
    kind: JointKind
    parent: str
    child: str
    placement: Placement
    axis: Array
    limits: tuple[float, float] | None = None
    effort: float | None = None
    velocity: float | None = None
    damping: float | None = None
    friction: float | None = None
    armature: float | None = None
    home: float | None = None


@dataclass(frozen=True)
class LinkTree:
    """Links and joints of one robot.

    Attributes:
        name: of the robot.
        source: path of the file, as messages name it.
        links: by name.
        joints: in the order of the file.
        numbers: what else of a robot file the format could hold: dotted key -> value.
        notes: what of the file is not used.
    """

    name: str
    source: str
    links: Mapping[str, RigidLink]
    joints: tuple[LinkJoint, ...]
    numbers: Mapping[str, float | list[float]] = field(default_factory=dict)
    notes: tuple[str, ...] = ()


def fuse_fixed(tree: LinkTree) -> LinkTree:
    """Return the tree with every link on a fixed joint made a part of its parent, and so what moves freely in an empty world.

    Raises:
        InputError: a joint names a link that is not there, a link has two parents, or the joints go round in a circle.
    """
    _check_names(tree)
    links, joints = dict(tree.links), list(tree.joints)

    def is_fixed(joint: LinkJoint) -> bool:
        return joint.kind == "fixed" or (joint.kind == "free" and links[joint.parent].mass == 0.0)

    while fixed := next(filter(is_fixed, joints), None):
        joints.remove(fixed)
        links[fixed.parent] = _merged(links[fixed.parent], links.pop(fixed.child), fixed.placement)
        joints = [
            replace(joint, parent=fixed.parent, placement=fixed.placement @ joint.placement)
            if joint.parent == fixed.child
            else joint
            for joint in joints
        ]
    return replace(tree, links=links, joints=tuple(joints))


def _check_names(tree: LinkTree) -> None:
    above: dict[str, str] = {}
    for joint in tree.joints:
        for role, name in (("parent", joint.parent), ("child", joint.child)):
            if name not in tree.links:
                raise InputError(f"{tree.source}: joint '{joint.name}': its {role} '{name}' is no link of the file")
        if joint.child in above:
            raise InputError(f"{tree.source}: link '{joint.child}' is the child of two joints: expected a tree")
        above[joint.child] = joint.parent
    try:
        graphlib.TopologicalSorter({child: [parent] for child, parent in above.items()}).prepare()
    except graphlib.CycleError as error:
        raise InputError(f"{tree.source}: link '{error.args[1][0]}' is above itself: expected a tree") from None


def _merged(parent: RigidLink, child: RigidLink, placement: Placement) -> RigidLink:
    """Return both links as one rigid body in the parent's frame."""
    shapes = tuple(replace(shape, placement=placement @ shape.placement) for shape in child.shapes)
    if child.mass == 0.0 and not child.inertia.any():
        return replace(parent, shapes=(*parent.shapes, *shapes))
    com = placement.point(child.com)
    mass = parent.mass + child.mass
    middle = (parent.mass * parent.com + child.mass * com) / mass if mass else parent.com
    inertia = parent.inertia + placement.rotation @ child.inertia @ placement.rotation.T
    for one, offset in ((parent.mass, parent.com - middle), (child.mass, com - middle)):  # of mass points that are off it
        inertia = inertia + one * (offset @ offset * np.eye(3) - np.outer(offset, offset))
    return RigidLink(parent.name, mass, middle, inertia, (*parent.shapes, *shapes))


# ---- topology --------------------------------------------------------------------------------------------------------


#: What is expected, in words.
EXPECTED = "expected four legs of one hinge each, with one wheel each: 8 hinges"
#: rad; axes that are further from the body's y axis are another robot's.
AXIS_TOLERANCE = 1e-3


@dataclass(frozen=True)
class Assembly:
    """One leg with its wheel, at joint angles 0, in the frame of the body link.

    Attributes:
        leg_joint, wheel_joint: as in the file.
        leg, wheel: links.
        leg_frame, wheel_frame: placements of the links.
        leg_sign, wheel_sign: 1 where the joint's axis is the body's +y axis, -1 where it is the opposite.
        length: hip to wheel, m.
        angle: of the leg here where the file's is 0, rad, in the turn in which the leg moves below the body.
    """

    leg_joint: LinkJoint
    wheel_joint: LinkJoint
    leg: RigidLink
    wheel: RigidLink
    leg_frame: Placement
    wheel_frame: Placement
    leg_sign: float
    wheel_sign: float
    length: float
    angle: float

    @property
    def wheel_centre(self) -> Array:
        """The wheel's centre of mass in the body link's frame (3,), m."""
        return self.wheel_frame.point(self.wheel.com)


def find_assemblies(tree: LinkTree) -> tuple[RigidLink, list[Assembly]]:
    """Return the body link and its legs with their wheels, in the order lf, rf, lr, rr, of a tree without fixed joints.

    Raises:
        InputError: another robot; the message names the joint, link or axis that differs.
    """
    where, children = tree.source, {joint.child for joint in tree.joints}
    roots = [link for name, link in tree.links.items() if name not in children]
    if len(roots) != 1:
        names = ", ".join(link.name for link in roots) or "none"
        raise InputError(f"{where}: expected one link that is no joint's child, found {len(roots)}: {names}")
    (body,) = roots
    for joint in tree.joints:
        if joint.kind != "hinge":
            raise InputError(f"{where}: joint '{joint.name}' is a {joint.kind}: {EXPECTED}")
    below: dict[str, list[LinkJoint]] = {name: [] for name in tree.links}
    for joint in tree.joints:
        below[joint.parent].append(joint)
    hips = below[body.name]
    if len(hips) != 4:
        names = ", ".join(f"'{joint.name}'" for joint in hips) or "none"
        raise InputError(f"{where}: {len(hips)} joints on body '{body.name}' ({names}), {len(tree.joints)} in all: {EXPECTED}")
    assemblies = [_assembly(tree, joint, below) for joint in hips]
    places = np.array([[one.leg_frame.position[0], one.wheel_centre[1]] for one in assemblies])
    found: dict[str, Assembly] = {}
    for one, (x, y) in zip(assemblies, places - places.mean(axis=0), strict=True):
        corner = ("l" if y > 0 else "r") + ("f" if x > 0 else "r")
        if corner in found:
            both = f"joints '{found[corner].leg_joint.name}' and '{one.leg_joint.name}' are both at the {CORNER_NAMES[corner]}"
            raise InputError(f"{where}: {both}: expected one leg at each corner, with x forward and y to the left (REP-103)")
        found[corner] = one
    return body, [found[corner] for corner in CORNERS]


def _assembly(tree: LinkTree, hip: LinkJoint, below: dict[str, list[LinkJoint]]) -> Assembly:
    where, axles = tree.source, below[hip.child]
    if not axles:
        raise InputError(f"{where}: link '{hip.child}' of joint '{hip.name}' carries no wheel: {EXPECTED}")
    if len(axles) > 1:
        names = ", ".join(f"'{joint.name}'" for joint in axles)
        raise InputError(f"{where}: link '{hip.child}' carries {len(axles)} joints ({names}): expected one wheel; {EXPECTED}")
    (axle,) = axles
    if further := below[axle.child]:
        after = f"'{further[0].name}' follows '{axle.name}'"
        raise InputError(f"{where}: leg '{hip.name}' has more than one hinge: {after}: {EXPECTED}")
    leg_frame = hip.placement
    wheel_frame = leg_frame @ axle.placement
    signs = []
    for joint, frame in ((hip, leg_frame), (axle, wheel_frame)):
        axis = frame.rotation @ joint.axis
        if np.hypot(axis[0], axis[2]) > AXIS_TOLERANCE:
            text = ", ".join(f"{value:.4g}" for value in axis)
            wanted = "expected its y axis, (0, 1, 0) or (0, -1, 0), with x forward, y to the left and z up (REP-103)"
            raise InputError(f"{where}: joint '{joint.name}' turns about ({text}) of the body: {wanted}")
        signs.append(float(np.sign(axis[1])))
    x, _, z = wheel_frame.position - leg_frame.position
    if math.hypot(x, z) == 0.0:
        raise InputError(f"{where}: leg '{hip.name}': its wheel '{axle.name}' turns about the hip: length = 0 m")
    angle, middle = math.atan2(-z, x) + 0.0, sum(hip.limits) / 2 if hip.limits else hip.home or 0.0
    turns = round((signs[0] * middle + angle - math.pi / 2) / (2.0 * math.pi))
    leg, wheel, angle = tree.links[hip.child], tree.links[axle.child], angle - 2.0 * math.pi * turns
    return Assembly(hip, axle, leg, wheel, leg_frame, wheel_frame, signs[0], signs[1], math.hypot(x, z), angle)


# ---- numbers ---------------------------------------------------------------------------------------------------------


#: Digits that imported numbers keep: what rotations and sums add to the last ones is no part of the file.
DIGITS = 14
#: Differences up to this share are of rounding in the file: nothing is said.
SAME = 1e-6
#: Differences and left-out numbers up to this share of what they are compared with are said; larger ones are refused.
SMALL = 0.05


@dataclass(frozen=True)
class JointMapping:
    """What an angle of the file is here: ``angle here = sign * angle there + offset`` (rad)."""

    joint: str
    name: str
    sign: float
    offset: float


@dataclass(frozen=True)
class ImportedRobot:
    """What a file says of a robot.

    Attributes:
        name: of the robot in the file.
        numbers: keys of a robot file -> values, nested as in one; only what the file states.
        joints: of the file, in joint order.
        notes: what was averaged, moved or left out, with numbers.
    """

    name: str
    numbers: dict[str, Any]
    joints: list[JointMapping]
    notes: list[str] = field(default_factory=list)


class _Reader:
    """Collects numbers and notes; refuses what differs by too much."""

    def __init__(self, source: str, idealise: bool, notes: Iterable[str]) -> None:
        self.source, self.idealise = source, idealise
        self.numbers: dict[str, Any] = {}
        self.individual: dict[str, float] = {}
        self.notes = list(notes)

    def put(self, key: str, value: Any) -> None:
        """Take a number, a list of them, or None, which is not stated; ``key`` is dotted."""
        if value is not None:
            self.numbers[key] = [rounded(one) for one in value] if isinstance(value, list | tuple) else rounded(value)

    def put_one(
        self, key: str, values: Sequence[float | None], unit: str, scale: float | None = None, elements: Sequence[str] = ()
    ) -> None:
        """Take the number that four are, if they are stated; of different ones their mean, and each where a file has it.

        Args:
            key: dotted.
            values: of the corners.
            unit: of them.
            scale: what differences are compared with; None = the largest value.
            elements: names under which a robot file states them one by one; without, those that differ much are refused.
        """
        stated = [value for value in values if value is not None]
        if 0 < len(stated) < len(values):
            count = f"stated for {len(stated)} of {len(values)} legs or wheels"
            raise InputError(f"{self.source}: {key}: {count}: expected all or none")
        if not stated:
            return
        spread, mean = max(stated) - min(stated), sum(stated) / len(stated)
        self.put(key, stated[0] if spread == 0.0 else mean)
        share = spread / (scale or max(map(abs, stated)) or 1.0)
        text = f"{key} = {', '.join(f'{value:.6g}' for value in stated)} {unit}"
        if share > SAME and elements:
            self.individual |= {name: rounded(value) for name, value in zip(elements, stated, strict=True)}
            self.notes.append(f"{text}: one by one under 'individual'; controllers use their mean {mean:.6g}")
        elif share > SAME:
            text += ": a robot file has one for all four"
            self._accept(share, f"{text}; their mean {mean:.6g} is used", text)

    def leave_out(self, what: str, value: float, unit: str, scale: float) -> None:
        """Note a number that a robot file has no place for; refuse a large one."""
        share = abs(value) / scale if scale else 0.0
        if share > SAME:
            text = f"{what} = {value:.4g} {unit}: a robot file has no number for it"
            self._accept(share, f"{text}; left out ({100 * share:.2g} % of {scale:.4g} {unit})", text)

    def leave_out_products(self, what: str, inertia: Array, scale: float | None = None) -> None:
        """Note an inertia's products, beside the moments of both axes or ``scale``; ``{}`` in ``what`` is the axes."""
        for (i, j), axes in (((0, 1), "xy"), ((0, 2), "xz"), ((1, 2), "yz")):
            beside = scale or math.sqrt(abs(inertia[i, i] * inertia[j, j]))
            self.leave_out(what.replace("{}", axes), float(inertia[i, j]), "kg m2", beside)

    def _accept(self, share: float, note: str, refusal: str) -> None:
        if share > SMALL and not self.idealise:
            raise InputError(
                f"{self.source}: {refusal}, and {100 * share:.3g} % is too much to pass over; accept it with --idealise"
            )
        self.notes.append(note)


def rounded(value: float) -> float:
    """Return a number to :data:`DIGITS` digits."""
    return float(f"{float(value):.{DIGITS}g}") + 0.0


def recognise(tree: LinkTree, *, idealise: bool = False, given: Mapping[str, Any] | None = None) -> ImportedRobot:
    """Return what a tree of links says of a robot with four legs of one hinge and four wheels.

    The body's origin is put in the middle of the hips along x and y, and at the centre of the body's box along z.

    Args:
        tree: of a file.
        idealise: accept that numbers are averaged or left out which change the robot by more than :data:`SMALL`.
        given: dotted key -> number that counts in place of the file's.

    Raises:
        InputError: another kind of robot, or numbers that no robot file can hold; the message names them.
    """
    body, assemblies = find_assemblies(fuse_fixed(tree))
    reader, given = _Reader(tree.source, idealise, tree.notes), dict(given or {})
    for key, value in tree.numbers.items():
        reader.put(key, value)
    for link in (body, *(link for one in assemblies for link in (one.leg, one.wheel))):
        if link.mass <= 0.0:
            raise InputError(f"{tree.source}: link '{link.name}': mass = {link.mass:g} kg: expected more than 0")
        for axes, moment in zip(("ixx", "iyy", "izz"), np.diag(link.inertia), strict=True):
            if moment <= 0.0:
                raise InputError(f"{tree.source}: link '{link.name}': {axes} = {moment:g} kg m2: expected more than 0")
    _read_body(body, assemblies, reader)
    _read_legs(assemblies, reader)
    _read_wheels(assemblies, reader, given.get("wheel.radius"))
    _read_drives(assemblies, reader)
    _read_limits(assemblies, reader)
    legs, wheels = zip(LEGS, assemblies, strict=True), zip(WHEELS, assemblies, strict=True)
    joints = [JointMapping(ours, one.leg_joint.name, one.leg_sign, rounded(one.angle)) for ours, one in legs]
    joints += [JointMapping(ours, one.wheel_joint.name, one.wheel_sign, 0.0) for ours, one in wheels]
    numbers, single = nested(reader.numbers | given), {key.partition("[")[0] for key in reader.individual} - set(given)
    if single:
        numbers["individual"] = {key: value for key, value in reader.individual.items() if key.partition("[")[0] in single}
    return ImportedRobot(tree.name, numbers, joints, reader.notes)


# ---- body ------------------------------------------------------------------------------------------------------------


def _corners(shape: LinkShape) -> Array:
    """Points (N, 3) in the link's frame between which a shape lies."""
    placement = shape.placement
    if shape.kind == "mesh":
        return placement.position + shape.points @ placement.rotation.T
    if shape.kind == "box":
        half = np.array(shape.size) / 2
    else:
        radius = shape.size[0]
        beyond = {"cylinder": 0.0, "capsule": radius, "sphere": radius}[shape.kind]
        half = np.array([radius, radius, sum(shape.size[1:]) / 2 + beyond])
    reach = np.abs(placement.rotation) @ half
    return np.array([placement.position - reach, placement.position + reach])


def _read_body(body: RigidLink, assemblies: Sequence[Assembly], reader: _Reader) -> None:
    # A hip is in the plane of its wheel: a hinge has no other place along its axis.
    hips = np.array([[one.leg_frame.position[0], one.wheel_centre[1], one.leg_frame.position[2]] for one in assemblies])
    corners = [corner for shape in body.shapes for corner in _corners(shape)]
    box = np.array([np.min(corners, axis=0), np.max(corners, axis=0)]) if corners else None
    origin = np.array([*hips.mean(axis=0)[:2], 0.0 if box is None else box.mean(axis=0)[2]])
    if np.linalg.norm(origin) > SAME:
        text = ", ".join(f"{value:.4g}" for value in origin)
        reader.notes.append(f"body origin: put at ({text}) m of link '{body.name}': the middle of hips and body")
    hips = hips - origin
    reader.put("body.mass", body.mass)
    if box is not None:
        reader.put("body.size", list(box[1] - box[0]))
    else:
        reader.notes.append(f"body.size: link '{body.name}' has no box: taken from the base")
    reader.put("body.inertia", list(np.diag(body.inertia)))
    reader.leave_out_products(f"body '{body.name}': product of inertia {{}}", body.inertia)
    reader.put("body.com_offset", list(body.com - origin))
    signs = np.array(CORNER_SIGNS)
    size = float(np.abs(hips[:, :2]).max())
    reader.put_one("hip_position.x", list(hips[:, 0] * signs[:, 0]), "m")
    reader.put_one("hip_position.y", list(hips[:, 1] * signs[:, 1]), "m")
    reader.put_one("hip_position.z", list(hips[:, 2]), "m", scale=size)


# ---- legs ------------------------------------------------------------------------------------------------------------


def _read_legs(assemblies: Sequence[Assembly], reader: _Reader) -> None:
    lengths = [one.length for one in assemblies]
    reader.put_one("leg.length", lengths, "m", elements=spec_of("leg.length").elements)
    rows = []
    for one in assemblies:
        sine, cosine = (0.0 if abs(value) < 1e-15 else value for value in (math.sin(one.angle), math.cos(one.angle)))
        axes = np.array(
            [[cosine, 0.0, sine], [0.0, 1.0, 0.0], [-sine, 0.0, cosine]]
        )  # columns: along the leg, body's y, across
        com = axes.T @ (one.leg_frame.point(one.leg.com) - one.leg_frame.position)
        inertia = axes.T @ one.leg_frame.rotation @ one.leg.inertia @ one.leg_frame.rotation.T @ axes
        beside = float(com[1] + one.leg_frame.position[1] - one.wheel_centre[1])
        where = f"leg '{one.leg.name}'"
        reader.leave_out(f"{where}: centre of mass off the line hip to wheel", float(com[2]), "m", one.length)
        reader.leave_out(f"{where}: centre of mass beside the wheel's plane", beside, "m", 2.0 * abs(one.wheel_centre[1]))
        reader.leave_out_products(f"{where}: product of inertia {{}} in the leg's frame", inertia)
        rows.append((one.leg.mass, float(com[0]), *(float(inertia[k, k]) for k in (2, 1, 0))))  # straight down: x, y, own axis
    mass, com, *moments = zip(*rows, strict=True)
    reader.put_one("leg.mass", mass, "kg", elements=spec_of("leg.mass").elements)
    if min(com) < 0.0:
        where = f"{reader.source}: leg.com_along_leg = {min(com):.6g} m"
        raise InputError(f"{where}: the legs' mass is behind the hip: expected 0 or more")
    reader.put_one("leg.com_along_leg", com, "m", max(lengths), spec_of("leg.com_along_leg").elements)
    scale, elements = max(map(max, moments)), spec_of("leg.inertia").elements
    for k, (axis, values) in enumerate(zip("xyz", moments, strict=True)):
        reader.put_one(f"leg.inertia {axis}", values, "kg m2", scale, elements[k::3])
    reader.put("leg.inertia", [reader.numbers.pop(f"leg.inertia {axis}") for axis in "xyz"])


# ---- wheels ----------------------------------------------------------------------------------------------------------


def _read_wheels(assemblies: Sequence[Assembly], reader: _Reader, given: float | None) -> None:
    sizes = [_wheel_size(one, reader, given) for one in assemblies]
    radii, widths = zip(*sizes, strict=True)
    reader.put_one("wheel.radius", radii, "m", elements=spec_of("wheel.radius").elements)
    reader.put_one("wheel.width", widths if None not in widths else (), "m")
    rows = []
    for one, (radius, _) in zip(assemblies, sizes, strict=True):
        where, frame = f"wheel '{one.wheel.name}'", one.wheel_frame
        inertia = frame.rotation @ one.wheel.inertia @ frame.rotation.T
        centre = one.wheel_centre - frame.position
        reader.leave_out(f"{where}: centre of mass off its axle", math.hypot(centre[0], centre[2]), "m", radius)
        across = float(inertia[0, 0] + inertia[2, 2]) / 2
        reader.leave_out(f"{where}: difference of its inertias across the axle", float(inertia[0, 0]) - across, "kg m2", across)
        reader.leave_out_products(f"{where}: product of inertia", inertia, across)
        rows.append((one.wheel.mass, float(inertia[1, 1]), across))
    units = {"mass": "kg", "spin_inertia": "kg m2", "transverse_inertia": "kg m2"}
    for (key, unit), values in zip(units.items(), zip(*rows, strict=True), strict=True):
        reader.put_one(f"wheel.{key}", values, unit, elements=spec_of(f"wheel.{key}").elements)


def _wheel_size(one: Assembly, reader: _Reader, given: float | None) -> tuple[float, float | None]:
    """Radius and width (m) by the link's shapes, the radius as it is given; None: no width."""
    radius, width = 0.0, None
    for shape in one.wheel.shapes:
        axis = one.wheel_frame.rotation @ shape.placement.rotation[:, 2]
        if shape.kind == "sphere":
            radius = max(radius, shape.size[0])
        elif shape.kind in ("cylinder", "capsule") and abs(axis[1]) > 1.0 - 1e-6:
            radius = max(radius, shape.size[0])
            width = max(width or 0.0, shape.size[1]) if shape.kind == "cylinder" else width
    meshes = [_corners(shape) @ one.wheel_frame.rotation.T for shape in one.wheel.shapes if shape.kind == "mesh"]
    if radius == 0.0 and meshes:
        points = np.concatenate(meshes)
        return float(np.hypot(points[:, 0], points[:, 2]).max()), float(np.ptp(points[:, 1]))
    if radius == 0.0 and given is None:
        seen = f"{reader.source}: wheel '{one.wheel.name}' has no cylinder about its axle and no sphere"
        raise InputError(f"{seen}: give its radius, such as --set wheel.radius=0.05")
    return given or radius, width


# ---- drives ----------------------------------------------------------------------------------------------------------


#: Field of a joint -> key of a motor in a robot file, and its unit.
_DRIVE: Mapping[str, tuple[str, str]] = {
    "effort": ("stall_torque", "N m"),
    "velocity": ("no_load_speed", "rad/s"),
    "armature": ("armature", "kg m2"),
    "friction": ("coulomb_friction", "N m"),
    "damping": ("viscous_friction", "N m s/rad"),
}


def _read_drives(assemblies: Sequence[Assembly], reader: _Reader) -> None:
    for group, half in (("leg", slice(4)), ("wheel", slice(4, 8))):
        joints = [getattr(one, f"{group}_joint") for one in assemblies]
        for name, (key, unit) in _DRIVE.items():
            values = [getattr(joint, name) for joint in joints]
            if wrong := [joint.name for joint, value in zip(joints, values, strict=True) if value is not None and value < 0.0]:
                raise InputError(f"{reader.source}: joint '{wrong[0]}': {name} is below 0: expected 0 or more {unit}")
            if name != "damping" and not any(values) and None not in values:  # what files say where nobody knows
                reader.notes.append(f"servo.{group}.{key}: 0 in the file: taken from the base")
            else:
                reader.put_one(f"servo.{group}.{key}", values, unit, elements=spec_of(f"servo.{key}").elements[half])


def _read_limits(assemblies: Sequence[Assembly], reader: _Reader) -> None:
    """Take the legs' limits, what all can, and their angle in the file's own pose, where it is one for all."""
    limits = [one.leg_joint.limits for one in assemblies]
    spans = [
        sorted(one.leg_sign * angle + one.angle for angle in span)
        for one, span in zip(assemblies, limits, strict=True)
        if span is not None
    ]
    if len(spans) == len(limits) and any(high > low for low, high in spans):
        lows, highs = zip(*spans, strict=True)
        low, high = max(lows), min(highs)
        if max(low - min(lows), max(highs) - high) > SAME:
            texts = ", ".join(f"[{first:.4g}, {last:.4g}]" for first, last in spans)
            reader.notes.append(
                f"leg_limits: legs move in {texts} rad: a robot file has one for all four; what all can is used"
            )
        if low >= high:
            raise InputError(f"{reader.source}: leg_limits: no angle is allowed to all legs: [{low:.6g}, {high:.6g}] rad")
        reader.put("leg_limits", [low, high])
    homes = [one.leg_joint.home for one in assemblies]
    angles = [one.leg_sign * (home or 0.0) + one.angle for one, home in zip(assemblies, homes, strict=True)]
    if None in homes:
        return
    if max(angles) - min(angles) > SAME:
        reader.notes.append(f"home.leg_angle: legs at {', '.join(f'{angle:.4g}' for angle in angles)} rad: taken from the base")
    else:
        reader.put("home.leg_angle", angles[0])


# ---- a robot file over a base ----------------------------------------------------------------------------------------


#: Width at which a comment starts.
_COMMENT = 42


def robot_text(
    name: str, base: str, numbers: Mapping[str, Any], *, title: Iterable[str] = (), comments: Mapping[str, str] | None = None
) -> str:
    """Return a robot file (YAML).

    Args:
        name: of the robot.
        base: config name or path of the robot that has all other numbers.
        numbers: keys of a robot file -> values, nested as in one.
        title: lines at its top, as comments.
        comments: dotted key -> comment beside it.
    """
    lines = [*(f"# {line}".rstrip() for line in title), "", f"base: {_scalar(base)}", f"name: {_scalar(name)}", ""]
    return "\n".join([*lines, *_lines(numbers, "", comments or {})]) + "\n"


def _lines(numbers: Mapping[str, Any], above: str, comments: Mapping[str, str]) -> Iterator[str]:
    indent = "  " * above.count(".")
    for key, value in numbers.items():
        if isinstance(value, Mapping):
            yield f"{indent}{key}:"
            yield from _lines(value, f"{above}{key}.", comments)
            if not above:
                yield ""
            continue
        line, comment = f"{indent}{key}: {_scalar(value)}", comments.get(above + key)
        yield f"{line:<{_COMMENT}} # {comment}" if comment else line


def _scalar(value: Any) -> str:
    return yaml.safe_dump(value, default_flow_style=True, width=1000).removesuffix("...\n").strip()


def base_beside(base: str, out: Path) -> str:
    """Return how a file at ``out`` names its base: a path is seen from the file's own folder."""
    if not base.endswith((".yaml", ".yml")):
        return base
    return Path(os.path.relpath(base, out.parent)).as_posix()


def of_all(numbers: Mapping[str, Any], base: str) -> dict[str, Any]:
    """Return numbers that also remove what the base says of single legs, wheels or servos where they state it of all."""
    removed = {}
    for element in load_robot(base, check=False).individual:
        spec = spec_of(element)
        found: Any = numbers
        for key in str(spec.sources[spec.elements.index(element) % len(spec.sources)]).split("."):
            found = found.get(key) if isinstance(found, Mapping) else None
        if found is not None:
            removed[element] = None
    single = removed | dict(numbers.get("individual", {}))
    return {**numbers, "individual": single} if single else dict(numbers)


def missing_numbers(numbers: Mapping[str, Any], of: Mapping[str, Any], above: str = "") -> dict[str, Any]:
    """Return dotted key -> value of what ``of``, a robot file's content, states and ``numbers`` do not."""
    found: dict[str, Any] = {}
    for key, value in of.items():
        inner = numbers.get(key)
        if isinstance(value, Mapping):
            found |= missing_numbers(inner if isinstance(inner, Mapping) else {}, value, f"{above}{key}.")
        elif inner is None and value is not None:
            found[above + key] = value
    return found


def robot_over(base: str, name: str, numbers: Mapping[str, Any], where: Path, *, check: bool = True) -> Robot:
    """Return the robot that a file at ``where`` with these numbers over ``base`` would be.

    Raises:
        InputError: as :func:`wlr_gym.robot.load_robot` of that file.
    """
    below = load_robot(base, check=False).model_dump(mode="json")
    robot = parse_config(Robot, overlay(below, {**numbers, "name": name}), str(where))
    return load_robot(robot, check=check)
