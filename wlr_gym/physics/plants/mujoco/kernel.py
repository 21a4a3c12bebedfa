"""Trace the arithmetic around a MuJoCo step into numba kernels that work on the batch's live arrays.

Strict IEEE arithmetic, one robot after the other, explicit fused multiply-adds: a robot's result depends on nothing but
itself.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wlr_gym.physics import servo
from wlr_gym.physics.codegen import (
    Graph,
    Inputs,
    compilation,
    emit,
    inputs_of,
    load_module,
    ops,
    source_of,
    straight_line_source,
)  # fmt: skip
from wlr_gym.physics.plants import base, drive, ground
from wlr_gym.physics.plants.base import TRUTH_LAYOUT
from wlr_gym.physics.plants.gibbs_appell import kinematics
from wlr_gym.physics.plants.gibbs_appell import step as engine
from wlr_gym.physics.plants.mujoco import step as source
from wlr_gym.physics.plants.mujoco.step import CORNERS, STATE
from wlr_gym.physics.plants.sensors import RAW_LAYOUT
from wlr_gym.robot import CORNER_SIGNS, Robot
from wlr_gym.robot.parameters import Parameters

# ---- the parameter table as numbers that the kernel reads: once per change -------------------------------------------


_CORNER_LANES = (
    "hip_x", "hip_y", "hip_z", "length", "radius", "zero_offset", "stiffness", "damping", "rolling", "wheel_spin",
    "contact_lightness_x", "contact_lightness_y",
)  # fmt: skip
#: Names of the kernel's parameter lanes, in storage order.
PARAMETER_LANES: tuple[str, ...] = (
    *ground.BODY_LANES,
    *(f"{name}{i}" for name in _CORNER_LANES for i in range(4)),
    *(f"joint_armature{j}" for j in range(8)),
    *drive.DRIVE_LANES,
    *ground.GROUND_LANES,
)


def pack(parameters: Parameters, robot: Robot, step: float) -> Array:
    """Return the kernel's parameter lanes, shape (N, len(PARAMETER_LANES)); ``step`` in s."""
    lightness_x, lightness_y = contact_lightness(parameters)
    signs = np.array(CORNER_SIGNS)
    hip = parameters["hip.position"]
    corners = {
        "hip_x": hip[:, :1] * signs[:, 0],
        "hip_y": hip[:, 1:2] * signs[:, 1],
        "hip_z": np.repeat(hip[:, 2:], 4, axis=1),
        "length": parameters["leg.length"],
        "radius": parameters["wheel.radius"],
        "zero_offset": parameters["joint.zero_offset"],
        "stiffness": parameters["ground.normal_stiffness"],
        "damping": parameters["ground.normal_damping"],
        "rolling": parameters["ground.rolling_resistance"],
        "wheel_spin": parameters["wheel.spin_inertia"],
        "contact_lightness_x": np.repeat(lightness_x[:, None], 4, axis=1),
        "contact_lightness_y": np.repeat(lightness_y[:, None], 4, axis=1),
    }
    lanes = (
        ground.pack_body(parameters, robot, step)
        | ground.by_column("joint_armature", range(8), drive.joint_armature(parameters))
        | drive.pack(parameters, robot, step, moved_inertia(parameters))
        | ground.pack(parameters)
    )
    lanes |= {f"{name}{i}": corners[name][:, i] for name in _CORNER_LANES for i in range(4)}
    return np.stack([lanes[name] for name in PARAMETER_LANES], axis=1)


def moved_inertia(parameters: Parameters) -> Array:
    """Return the inertia (N, 8) that turns with each joint about its axis, rotor included, kg m2."""
    length, com = parameters["leg.length"], parameters["leg.com_along_leg"]
    leg = parameters["leg.inertia"].reshape(-1, 4, 3)[:, :, 1] + parameters["leg.mass"] * com**2
    leg = leg + parameters["wheel.mass"] * length**2
    return parameters["servo.armature"] + np.hstack([leg, parameters["wheel.spin_inertia"]])


