"""Numpy reference of the robot's mechanics, batched over N robots and built on the generated equations.

The engine, the tests and the paper's model share it. SI units. Frames: ``v`` and ``w`` are the velocity of the body origin and
the angular velocity, both in the body frame; positions and gravity are in the floor frame. ``leg_rate`` and ``wheel_rate``
are the ABSOLUTE pitch rates of :mod:`wlr_gym.physics.model.equations`; ``joint_velocity`` is relative to the parent link.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from wlr_gym.base.errors import InputError
from wlr_gym.physics.model.equations import assembly_terms, platform_terms
from wlr_gym.robot import CORNER_SIGNS, LEG_SLICE, WHEEL_SLICE
from wlr_gym.robot.parameters import Parameters

Array = NDArray[np.float64]

#: Names in :func:`inertial_constants` that describe one leg with its wheel, in the argument order of ``assembly_terms``.
ASSEMBLY_CONSTANTS = (
    "hip_x", "hip_y", "hip_z", "assembly_mass", "first_moment", "second_moment", "leg_ixx", "leg_iyy", "leg_izz",
    "wheel_transverse", "wheel_spin", "armature_leg", "armature_wheel",
)  # fmt: skip
_SIGNS = np.array(CORNER_SIGNS)
_LEG_ROWS = slice(6, 10)
_WHEEL_ROWS = slice(10, 14)


def inertial_constants(parameters: Parameters) -> dict[str, Array]:
    """Return what the equations need of the parameters.

    Returns:
        platform_mass (N,), platform_first_moment (N, 3) and platform_inertia (N, 6: xx, yy, zz, xy, xz, yz about the body
        origin, xy = -integral of x y dm), payload included; and the names of :data:`ASSEMBLY_CONSTANTS`, each (N, 4) in
        corner order.
    """
    leg_mass, wheel_mass = parameters["leg.mass"], parameters["wheel.mass"]
    com, length = parameters["leg.com_along_leg"], parameters["leg.length"]
    leg_inertia = parameters["leg.inertia"].reshape(-1, 4, 3)
    hip, armature = parameters["hip.position"], parameters["servo.armature"]
    return _platform_constants(parameters) | {
        "hip_x": hip[:, 0:1] * _SIGNS[:, 0],
        "hip_y": hip[:, 1:2] * _SIGNS[:, 1],
        "hip_z": np.repeat(hip[:, 2:3], 4, axis=1),
        "assembly_mass": leg_mass + wheel_mass,
        "first_moment": leg_mass * com + wheel_mass * length,
        "second_moment": leg_mass * com**2 + wheel_mass * length**2,
        "leg_ixx": leg_inertia[:, :, 0],
        "leg_iyy": leg_inertia[:, :, 1],
        "leg_izz": leg_inertia[:, :, 2],
        "wheel_transverse": parameters["wheel.transverse_inertia"],
        "wheel_spin": parameters["wheel.spin_inertia"],
        "armature_leg": armature[:, LEG_SLICE],
        "armature_wheel": armature[:, WHEEL_SLICE],
    }


def _platform_constants(parameters: Parameters) -> dict[str, Array]:
    """Platform and payload as one rigid body about the body origin."""
    body_mass, payload_mass = parameters["body.mass"], parameters["payload.mass"]
    com, payload = parameters["body.com_offset"], parameters["payload.position"]
    inertia = np.zeros((len(parameters), 6))
    inertia[:, :3] = parameters["body.inertia"]
    inertia += point_inertia(body_mass, com) + point_inertia(payload_mass, payload) + parameters["payload.inertia"]
    return {
        "platform_mass": body_mass + payload_mass,
        "platform_first_moment": body_mass[:, None] * com + payload_mass[:, None] * payload,
        "platform_inertia": inertia,
    }


def point_inertia(mass: Array, position: Array) -> Array:
    """Inertia (N, 6) about the origin of mass points (N,) at positions (N, 3)."""
    x, y, z = position.T
    return (mass * np.array([y * y + z * z, x * x + z * z, x * x + y * y, -x * y, -x * z, -y * z])).T


def mass_matrix_and_bias(
    parameters: Parameters, joint_position: Array, w: Array, leg_rate: Array, wheel_rate: Array
) -> tuple[Array, Array]:
    """Return M (N, 14, 14) and bias (N, 14) of ``M (a0; w'; leg_rate'; wheel_rate') + bias = Q``.

    Args:
        parameters: N robots.
        joint_position: (N, 8) rad; only the leg angles matter.
        w: (N, 3) angular velocity, body frame, rad/s.
        leg_rate, wheel_rate: (N, 4) absolute pitch rates, rad/s.
    """
    constants = inertial_constants(parameters)
    mass_matrix, bias = np.zeros((len(parameters), 14, 14)), np.zeros((len(parameters), 14))
    platform = (constants["platform_mass"], *constants["platform_first_moment"].T, *constants["platform_inertia"].T)
    _add(mass_matrix, bias, *platform_terms(*platform, *w.T))
    for corner in range(4):
        leg, wheel = 6 + corner, 10 + corner
        angle = joint_position[:, corner]
        arguments = [constants[name][:, corner] for name in ASSEMBLY_CONSTANTS]
        arguments += [np.sin(angle), np.cos(angle), *w.T, leg_rate[:, corner], wheel_rate[:, corner]]
        base_mass, base_bias, coupling, leg_leg, leg_wheel, wheel_wheel, leg_bias, wheel_bias = assembly_terms(*arguments)
        leg_block = {(row, leg): value for row, value in coupling.items()} | {
            (leg, leg): leg_leg,
            (leg, wheel): leg_wheel,
            (wheel, wheel): wheel_wheel,
        }
        _add(mass_matrix, bias, base_mass | leg_block, base_bias | {leg: leg_bias, wheel: wheel_bias})
    lower = np.tril_indices(14, -1)
    mass_matrix[:, lower[0], lower[1]] = mass_matrix[:, lower[1], lower[0]]
    return mass_matrix, bias


def _add(mass_matrix: Array, bias: Array, entries: dict, rows: dict) -> None:
    for (row, column), value in entries.items():
        mass_matrix[:, row, column] += value
    for row, value in rows.items():
        bias[:, row] += value


def absolute_rates(w: Array, joint_velocity: Array) -> tuple[Array, Array]:
    """Return absolute pitch rates of legs and wheels, (N, 4) each, from rates relative to the parent link (N, 8)."""
    leg_rate = w[:, 1:2] + joint_velocity[:, LEG_SLICE]
    return leg_rate, leg_rate + joint_velocity[:, WHEEL_SLICE]


def absolute_forces(force: Array) -> Array:
    """Return the generalised forces (N, 14) that belong to the absolute rates.

    Args:
        force: (N, 14) force and moment on the body at its origin (body frame, N and N m), then the 8 joint torques. A joint's
            torque acts on its child and reacts on its parent.
    """
    absolute = force.copy()
    absolute[:, 4] -= force[:, _LEG_ROWS].sum(axis=1)
    absolute[:, _LEG_ROWS] -= force[:, _WHEEL_ROWS]
    return absolute


def accelerations(
    parameters: Parameters, quaternion: Array, v: Array, w: Array, joint_position: Array, joint_velocity: Array, force: Array
) -> Array:
    """Return (N, 14): dv/dt and dw/dt (rates of the body-frame components), then joint accelerations relative to the parent.

    Args:
        parameters: N robots.
        quaternion: (N, 4) body to floor frame, (w, x, y, z).
        v, w: (N, 3) velocity of the body origin and angular velocity, body frame.
        joint_position, joint_velocity: (N, 8).
        force: (N, 14) as in :func:`absolute_forces`.
    """
    leg_rate, wheel_rate = absolute_rates(w, joint_velocity)
    mass_matrix, bias = mass_matrix_and_bias(parameters, joint_position, w, leg_rate, wheel_rate)
    result = np.asarray(np.linalg.solve(mass_matrix, (absolute_forces(force) - bias)[:, :, None])[:, :, 0], dtype=np.float64)
    gravity_in_body = np.einsum("nji,nj->ni", rotation_matrix(quaternion), gravity_in_floor(parameters))
    result[:, :3] += gravity_in_body - np.cross(w, v)
    result[:, _WHEEL_ROWS] -= result[:, _LEG_ROWS]
    result[:, _LEG_ROWS] -= result[:, 4:5]
    return result


def gravity_in_floor(parameters: Parameters) -> Array:
    """Return gravity (N, 3) in the floor frame, m/s2: the floor's x axis climbs at slope[pitch], its y axis at slope[roll].

    Raises:
        InputError: no plane has both inclinations.
    """
    uphill = np.sin(parameters["ground.slope"])
    squared = 1.0 - (uphill**2).sum(axis=1)
    if (squared < 0).any():
        robot = int(np.argmax(squared < 0))
        pitch, roll = parameters["ground.slope"][robot]
        raise InputError(
            f"parameter ground.slope = ({pitch:g}, {roll:g}) rad (robot {robot} of the batch): no plane climbs so much "
            "along both axes, sin(pitch)^2 + sin(roll)^2 must not exceed 1"
        )
    return -parameters["gravity"][:, None] * np.column_stack([uphill, np.sqrt(squared)])


def rotation_matrix(quaternion: Array) -> Array:
    """Return rotation matrices (N, 3, 3), body to floor frame, of unit quaternions (N, 4: w, x, y, z)."""
    w, x, y, z = quaternion.T
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.array(rows).transpose(2, 0, 1)
