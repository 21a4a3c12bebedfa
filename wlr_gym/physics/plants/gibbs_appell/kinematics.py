"""The engine's lanes by name (what a step keeps, reads and shows), and the geometry of the wheels on the floor.

Every function of the step maps lanes (state, parameters, inputs; each a scalar) to new lanes.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from wlr_gym.physics.codegen import ops
from wlr_gym.physics.codegen.ops import Lanes, Value, Vector
from wlr_gym.physics.plants import drive, relief
from wlr_gym.physics.plants.base import COORDINATES
from wlr_gym.physics.plants.base import INPUTS as INPUTS_OF_FORMULAS

CORNERS = range(4)
#: Contacts of the wheels: contact i and contact i + 4 are those of wheel i. Without pieces on the floor the second has none.
CONTACTS = range(8)
AXES = "xyz"

STATE: tuple[str, ...] = (
    *(f"p{a}" for a in AXES),
    *(f"q{a}" for a in "wxyz"),
    *(f"v{a}" for a in AXES),
    *(f"w{a}" for a in AXES),
    *(f"leg_angle{i}" for i in CORNERS),
    *(f"wheel_angle{i}" for i in CORNERS),
    *(f"leg_rate{i}" for i in CORNERS),
    *(f"wheel_rate{i}" for i in CORNERS),
    *drive.STATE,
    # what the step remembers: velocities one step ago, impulses of the last step (warm start), sensor filters
    *(f"last_w{a}" for a in AXES),
    *(f"last_leg_rate{i}" for i in CORNERS),
    *(f"last_wheel_rate{i}" for i in CORNERS),
    *(f"last_gap_rate{c}" for c in CONTACTS),
    *(f"friction_{a}{c}" for c in CONTACTS for a in "xy"),
    *(f"multiplier{c}" for c in CONTACTS),
    *(f"shear_{a}{c}" for c in CONTACTS for a in "xy"),
    *(f"gear_friction{j}" for j in range(8)),
    *(f"rolling_friction{i}" for i in CORNERS),
    *(f"gyro_{a}" for a in AXES),
    *(f"acceleration_{a}" for a in AXES),
    # single precision only: what rounding has added to the position so far, and where wheel angles are counted from: whole
    # turns, an angle, and what that lacks by rounding
    *(f"rounding_p{a}" for a in "xy"),
    *(f"turns{i}" for i in CORNERS),
    *(f"zero_angle{i}" for i in CORNERS),
    *(f"zero_rest{i}" for i in CORNERS),
)
#: Among the features: single precision, in which a sum over hours must not be one number.
SINGLE = "single"
#: A turn of a wheel, rad.
TURN = 2.0 * math.pi
#: Results of the last substep or of the whole tick, kept with the state for the observation block.
RESULTS: tuple[str, ...] = (
    *(f"normal{c}" for c in CONTACTS),
    *(f"motor_torque{j}" for j in range(8)),
    *(f"current_torque{j}" for j in range(8)),
    *(f"slip_displacement_{a}{i}" for i in CORNERS for a in "xy"),
    "mechanical_energy",
    "electrical_energy",
)
TICK_SUMS: tuple[str, ...] = RESULTS[-10:]
STORED: tuple[str, ...] = STATE + RESULTS
#: Written each control tick.
INPUTS: tuple[str, ...] = (
    *(f"goal{j}" for j in range(8)),
    *(f"old_goal{j}" for j in range(8)),
    *(f"switch_time{j}" for j in range(8)),
    *(f"on{j}" for j in range(8)),
)
#: Inertia of body and loads, and of one corner: arguments of the generated equations (:mod:`wlr_gym.physics.model.equations`).
PLATFORM = (
    "platform_mass",
    *(f"platform_moment_{a}" for a in AXES),
    *(f"platform_inertia_{a}" for a in ("xx", "yy", "zz", "xy", "xz", "yz")),
)
ASSEMBLY = (
    *(f"hip_{a}" for a in AXES),
    "assembly_mass",
    "first_moment",
    "second_moment",
    "leg_ixx",
    "leg_iyy",
    "leg_izz",
    "wheel_transverse",
    "wheel_spin",
    "armature_leg",
    "armature_wheel",
)
#: Lanes that formula forces read and write; each group lies side by side in this order.
FORMULA_INPUTS: tuple[str, ...] = tuple(f"formula_input_{name}" for name in INPUTS_OF_FORMULAS)
FORMULA_OUTPUTS: tuple[str, ...] = tuple(f"formula_{name}" for name in COORDINATES)


# ---- vectors, turns, and the wheels on the floor ---------------------------------------------------------------------


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
    """

    number: int
    hip: Vector
    leg: Vector
    rim: Vector
    axes: tuple[Vector, Vector, Vector, Value]
    depth: Value | None = None

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
        Contact(i + 4 * k, hip, leg, to_body(rows, touch.reach), axes_on(to_body(rows, touch.normal)), touch.depth)
        for k, touch in enumerate(found)
    ]


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


def wheel_angle(lanes: Lanes, i: int, features: frozenset[str]) -> Value:
    """Angle of a wheel relative to its leg; in single precision within the present turn, with the present tick's motion."""
    own = lanes[f"wheel_angle{i}"]
    return lanes[f"zero_angle{i}"] + own if SINGLE in features else own


def joints_of(lanes: Lanes, features: frozenset[str]) -> list[drive.Joint]:
    """Return the eight joints as the drive sees them."""
    joints: list[drive.Joint] = []
    for i in CORNERS:
        angle = lanes[f"leg_angle{i}"]
        joints.append(drive.Joint(angle, lanes[f"leg_rate{i}"] - lanes["wy"], angle + lanes[f"zero_offset{i}"]))
    for i in CORNERS:
        angle = lanes[f"wheel_angle{i}"]
        rate = lanes[f"wheel_rate{i}"] - lanes[f"leg_rate{i}"]
        joints.append(drive.Joint(wheel_angle(lanes, i, features), rate, angle))
    return joints
