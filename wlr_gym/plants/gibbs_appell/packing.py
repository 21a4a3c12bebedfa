"""Turn the parameter table into the numbers the kernel reads, once per change (float64, before any cast)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from wlr_gym import servo
from wlr_gym.model.dynamics import gravity_in_floor, inertial_constants
from wlr_gym.parameters import Parameters
from wlr_gym.plants.gibbs_appell.step import ASSEMBLY, PLATFORM
from wlr_gym.robot import Robot

Array = NDArray[np.float64]

_CORNER_LANES = (
    *ASSEMBLY,
    "length",
    "radius",
    "zero_offset",
    "stiffness",
    "damping",
    "look_ahead",
    "mu_x",
    "mu_y",
    "inverse_mu_x",
    "inverse_mu_y",
    "rolling",
)
_JOINT_LANES = (
    "kp", "kd", "volt_gain", "back_emf_damping", "viscous", "weight", "gear_bound", "inverse_constant", "effort_scale",
    "velocity_limit", "acceleration_limit",
)  # fmt: skip
_SCALAR_LANES = (
    *PLATFORM, "gravity_x", "gravity_y", "gravity_z", "external_x", "external_y", "supply", "low_pass",
    "half_size_x", "half_size_y", "half_size_z",
)  # fmt: skip
#: Names of the kernel's parameter lanes, in storage order.
PARAMETER_LANES: tuple[str, ...] = (
    *_SCALAR_LANES,
    *(f"{name}{i}" for name in _CORNER_LANES for i in range(4)),
    *(f"{name}{j}" for name in _JOINT_LANES for j in range(8)),
)


def pack(parameters: Parameters, robot: Robot, step: float) -> Array:
    """Return the kernel's parameter lanes, shape (N, len(PARAMETER_LANES)).

    ``step`` (s) is needed for the exponentially fitted damping weights, the impulse bounds of gear friction and the
    sensors' low-pass.
    """
    count = len(parameters)
    lanes: dict[str, Array] = {}
    inertia = inertial_constants(parameters)
    lanes["platform_mass"] = inertia["platform_mass"]
    _spread(lanes, inertia["platform_first_moment"], [f"platform_moment_{a}" for a in "xyz"])
    _spread(lanes, inertia["platform_inertia"], [f"platform_inertia_{a}" for a in ("xx", "yy", "zz", "xy", "xz", "yz")])
    _spread(lanes, gravity_in_floor(parameters), [f"gravity_{a}" for a in "xyz"])
    _spread(lanes, parameters["external_force"], ["external_x", "external_y"])
    lanes["supply"] = parameters["servo.supply_voltage"]
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
        "mu_x": parameters["ground.mu_x"],
        "mu_y": parameters["ground.mu_y"],
        "inverse_mu_x": 1.0 / np.maximum(parameters["ground.mu_x"], 1e-9),
        "inverse_mu_y": 1.0 / np.maximum(parameters["ground.mu_y"], 1e-9),
        "rolling": parameters["ground.rolling_resistance"],
    }
    for name in _CORNER_LANES:
        _spread(lanes, corners[name], [f"{name}{i}" for i in range(4)])
    joints = _joint_lanes(parameters, robot, step, inertia)
    for name in _JOINT_LANES:
        _spread(lanes, joints[name], [f"{name}{j}" for j in range(8)])
    return np.stack([lanes[name] for name in PARAMETER_LANES], axis=1)


def _spread(lanes: dict[str, Array], columns: Array, names: list[str]) -> None:
    for k, name in enumerate(names):
        lanes[name] = columns[:, k]


def _joint_lanes(parameters: Parameters, robot: Robot, step: float, inertia: dict[str, Array]) -> dict[str, Array]:
    nominal_voltage = robot.servo.supply_voltage
    constant, resistance = servo.motor_constants(
        parameters["servo.stall_torque"], parameters["servo.no_load_speed"], nominal_voltage
    )
    nominal_constant, _ = servo.motor_constants(*_nominal_motor(robot), nominal_voltage)
    back_emf_damping = constant * constant / resistance
    viscous = parameters["servo.viscous_friction"]
    leg_inertia = inertia["armature_leg"] + inertia["second_moment"] + inertia["leg_iyy"]
    wheel_inertia = inertia["armature_wheel"] + inertia["wheel_spin"]
    velocity_limit, acceleration_limit = servo.profile_limits(
        parameters["servo.profile_velocity"], parameters["servo.profile_acceleration"]
    )
    return {
        "kp": parameters["servo.kp"],
        "kd": parameters["servo.kd"],
        "volt_gain": constant / resistance,
        "back_emf_damping": back_emf_damping,
        "viscous": viscous,
        "weight": fitted_weight(step * (back_emf_damping + viscous) / np.hstack([leg_inertia, wheel_inertia])),
        "gear_bound": step * parameters["servo.coulomb_friction"],
        "inverse_constant": 1.0 / constant,
        "effort_scale": nominal_constant / constant,
        "velocity_limit": velocity_limit,
        "acceleration_limit": acceleration_limit,
    }


def _nominal_motor(robot: Robot) -> tuple[Array, Array]:
    leg, wheel = robot.servo.leg, robot.servo.wheel
    return (
        np.array([leg.stall_torque] * 4 + [wheel.stall_torque] * 4),
        np.array([leg.no_load_speed] * 4 + [wheel.no_load_speed] * 4),
    )


def damper_look_ahead(parameters: Parameters, step: float) -> Array:
    """How far the contact damper's rate is extrapolated, in steps, shape (N, 4).

    Half a step makes it second order, but an extrapolated damper is unstable at step * damping / mass = 1. So it fades to
    none between 0.3 and 0.6, where the lightest mass that a wheel's damper can act on alone is the pitching platform's.
    """
    mass = parameters["body.mass"][:, None] / 12.0
    stiffness_ratio = step * parameters["ground.normal_damping"] / mass
    return 0.5 * np.clip(2.0 - stiffness_ratio / 0.3, 0.0, 1.0)


def fitted_weight(z: Array) -> Array:
    """Weight of the new velocity in an implicit damping force, so that a free joint decays exactly by exp(-z) per step.

    weight = 1/(1 - exp(-z)) - 1/z: 1/2 (second order) for a soft joint, 1 for a stiff one.
    """
    small = np.abs(z) < 1e-4
    safe = np.where(small, 1.0, z)
    return np.where(small, 0.5 + z / 12.0, -1.0 / np.expm1(-safe) - 1.0 / safe)
