"""Turn the parameter table into the numbers the kernel reads, once per change (float64, before any cast)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from wlr_gym.physics.model.dynamics import gravity_in_floor, inertial_constants
from wlr_gym.physics.plants import drive, ground
from wlr_gym.physics.plants.gibbs_appell.lanes import ASSEMBLY, PLATFORM
from wlr_gym.robot import LEG_SLICE, WHEEL_SLICE, Robot
from wlr_gym.robot.parameters import Parameters

Array = NDArray[np.float64]

_CORNER_LANES = (
    *ASSEMBLY,
    "length",
    "radius",
    "zero_offset",
    "stiffness",
    "damping",
    "look_ahead",
    "rolling",
)
_SCALAR_LANES = (
    *PLATFORM, "gravity_x", "gravity_y", "gravity_z", "external_x", "external_y", "tether_stiffness", "anchor_x", "anchor_y",
    "low_pass", "half_size_x", "half_size_y", "half_size_z",
)  # fmt: skip
#: Names of the kernel's parameter lanes, in storage order.
PARAMETER_LANES: tuple[str, ...] = (
    *_SCALAR_LANES,
    *(f"{name}{i}" for name in _CORNER_LANES for i in range(4)),
    *drive.DRIVE_LANES,
    *ground.GROUND_LANES,
)


def pack(parameters: Parameters, robot: Robot, step: float) -> Array:
    """Return the kernel's parameter lanes, shape (N, len(PARAMETER_LANES)).

    ``step`` (s) is needed for the exponentially fitted damping weights, the impulse bounds of gear friction and the
    sensors' low-pass.
    """
    count = len(parameters)
    lanes: dict[str, Array] = {}
    inertia = inertial_constants(parameters)
    moved = [inertia["armature_leg"] + inertia["second_moment"] + inertia["leg_iyy"]]
    moved += [inertia["armature_wheel"] + inertia["wheel_spin"]]
    lanes |= drive.pack(parameters, robot, step, np.hstack(moved)) | ground.pack(parameters)
    armature = drive.joint_armature(parameters)
    inertia["armature_leg"], inertia["armature_wheel"] = armature[:, LEG_SLICE], armature[:, WHEEL_SLICE]
    lanes["platform_mass"] = inertia["platform_mass"]
    _spread(lanes, inertia["platform_first_moment"], [f"platform_moment_{a}" for a in "xyz"])
    _spread(lanes, inertia["platform_inertia"], [f"platform_inertia_{a}" for a in ("xx", "yy", "zz", "xy", "xz", "yz")])
    _spread(lanes, gravity_in_floor(parameters), [f"gravity_{a}" for a in "xyz"])
    _spread(lanes, parameters["external_force"], ["external_x", "external_y"])
    lanes["tether_stiffness"] = parameters["tether.stiffness"]
    _spread(lanes, parameters["tether.anchor"], ["anchor_x", "anchor_y"])
    lanes["low_pass"] = 1.0 - np.exp(-2.0 * np.pi * parameters["imu.bandwidth"] * step)
    for axis, size in zip("xyz", robot.body.size, strict=True):
        lanes[f"half_size_{axis}"] = np.full(count, 0.5 * size)
    corners: dict[str, Array] = {name: inertia[name] for name in ASSEMBLY}
    corners |= {
        "length": parameters["leg.length"],
        "radius": parameters["wheel.radius"],
        "zero_offset": parameters["joint.zero_offset"],
        "stiffness": parameters["ground.normal_stiffness"],
        "damping": parameters["ground.normal_damping"],
        "look_ahead": damper_look_ahead(parameters, step),
        "rolling": parameters["ground.rolling_resistance"],
    }
    for name in _CORNER_LANES:
        _spread(lanes, corners[name], [f"{name}{i}" for i in range(4)])
    return np.stack([lanes[name] for name in PARAMETER_LANES], axis=1)


def _spread(lanes: dict[str, Array], columns: Array, names: list[str]) -> None:
    for k, name in enumerate(names):
        lanes[name] = columns[:, k]


def damper_look_ahead(parameters: Parameters, step: float) -> Array:
    """How far the contact damper's rate is extrapolated, in steps, shape (N, 4).

    Half a step makes it second order, but an extrapolated damper is unstable at step * damping / mass = 1. So it fades to
    none between 0.3 and 0.6, where the lightest mass that a wheel's damper can act on alone is the pitching platform's.
    """
    mass = parameters["body.mass"][:, None] / 12.0
    stiffness_ratio = step * parameters["ground.normal_damping"] / mass
    return 0.5 * np.clip(2.0 - stiffness_ratio / 0.3, 0.0, 1.0)
