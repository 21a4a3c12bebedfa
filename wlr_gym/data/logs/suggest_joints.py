"""Propose units, signs and zeros of joints, from names, types and what the numbers do."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import partial

import numpy as np
from numpy.typing import NDArray

from wlr_gym.data.check import integral
from wlr_gym.data.logs.map import FACTORS, effort_range, factor, units_of
from wlr_gym.data.logs.names import words
from wlr_gym.data.logs.signals import (
    GUESS,
    LIKELY,
    SURE,
    BodyMotion,
    Likeness,
    LogSignals,
    common_grid,
    likeness,
    over_windows,
    unit_of,
)
from wlr_gym.robot import JOINTS, LEGS, WHEELS
from wlr_gym.robot.parameters import Parameters

Array = NDArray[np.float64]

_ANGLES = FACTORS["rad"]
#: Units that setpoints and rates are likely to be in.
_ANGLE_UNITS = {unit: _ANGLES[unit] for unit in ("rad", "deg", "count")}
_RATE_UNITS = {unit: FACTORS["rad/s"][unit] for unit in ("rad/s", "deg/s", "rpm", "count")}
#: rad; angles whose steps nearly reach one of these start anew after it.
_LARGEST_ANGLE = 2.2 * np.pi
#: Correlation from which on a comparison decides.
_CLEAR = 0.8


@dataclass
class JointFindings:
    """What was found: column -> unit and sign, joint -> sign and zero (rad), and the wheels that roll as the body moves."""

    unit: dict[str, str] = field(default_factory=dict)
    sign: dict[str, int] = field(default_factory=dict)
    joint_sign: dict[str, int] = field(default_factory=dict)
    joint_zero: dict[str, float] = field(default_factory=dict)
    rolled: set[str] = field(default_factory=set)


def find_joints(look: LogSignals, motion: BodyMotion | None) -> JointFindings:
    """Return units, signs and zeros of all joint columns that have a field; the reasons go into ``look``."""
    found = JointFindings()
    for joint in filter(partial(is_given, look), JOINTS):
        found.joint_sign[joint], found.joint_zero[joint] = look.given.joints[joint].sign, look.given.joints[joint].zero
    for joint in JOINTS:
        if look.has(f"pos_{joint}"):
            found.unit[f"pos_{joint}"] = _angle_unit(look, f"pos_{joint}")
    if motion is not None:
        _wheels_against_body(look, found, motion)
    for joint in JOINTS:
        _rate(look, found, joint)
    for leg in LEGS:
        _leg_zero(look, found, leg)
    if motion is not None:
        _legs_against_body(look, found, motion)
    for joint in JOINTS:
        _setpoint(look, found, joint)
        _effort(look, found, joint)
    _say(look, found)
    return found


def is_given(look: LogSignals, joint: str) -> bool:
    """Whether the user's map says a joint's sign or zero."""
    return joint in look.given.joints and bool({"sign", "zero"} & look.given.joints[joint].model_fields_set)


def angle(look: LogSignals, found: JointFindings, joint: str) -> tuple[Array, Array]:
    """Return times and angle (rad) of a joint by what was found so far, its sign included, its zero not."""
    column = f"pos_{joint}"
    t, raw = look.raw(column)
    values = raw * _ANGLES[found.unit[column]]
    if np.ptp(values) < _LARGEST_ANGLE and (np.abs(np.diff(values)) > 1.8 * np.pi).any():
        values = np.unwrap(values)
    return t, values * found.joint_sign.get(joint, 1)


# ---- positions -------------------------------------------------------------------------------------------------------


def _angle_unit(look: LogSignals, column: str) -> str:
    """Return the unit by name, else by magnitude: a leg's angle is within a turn; a wheel turns less than 9 rad/s."""
    hint = look.chosen[column].unit
    if hint is not None and hint in _ANGLES:
        return hint
    t, raw = look.raw(column)
    whole = bool(np.all(raw == np.round(raw))) and np.ptp(raw) > 20.0
    if column.removeprefix("pos_") in LEGS:
        largest = float(np.quantile(np.abs(raw), 0.95))
        return "rad" if largest < 2.0 * np.pi else "count" if whole and largest > 400.0 else "deg"
    size = float(np.quantile(np.abs(np.diff(raw) / np.diff(t)), 0.9))
    return "rad" if size < 12.0 else "count" if whole and size > 520.0 else "deg" if size < 520.0 else "count"


