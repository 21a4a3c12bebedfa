"""A robot as links and joints, as other programs' files describe it. SI units; no file format is known here."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from wlr_gym.base.errors import InputError

Array = NDArray[np.float64]
JointKind = Literal["hinge", "slide", "ball", "fixed"]


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
        kind: ``fixed``, ``hinge``, ``slide`` or ``ball``.
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
    """

    name: str
    source: str
    links: Mapping[str, RigidLink]
    joints: tuple[LinkJoint, ...]
    numbers: Mapping[str, float | list[float]] = field(default_factory=dict)

    def root(self) -> RigidLink:
        """Return the link that is nobody's child.

        Raises:
            InputError: none, or several.
        """
        children = {joint.child for joint in self.joints}
        roots = [link for name, link in self.links.items() if name not in children]
        if len(roots) != 1:
            names = ", ".join(link.name for link in roots) or "none"
            raise InputError(f"{self.source}: expected one link that is no joint's child, found {len(roots)}: {names}")
        return roots[0]


def fuse_fixed(tree: LinkTree) -> LinkTree:
    """Return the tree with every link on a fixed joint made a part of its parent.

    Raises:
        InputError: a joint names a link that is not there, a link has two parents, or the joints go round in a circle.
    """
    _check_names(tree)
    links, joints = dict(tree.links), list(tree.joints)
    while fixed := next((joint for joint in joints if joint.kind == "fixed"), None):
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
    for name in tree.links:
        seen, link = set(), name
        while link in above:
            if link in seen:
                raise InputError(f"{tree.source}: link '{link}' is above itself: expected a tree")
            seen.add(link)
            link = above[link]


def _merged(parent: RigidLink, child: RigidLink, placement: Placement) -> RigidLink:
    """Return both links as one rigid body in the parent's frame."""
    shapes = tuple(replace(shape, placement=placement @ shape.placement) for shape in child.shapes)
    if child.mass == 0.0 and not child.inertia.any():
        return replace(parent, shapes=(*parent.shapes, *shapes))
    com = placement.point(child.com)
    inertia = placement.rotation @ child.inertia @ placement.rotation.T
    mass = parent.mass + child.mass
    middle = (parent.mass * parent.com + child.mass * com) / mass if mass else parent.com
    inertia = parent.inertia + inertia + _shift(parent.mass, parent.com - middle) + _shift(child.mass, com - middle)
    return RigidLink(parent.name, mass, middle, inertia, (*parent.shapes, *shapes))


def _shift(mass: float, offset: Array) -> Array:
    """Inertia (3, 3) of a mass point about a point that is ``offset`` away."""
    return mass * (offset @ offset * np.eye(3) - np.outer(offset, offset))
