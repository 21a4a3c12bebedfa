"""Where the wheels touch the floor: the contacts' points and axes, as scalar source for every simulator, and in numbers.

Vectors are those of the body's frame unless named otherwise; lanes: :mod:`wlr_gym.physics.plants.gibbs_appell.kinematics`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from wlr_gym.physics.codegen import ops
from wlr_gym.physics.codegen.ops import Lanes, Out, Value, Vector
from wlr_gym.physics.model.dynamics import rotation_matrix
from wlr_gym.physics.plants import relief
from wlr_gym.physics.plants.base import Contacts, Plant, PlantState, Truth
from wlr_gym.robot import CORNER_SIGNS, Robot
from wlr_gym.robot.parameters import Parameters

Array = NDArray[np.float64]

CORNERS = range(4)
#: Contacts of the wheels: contact i and contact i + 4 are those of wheel i. Without pieces on the floor the second has none.
CONTACTS = range(8)
AXES = "xyz"


def cross(a: Sequence[Value], b: Sequence[Value]) -> Vector:
    """Vector product."""
    return [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]


def dot(a: Sequence[Value], b: Sequence[Value]) -> Value:
    """Scalar product."""
    total: Value = a[0] * b[0]
    for x, y in zip(a[1:], b[1:], strict=True):
        total = total + x * y
    return total


def vector(lanes: Lanes, prefix: str) -> Vector:
    """Read the three lanes ``prefix + x|y|z``."""
    return [lanes[prefix + a] for a in AXES]


def rotation_rows(lanes: Lanes) -> list[Vector]:
    """Rotation matrix body -> floor as rows, from the unit quaternion."""
    w, x, y, z = (lanes[f"q{a}"] for a in "wxyz")
    return [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]


def to_body(rows: Sequence[Sequence[Value]], a: Sequence[Value]) -> Vector:
    """Turn a floor-frame vector into the body frame."""
    return [rows[0][k] * a[0] + rows[1][k] * a[1] + rows[2][k] * a[2] for k in range(3)]


def axes_on(n: Vector) -> tuple[Vector, Vector, Vector, Value]:
    """Return a floor normal n, the wheels' heading t_x and lateral axis t_y on that floor, body frame, and 1/|axle x n|.

    All axles are parallel to body y. t_x = (axle x n)/|.|, t_y = n x t_x.
    """
    scale = 1.0 / ops.sqrt(n[0] * n[0] + n[2] * n[2] + 1e-12)
    heading = [n[2] * scale, 0.0, -(n[0] * scale)]
    return list(n), heading, cross(n, heading), scale


@dataclass(frozen=True)
class Contact:
    """One place where a wheel touches the floor, or is nearest to it. Vectors in the body frame.

    Attributes:
        number: contact i and contact i + 4 are those of wheel i.
        hip, leg, rim: from the body's origin to the hip, on to the axle, and on to the point of the wheel that is deepest, m.
        axes: see :func:`axes_on`.
        depth: how far that point is in the floor, m; None: as far as it is below z = 0.
        place: what it touches, see :class:`wlr_gym.physics.plants.relief.Touch`.
    """

    number: int
    hip: Vector
    leg: Vector
    rim: Vector
    axes: tuple[Vector, Vector, Vector, Value]
    depth: Value | None = None
    place: Value = 1.0

    @property
    def wheel(self) -> int:
        """Of which wheel it is."""
        return self.number % len(CORNERS)

    @property
    def point(self) -> Vector:
        """From the body's origin, m."""
        return [self.hip[k] + self.leg[k] + self.rim[k] for k in range(3)]

    def gap(self, lanes: Lanes) -> Value:
        """Distance from the floor, m; negative: in it."""
        return lanes["pz"] + dot(self.axes[0], self.point) if self.depth is None else -self.depth

    def row(self, e: Sequence[Value], rise: Vector | None = None) -> tuple[Vector, Value]:
        """Jacobian of the point's velocity along ``e``: six base entries and the leg-rate entry.

        The wheel-rate entry is -radius along the heading and zero along the lateral axis and the normal. ``rise``, and that
        radius: :func:`rolling_contact`.
        """
        hip, leg, rim = self.hip, self.leg, self.rim
        point = [hip[0] + leg[0] + rim[0], hip[1] + rim[1], hip[2] + leg[2] + rim[2]]
        if rise is not None:
            point = [point[k] + rise[k] for k in range(3)]
        arm = cross(point, e)
        return [*e, arm[0], hip[2] * e[0] - hip[0] * e[2], arm[2]], leg[2] * e[0] - leg[0] * e[2]