def _wheels_against_body(look: LogSignals, found: JointFindings, motion: BodyMotion) -> None:
    """Set unit and sign of wheels by how far they should have rolled."""
    nominal = Parameters.nominal(look.robot)
    radius, half_track = nominal["wheel.radius"][0], nominal["hip.position"][0, 1]
    for k, wheel in enumerate(WHEELS):
        column = f"pos_{wheel}"
        if column not in look.chosen:
            continue
        t, angle_raw = angle(look, found, wheel)
        grid = common_grid(t, motion.t)
        side = 1.0 if wheel.endswith(("lf", "lr")) else -1.0
        turn = over_windows(motion.t, motion.heading, grid)
        expected = (over_windows(motion.t, motion.forward, grid) - side * half_track * turn) / radius[k]
        same = likeness(over_windows(t, angle_raw, grid), expected)
        if same is None or abs(same.correlation) < _CLEAR:
            continue
        found.rolled.add(wheel)
        if not is_given(look, wheel):
            found.joint_sign[wheel] = int(np.sign(same.ratio)) * found.joint_sign.get(wheel, 1)
        if look.chosen[column].unit is None:
            units = {unit: factor / _ANGLES[found.unit[column]] for unit, factor in _ANGLES.items() if unit != "turn"}
            found.unit[column], _ = unit_of(same.ratio, units)


def _leg_zero(look: LogSignals, found: JointFindings, leg: str) -> None:
    """Set sign and zero so that the leg stands about where it stands at home, straight down: quarter turns only.

    A sign that the user gives stays, and has its zero.
    """
    column = f"pos_{leg}"
    given = look.given.joints[leg].model_fields_set if leg in look.given.joints else set[str]()
    if column not in look.chosen or "zero" in given:
        return
    known = found.joint_sign.get(leg, 1)
    values = known * angle(look, found, leg)[1]
    middle, (low, high) = float(np.median(values)), look.robot.leg_limits
    best = None
    for sign in (known,) if "sign" in given else (1, -1):
        for quarter in range(-4, 5):
            zero = quarter * np.pi / 2
            moved = sign * (values - zero)
            inside = float(((moved > low) & (moved < high)).mean())
            cost = abs(sign * (middle - zero) - look.robot.home.leg_angle) + 3.0 * (1.0 - inside) + 0.2 * (sign < 0)
            cost += 0.01 * abs(quarter)
            if best is None or cost < best[0] - 1e-9:
                best = (cost, sign, zero)
    assert best is not None
    if best[1] < 0:
        found.joint_sign[leg] = -1
    if best[2] != 0.0:
        found.joint_zero[leg] = best[2]


def _legs_against_body(look: LogSignals, found: JointFindings, motion: BodyMotion) -> None:
    """Set the sign of legs by how the body moves when they swing: it goes forward as they turn back under it."""
    if not look.has(*(f"pos_{joint}" for joint in JOINTS)) or any(is_given(look, leg) for leg in LEGS):
        return
    radius = float(Parameters.nominal(look.robot)["wheel.radius"][0, 0])
    tracks = [angle(look, found, joint) for joint in JOINTS]
    grid = common_grid(motion.t, *(t for t, _ in tracks))
    moved = np.stack([over_windows(t, values, grid) for t, values in tracks], axis=1)
    legs, wheels = moved[:, : len(LEGS)], moved[:, len(LEGS) :]
    rest = over_windows(motion.t, motion.forward, grid) - radius * wheels.mean(axis=1)
    for k, leg in enumerate(LEGS):
        swinging = np.abs(legs[:, k]) > 0.1
        if swinging.sum() < 20:
            continue
        slope, *_ = np.linalg.lstsq(legs[swinging], rest[swinging], rcond=1e-3)
        explained = likeness(rest[swinging], legs[swinging] @ slope)
        if slope[k] < -0.01 and explained is not None and explained.correlation > _CLEAR:
            _mirror(found, leg, look)


