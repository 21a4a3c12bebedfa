"""Trace the step into numba kernels over tiles of robots: robots innermost, one flat scratch array, no branches.

A tile holds ``width`` robots side by side (8 float64 or 16 float32 lanes fill a vector register; 1 for a single robot). The
arithmetic is strict IEEE with explicit fused multiply-adds, so a robot's result does not depend on the tile width, on the
robots beside it, or on the number of threads.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping
from functools import cache
from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wlr_gym.physics import servo
from wlr_gym.physics.codegen import (
    Graph,
    Inputs,
    Node,
    compilation,
    emit,
    hoist,
    inputs_of,
    load_module,
    ops,
    source_of,
    straight_line_source,
)
from wlr_gym.physics.model import equations
from wlr_gym.physics.model.dynamics import inertial_constants
from wlr_gym.physics.plants import body, contacts, drive, ground, relief
from wlr_gym.physics.plants.base import TRUTH_LAYOUT
from wlr_gym.physics.plants.gibbs_appell import gauss, kinematics
from wlr_gym.physics.plants.gibbs_appell import step as substep
from wlr_gym.physics.plants.gibbs_appell.kinematics import (
    ASSEMBLY,
    FORMULA_INPUTS,
    FORMULA_OUTPUTS,
    INPUTS,
    PLATFORM,
    SINGLE,
    STORED,
    TICK_SUMS,
    TURN,
)
from wlr_gym.physics.plants.sensors import RAW_LAYOUT
from wlr_gym.robot import FIRST_WHEEL, LEG_SLICE, WHEEL_SLICE, Robot
from wlr_gym.robot.parameters import Parameters

Array = NDArray[np.float64]

# ---- the parameter table as numbers that the kernel reads: once per change, float64, before any cast -----------------


_CORNER_LANES = (*ASSEMBLY, "length", "radius", "zero_offset", "stiffness", "damping", "look_ahead", "rolling")
#: Names of the kernel's parameter lanes, in storage order.
PARAMETER_LANES: tuple[str, ...] = (
    *PLATFORM,
    *ground.BODY_LANES,
    *(f"{name}{i}" for name in _CORNER_LANES for i in range(4)),
    *drive.DRIVE_LANES,
    *ground.GROUND_LANES,
    *relief.RELIEF_LANES,
)


def pack(parameters: Parameters, robot: Robot, step: float) -> Array:
    """Return the kernel's parameter lanes, shape (N, len(PARAMETER_LANES)).

    ``step`` (s) is needed for the exponentially fitted damping weights, the impulse bounds of gear friction and the
    sensors' low-pass.
    """
    inertia = inertial_constants(parameters)
    moved = [inertia["armature_leg"] + inertia["second_moment"] + inertia["leg_iyy"]]
    moved += [inertia["armature_wheel"] + inertia["wheel_spin"]]
    armature = drive.joint_armature(parameters)
    inertia["armature_leg"], inertia["armature_wheel"] = armature[:, LEG_SLICE], armature[:, WHEEL_SLICE]
    corners = {name: inertia[name] for name in ASSEMBLY} | {
        "length": parameters["leg.length"],
        "radius": parameters["wheel.radius"],
        "zero_offset": parameters["joint.zero_offset"],
        "stiffness": parameters["ground.normal_stiffness"],
        "damping": parameters["ground.normal_damping"],
        "look_ahead": damper_look_ahead(parameters, step),
        "rolling": parameters["ground.rolling_resistance"],
    }
    lanes = (
        {"platform_mass": inertia["platform_mass"]}
        | ground.by_column("platform_moment_", "xyz", inertia["platform_first_moment"])
        | ground.by_column("platform_inertia_", ("xx", "yy", "zz", "xy", "xz", "yz"), inertia["platform_inertia"])
        | ground.pack_body(parameters, robot, step)
        | drive.pack(parameters, robot, step, np.hstack(moved))
        | ground.pack(parameters)
        | relief.pack(parameters, robot)
    )
    lanes |= {f"{name}{i}": corners[name][:, i] for name in _CORNER_LANES for i in range(4)}
    return np.stack([lanes[name] for name in PARAMETER_LANES], axis=1)


def damper_look_ahead(parameters: Parameters, step: float) -> Array:
    """How far the contact damper's rate is extrapolated, in steps, shape (N, 4).

    Half a step makes it second order, but an extrapolated damper is unstable at step * damping / mass = 1. So it fades to
    none between 0.3 and 0.6, where the lightest mass that a wheel's damper can act on alone is the pitching platform's.
    """
    mass = parameters["body.mass"][:, None] / 12.0
    stiffness_ratio = step * parameters["ground.normal_damping"] / mass
    return 0.5 * np.clip(2.0 - stiffness_ratio / 0.3, 0.0, 1.0)


# ---- tracing ---------------------------------------------------------------------------------------------------------


WIDTH = {"float64": 8, "float32": 16}

_FIXED = frozenset(INPUTS + PARAMETER_LANES + ("step",))


def trace(features: frozenset[str], precision: str) -> dict[str, dict[str, Any]]:
    """Trace all blocks: name -> outputs. ``prepare`` holds what depends on parameters and inputs alone."""
    if precision == "float32":
        features |= {SINGLE}
    owner = Graph()
    lanes = Inputs(owner)
    step, time = owner.input("step"), owner.input("time")
    setup = gauss.kick_setup(lanes, time, step, features)
    known = {name: value for name, value in setup.items() if _is_known(value) and name not in STORED}
    inner = Inputs(owner, known)
    blocks = {
        "setup": {name: value for name, value in setup.items() if name not in known},
        "sweep": gauss.kick_sweep(inner, features),
        **({"sweep_pairs": gauss.kick_sweep(inner, features, pairs=True)} if "piece" in features else {}),
        "finish": substep.kick_finish(inner, step, features),
    }
    prepare: dict[str, Any] = {}
    for name in blocks:
        blocks[name], hoisted = hoist(blocks[name], _FIXED.__contains__, f"{name}_constant")
        prepare |= hoisted
    blocks["setup"] = _without_unread(blocks["setup"], *(blocks[name] for name in blocks if name != "setup"))
    if "forces" in features:
        blocks["sense"] = substep.sense(lanes, step, features)
    if "piece" in features:
        blocks["push_of_piece"] = body.push_of_piece(lanes)
    return {
        "prepare": prepare,
        "drift": substep.drift(lanes, owner.input("duration"), features),
        **blocks,
        "nearness": body.nearness(lanes, features),
        "push_of_base": body.push_of_base(lanes, features),
        "touch": substep.touch(inner, step, features),
        "observe": substep.observe(lanes, step, features),
    }


def _is_known(value: Any) -> bool:
    """Tell whether a value is a plain number or a parameter, which the other blocks can read where it is."""
    return not isinstance(value, Node) or (value.op == "input" and value.operands[0] in _FIXED)


def _without_unread(outputs: dict[str, Any], *readers: dict[str, Any]) -> dict[str, Any]:
    read = {name for block in readers for name in inputs_of(block.values())}
    return {name: value for name, value in outputs.items() if name in read or name in STORED}


@cache
def outputs() -> tuple[str, ...]:
    """Return the names of what is shown of a state, in storage order."""
    return tuple(substep.observe(Inputs(Graph()), 1.0, frozenset()))


_SCALARS = ("step", "time", "duration")
#: Lanes of the one piece that pushes body and legs.
_OF_PIECE = frozenset((*body.PIECE_LANES, "near_piece"))


def kernel_source(features: frozenset[str], precision: str, width: int) -> str:
    """Return the module of the step's blocks for one set of effect families, precision and tile width, and its driver.

    With formula forces the driver is a module of its own (:func:`driver_source`): a new formula leaves the blocks as they are.
    """
    blocks = trace(features, precision)
    start = _places(blocks, width)

    def load(name: str) -> str:
        if name in _OF_PIECE:  # lanes of pieces lie side by side
            return f"w[{start[f'{name}0']} + piece * {width} + k]"
        return name if name in _SCALARS else f"w[{start[name]} + k]"

    def constant(value: float) -> str:
        return f"F({value!r})" if precision == "float32" else (repr(value) if value >= 0 else f"({value!r})")

    lines = [f"F = np.{precision}", ""]
    for block, results in blocks.items():
        used = inputs_of(results.values())
        scalars = [name for name in _SCALARS if name in used] + ["piece"] * (not used.isdisjoint(_OF_PIECE))
        text = emit(results, load, lambda name, text: f"w[{start[name]} + k] = {text}", "", constant, fused=True, compact=True)
        lines += [
            *straight_line_source(f"{block}_of_robot", ["w", "k", *scalars], text),
            "",
            _DECORATOR,
            f"def {block}({', '.join(['W', *scalars])}):",
            "    whole_registers()",
            "    w = numbers_of(W)",
            f"    for k in range({width}):",
            f"        {block}_of_robot({', '.join(['w', 'k', *scalars])})",
            "",
        ]
    return "\n".join(lines) + ("" if "forces" in features else _driver(start, width, precision, "piece" in features))


def driver_source(features: frozenset[str], precision: str, width: int, blocks: str, formulas: str) -> str:
    """Return the driver module that steps the blocks of module ``blocks`` under the formula forces of module ``formulas``."""
    traced = trace(features, precision)
    imports = f"from {blocks} import {', '.join(traced)}\nfrom {formulas} import evaluate\nF = np.{precision}\n"
    return imports + _driver(_places(traced, width), width, precision, "piece" in features, _APPLY_FORMULAS)


def _places(blocks: Mapping[str, Mapping[str, Any]], width: int) -> dict[str, int]:
    """Where each lane starts in the flat scratch array."""
    formula = (*FORMULA_INPUTS, *FORMULA_OUTPUTS) if "sense" in blocks else ()
    touching = (*blocks["nearness"], *body.PUSHES)
    names = dict.fromkeys(
        [*STORED, *INPUTS, *PARAMETER_LANES, *blocks["prepare"], *blocks["setup"], *outputs(), *formula, *touching]
    )
    return {name: index * width for index, name in enumerate(names)}


def _driver(start: Mapping[str, int], width: int, precision: str, has_pairs: bool, apply_formulas: str = "") -> str:
    values = {
        "width": width,
        "scratch": len(start) * width,
        "stored": len(STORED) * width,
        "kept": start[body.SPOT_STATE[0]],
        "near": start["near"],
        "near_base": start["near_base"],
        "near_piece": start.get("near_piece0"),
        "pieces": sum(name.startswith("near_piece") for name in start),
        "pushes": start[body.PUSHES[0]],
        "push_count": len(body.PUSHES) * width,
        "inputs": start[INPUTS[0]],
        "parameters": start[PARAMETER_LANES[0]],
        "parameter_count": len(PARAMETER_LANES) * width,
        "truth": start[outputs()[0]],
        "truth_count": TRUTH_LAYOUT.width,
        "raw": start[outputs()[TRUTH_LAYOUT.width]],
        "raw_count": RAW_LAYOUT.width - 1,
        "cosine": start["heading_cosine"],
        "sine": start["heading_sine"],
        "sums": start[TICK_SUMS[0]],
        "sum_count": len(TICK_SUMS) * width,
        "decorator": _DECORATOR,
        "sensed": start.get(FORMULA_INPUTS[0]),
        "sensed_count": len(FORMULA_INPUTS),
        "formula": start.get(FORMULA_OUTPUTS[0]),
        "formula_count": len(FORMULA_OUTPUTS),
        "wheel_angle": start["wheel_angle0"],
        "wheel_reference": start[f"reference_position{FIRST_WHEEL}"],
        "turns": start["turns0"],
        "zero_angle": start["zero_angle0"],
        "zero_rest": start["zero_rest0"],
        "rounding": start["rounding_px"],
        "wheel_column": TRUTH_LAYOUT.slices["joint_position"].start + FIRST_WHEEL,
        "raw_wheel_column": RAW_LAYOUT.slices["joint_position"].start + FIRST_WHEEL,
        "raw_pose": RAW_LAYOUT.slices["pose"].start,
        "turn": TURN,
        "second_normal": start["normal4"],
    }
    single = precision == "float32"
    parts = {
        "apply_formulas": apply_formulas.format(**values),
        "unwrap": _UNWRAP.format(**values) if single else "",
        "push_of_pieces": _PUSH_OF_PIECES.format(**values) if has_pairs else "",
        "sweeping": (_SWEEP_PAIRS if has_pairs else _SWEEP).format(**values),
        "count_anew": _COUNT_ANEW.format(**values) if single else "",
    }
    return _DRIVER.format(**values, **parts)


#: Arrays are copied by loops: numba's slice assignment takes four times as long.
_DECORATOR = "@compiled(error_model='numpy')"
_APPLY_FORMULAS = """
            sense(W)
            seen = W[{sensed} : {sensed} + {sensed_count} * {width}].reshape({sensed_count}, {width})
            pushes = W[{formula} : {formula} + {formula_count} * {width}].reshape({formula_count}, {width})
            evaluate(seen, formula_values[tile], memory[tile], pushes, step)"""
_SWEEP = """
            for _ in range(sweeps):
                sweep(W)"""
#: Where no robot of the tile touches at a second contact of any wheel, the passes leave these out.
_SWEEP_PAIRS = """
            touched = F(0.0)
            for at in range(4 * {width}):
                touched = max(touched, W[{second_normal} + at])
            for _ in range(sweeps):
                if touched > F(0.0):
                    sweep_pairs(W)
                else:
                    sweep(W)"""
#: The pieces that a robot of the tile is near push it.
_PUSH_OF_PIECES = """
                for piece in range({pieces}):
                    if largest(W, {near_piece} + piece * {width}) > F(0.0):
                        push_of_piece(W, piece)"""
#: Single precision: the shown wheel angles and place, put together in double precision.
_UNWRAP = """
        for i in range(4):
            at = i * {width} + k
            angle = np.float64(W[{zero_angle} + at]) + np.float64(W[{zero_rest} + at]) + np.float64(W[{wheel_angle} + at])
            angle += {turn!r} * np.float64(W[{turns} + at])
            TRUTH[row, {wheel_column} + i] = angle
            RAW[row, {raw_wheel_column} + i] = angle
        for i in range(2):
            place = TRUTH[row, i] - np.float64(W[{rounding} + i * {width} + k])
            TRUTH[row, i] = place
            RAW[row, {raw_pose} + i] = place"""
#: Single precision: wheel angles, and the servos' references with them, count from where the wheels stand after each tick.
_COUNT_ANEW = """
        for at in range(4 * {width}):
            moved = W[{wheel_angle} + at]
            angle = np.float64(W[{zero_angle} + at]) + np.float64(W[{zero_rest} + at]) + np.float64(moved)
            turned = np.rint(angle / {turn!r})
            angle -= turned * {turn!r}
            W[{zero_angle} + at] = angle
            W[{zero_rest} + at] = angle - np.float64(W[{zero_angle} + at])
            W[{turns} + at] += F(turned)
            W[{wheel_angle} + at] = F(0.0)
            W[{wheel_reference} + at] -= moved"""
_DRIVER = """
{decorator}
def copy(source, target):
    for i in range(len(target)):
        target[i] = source[i]


