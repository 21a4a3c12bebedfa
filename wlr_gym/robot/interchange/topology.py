"""Four legs of one hinge, each with a driven wheel: found in a tree of links, or what differs is named."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from wlr_gym.base.errors import InputError
from wlr_gym.robot.interchange.links import LinkJoint, LinkTree, Placement, RigidLink
from wlr_gym.robot.joints import CORNER_NAMES, CORNERS

Array = NDArray[np.float64]

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
    """

    leg_joint: LinkJoint
    wheel_joint: LinkJoint
    leg: RigidLink
    wheel: RigidLink
    leg_frame: Placement
    wheel_frame: Placement
    leg_sign: float
    wheel_sign: float

    @property
    def wheel_centre(self) -> Array:
        """The wheel's centre of mass in the body link's frame (3,), m."""
        return self.wheel_frame.point(self.wheel.com)


def find_assemblies(tree: LinkTree) -> tuple[RigidLink, list[Assembly]]:
    """Return the body link and its legs with their wheels, in the order lf, rf, lr, rr.

    Args:
        tree: without fixed joints (:func:`wlr_gym.robot.interchange.links.fuse_fixed`).

    Raises:
        InputError: another robot; the message names the joint, link or axis that differs.
    """
    where, body = tree.source, tree.root()
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
    return body, _in_corner_order(assemblies, where)


def _assembly(tree: LinkTree, hip: LinkJoint, below: dict[str, list[LinkJoint]]) -> Assembly:
    axles = below[hip.child]
    if not axles:
        raise InputError(f"{tree.source}: link '{hip.child}' of joint '{hip.name}' carries no wheel: {EXPECTED}")
    if len(axles) > 1:
        names = ", ".join(f"'{joint.name}'" for joint in axles)
        raise InputError(
            f"{tree.source}: link '{hip.child}' carries {len(axles)} joints ({names}): expected one wheel; {EXPECTED}"
        )
    (axle,) = axles
    if further := below[axle.child]:
        raise InputError(
            f"{tree.source}: leg '{hip.name}' has more than one hinge: '{further[0].name}' follows '{axle.name}': {EXPECTED}"
        )
    leg_frame = hip.placement
    wheel_frame = leg_frame @ axle.placement
    signs = _sign(tree.source, hip, leg_frame), _sign(tree.source, axle, wheel_frame)
    return Assembly(hip, axle, tree.links[hip.child], tree.links[axle.child], leg_frame, wheel_frame, *signs)


def _sign(where: str, joint: LinkJoint, frame: Placement) -> float:
    """Return whether a joint's axis is +y or -y of the body."""
    axis = frame.rotation @ joint.axis
    if np.hypot(axis[0], axis[2]) > AXIS_TOLERANCE:
        text = ", ".join(f"{value:.4g}" for value in axis)
        raise InputError(
            f"{where}: joint '{joint.name}' turns about ({text}) of the body: expected its y axis, (0, 1, 0) or (0, -1, 0), "
            "with x forward, y to the left and z up (REP-103)"
        )
    return float(np.sign(axis[1]))


def _in_corner_order(assemblies: list[Assembly], where: str) -> list[Assembly]:
    """Sort by the hips' places about their middle."""
    hips = np.array([[one.leg_frame.position[0], one.wheel_centre[1]] for one in assemblies])
    middle = hips.mean(axis=0)
    found: dict[str, Assembly] = {}
    for one, place in zip(assemblies, hips - middle, strict=True):
        corner = ("l" if place[1] > 0 else "r") + ("f" if place[0] > 0 else "r")
        if corner in found:
            raise InputError(
                f"{where}: joints '{found[corner].leg_joint.name}' and '{one.leg_joint.name}' are both at the "
                f"{CORNER_NAMES[corner]}: expected one leg at each corner, with x forward and y to the left (REP-103)"
            )
        found[corner] = one
    return [found[corner] for corner in CORNERS]