def contacts_of(
    lanes: Lanes,
    i: int,
    rows: Sequence[Sequence[Value]],
    level: tuple[Vector, Vector, Vector, Value],
    leg_turn: tuple[Value, Value],
    features: frozenset[str],
) -> list[Contact]:
    """Return the contacts of wheel ``i``: one, or two where there are pieces on the floor.

    On a level floor the wheel is a thin disc, whose lowest point lies in its plane.

    Args:
        lanes: of the step.
        i: wheel.
        rows: of the rotation body -> floor.
        level: :func:`axes_on` the normal of z = 0.
        leg_turn: sine and cosine of the leg's angle.
        features: families that are traced.
    """
    sine, cosine = leg_turn
    hip = [lanes[f"hip_{a}{i}"] for a in AXES]
    leg = [lanes[f"length{i}"] * cosine, 0.0, -(lanes[f"length{i}"] * sine)]
    if "relief" not in features:
        n, _, _, scale = level
        reach = lanes[f"radius{i}"] * scale
        return [Contact(i, hip, leg, [-(reach * n[0]), 0.0, -(reach * n[2])], level)]
    centre = [lanes[f"p{a}"] + dot(rows[k], [hip[m] + leg[m] for m in range(3)]) for k, a in enumerate(AXES)]
    found = relief.touches(lanes, i, centre, [row[1] for row in rows], features)
    return [
        Contact(i + 4 * k, hip, leg, to_body(rows, touch.reach), axes_on(to_body(rows, touch.normal)), touch.depth, touch.place)
        for k, touch in enumerate(found)
    ]


def remembered(lanes: Lanes, contacts: Sequence[Contact], names: Sequence[str], load: str) -> Out:
    """Return what two contacts of a wheel keep from the last step, and their places.

    The deeper contact is the first. Where the two have changed places, so does what they remember; a new place has nothing to
    remember.

    Args:
        lanes: with those called ``names`` and ``place`` and the contact's number.
        contacts: of one wheel.
        names: of what is kept.
        load: name of the contact's normal force; what carried none has nothing to remember at another place.
    """
    out: Out = {}
    if len(contacts) == 1:
        return out
    for own, other in (contacts, contacts[::-1]):
        stays = 0.5 - ops.absolute(own.place - lanes[f"place{own.number}"])
        comes = ops.minimum(0.5 - ops.absolute(own.place - lanes[f"place{other.number}"]), lanes[f"{load}{other.number}"])
        for name in names:
            moved = ops.where_positive(comes, lanes[f"{name}{other.number}"], 0.0)
            out[f"{name}{own.number}"] = ops.where_positive(stays, lanes[f"{name}{own.number}"], moved)
        out[f"place{own.number}"] = own.place
    return out


def contact_numbers(i: int, features: frozenset[str]) -> list[int]:
    """Return the numbers of the contacts of wheel ``i``."""
    return [i, i + 4] if "piece" in features else [i]


def rolling_contact(lanes: Lanes, contact: Contact, features: frozenset[str]) -> tuple[Vector | None, Value]:
    """How far above the deepest point friction acts (body frame; None = there), and the radius on which the wheel rolls.

    A loaded tyre flattens: it rolls on its radius less a share of what it is deeper in the floor than the robot at rest.
    """
    i, (n, heading, _, scale) = contact.wheel, contact.axes
    radius = lanes[f"radius{i}"]
    if contact.depth is not None:
        radius = contact.rim[0] * heading[2] - contact.rim[2] * heading[0]
    if "compliance" not in features:
        return None, radius
    flat = lanes[f"flattening{i}"] * (ops.maximum(-contact.gap(lanes), 0.0) - lanes[f"rest_depth{i}"])
    return [(flat * scale) * n[k] for k in range(3)], radius - flat


def contact_place(lanes: Lanes, rows: Sequence[Sequence[Value]], contact: Contact) -> Vector:
    """Place (x, y) of a contact on the floor, m."""
    point = contact.point
    return [lanes[f"p{a}"] + dot(rows[k], point) for k, a in enumerate("xy")]


def slip_velocity(lanes: Lanes, contact: Contact, twist: Vector, features: frozenset[str]) -> Vector:
    """Velocity of a contact's point over the floor along heading and axle, at the present rates, m/s."""
    i, (_, heading, lateral, _) = contact.wheel, contact.axes
    rise, radius = rolling_contact(lanes, contact, features)
    slip: Vector = []
    for e, wheel_entry in ((heading, -radius), (lateral, 0.0)):
        base_row, leg_entry = contact.row(e, rise)
        speed = dot(base_row, twist) + leg_entry * lanes[f"leg_rate{i}"] + wheel_entry * lanes[f"wheel_rate{i}"]
        slip.append(speed)
    return slip


