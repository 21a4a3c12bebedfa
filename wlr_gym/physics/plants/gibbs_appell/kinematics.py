"""The engine's lanes by name: what a step keeps, reads and shows.

Every function of the step maps lanes (state, parameters, inputs; each a scalar) to new lanes.
"""

from __future__ import annotations

import math

from wlr_gym.physics.codegen.ops import Lanes, Value
from wlr_gym.physics.plants import body, drive
from wlr_gym.physics.plants.base import COORDINATES
from wlr_gym.physics.plants.base import INPUTS as INPUTS_OF_FORMULAS
from wlr_gym.physics.plants.contacts import AXES, CONTACTS, CORNERS

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
    *(f"place{c}" for c in CONTACTS),
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
#: Of these the last, those of body and legs on the floor, are only looked at where they are near it.
STORED: tuple[str, ...] = STATE + RESULTS + body.SPOT_STATE
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


# ---- joints ----------------------------------------------------------------------------------------------------------


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
