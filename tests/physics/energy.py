"""Energy of the robot from its readable mass matrix: what simulators must keep."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from wlr_gym.physics.model.dynamics import (
    absolute_rates,
    gravity_in_floor,
    inertial_constants,
    mass_matrix_and_bias,
    rotation_matrix,
)
from wlr_gym.physics.plants.base import Truth
from wlr_gym.robot import LEG_SLICE
from wlr_gym.robot.parameters import Parameters

Array = NDArray[np.float64]


def kinetic_energy(parameters: Parameters, v: Array, w: Array, joint_position: Array, joint_velocity: Array) -> Array:
    """Return the kinetic energy (N,), rotors included, J."""
    leg_rate, wheel_rate = absolute_rates(w, joint_velocity)
    mass_matrix, _ = mass_matrix_and_bias(parameters, joint_position, w, leg_rate, wheel_rate)
    velocity = np.concatenate([v, w, leg_rate, wheel_rate], axis=1)
    return 0.5 * np.einsum("ni,nij,nj->n", velocity, mass_matrix, velocity)


def potential_energy(parameters: Parameters, position: Array, quaternion: Array, joint_position: Array) -> Array:
    """Return the potential energy (N,) in the inclined gravity field, zero with all mass at the floor frame's origin, J."""
    constants = inertial_constants(parameters)
    mass = constants["platform_mass"] + constants["assembly_mass"].sum(axis=1)
    moment = mass[:, None] * position + np.einsum(
        "nij,nj->ni", rotation_matrix(quaternion), _first_moment(constants, joint_position)
    )
    return -np.einsum("ni,ni->n", gravity_in_floor(parameters), moment)


def mechanical_energy(parameters: Parameters, state: Any) -> Array:
    """Return kinetic and potential energy (N,), J, of robots in a plant's truth or mechanical state."""
    motion = state.linear_velocity_in_body, state.angular_velocity_in_body, state.joint_position, state.joint_velocity
    place = state.position, state.quaternion, state.joint_position
    return kinetic_energy(parameters, *motion) + potential_energy(parameters, *place)


def wheel_gaps(parameters: Parameters, truth: Truth) -> Array:
    """Return the height (N, 4) of every thin-disc wheel's lowest point over the floor, m."""
    normal = rotation_matrix(truth.quaternion)[:, 2]
    angle = truth.joint_position[:, :4]
    axle = parameters["hip.position"][:, None, :] * [[1, 1, 1], [1, -1, 1], [-1, 1, 1], [-1, -1, 1]]
    axle += parameters["leg.length"][..., None] * np.stack([np.cos(angle), 0 * angle, -np.sin(angle)], axis=-1)
    reach = parameters["wheel.radius"] * np.hypot(normal[:, :1], normal[:, 2:])
    return truth.position[:, 2:] + np.einsum("nwk,nk->nw", axle, normal) - reach


def _first_moment(constants: dict[str, Array], joint_position: Array) -> Array:
    """First moment of the whole robot about the body origin (N, 3), body frame, kg m."""
    mass, moment, angle = constants["assembly_mass"], constants["first_moment"], joint_position[:, LEG_SLICE]
    x = mass * constants["hip_x"] + moment * np.cos(angle)
    z = mass * constants["hip_z"] - moment * np.sin(angle)
    assemblies = np.stack([x, mass * constants["hip_y"], z], axis=2).sum(axis=1)
    return constants["platform_first_moment"] + assemblies