def _mirror(found: JointFindings, leg: str, look: LogSignals) -> None:
    """Turn a leg's sign; straight down stays straight down: -s (x - z') = 2 down - s (x - z)."""
    sign = found.joint_sign.get(leg, 1)
    found.joint_sign[leg] = -sign
    zero = found.joint_zero.pop(leg, 0.0) + 2.0 * sign * look.robot.home.leg_angle
    if abs(zero) >= 1e-9:
        found.joint_zero[leg] = float(zero)


# ---- rates, setpoints, efforts ---------------------------------------------------------------------------------------


def _rate(look: LogSignals, found: JointFindings, joint: str) -> None:
    column = f"vel_{joint}"
    if look.has(column):
        of_same_kind = {"deg": "deg/s", "count": "count"}.get(found.unit.get(f"pos_{joint}", "rad"), "rad/s")
        _decide(look, found, column, _rate_against_angle(look, found, joint, column), _RATE_UNITS, of_same_kind)


def _decide(
    look: LogSignals, found: JointFindings, column: str, same: Likeness | None, units: Mapping[str, float], default: str
) -> None:
    """Set a column's unit: that of its name, else by how it goes with the joint's angle, else the default; and its sign."""
    hint, clear = look.chosen[column].unit, same is not None and abs(same.correlation) > _CLEAR
    if hint is not None and hint in units:
        found.unit[column] = hint
    else:
        found.unit[column] = unit_of(same.ratio, units)[0] if same is not None and clear else default
    if same is not None and same.correlation < -_CLEAR:
        found.sign[column] = -1


def _rate_against_angle(look: LogSignals, found: JointFindings, joint: str, column: str) -> Likeness | None:
    """Return how a raw rate goes with its angle (rad), the joint's sign taken out."""
    if not look.has(f"pos_{joint}"):
        return None
    t, values = angle(look, found, joint)
    at, rate = look.raw(column)
    if len(at) < 20:
        return None
    grid = common_grid(t, at)
    sign = found.joint_sign.get(joint, 1)
    return likeness(over_windows(at, integral(at, rate), grid), sign * over_windows(t, values, grid))


def _setpoint(look: LogSignals, found: JointFindings, joint: str) -> None:
    column = f"cmd_{joint}"
    if not look.has(column):
        return
    if joint in WHEELS:
        same, default = _rate_against_angle(look, found, joint, column), found.unit.get(f"vel_{joint}", "rad/s")
        _decide(look, found, column, same, _RATE_UNITS, default)
    else:
        same, default = _against_position(look, found, joint, column), found.unit.get(f"pos_{joint}", "rad")
        _decide(look, found, column, same, _ANGLE_UNITS, default)


def _against_position(look: LogSignals, found: JointFindings, leg: str, column: str) -> Likeness | None:
    """Return how a raw setpoint varies with its leg's angle (rad), the joint's sign taken out."""
    if not look.has(f"pos_{leg}"):
        return None
    t, values = angle(look, found, leg)
    at, raw = look.raw(column)
    if len(at) < 2 or np.ptp(values) < 0.05:
        return None
    grid = np.arange(max(t[0], at[0]), min(t[-1], at[-1]), 0.05)
    held = raw[np.clip(np.searchsorted(at, grid, side="right") - 1, 0, len(at) - 1)]
    measured = np.interp(grid, t, values) * found.joint_sign.get(leg, 1)
    return likeness(held - held.mean(), measured - measured.mean())