def contact_lightness(parameters: Parameters) -> tuple[Array, Array]:
    """Return how much velocity a horizontal impulse at a wheel's contact gives it through the body, along x and y, 1/kg.

    Legs and wheels taken as rigid on the body, whose own inertia resists alone: an upper estimate. The wheel's spin comes on
    top along its heading.
    """
    inertia = parameters["body.inertia"]
    mass = parameters["body.mass"]
    hip = parameters["hip.position"]
    height = parameters["leg.length"].max(axis=1) + parameters["wheel.radius"].max(axis=1)
    turn = 1.0 / inertia[:, 2]
    along = 1.0 / mass + height**2 / inertia[:, 1] + hip[:, 1] ** 2 * turn
    across = 1.0 / mass + height**2 / inertia[:, 0] + hip[:, 0] ** 2 * turn
    return along, across


# ---- tracing ---------------------------------------------------------------------------------------------------------


Array = NDArray[np.float64]

#: Arrays the kernels work on, in this order, one row per robot (:func:`addresses`): MuJoCo's positions, velocities, constraint
#: forces and contact sensors; own state; parameter lanes; the tick's inputs; formula forces; what a step reads.
_FLAT = (
    "qpos", "qvel", "constraint", "contact", "state", "parameters", "setpoints", "old_setpoints", "switch_time", "on",
    "generalised", "applied", "armature", "gear_bound", "pair_margin",
)  # fmt: skip
#: These have four rows per robot, one per wheel.
_PER_WHEEL = ("pair_friction", "geom_size", "geom_pos", "geom_quat")


def addresses(flat: Sequence[Array], per_wheel: Sequence[Array]) -> NDArray[np.intp]:
    """Return where every robot's rows lie in memory, (N, rows per robot).

    Unpacking twenty array arguments takes numba longer than computing a robot's step, so the kernels get this one table. It
    holds for as long as the arrays live.
    """
    return np.hstack([_row_addresses(array).reshape(len(array), -1) for array in (*flat, *per_wheel)])


def _row_addresses(array: Array) -> NDArray[np.intp]:
    offsets = np.tensordot(np.array(array.strides[:-1]), np.indices(array.shape[:-1]), 1)
    return array.ctypes.data + offsets


def _columns(array: str, names: Sequence[str]) -> dict[str, str]:
    return {name: f"{array}[{k}]" for k, name in enumerate(names)}


_PLACES: dict[str, str] = (
    _columns("qpos", source.POSITION)
    | _columns("qvel", source.VELOCITY)
    | _columns("constraint", source.CONSTRAINT)
    | _columns("contact", source.CONTACT)
    | _columns("state", STATE)
    | _columns("parameters", PARAMETER_LANES)
    | _columns("setpoints", [f"goal{j}" for j in range(8)])
    | _columns("old_setpoints", [f"old_goal{j}" for j in range(8)])
    | _columns("switch_time", [f"switch_time{j}" for j in range(8)])
    | _columns("on", [f"on{j}" for j in range(8)])
    | {name: f"generalised[{k} * count]" for k, name in enumerate(source.FORMULA)}  # the formulas' kernel has robots in columns
    | _columns("applied", [f"applied_{name}" for name in source.VELOCITY])
    | _columns("armature", [f"armature_{name}" for name in source.VELOCITY])
    | _columns("gear_bound", [f"gear_bound_{name}" for name in source.VELOCITY])
    | _columns("pair_margin", [f"margin{i}" for i in CORNERS])
    # a capsule's first tangent runs along its axis: the axle
    | {f"friction_{a}{i}": f"pair_friction{i}[{k}]" for i in CORNERS for k, a in enumerate("yx")}
    | {f"geom_radius{i}": f"geom_size{i}[0]" for i in CORNERS}
    | {f"geom_{a}{i}": f"geom_pos{i}[{k}]" for i in CORNERS for k, a in enumerate("xyz")}
    | {f"geom_q{a}{i}": f"geom_quat{i}[{k}]" for i in CORNERS for k, a in enumerate("wxy")}
)
_ROWS = (*_FLAT, *(f"{name}{i}" for name in _PER_WHEEL for i in CORNERS))
_SCALARS = ("step", "time", "duration")


