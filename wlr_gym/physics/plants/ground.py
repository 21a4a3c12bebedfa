"""Friction under a wheel, defined once for every simulator: grip, patches of floor, slip weakening, tyre creep.

Scalar source over lanes (see :mod:`wlr_gym.physics.plants.drive`), traced by each simulator into its own kernel. :func:`pack`
fills the parameter lanes from the table, :func:`pack_body` those of what else acts on a robot from without. Families of
effects that change what is traced: ``ground`` (patches, weakening), ``friction_map`` (with it), ``compliance``,
``rolling_resistance`` and ``brush``; without the first friction is a constant of each wheel, ``mu_x{i}`` and ``mu_y{i}``.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from wlr_gym.physics.codegen import ops
from wlr_gym.physics.codegen.ops import Lanes, Value
from wlr_gym.physics.model.dynamics import gravity_in_floor
from wlr_gym.physics.plants.relief import map_lanes, map_value, pack_map, place_in_map
from wlr_gym.robot import SHANK_RADIUS, Robot
from wlr_gym.robot.parameter_table import PATCHES
from wlr_gym.robot.parameters import Parameters

Array = NDArray[np.float64]

WHEEL_LANES = (
    "mu_x", "mu_y", "inverse_mu_x", "inverse_mu_y", "grip", "anisotropy", "kinetic_drop", "inverse_weakening_speed",
    "creep_speed", "inverse_creep_speed", "flattening", "rest_depth",
    "tread_stiffness", "relaxation_length", "tread_damping", "inverse_rest_load",
)  # fmt: skip
_PATCH_FIELDS = ("mu", "x_min", "x_max", "y_min", "y_max")
_PATCH_NUMBERS = range(len(PATCHES))
#: Parameter lanes of the ground: four per wheel quantity, and the patches.
GROUND_LANES: tuple[str, ...] = (
    *(f"{name}{i}" for name in WHEEL_LANES for i in range(4)),
    *map_lanes("friction_map"),
    *(f"patch_{name}{k}" for name in _PATCH_FIELDS for k in _PATCH_NUMBERS),
)
#: Smallest friction coefficient that is divided by.
_LEAST_MU = 1e-9


def pack(parameters: Parameters) -> dict[str, Array]:
    """Return the lanes GROUND_LANES, each (N,); ``anisotropy`` is ground.mu_y over mu_x (1 where mu_x is 0)."""
    grip = parameters["wheel.grip"]
    creep_speed = np.where(parameters["ground.slip_compliance"] > 0.0, 0.0, parameters["ground.creep_speed"])
    mu_x, mu_y = parameters["ground.mu_x"], parameters["ground.mu_y"]
    mass = parameters["body.mass"] + parameters["leg.mass"].sum(axis=1) + parameters["wheel.mass"].sum(axis=1)
    load = parameters["gravity"] * mass / 4
    wheel = {
        "mu_x": grip * mu_x,
        "mu_y": grip * mu_y,
        "inverse_mu_x": 1.0 / np.maximum(grip * mu_x, _LEAST_MU),
        "inverse_mu_y": 1.0 / np.maximum(grip * mu_y, _LEAST_MU),
        "grip": grip,
        "anisotropy": np.where(mu_x > 0.0, mu_y / np.where(mu_x > 0.0, mu_x, 1.0), 1.0),
        "kinetic_drop": 1.0 - parameters["ground.kinetic_ratio"],
        "inverse_weakening_speed": 1.0 / parameters["ground.weakening_speed"],
        "creep_speed": creep_speed,
        "inverse_creep_speed": 1.0 / np.where(creep_speed > 0.0, creep_speed, 1.0),
        "flattening": parameters["ground.flattening"],
        "rest_depth": load[:, None] / parameters["ground.normal_stiffness"],
        "tread_stiffness": load[:, None]
        * _inverse(parameters["ground.slip_compliance"])
        / parameters["ground.relaxation_length"],
        "relaxation_length": parameters["ground.relaxation_length"],
        "tread_damping": parameters["ground.tread_damping"],
        "inverse_rest_load": np.repeat(1.0 / np.maximum(load, 1e-3)[:, None], 4, axis=1),
    }
    lanes = {f"{name}{i}": wheel[name][:, i] for name in WHEEL_LANES for i in range(4)}
    lanes |= pack_map(parameters, "friction_map")
    return lanes | {f"patch_{name}{k}": parameters[f"patch.{name}"][:, k] for name in _PATCH_FIELDS for k in _PATCH_NUMBERS}


def _inverse(values: Array) -> Array:
    """Return 1/values, 0 where they are 0."""
    return np.where(values > 0.0, 1.0 / np.where(values > 0.0, values, 1.0), 0.0)


#: Parameter lanes of the body: gravity, pulls, the inertial sensors' low-pass, half the body's size, and how body and legs
#: touch the floor (:mod:`wlr_gym.physics.plants.body`); ``reach``: of body and shanks from the body's origin.
BODY_LANES = (
    "gravity_x", "gravity_y", "gravity_z", "external_x", "external_y", "tether_stiffness", "anchor_x", "anchor_y", "low_pass",
    "half_size_x", "half_size_y", "half_size_z",
    "body_stiffness", "body_damping", "shank_stiffness", "shank_damping", "body_mu", "reach",
)  # fmt: skip


def pack_body(parameters: Parameters, robot: Robot, step: float) -> dict[str, Array]:
    """Return the lanes BODY_LANES, each (N,); ``step`` in s."""
    lanes = by_column("gravity_", "xyz", gravity_in_floor(parameters))
    lanes |= by_column("external_", "xy", parameters["external_force"]) | by_column(
        "anchor_", "xy", parameters["tether.anchor"]
    )
    lanes |= by_column("half_size_", "xyz", np.tile(0.5 * np.array(robot.body.size), (len(parameters), 1)))
    lanes["tether_stiffness"] = parameters["tether.stiffness"]
    lanes["low_pass"] = 1.0 - np.exp(-2.0 * np.pi * parameters["imu.bandwidth"] * step)
    return lanes | _pack_springs(parameters, robot, step)


#: Of step^2 stiffness/mass (4: unstable) and step damping/mass (2): how much springs and dampers of body and legs have at most.
_STIFFEST = 1.0
_MOST_DAMPED = 0.5


def _pack_springs(parameters: Parameters, robot: Robot, step: float) -> dict[str, Array]:
    """Springs of body and legs, bounded by the lightest that moves against one, and how far body and legs reach."""
    half, inertia = 0.5 * np.array(robot.body.size), parameters["body.inertia"]
    squares = np.array([half[1] ** 2 + half[2] ** 2, half[0] ** 2 + half[2] ** 2, half[0] ** 2 + half[1] ** 2])
    on_body = 4.0 / parameters["body.mass"] + 4.0 * (squares / inertia).max(axis=1)  # on four corners at once, 1/kg
    length, pitching = parameters["leg.length"], parameters["leg.inertia"].reshape(-1, 4, 3)[:, :, 1]
    about_hip = pitching + parameters["leg.mass"] * parameters["leg.com_along_leg"] ** 2 + parameters["wheel.mass"] * length**2
    on_leg = on_body + (length**2 / np.maximum(about_hip, 1e-9)).max(axis=1)  # a gear may have play: without its rotor
    lanes = {"body_mu": parameters["body.mu"]}
    for name, lightness in (("body", on_body), ("shank", on_leg)):
        lanes[f"{name}_stiffness"] = np.minimum(parameters["body.normal_stiffness"], _STIFFEST / (step**2 * lightness))
        lanes[f"{name}_damping"] = np.minimum(parameters["body.normal_damping"], _MOST_DAMPED / (step * lightness))
    hip = np.linalg.norm(parameters["hip.position"], axis=1)
    lanes["reach"] = np.maximum(np.linalg.norm(half), hip + length.max(axis=1) + SHANK_RADIUS)
    return lanes


def by_column(name: str, labels: Iterable[object], columns: Array) -> dict[str, Array]:
    """Return the columns of a matrix (N, K) as lanes: name with label -> (N,)."""
    return {f"{name}{label}": columns[:, k] for k, label in enumerate(labels)}


def families(parameters: Parameters) -> set[str]:
    """Return which families of ground effects some robot of the batch has."""
    has_patch = (parameters["patch.x_max"] > parameters["patch.x_min"]) & (
        parameters["patch.y_max"] > parameters["patch.y_min"]
    )
    has_map = parameters["friction_map.number"].any()
    present = {
        "ground": has_patch.any() or has_map or (parameters["ground.kinetic_ratio"] != 1.0).any(),
        "friction_map": has_map,
        "compliance": parameters["ground.creep_speed"].any() or parameters["ground.flattening"].any(),
        "rolling_resistance": parameters["ground.rolling_resistance"].any(),
        "brush": parameters["ground.slip_compliance"].any(),
    }
    return {name for name, is_present in present.items() if is_present}


@dataclass(frozen=True)
class Friction:
    """Friction coefficients acting under one wheel, along its heading (x) and its axle (y), and their inverses."""

    mu_x: Value
    mu_y: Value
    inverse_mu_x: Value
    inverse_mu_y: Value


def friction(lanes: Lanes, i: int, x: Value, y: Value, slip_speed: Value, features: frozenset[str]) -> Friction:
    """Return the friction under wheel ``i`` whose contact point stands at (x, y) (m, floor frame) and slips at a speed (m/s).

    mu_x = grip * (mu of the last patch that holds the point, else of the map's cell, else ground.mu_x),
    mu_y = mu_x * ground.mu_y/ground.mu_x, both times
    kinetic_ratio + (1 - kinetic_ratio) exp(-slip speed/weakening_speed). Tyre creep is not in it.
    """
    mu_x, mu_y = lanes[f"mu_x{i}"], lanes[f"mu_y{i}"]
    inverse_x, inverse_y = lanes[f"inverse_mu_x{i}"], lanes[f"inverse_mu_y{i}"]
    if "ground" not in features:
        return Friction(mu_x, mu_y, inverse_x, inverse_y)
    is_inside: Value = -1.0
    patch_mu: Value = mu_x
    if "friction_map" in features:
        inside, mapped = friction_of_map(lanes, x, y)
        is_inside = ops.where_positive(inside, 1.0, is_inside)
        patch_mu = ops.where_positive(inside, lanes[f"grip{i}"] * mapped, patch_mu)
    for k in _PATCH_NUMBERS:
        margin_x = ops.minimum(x - lanes[f"patch_x_min{k}"], lanes[f"patch_x_max{k}"] - x)
        margin_y = ops.minimum(y - lanes[f"patch_y_min{k}"], lanes[f"patch_y_max{k}"] - y)
        inside = ops.minimum(margin_x, margin_y)
        is_inside = ops.where_positive(inside, 1.0, is_inside)
        patch_mu = ops.where_positive(inside, lanes[f"grip{i}"] * lanes[f"patch_mu{k}"], patch_mu)
    patch_mu_y = patch_mu * lanes[f"anisotropy{i}"]
    mu_y = ops.where_positive(is_inside, patch_mu_y, mu_y)
    inverse_x = ops.where_positive(is_inside, 1.0 / ops.maximum(patch_mu, _LEAST_MU), inverse_x)
    inverse_y = ops.where_positive(is_inside, 1.0 / ops.maximum(patch_mu_y, _LEAST_MU), inverse_y)
    left = 1.0 - lanes[f"kinetic_drop{i}"] * (1.0 - ops.decay(slip_speed * lanes[f"inverse_weakening_speed{i}"]))
    inverse_left = 1.0 / ops.maximum(left, _LEAST_MU)
    return Friction(patch_mu * left, mu_y * left, inverse_x * inverse_left, inverse_y * inverse_left)


def friction_of_map(lanes: Lanes, x: Value, y: Value) -> tuple[Value, Value]:
    """Return how far inside the map of friction a place (m, floor frame) is, in cells, and the friction of its cell."""
    column, row = place_in_map(lanes, "friction_map", x, y)
    columns, rows = lanes["friction_map_columns"], lanes["friction_map_rows"]
    inside = ops.minimum(ops.minimum(column, columns - column), ops.minimum(row, rows - row))
    return inside, lanes["friction_map_scale"] * map_value(lanes, "friction_map", ops.floor(column), ops.floor(row))


def creep_share(lanes: Lanes, i: int, slip_speed: Value) -> tuple[Value, Value]:
    """Share of its friction that wheel ``i`` with tyre creep builds up at a slip speed (m/s), and its slope (s/m).

    tanh(speed/creep_speed), against the whole slip vector. Only of use where ``creep_speed{i}`` is positive.
    """
    share = ops.saturation(slip_speed * lanes[f"inverse_creep_speed{i}"])
    return share, (1.0 - share * share) * lanes[f"inverse_creep_speed{i}"]


@dataclass(frozen=True)
class Tread:
    """The elastic tread of one wheel under its present load.

    Attributes:
        stiffness: along the floor, N/m.
        held: what of it a step of rolling leaves: bristles leave the contact at its rear, unstrained ones enter at its front.
        softness: slip that an impulse takes away within the step, m/s per N s; 0 where the tread is rigid.
    """

    stiffness: Value
    held: Value
    softness: Value


def tread(lanes: Lanes, i: int, normal: Value, rolling_speed: Value, step: Value) -> Tread:
    """Return the tread of wheel ``i`` under a normal force (N), rolling at a speed (m/s, 0 or more).

    A brush with relaxation: shear u' = s - |V|/sigma u for the slip velocity s, force F = -c u - d s, at most mu N. Stiffness
    c = C/sigma and relaxation length sigma both grow with the square root of the load, so that the slip stiffness C grows with
    the load. Within a step of length h, implicitly: F = -c'(u + h s) - d s with c' = c/(1 + h |V|/sigma).
    """
    growth = ops.sqrt(ops.maximum(normal * lanes[f"inverse_rest_load{i}"], 1e-4))
    stiffness = lanes[f"tread_stiffness{i}"] * growth
    held = stiffness / (1.0 + step * rolling_speed / (lanes[f"relaxation_length{i}"] * growth))
    softness = 1.0 / (step * step * held + step * lanes[f"tread_damping{i}"] + 1e-12)
    return Tread(stiffness, held, ops.where_positive(stiffness, softness, 0.0))
