"""Equations (1) to (30) as printed, symbol by symbol. Do not simulate with them: see :mod:`studies.paper.verdicts`.

A bracket that is opened and never closed is closed at the end of its equation. ``s`` is the state, ``c`` the constants. The
z-parts of (19) and (20) count z downwards (wheels above the hips if z were up); :func:`leg_acceleration` can do both.
"""

from __future__ import annotations

from functools import partial
from typing import Any

from studies.paper.quantities import (
    WHEELS,
    PaperConstants,
    State,
    Value,
    Vector,
    ahead,
    cos,
    is_front,
    lever,
    sign,
    sin,
    to_the_right,
    wheelbase,
)


def eq1_velocity_of_a_wheel_centre(v_g: Vector, yaw_d: Value, r: Vector, r_d: Vector) -> Vector:
    """(1): v = v_G + theta' k x r_O/G + v_O/G, components of the yaw frame."""
    return v_g[0] - yaw_d * r[1] + r_d[0], v_g[1] + yaw_d * r[0] + r_d[1], v_g[2] + r_d[2]


def eq2_velocity_of_the_body(s: State) -> Vector:
    """(2): (x', y', z')."""
    return s.x_d, s.y_d, s.z_d


def wheel_vector(c: PaperConstants, s: State, wheel: str) -> tuple[Vector, Vector]:
    """r and r' of a wheel's centre from G, yaw frame, z up; (3)-(6) name them and do not print them."""
    phi, phi_d, _ = s.absolute_leg(wheel)
    hip = ahead(wheel) * c.l_x / 2
    x, z = hip * cos(s.psi) + c.l * cos(phi), -hip * sin(s.psi) - c.l * sin(phi)
    x_d = -hip * sin(s.psi) * s.psi_d - c.l * sin(phi) * phi_d
    z_d = -hip * cos(s.psi) * s.psi_d - c.l * cos(phi) * phi_d
    return (x, -to_the_right(wheel) * c.l_y / 2, z), (x_d, 0.0, z_d)


def _wheel_velocity(c: PaperConstants, s: State, wheel: str) -> Vector:
    """(3), (4), (5), (6): (x' - x_s' - a theta') i + (y' - y_s') j + (z' - z_s') k + theta' k x r + r'."""
    v = (s.x_d - s.x_s_d[wheel] - c.a * s.theta_d[wheel], s.y_d - s.y_s_d[wheel], s.z_d - s.z_s_d[wheel])
    return eq1_velocity_of_a_wheel_centre(v, s.yaw_d, *wheel_vector(c, s, wheel))


eq3_velocity_of_the_right_front_wheel = partial(_wheel_velocity, wheel="rf")
eq4_velocity_of_the_left_front_wheel = partial(_wheel_velocity, wheel="lf")
eq5_velocity_of_the_right_rear_wheel = partial(_wheel_velocity, wheel="rr")
eq6_velocity_of_the_left_rear_wheel = partial(_wheel_velocity, wheel="lr")


def eq7_gibbs_function_of_the_wheels(c: PaperConstants, s: State) -> Value:
    """(7): I_o/2 sum theta_i''^2."""
    return c.I_o / 2 * sum(s.theta_dd[wheel] ** 2 for wheel in WHEELS)


def leg_acceleration(c: PaperConstants, s: State, wheel: str, z_down: bool = True) -> Vector:
    """What the paper takes for the acceleration a_i of a leg: d/dt of the components of (3)-(6), without theta' x v.

    The lateral part keeps the terms of theta' k x r; no equation of the paper uses it.
    """
    phi, phi_d, phi_dd = s.absolute_leg(wheel)
    side, sigma = to_the_right(wheel) * c.l_y / 2, ahead(wheel) * c.l_x / 2
    up = 1 if z_down else -1
    x = (
        s.x_dd - s.x_s_dd[wheel] - c.a * s.theta_dd[wheel] + side * s.yaw_dd
        - sigma * (s.psi_dd * sin(s.psi) + s.psi_d**2 * cos(s.psi)) - c.l * (phi_dd * sin(phi) + phi_d**2 * cos(phi))
    )  # fmt: skip
    x_d = -sigma * sin(s.psi) * s.psi_d - c.l * sin(phi) * phi_d
    y = s.y_dd - s.y_s_dd[wheel] + s.yaw_dd * lever(c, s, wheel) + s.yaw_d * x_d
    z = (
        s.z_dd - s.z_s_dd[wheel]
        + up * (sigma * (s.psi_dd * cos(s.psi) - s.psi_d**2 * sin(s.psi)) + c.l * (phi_dd * cos(phi) - phi_d**2 * sin(phi)))
    )  # fmt: skip
    return x, y, z


def eq8_gibbs_function_of_the_legs(c: PaperConstants, s: State, accelerations: dict[str, Vector]) -> Value:
    """(8): I_ly (alpha''^2 + beta''^2) + I_lx theta''^2 (cos^2 alpha + cos^2 beta) + m_l/2 sum a_i^2."""
    squares = sum(component**2 for wheel in WHEELS for component in accelerations[wheel])
    return (
        c.I_ly * (s.alpha_dd**2 + s.beta_dd**2)
        + c.I_lx * s.yaw_dd**2 * (cos(s.alpha) ** 2 + cos(s.beta) ** 2)
        + c.m_l / 2 * squares
    )


