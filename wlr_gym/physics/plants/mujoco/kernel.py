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
from wlr_gym.physics.plants import base, body, contacts, drive, ground, relief
from wlr_gym.physics.plants.base import TRUTH_LAYOUT
from wlr_gym.physics.plants.contacts import CONTACTS, CORNERS
from wlr_gym.physics.plants.gibbs_appell import kinematics
from wlr_gym.physics.plants.gibbs_appell import step as engine
from wlr_gym.physics.plants.mujoco import step as source
from wlr_gym.physics.plants.mujoco.step import STATE
from wlr_gym.physics.plants.sensors import RAW_LAYOUT
from wlr_gym.robot import CORNER_SIGNS, Robot
from wlr_gym.robot.parameter_table import PIECES
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
    *relief.RELIEF_LANES,
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
        | relief.pack(parameters, robot)
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
    "generalised", "applied", "armature", "gear_bound",
)  # fmt: skip
#: These have a row per contact of a robot; the last two only on relief.
_PER_CONTACT = ("pair_friction", "pair_margin", "geom_size", "geom_pos", "geom_quat", "plane_pos", "plane_quat")


def addresses(flat: Sequence[Array], per_contact: Sequence[Array]) -> NDArray[np.intp]:
    """Return where every robot's rows lie in memory, (N, rows per robot); ``per_contact``: arrays (N, contacts, ...).

    Unpacking twenty array arguments takes numba longer than computing a robot's step, so the kernels get this one table. It
    holds for as long as the arrays live.
    """
    return np.hstack([_row_addresses(array).reshape(len(array), -1) for array in (*flat, *per_contact)])


def _row_addresses(array: Array) -> NDArray[np.intp]:
    offsets = np.tensordot(np.array(array.strides[:-1]), np.indices(array.shape[:-1]), 1)
    return array.ctypes.data + offsets


_LABELS = {
    "qpos": source.POSITION,
    "qvel": source.VELOCITY,
    "constraint": source.CONSTRAINT,
    "contact": source.CONTACT,
    "state": STATE,
    "parameters": PARAMETER_LANES,
    "setpoints": [f"goal{j}" for j in range(8)],
    "old_setpoints": [f"old_goal{j}" for j in range(8)],
    "switch_time": [f"switch_time{j}" for j in range(8)],
    "on": [f"on{j}" for j in range(8)],
    "applied": [f"applied_{name}" for name in source.VELOCITY],
    "armature": [f"armature_{name}" for name in source.VELOCITY],
    "gear_bound": [f"gear_bound_{name}" for name in source.VELOCITY],
}
_PLACES: dict[str, str] = {name: f"{array}[{k}]" for array, names in _LABELS.items() for k, name in enumerate(names)} | {
    name: f"generalised[{k} * count]" for k, name in enumerate(source.FORMULA)
}  # the formulas' kernel has robots in columns
_PLACES |= {
    name: place
    for c in CONTACTS
    for name, place in (
        # a capsule's first tangent runs along its axis: the axle
        *((f"friction_{a}{c}", f"pair_friction{c}[{k}]") for k, a in enumerate("yx")),
        (f"margin{c}", f"pair_margin{c}[0]"),
        (f"geom_radius{c}", f"geom_size{c}[0]"),
        *((f"geom_{a}{c}", f"geom_pos{c}[{k}]") for k, a in enumerate("xyz")),
        *((f"geom_q{a}{c}", f"geom_quat{c}[{k}]") for k, a in enumerate("wxy")),
        *((f"plane_{a}{c}", f"plane_pos{c}[{k}]") for k, a in enumerate("xyz")),
        *((f"plane_q{a}{c}", f"plane_quat{c}[{k}]") for k, a in enumerate("wxyz")),
    )
}
_SCALARS = ("step", "time", "duration")
#: What a step knows of body and legs on the floor, beside the state.
_TOUCHING = ("near", "near_base", *(f"near_piece{k}" for k in range(len(PIECES))), *body.PUSHES)
_PLACES |= {name: f"touching[{k}]" for k, name in enumerate(_TOUCHING)}
#: Lanes of the one piece that pushes; those of all pieces lie side by side.
_PLACES |= {name: f"{_PLACES[f'{name}0'][:-1]} + piece]" for name in (*body.PIECE_LANES, "near_piece")}
#: Blocks that are run only where body or legs are near the floor.
_WHERE_NEAR = ("nearness", "push_of_base", "push_of_piece", "touch")


def trace(features: frozenset[str]) -> dict[str, dict[str, Any]]:
    """Trace all blocks: name -> outputs."""
    owner = Graph()
    lanes = Inputs(owner)
    step = owner.input("step")
    return {
        "drift": source.drift(lanes, owner.input("duration")),
        "before": source.before(lanes, owner.input("time"), step, features),
        "nearness": source.nearness(lanes, features),
        "push_of_base": source.push_of_base(lanes, features),
        "push_of_piece": source.push_of_piece(lanes) if "piece" in features else {},
        "touch": source.touch(lanes, step, features),
        "after": source.after(lanes, step, features),
        "features": source.formula_inputs(lanes, features),
        "observe": source.observe(lanes, features),
    }


