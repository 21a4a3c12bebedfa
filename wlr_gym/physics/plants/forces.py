"""Forces given as formulas: what neither parameters nor named effects express, such as a spring in one leg joint.

A :class:`Force` is a checked formula over :data:`FEATURES` (what the robot does) and named constants, acting on one or more
:data:`COORDINATES`. Every simulator takes ``forces`` when it is made and, once per physics step, hands the quantities
:data:`INPUTS` to the compiled kernel of :func:`compile_forces`, which returns one generalised force per coordinate. It is
held over the step. What a formula may remember, :data:`MEMORY`, the kernel moves on by itself.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from wlr_gym.base.errors import InputError, unknown_name
from wlr_gym.physics.codegen import Graph, Inputs, emit, inputs_of, load_module, ops
from wlr_gym.physics.codegen.expression import (
    Expression,
    Unit,
    evaluate,
    finite_number,
    parse,
    parse_unit,
    renamed,
    symbols,
    unit_of,
)
from wlr_gym.physics.codegen.ops import Lanes, Value
from wlr_gym.physics.plants.base import COORDINATES, INPUTS, MEMORY
from wlr_gym.robot import CORNERS, JOINTS
from wlr_gym.robot.parameter_table import XYZ

Array = NDArray[np.float64]

#: rad; scale of the way on which a joint winds up.
WIND_UP = 0.1


# ---- features --------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Feature:
    """Something a formula may depend on.

    Attributes:
        unit, doc: SI unit; meaning and frame.
        value: from the inputs and a number: the joint's (``joint``), the corner's (``corner``), or none that counts.
        scope: ``joint``: of the joint the force acts on; ``corner``: of the leg with its wheel the force acts on, or of the one
            named at its end (``leg_angle_lf``); ``robot``: of the whole robot.
    """

    unit: str
    doc: str
    value: Callable[[Lanes, int], Value]
    scope: str = "robot"


def _lane(pattern: str, shift: int = 0) -> Callable[[Lanes, int], Value]:
    return lambda lanes, number: lanes[pattern.format(number + shift)]


def _opposite(pattern: str, shift: int = 0) -> Callable[[Lanes, int], Value]:
    """The same at the corner on the other side: left and right corners follow one another."""
    return lambda lanes, corner: lanes[pattern.format((corner ^ 1) + shift)]


def _slip_speed(lanes: Lanes, corner: int) -> Value:
    x, y = (lanes[f"slip_velocity_{corner}_{a}"] for a in "xy")
    return ops.sqrt(x * x + y * y)


def _floor_axis(lanes: Lanes, axis: int) -> tuple[Value, Value, Value]:
    """Row ``axis`` of the rotation matrix, body to floor frame."""
    w, x, y, z = (lanes[f"quaternion_{a}"] for a in "wxyz")
    if axis == 0:
        return 1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)
    if axis == 1:
        return 2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)
    return 2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)


def _floor_velocity(axis: int) -> Callable[[Lanes, int], Value]:
    def value(lanes: Lanes, _: int) -> Value:
        row = _floor_axis(lanes, axis)
        return sum(row[k] * lanes[f"linear_velocity_in_body_{a}"] for k, a in enumerate(XYZ))

    return value


def _roll(lanes: Lanes, _: int) -> Value:
    up = _floor_axis(lanes, 2)
    return ops.arctan2(up[1], up[2])


def _pitch(lanes: Lanes, _: int) -> Value:
    up = _floor_axis(lanes, 2)
    return ops.arctan2(-up[0], ops.sqrt(up[1] * up[1] + up[2] * up[2]))


def _yaw(lanes: Lanes, _: int) -> Value:
    return ops.arctan2(_floor_axis(lanes, 1)[0], _floor_axis(lanes, 0)[0])


FEATURES: dict[str, Feature] = {
    "angle": Feature("rad", "true angle of the joint the force acts on", _lane("joint_position_{}"), "joint"),
    "rate": Feature("rad/s", "its rate, relative to the parent link", _lane("joint_velocity_{}"), "joint"),
    "wind_up": Feature(
        "-",
        f"how far it is wound up since it turned back, -1 to 1: dz = (rate - abs(rate) z) dt / {WIND_UP:g} rad (Dahl)",
        _lane("wind_up_{}"),
        "joint",
    ),
    "motor_torque": Feature(
        "N m", "its motor's torque at the output shaft, before gear friction", _lane("motor_torque_{}"), "joint"
    ),
    "leg_angle": Feature("rad", "true angle of the leg joint; pi/2 = straight down", _lane("joint_position_{}"), "corner"),
    "leg_rate": Feature("rad/s", "its rate, relative to the body", _lane("joint_velocity_{}"), "corner"),
    "leg_torque": Feature("N m", "torque of the leg's motor", _lane("motor_torque_{}"), "corner"),
    "wheel_angle": Feature("rad", "angle of the wheel, relative to its leg", _lane("joint_position_{}", 4), "corner"),
    "wheel_rate": Feature("rad/s", "its rate, relative to its leg", _lane("joint_velocity_{}", 4), "corner"),
    "wheel_torque": Feature("N m", "torque of the wheel's motor", _lane("motor_torque_{}", 4), "corner"),
    "leg_torque_opposite": Feature(
        "N m", "torque of the motor of the leg on the other side", _opposite("motor_torque_{}"), "corner"
    ),
    "wheel_torque_opposite": Feature(
        "N m", "torque of the motor of the wheel on the other side", _opposite("motor_torque_{}", 4), "corner"
    ),
    "normal_force": Feature("N", "of the floor on the wheel", _lane("contact_force_{}_z"), "corner"),
    "slip_velocity_x": Feature(
        "m/s", "of the wheel's contact point over the floor, along the wheel's heading", _lane("slip_velocity_{}_x"), "corner"
    ),
    "slip_velocity_y": Feature("m/s", "the same along its axle (left)", _lane("slip_velocity_{}_y"), "corner"),
    "slip_speed": Feature("m/s", "length of the slip velocity", _slip_speed, "corner"),
    **{
        f"velocity_{a}": Feature("m/s", f"of the body origin, along the body's {a}", _lane(f"linear_velocity_in_body_{a}"))
        for a in XYZ
    },
    "floor_velocity_x": Feature("m/s", "of the body origin, along the floor's x", _floor_velocity(0)),
    "floor_velocity_y": Feature("m/s", "of the body origin, along the floor's y", _floor_velocity(1)),
    **{
        f"{name}_rate": Feature("rad/s", f"body's angular velocity about its own {a}", _lane(f"angular_velocity_in_body_{a}"))
        for name, a in zip(("roll", "pitch", "yaw"), XYZ, strict=True)
    },
    "roll": Feature("rad", "of the body over the floor; right side down positive", _roll),
    "pitch": Feature("rad", "of the body over the floor; nose down positive", _pitch),
    "yaw": Feature("rad", "heading in the floor frame, in (-pi, pi]", _yaw),
    **{f"position_{a}": Feature("m", f"{a} of the body origin in the floor frame", _lane(f"position_{a}")) for a in XYZ},
    "supply_voltage": Feature("V", "at the servos", _lane("supply_voltage")),
    "time": Feature("s", "since the start of the run or episode", _lane("time")),
}


def _full_name(name: str, coordinate: str) -> str | None:
    """Return ``name`` as it stands in a force on ``coordinate``, with its joint or corner; None if it needs one."""
    scope = FEATURES[name].scope
    if scope == "robot":
        return name
    if coordinate not in JOINTS:
        return None
    return f"{name}_{coordinate}" if scope == "joint" else f"{name}_{coordinate.partition('_')[2]}"


#: Every feature by its full name -> (feature, joint or corner).
_PLACED: dict[str, tuple[Feature, int]] = {}
for _name, _feature in FEATURES.items():
    _places = {"joint": JOINTS, "corner": CORNERS, "robot": ("",)}[_feature.scope]
    _PLACED |= {f"{_name}_{place}" if place else _name: (_feature, k) for k, place in enumerate(_places)}

#: Features by the names a formula may use: with their corner, or bare where the force acts on a joint.
_ANYWHERE: dict[str, Unit] = {
    name: parse_unit(feature.unit) for name, (feature, _) in _PLACED.items() if feature.scope != "joint"
}
_BARE: dict[str, Unit] = {name: parse_unit(feature.unit) for name, feature in FEATURES.items()}


# ---- forces ----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Force:
    """A checked formula and where it acts; made by :func:`make_force`.

    Attributes:
        where: coordinates; the same law at each.
        formula: tree over features and parameters.
        parameters: values of its constants, SI.
    """

    where: tuple[str, ...]
    formula: Expression
    parameters: Mapping[str, float]


def make_force(where: Sequence[str], formula: str, parameters: Mapping[str, float], units: Mapping[str, str]) -> Force:
    """Check a formula and return the force.

    Args:
        where: one or more of :data:`COORDINATES`.
        formula: such as ``-k * (leg_angle - a0)``: N m at joints and for body torques, N for forces.
        parameters: values of the formula's constants, in ``units``.
        units: unit of each constant, such as ``{"k": "N m/rad", "a0": "rad"}``; ``-`` is a pure number.

    Raises:
        InputError: an unknown coordinate, name or unit, a formula that is broken or has another unit than a coordinate's, a
            constant without value, unit or use.
    """
    for coordinate in where:
        if coordinate not in COORDINATES:
            raise unknown_name("where", str(coordinate), COORDINATES)
    if not where:
        raise InputError(f"where = []: expected a list of {', '.join(COORDINATES)}")
    tree = parse(formula)
    known = _constant_units(parameters, units)
    _check_constants(parameters, known, tree)
    for coordinate in where:
        _check_unit(tree, known, coordinate, formula)
    return Force(tuple(where), tree, {name: float(value) for name, value in parameters.items()})


def _constant_units(parameters: Mapping[str, float], units: Mapping[str, str]) -> dict[str, Unit]:
    for name in units:
        if name not in parameters:
            raise unknown_name("parameter", str(name), parameters, "units")
    return {name: parse_unit(unit) for name, unit in units.items()}


def _check_constants(parameters: Mapping[str, float], known: Mapping[str, Unit], tree: Expression) -> None:
    used = set(symbols(tree))
    for name, value in parameters.items():
        if name in _PLACED or name in FEATURES:
            raise InputError(f"parameter '{name}': the name of a feature ({_feature_of(name).doc}); choose another")
        if name not in known:
            raise InputError(f"parameter '{name}': its unit is missing; add units: {{{name}: ...}}, such as N m/rad")
        if name not in used:
            raise InputError(f"parameter '{name}' does not occur in the formula")
        if finite_number(value) is None:
            raise InputError(f"parameter {name} = {value!r}: expected a finite number")


def _feature_of(name: str) -> Feature:
    return FEATURES[name] if name in FEATURES else _PLACED[name][0]


def _check_unit(tree: Expression, known: Mapping[str, Unit], coordinate: str, formula: str) -> None:
    for name in symbols(tree):
        if name in FEATURES and name not in known and _full_name(name, coordinate) is None:
            corners = f"; name a corner: {name}_lf" if FEATURES[name].scope == "corner" else ""
            raise InputError(f"formula '{formula}': '{name}' belongs to a joint, and {coordinate} is none{corners}")
    found = unit_of(tree, {**_ANYWHERE, **_BARE, **known})
    expected = parse_unit(COORDINATES[coordinate])
    if found is not None and found != expected:
        raise InputError(f"formula '{formula}' is in {found}; {coordinate} takes {COORDINATES[coordinate]}")


def generalised_forces(forces: Sequence[Force], inputs: Lanes, values: Sequence[Value] | None = None) -> dict[str, Value]:
    """Return the sum of all forces on each coordinate that has one: coordinate -> N or N m.

    Args:
        forces: what acts.
        inputs: :data:`INPUTS` and :data:`MEMORY` as floats, arrays or traced nodes.
        values: constants in the order of :func:`force_values`; None = the forces' own.
    """
    constants = iter(force_values(forces).tolist() if values is None else values)
    total: dict[str, Value] = {}
    for force in forces:
        own = {name: next(constants) for name in force.parameters}
        for coordinate in force.where:
            tree = _placed(force.formula, coordinate)
            known = {name: own[name] if name in own else _value(name, inputs) for name in symbols(tree)}
            push = evaluate(tree, known)
            total[coordinate] = total[coordinate] + push if coordinate in total else push
    return total


def features_read(force: Force, inputs: Lanes) -> dict[str, tuple[str, Value]]:
    """Return what a force depends on, of all its coordinates: full name of the feature -> unit, value."""
    trees = [_placed(force.formula, coordinate) for coordinate in force.where]
    names = dict.fromkeys(name for tree in trees for name in symbols(tree) if name not in force.parameters)
    return {name: (_PLACED[name][0].unit, _value(name, inputs)) for name in names}


def force_values(forces: Sequence[Force]) -> Array:
    """Return the constants of all forces, one after the other, in the order the kernel reads them."""
    return np.array([value for force in forces for value in force.parameters.values()], dtype=np.float64)


def _placed(tree: Expression, coordinate: str) -> Expression:
    bare = {name for name in symbols(tree) if name in FEATURES}
    return renamed(tree, {name: _full_name(name, coordinate) or name for name in bare})


def _value(name: str, inputs: Lanes) -> Value:
    feature, number = _PLACED[name]
    return feature.value(inputs, number)


# ---- the kernel ------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class ForceKernel:
    """Compiled forces.

    Attributes:
        evaluate: numba function ``evaluate(inputs, values, memory, generalised, step)`` on C-ordered matrices of the kernel's
            precision with one column per robot: reads inputs (len(INPUTS), n), constants (len(values), n) and memory
            (len(MEMORY), n), writes all of generalised (len(COORDINATES), n), zero where nothing acts, and moves memory on by
            step (s): the time, and the wind-up of joints whose formula asks for it. Same bits for every n.
        values: the constants' nominal values (V,); a simulator repeats them for its robots.
        module: name of the module that holds ``evaluate``, for generated code that imports it.
    """

    evaluate: Callable[[Array, Array, Array, Array, float], None]
    values: Array
    module: str


def compile_forces(forces: Sequence[Force], precision: str = "float64") -> ForceKernel:
    """Compile the forces (first use: below a second; then from the cache). Constants are data: other values, same code."""
    module = load_module(f"forces_{precision}", force_source(forces, precision))
    return ForceKernel(module.evaluate, force_values(forces), module.__name__)


def force_source(forces: Sequence[Force], precision: str) -> str:
    """Return the kernel's source. Only numbers and operations of the checked trees reach it, never the user's text."""
    owner = Graph()
    count = len(force_values(forces))
    found = generalised_forces(forces, Inputs(owner), [owner.input(f"value_{n}") for n in range(count)])
    row = {name: f"inputs[{k}, k]" for k, name in enumerate(INPUTS)}
    row |= {f"value_{n}": f"values[{n}, k]" for n in range(count)} | {name: f"memory[{m}, k]" for m, name in enumerate(MEMORY)}
    place = {name: k for k, name in enumerate(COORDINATES)}
    body = emit(
        {name: found.get(name, 0.0) for name in COORDINATES},
        row.__getitem__,
        lambda name, text: f"generalised[{place[name]}, k] = {text}",
        " " * 8,
        lambda value: f"F({value!r})",
        fused=True,
    )
    read = inputs_of(found.values())
    for j in (j for j in range(8) if f"wind_up_{j}" in read):
        wound = row[f"wind_up_{j}"]
        body += [
            f"        way = {row[f'joint_velocity_{j}']} * (step / F({WIND_UP!r}))",
            f"        {wound} += way - abs(way) * {wound}",
        ]
    body.append(f"        {row['time']} += step")
    head = ["@compiled(error_model='numpy')", "def evaluate(inputs, values, memory, generalised, step):"]
    return "\n".join([f"F = np.{precision}", "", *head, "    for k in range(inputs.shape[1]):", *body, ""])