def eq9_gibbs_function_of_the_body(c: PaperConstants, s: State) -> Value:
    """(9): 1/2 (I_Gz theta''^2 + I_Gy Psi'^2 + M_G a_G^2), with the Psi' that (10) prints as Psi''."""
    return (c.I_Gz * s.yaw_dd**2 + c.I_Gy * s.psi_d**2 + c.M_G * _squared(eq11_acceleration_of_the_body(s))) / 2


def eq10_gibbs_function(c: PaperConstants, s: State, accelerations: dict[str, Vector]) -> Value:
    """(10): the sum of (7), (8) and (9), with Psi''^2."""
    body = (c.I_Gz * s.yaw_dd**2 + c.I_Gy * s.psi_dd**2 + c.M_G * _squared(eq11_acceleration_of_the_body(s))) / 2
    return eq7_gibbs_function_of_the_wheels(c, s) + eq8_gibbs_function_of_the_legs(c, s, accelerations) + body


def eq11_acceleration_of_the_body(s: State) -> Vector:
    """(11): x'' i + y'' j + z'' k + theta' k x x' i."""
    return s.x_dd, s.y_dd + s.yaw_d * s.x_d, s.z_dd


def eq12_potential(c: PaperConstants, s: State) -> Value:
    """(12): g l (m_l (sin alpha + sin beta) + M_G/2 (sin(alpha + psi) + sin(beta + psi)))."""
    legs = c.m_l * (sin(s.alpha) + sin(s.beta))
    return c.g * c.l * (legs + c.M_G / 2 * (sin(s.alpha + s.psi) + sin(s.beta + s.psi)))


def eq13_dahl_friction(sigma_0: Value, displacement: Value) -> Value:
    """(13): F = -sigma_0 z."""
    return -sigma_0 * displacement


def eq14_coulomb_friction(mu: Value, f_n: Value, velocity: Value) -> Value:
    """(14): F = -mu F_n sgn(v), v called the linear velocity of the wheels."""
    return -mu * f_n * sign(velocity)


def eq15_dissipation(c: PaperConstants, s: State, f_nf: Value, f_nr: Value) -> Value:
    """(15), whose bracket after mu_dx is never closed: it would take the lateral part in, times mu_dx."""
    along = sum((f_nf if is_front(w) else f_nr) * s.x_s_d[w] * sign(s.x_s_d[w]) for w in WHEELS)
    across = f_nf * s.y_f_d * sign(s.y_f_d) + f_nr * s.y_r_d * sign(s.y_r_d)
    return c.mu_dx * (along + 2 * c.mu_dy * across)


def _squared(vector: Vector) -> Value:
    return sum(component**2 for component in vector)


def front_moment(c: PaperConstants, s: State) -> Value:
    """The numerator of (16), N m."""
    hips, front, rear = c.l_x * cos(s.psi), c.l * cos(s.alpha + s.psi), c.l * cos(s.beta + s.psi)
    return c.M_G * c.g / 2 * (hips / 2 - rear) + c.m_l * c.g * (hips + front / 2 - 3 * rear / 2)


def rear_moment(c: PaperConstants, s: State) -> Value:
    """The numerator of (17), N m."""
    hips, front, rear = c.l_x * cos(s.psi), c.l * cos(s.alpha + s.psi), c.l * cos(s.beta + s.psi)
    return c.M_G * c.g / 2 * (hips / 2 + front) + c.m_l * c.g * (hips + 3 * front / 2 - rear / 2)


def _misprinted_base(c: PaperConstants, s: State) -> Value:
    """The denominator of (28)-(30), where "l(" is lost."""
    return c.l_x * cos(s.psi) + c.l * cos(s.alpha + s.psi) - cos(s.beta + s.psi)


def eq16_normal_force_in_front(c: PaperConstants, s: State) -> Value:
    """(16): on one front wheel, N."""
    return front_moment(c, s) / wheelbase(c, s)


def eq17_normal_force_behind(c: PaperConstants, s: State) -> Value:
    """(17): on one rear wheel, N."""
    return rear_moment(c, s) / wheelbase(c, s)


def eq18_generalised_force(ds: Value, dd: Value, dv: Value) -> Value:
    """(18): dS/dq'' + dD/dq' + dV/dq = tau."""
    return ds + dd + dv