# ---- in numbers: for pictures, logs and tests ------------------------------------------------------------------------


#: Returns the contacts (N) of a plant's robots now: :meth:`wlr_gym.physics.plants.simulator.Simulator.contacts`.
ContactsOf = Callable[[], Contacts]


def contacts_of_plant(plant: Plant) -> ContactsOf | None:
    """Return what tells the contacts of a plant's robots; None = it does not know them."""
    return getattr(plant, "contacts", None)


def lanes_at(robot: Robot, parameters: Parameters, truth: Truth | PlantState) -> dict[str, Array]:
    """Return the lanes of floor, geometry and pose of robots (N) in the poses of a truth."""
    lanes = relief.pack(parameters, robot) | {f"q{a}": truth.quaternion[:, k] for k, a in enumerate("wxyz")}
    lanes |= {f"p{a}": truth.position[:, k] for k, a in enumerate(AXES)}
    for i in CORNERS:
        hip = parameters["hip.position"] * [*CORNER_SIGNS[i], 1.0]
        lanes |= {f"hip_{a}{i}": hip[:, k] for k, a in enumerate(AXES)}
        lanes |= {f"length{i}": parameters["leg.length"][:, i], f"radius{i}": parameters["wheel.radius"][:, i]}
        lanes[f"leg_angle{i}"] = truth.joint_position[:, i]
    return lanes


def contacts_at(robot: Robot, parameters: Parameters, truth: Truth, force: Array) -> Contacts:
    """Return the contacts of the wheels of robots (N) in the poses of a truth.

    Args:
        robot: theirs.
        parameters: (N).
        truth: (N) where they are.
        force: (N, 8, 3) of the contacts, along their axes, N.
    """
    lanes, turn, found = _contacts_now(robot, parameters, truth)
    count = len(parameters)
    point, normal, heading, lateral = np.zeros((4, count, len(CONTACTS), 3))
    depth = np.full((count, len(CONTACTS)), -np.inf)
    for contact in found:
        c = contact.number
        depth[:, c] = -contact.gap(lanes)
        for target, vector in zip((point, normal, heading, lateral), (contact.point, *contact.axes[:3]), strict=True):
            in_body = np.stack([np.broadcast_to(value, count) for value in vector], axis=1)
            target[:, c] = np.einsum("nij,nj->ni", turn, in_body)
        point[:, c] += truth.position
    return Contacts(point, depth, normal, heading, lateral, np.where(np.isfinite(depth)[:, :, None], force, 0.0))


def slip_on_relief(robot: Robot, parameters: Parameters, state: PlantState) -> Array:
    """Return the slip velocities (N, 4, 2) of wheels where each is deepest in the floor, along heading and axle, m/s."""
    rate, joint_rates = state.angular_velocity_in_body, state.joint_velocity
    slip, twist = np.zeros((len(parameters), len(CORNERS), 2)), [*state.linear_velocity_in_body.T, *rate.T]
    lanes, _, found = _contacts_now(robot, parameters, state)
    for contact in found:
        i = contact.wheel
        if contact.number == i:
            leg_rate = rate[:, 1] + joint_rates[:, i]
            moving = {**lanes, f"leg_rate{i}": leg_rate, f"wheel_rate{i}": leg_rate + joint_rates[:, len(CORNERS) + i]}
            slip[:, i] = np.stack(slip_velocity(moving, contact, twist, frozenset()), axis=1)
    return slip


def _contacts_now(
    robot: Robot, parameters: Parameters, pose: Truth | PlantState
) -> tuple[dict[str, Array], Array, list[Contact]]:
    """Return the lanes of robots (N), their rotations (N, 3, 3) body -> floor, and every contact of theirs."""
    features, lanes = frozenset(relief.families(parameters)), lanes_at(robot, parameters, pose)
    turn, joints = rotation_matrix(pose.quaternion), pose.joint_position
    rows = [[turn[:, k, m] for m in range(3)] for k in range(3)]
    level, found = axes_on(rows[2]), []
    for i in CORNERS:
        found += contacts_of(lanes, i, rows, level, (np.sin(joints[:, i]), np.cos(joints[:, i])), features)
    return lanes, turn, found