def trace() -> dict[str, dict[str, Any]]:
    """Trace all blocks: name -> outputs."""
    owner = Graph()
    lanes = Inputs(owner)
    step = owner.input("step")
    return {
        "drift": source.drift(lanes, owner.input("duration")),
        "before": source.before(lanes, owner.input("time"), step),
        "after": source.after(lanes, step),
        "features": source.formula_inputs(lanes),
        "observe": source.observe(lanes),
    }


def kernel_source() -> str:
    """Return the kernel module's source."""
    blocks = trace()
    observed = {name: f"truth[{k}]" for k, name in enumerate(blocks["observe"])}
    for k, name in enumerate(list(observed)[TRUTH_LAYOUT.width :]):
        observed[name] = f"raw[{k}]" if k < RAW_LAYOUT.width - 1 else name
    named = {name: f"inputs[{k} * count + i]" for k, name in enumerate(base.INPUTS)}
    rows = [f"        {name} = array_at(table[i, {k}])" for k, name in enumerate(_ROWS)]
    lines = []
    for block, outputs in blocks.items():
        used = inputs_of(outputs.values())
        scalars = [name for name in _SCALARS if name in used]
        own = {"observe": ["truth", "raw"], "features": ["inputs"]}.get(block, [])
        places = _PLACES | {"observe": observed, "features": named}.get(block, {})

        def load(name: str) -> str:
            return name if name in _SCALARS else _PLACES[name]

        body = emit(outputs, load, lambda name, text, places=places: f"{places[name]} = {text}", "", fused=True)
        if block == "observe":
            body.append(f"raw[{RAW_LAYOUT.width - 1}] = math.atan2(heading_sine, heading_cosine)")
        signature = "" if block == "features" else _signature(len(own), len(scalars))
        pointers = [f"numbers_of({name})" if block == "features" else f"numbers_of({name}[i])" for name in own]
        lines += [
            *straight_line_source(f"{block}_of_robot", [*_ROWS, *own, "i", "count", *scalars], body),
            "",
            f"@njit({signature}cache=True, nogil=True, error_model='numpy')",
            f"def {block}({', '.join(['table', 'rows', *own, *scalars])}):",
            "    count = len(table)",
            "    for i in rows:",
            *rows,
            f"        {block}_of_robot({', '.join([*_ROWS, *pointers, 'i', 'count', *scalars])})",
            "",
        ]
    return "\n".join(["from numba import types", "", *lines])


def _signature(own: int, scalars: int) -> str:
    """Types of a block's arguments, so that one compilation at import serves every batch size."""
    kinds = ["types.intp[:, ::1]", "types.intp[::1]"] + ["types.float64[:, ::1]"] * own + ["types.float64"] * scalars
    return f"types.void({', '.join(kinds)}), "


def load_kernel() -> ModuleType:
    """Load (first use: generate and compile) the kernel module."""
    message = "wlr_gym: compiling the MuJoCo plant's kernel; some seconds, once on this machine"
    return load_module("mujoco_plant", kernel_source, message, _SOURCE_KEY)


#: What the kernels are traced from. numba itself notices only that the generated file has changed.
TRACED = (
    source, engine, kinematics, base, servo, drive, ground, ops, compilation, sys.modules[__name__]
)  # fmt: skip
_SOURCE_KEY = "\0".join([source_of(*TRACED), *PARAMETER_LANES, f"{TRUTH_LAYOUT.width} {RAW_LAYOUT.width}"])