def _effort(look: LogSignals, found: JointFindings, joint: str) -> None:
    column = f"eff_{joint}"
    if not look.has(column):
        return
    t, raw = look.raw(column)
    if len(t) < 2 or np.ptp(raw) == 0.0:
        del look.chosen[column]  # drivers that know no effort send zeros
        return
    hint = look.chosen[column].unit
    found.unit[column] = hint if hint is not None and hint in units_of(column) else _torque_unit(look, column, raw)


def _torque_unit(look: LogSignals, column: str, raw: Array) -> str:
    """Return the unit by magnitude: of N m and A there are at most what the motor has, of mA and counts many."""
    field = look.chosen[column].field
    stall, _ = effort_range(column, look.robot)
    constant = factor(column, "A", look.robot, look.log.name)
    size = float(np.quantile(np.abs(raw), 0.95))
    whole = bool(np.all(raw == np.round(raw)))
    if whole and field.startswith("dynamixel_state"):
        return "count"
    if "current" in words(field):
        return "A" if size * constant < 1.5 * stall and not whole else "mA"
    if size < 1.5 * stall:
        return "N m"
    return "mA" if 1e-3 * size * constant < stall else "mN m"


# ---- what is said ----------------------------------------------------------------------------------------------------


def _say(look: LogSignals, found: JointFindings) -> None:
    for kind, what in (("pos", "angle"), ("vel", "rate"), ("cmd", "setpoint"), ("eff", "effort")):
        for part, joints in (("leg", LEGS), ("wheel", WHEELS)):
            columns = [f"{kind}_{joint}" for joint in joints if look.has(f"{kind}_{joint}")]
            if columns:
                _say_group(look, found, f"{kind}_{part}", columns, what)
    for joint in JOINTS:
        if joint in found.joint_zero or found.joint_sign.get(joint, 1) < 0:
            zero, sign = found.joint_zero.get(joint, 0.0), found.joint_sign.get(joint, 1)
            sure = LIKELY if joint in WHEELS else GUESS
            why = "rolls against the body's motion" if joint in WHEELS else "so it stands about straight down, as at home"
            look.note(f"joints.{joint}", sure, f"sign {sign:+d}, zero at {zero:.4f} rad: {why}")


def _say_group(look: LogSignals, found: JointFindings, name: str, columns: list[str], what: str) -> None:
    units = {found.unit[column] for column in columns}
    places = sorted({look.chosen[column].topic for column in columns})
    if len(units) > 1:
        each = ", ".join(f"{look.chosen[column].field} in {found.unit[column]}" for column in columns)
        look.note(name, GUESS, f"mixed units in topic '{places[0]}': {each}: check them")
        return
    (unit,) = units
    named = all(look.chosen[column].unit == unit for column in columns)
    by = "by its name" if named else _by(found, name, what, unit)
    sure = SURE if named or unit in ("rad", "rad/s", "deg", "deg/s", "rpm") else LIKELY
    sure = LIKELY if not named and (what == "effort" or (name == "pos_wheel" and not found.rolled)) else sure
    sure = GUESS if not named and unit in ("mA", "mN m") else sure
    count = f"{len(columns)} of 4 joints; " if len(columns) < 4 else ""
    look.note(name, sure, f"{count}topic '{', '.join(places)}', in {unit}, {by}")


def _by(found: JointFindings, name: str, what: str, unit: str) -> str:
    """Return what showed the unit of a group."""
    if name == "pos_wheel" and not found.rolled:
        return "by how fast a wheel can turn"
    if name == "pos_leg":
        return "by how large they are"
    if what == "effort" and unit != "N m":
        return "by how large they are and by names: mA, mN m or another unit? state it in the map if you know it"
    return f"by how {what}s go with the others" if unit not in ("rad", "rad/s", "N m") else "as usual"