def _leg_torque(c: PaperConstants, s: State, right: str, left: str) -> Value:
    """(19), (20): sum of both hip motors of an axle, N m.

    One bracket for each wheel of the axle, all inside 1/2 m_l(...), the z-part with 1/2 over all of it.
    """
    phi, phi_d, phi_dd = s.absolute_leg(right)
    sigma, leg_dd = ahead(right) * c.l_x, s.leg(right)[2]
    pitch_x = -sigma * s.psi_dd * sin(s.psi) - sigma * s.psi_d**2 * cos(s.psi)
    pitch_z = sigma * s.psi_dd * cos(s.psi) - sigma * s.psi_d**2 * sin(s.psi)
    total = 0
    for wheel in (right, left):
        along = (
            s.x_dd - s.x_s_dd[wheel] - c.a * s.theta_dd[wheel] + (to_the_right(wheel) * s.yaw_dd * c.l_y + pitch_x) / 2
            - c.l * phi_dd * sin(phi) - c.l * phi_d**2 * cos(phi)
        )  # fmt: skip
        up = s.z_dd - s.z_s_dd[wheel] + (pitch_z + c.l * phi_dd * cos(phi) - c.l * phi_d**2 * sin(phi)) / 2
        total = total - 2 * along * c.l * sin(phi) + up * c.l * cos(phi)
    return 2 * c.I_ly * leg_dd + c.m_l * total / 2


eq19_torque_of_the_front_legs = partial(_leg_torque, right="rf", left="lf")
eq20_torque_of_the_rear_legs = partial(_leg_torque, right="rr", left="lr")


def _wheel_torque(c: PaperConstants, s: State, wheel: str) -> Value:
    """(21), (22), (23), (24), their last bracket closed at the end: I_o theta'' - m_l a (x'' - ...), N m."""
    return c.I_o * s.theta_dd[wheel] - c.m_l * c.a * leg_acceleration(c, s, wheel)[0]


eq21_torque_of_the_right_front_wheel = partial(_wheel_torque, wheel="rf")
eq22_torque_of_the_left_front_wheel = partial(_wheel_torque, wheel="lf")
eq23_torque_of_the_right_rear_wheel = partial(_wheel_torque, wheel="rr")
eq24_torque_of_the_left_rear_wheel = partial(_wheel_torque, wheel="lr")


def _longitudinal_force(c: PaperConstants, s: State, wheel: str, yaw_sign: int, friction: Value) -> Value:
    """(25)-(28): m_l/2 (-2 x'' + 2 x_s'' + 2 a theta'' + yaw_sign theta'' l_y ...) + mu_dx F_n, without sgn."""
    phi, phi_d, phi_dd = s.absolute_leg(wheel)
    sigma = ahead(wheel) * c.l_x
    inertia = (
        -2 * s.x_dd + 2 * s.x_s_dd[wheel] + 2 * c.a * s.theta_dd[wheel] + yaw_sign * s.yaw_dd * c.l_y
        + sigma * s.psi_dd * sin(s.psi) + sigma * s.psi_d**2 * cos(s.psi)
        + 2 * c.l * phi_dd * sin(phi) + 2 * c.l * phi_d**2 * cos(phi)
    )  # fmt: skip
    return c.m_l * inertia / 2 + c.mu_dx * friction


def eq25_force_on_the_right_front_wheel(c: PaperConstants, s: State) -> Value:
    """(25): N."""
    return _longitudinal_force(c, s, "rf", -1, eq16_normal_force_in_front(c, s))


def eq26_force_on_the_left_front_wheel(c: PaperConstants, s: State) -> Value:
    """(26): N."""
    return _longitudinal_force(c, s, "lf", +1, eq16_normal_force_in_front(c, s))


def eq27_force_on_the_right_rear_wheel(c: PaperConstants, s: State) -> Value:
    """(27): N. Prints + theta'' l_y where (23) and (25) have it with the other sign."""
    return _longitudinal_force(c, s, "rr", +1, eq17_normal_force_behind(c, s))


def eq28_force_on_the_left_rear_wheel(c: PaperConstants, s: State) -> Value:
    """(28): over a denominator that adds metres to a pure number."""
    return _longitudinal_force(c, s, "lr", +1, rear_moment(c, s) / _misprinted_base(c, s))


def eq29_lateral_force_in_front(c: PaperConstants, s: State) -> Value:
    """(29): both front wheels, over the same denominator as (28), N."""
    return 2 * c.mu_dy * front_moment(c, s) / _misprinted_base(c, s)


def eq30_lateral_force_behind(c: PaperConstants, s: State) -> Value:
    """(30): both rear wheels, N."""
    return 2 * c.mu_dy * rear_moment(c, s) / _misprinted_base(c, s)


def forces_as_used(c: PaperConstants, s: State) -> dict[str, Any]:
    """Return (19)-(28) at one state, as the paper uses them: driven by measured motion and slip."""
    forces = (
        eq25_force_on_the_right_front_wheel, eq26_force_on_the_left_front_wheel,
        eq27_force_on_the_right_rear_wheel, eq28_force_on_the_left_rear_wheel,
    )  # fmt: skip
    return {
        "tau_alpha": eq19_torque_of_the_front_legs(c, s),
        "tau_beta": eq20_torque_of_the_rear_legs(c, s),
        "tau_theta": {wheel: _wheel_torque(c, s, wheel) for wheel in WHEELS},
        "x": {wheel: equation(c, s) for wheel, equation in zip(WHEELS, forces, strict=True)},
    }