{decorator}
def largest(W, start):
    found = W[start]
    for at in range(start + 1, start + {width}):
        found = max(found, W[at])
    return found


{decorator}
def scatter(W, TRUTH, RAW, tile, count):
    truth = W[{truth} : {truth} + {truth_count} * {width}].reshape({truth_count}, {width})
    raw = W[{raw} : {raw} + {raw_count} * {width}].reshape({raw_count}, {width})
    for k in range(min({width}, count - tile * {width})):
        row = tile * {width} + k
        to_truth, to_raw = TRUTH[row], RAW[row]
        for c in range({truth_count}):
            to_truth[c] = truth[c, k]
        for c in range({raw_count}):
            to_raw[c] = raw[c, k]
        to_raw[{raw_count}] = math.atan2(W[{sine} + k], W[{cosine} + k]){unwrap}


{decorator}
def tick(
    X, P, setpoints, old_setpoints, switch_time, on, formula_values, memory, TRUTH, RAW, first, last, count, step,
    substeps, sweeps
):
    whole_registers()
    W = np.zeros({scratch}, F)
    stored, parameters = W[:{kept}], W[{parameters} : {parameters} + {parameter_count}]
    half = F(0.5) * step
    for tile in range(first, last):
        copy(X[tile], stored)
        copy(P[tile], parameters)
        W[{sums}:{sums} + {sum_count}] = F(0.0)
        for k in range({width}):
            row = min(tile * {width} + k, count - 1)
            for j in range(8):
                W[{inputs} + j * {width} + k] = setpoints[row, j]
                W[{inputs} + (8 + j) * {width} + k] = old_setpoints[row, j]
                W[{inputs} + (16 + j) * {width} + k] = switch_time[row, j]
                W[{inputs} + (24 + j) * {width} + k] = on[row, j]
        prepare(W, step)
        drift(W, half)
        has_been_near = False
        for s in range(substeps):{apply_formulas}
            setup(W, step, (F(s) + F(0.5)) * step)
            nearness(W)
            if largest(W, {near}) > F(0.0):
                if not has_been_near:
                    copy(X[tile, {kept}:], W[{kept}:{stored}])
                    has_been_near = True
                W[{pushes}:{pushes} + {push_count}] = F(0.0)
                if largest(W, {near_base}) > F(0.0):
                    push_of_base(W){push_of_pieces}
                touch(W, step){sweeping}
            finish(W, step)
            drift(W, step if s + 1 < substeps else half){count_anew}
        observe(W, step)
        scatter(W, TRUTH, RAW, tile, count)
        copy(stored, X[tile, :{kept}])
        if has_been_near:
            copy(W[{kept}:{stored}], X[tile, {kept}:])