def kernel_source(features: frozenset[str]) -> str:
    """Return the kernel module's source."""
    blocks = trace(features)
    contacts = CONTACTS if "relief" in features else CORNERS
    per_contact = _PER_CONTACT if "relief" in features else _PER_CONTACT[:5]
    names = (*_FLAT, *(f"{name}{c}" for name in per_contact for c in contacts))
    observed = {name: f"truth[{k}]" for k, name in enumerate(blocks["observe"])}
    for k, name in enumerate(list(observed)[TRUTH_LAYOUT.width :]):
        observed[name] = f"raw[{k}]" if k < RAW_LAYOUT.width - 1 else name
    named = {name: f"inputs[{k} * count + i]" for k, name in enumerate(base.INPUTS)}
    rows = [f"        {name} = array_at(table[i, {k}])" for k, name in enumerate(names)]
    lines = []
    for block, outputs in blocks.items():
        used = inputs_of(outputs.values())
        scalars = [name for name in _SCALARS if name in used]
        near = ["touching", "piece"] if block in _WHERE_NEAR else []
        own = {"observe": ["truth", "raw"], "features": ["inputs"]}.get(block, [])
        places = _PLACES | {"observe": observed, "features": named}.get(block, {})

        def load(name: str) -> str:
            return name if name in _SCALARS else _PLACES[name]

        text = emit(outputs, load, lambda name, text, places=places: f"{places[name]} = {text}", "", fused=True)
        if block == "observe":
            text.append(f"raw[{RAW_LAYOUT.width - 1}] = math.atan2(heading_sine, heading_cosine)")
        lines += [*straight_line_source(f"{block}_of_robot", [*names, *own, *near, "i", "count", *scalars], text), ""]
        if near or block == "before":
            continue
        signature = "" if block == "features" else _signature(len(own), len(scalars))
        pointers = [f"numbers_of({name})" if block == "features" else f"numbers_of({name}[i])" for name in own]
        lines += [
            f"@compiled({signature}error_model='numpy')",
            f"def {block}({', '.join(['table', 'rows', *own, *scalars])}):",
            "    count = len(table)",
            "    for i in rows:",
            *rows,
            f"        {block}_of_robot({', '.join([*names, *pointers, 'i', 'count', *scalars])})",
            "",
        ]
    before = _BEFORE.format(
        signature=_signature(0, 2),
        room=len(_TOUCHING),
        rows="\n".join(rows),
        arrays=", ".join(names),
        scalars=", ".join(name for name in _SCALARS if name in inputs_of(blocks["before"].values())),
        pieces=len(relief.piece_numbers(features)),
    )
    return "\n".join(["from numba import types", "", *lines, before])


#: What is done before a step; body and legs on the floor, where they are near it.
_BEFORE = """
@compiled({signature}error_model='numpy')
def before(table, rows, step, time):
    count, room = len(table), np.zeros({room})
    touching = numbers_of(room)
    for i in rows:
{rows}
        before_of_robot({arrays}, i, count, {scalars})
        nearness_of_robot({arrays}, touching, 0, i, count)
        if room[0] > 0.0:
            if room[1] > 0.0:
                push_of_base_of_robot({arrays}, touching, 0, i, count)
            for piece in range({pieces}):
                if room[2 + piece] > 0.0:
                    push_of_piece_of_robot({arrays}, touching, piece, i, count)
            touch_of_robot({arrays}, touching, 0, i, count, step)
"""


def _signature(own: int, scalars: int) -> str:
    """Types of a block's arguments, so that one compilation at import serves every batch size."""
    kinds = ["types.intp[:, ::1]", "types.intp[::1]"] + ["types.float64[:, ::1]"] * own + ["types.float64"] * scalars
    return f"signatures=[types.void({', '.join(kinds)})], "


def load_kernel(features: frozenset[str]) -> ModuleType:
    """Load (first use: generate and compile) the kernel module for level floors, or for relief."""
    message = "wlr_gym: compiling the MuJoCo plant's kernel; some seconds, once on this machine"
    tag = "mujoco_plant_relief" if "relief" in features else "mujoco_plant"
    return load_module(tag, lambda: kernel_source(features), message, _SOURCE_KEY)


#: What the kernels are traced from. numba itself notices only that the generated file has changed.
TRACED = (
    source, engine, kinematics, base, servo, drive, contacts, ground, relief, body, ops, compilation, sys.modules[__name__]
)  # fmt: skip
_SOURCE_KEY = "\0".join([source_of(*TRACED), *PARAMETER_LANES, f"{TRUTH_LAYOUT.width} {RAW_LAYOUT.width}"])
