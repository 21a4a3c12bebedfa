"""The numbers of the parameter table that the substep kernel reads, once per change."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from wlr_gym.physics.model.dynamics import gravity_in_floor
from wlr_gym.physics.plants import drive, ground
from wlr_gym.robot import CORNER_SIGNS, Robot
from wlr_gym.robot.parameters import Parameters

Array = NDArray[np.float64]

_CORNER_LANES = (
    "hip_x", "hip_y", "hip_z", "length", "radius", "zero_offset", "stiffness", "damping", "rolling", "wheel_spin",
    "contact_lightness_x", "contact_lightness_y",
)  # fmt: skip
_SCALAR_LANES = (
    "gravity_x", "gravity_y", "gravity_z", "external_x", "external_y", "tether", "anchor_x", "anchor_y", "low_pass",
    "half_size_x", "half_size_y", "half_size_z",
)  # fmt: skip
#: Names of the kernel's parameter lanes, in storage order.
PARAMETER_LANES: tuple[str, ...] = (
    *_SCALAR_LANES,
    *(f"{name}{i}" for name in _CORNER_LANES for i in range(4)),
    *(f"joint_armature{j}" for j in range(8)),
    *drive.DRIVE_LANES,
    *ground.GROUND_LANES,
)


def pack(parameters: Parameters, robot: Robot, step: float) -> Array:
    """Return the kernel's parameter lanes, shape (N, len(PARAMETER_LANES)); ``step`` in s."""
    count = len(parameters)
    lanes: dict[str, Array] = {}
    _spread(lanes, gravity_in_floor(parameters), [f"gravity_{a}" for a in "xyz"])
    _spread(lanes, parameters["external_force"], ["external_x", "external_y"])
    _spread(lanes, parameters["tether.anchor"], ["anchor_x", "anchor_y"])
    lanes["tether"] = parameters["tether.stiffness"]
    lanes["low_pass"] = 1.0 - np.exp(-2.0 * np.pi * parameters["imu.bandwidth"] * step)
    for axis, size in zip("xyz", robot.body.size, strict=True):
        lanes[f"half_size_{axis}"] = np.full(count, 0.5 * size)
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
    for name in _CORNER_LANES:
        _spread(lanes, corners[name], [f"{name}{i}" for i in range(4)])
    _spread(lanes, drive.joint_armature(parameters), [f"joint_armature{j}" for j in range(8)])
    lanes |= drive.pack(parameters, robot, step, moved_inertia(parameters)) | ground.pack(parameters)
    return np.stack([lanes[name] for name in PARAMETER_LANES], axis=1)


def _spread(lanes: dict[str, Array], columns: Array, names: list[str]) -> None:
    for k, name in enumerate(names):
        lanes[name] = columns[:, k]


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