{decorator}
def look(X, P, TRUTH, RAW, tiles, count, step):
    whole_registers()
    W = np.zeros({scratch}, F)
    for tile in tiles:
        copy(X[tile], W[:{stored}])
        copy(P[tile], W[{parameters} : {parameters} + {parameter_count}])
        observe(W, step)
        scatter(W, TRUTH, RAW, tile, count)
"""


def load_kernel(features: frozenset[str], precision: str, width: int, formulas: str | None = None) -> ModuleType:
    """Load (first use: generate and compile) the kernel module for a set of effect families.

    Args:
        features: families; holds ``forces`` exactly when there are formulas.
        precision: ``float64`` or ``float32``.
        width: robots side by side.
        formulas: name of the module of compiled formula forces (``wlr_gym.physics.plants.forces``).
    """
    tag = "_".join(["gibbs_appell", precision, str(width), *sorted(features)])
    message = (
        f"wlr_gym: compiling the Gibbs-Appell engine ({precision}, robots at once: {width}); some seconds, once on this machine"
    )
    blocks = load_module(tag, lambda: kernel_source(features, precision, width), message, _SOURCE_KEY)
    if formulas is None:
        return blocks
    names = (blocks.__name__, formulas)
    return load_module(
        f"{tag}_driver", lambda: driver_source(features, precision, width, *names), key="\0".join([_SOURCE_KEY, *names])
    )


#: What the kernels are traced from. numba itself notices only that the generated file has changed.
TRACED = (
    substep, gauss, kinematics, equations, servo, drive, contacts, ground, relief, body, ops, compilation, sys.modules[__name__]
)  # fmt: skip
_SOURCE_KEY = "\0".join(
    [source_of(*TRACED), *PARAMETER_LANES, *FORMULA_INPUTS, *FORMULA_OUTPUTS, f"{TRUTH_LAYOUT.width} {RAW_LAYOUT.width}"]
)
