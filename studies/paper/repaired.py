"""The misprints undone: each equation as the paper's own S, V, D and (18) give it. Still not a model of the robot.

Only the equations that are misprinted stand here; :data:`studies.paper.verdicts.EQUATIONS` has them all. The physics
that the paper's S, V and D leave out is in :mod:`studies.paper.corrected`.
"""

from __future__ import annotations

from functools import partial

from studies.paper import printed
from studies.paper.quantities import PaperConstants, State, Value, cos, is_front, sign, sin


def eq9_gibbs_function_of_the_body(c: PaperConstants, s: State) -> Value:
    """(9) with Psi''^2, as in (10)."""
    squared = sum(component**2 for component in printed.eq11_acceleration_of_the_body(s))
    return (c.I_Gz * s.yaw_dd**2 + c.I_Gy * s.psi_dd**2 + c.M_G * squared) / 2


def eq12_potential(c: PaperConstants, s: State) -> Value:
    """(12) with alpha + psi and beta + psi in the legs' term too."""
    return c.g * c.l * (c.m_l + c.M_G / 2) * (sin(s.alpha + s.psi) + sin(s.beta + s.psi))


def eq15_dissipation(c: PaperConstants, s: State, f_nf: Value, f_nr: Value) -> Value:
    """(15) with the bracket after mu_dx closed before the lateral part."""
    along = sum((f_nf if is_front(w) else f_nr) * slip * sign(slip) for w, slip in s.x_s_d.items())
    across = f_nf * s.y_f_d * sign(s.y_f_d) + f_nr * s.y_r_d * sign(s.y_r_d)
    return c.mu_dx * along + 2 * c.mu_dy * across


def _leg_torque(c: PaperConstants, s: State, right: str, left: str) -> Value:
    """(19), (20): 2 I_ly leg'' + m_l l sum(-A_x sin + A_z cos): the factor 2 of the z-part back, the leg out of its 1/2."""
    phi, leg_dd = s.absolute_leg(right)[0], s.leg(right)[2]
    total = 0
    for wheel in (right, left):
        along, _, down = printed.leg_acceleration(c, s, wheel)
        total = total - along * sin(phi) + down * cos(phi)
    return 2 * c.I_ly * leg_dd + c.m_l * c.l * total


eq19_torque_of_the_front_legs = partial(_leg_torque, right="rf", left="lf")
eq20_torque_of_the_rear_legs = partial(_leg_torque, right="rr", left="lr")


def _longitudinal_force(c: PaperConstants, s: State, wheel: str) -> Value:
    """(25)-(28): -m_l A_x + mu F_n sgn(x_s'): the sgn back, -theta'' l_y in (27), the denominator of (28) the wheelbase."""
    normal = printed.eq16_normal_force_in_front(c, s) if is_front(wheel) else printed.eq17_normal_force_behind(c, s)
    return -c.m_l * printed.leg_acceleration(c, s, wheel)[0] + c.mu_dx * normal * sign(s.x_s_d[wheel])


eq25_force_on_the_right_front_wheel = partial(_longitudinal_force, wheel="rf")
eq26_force_on_the_left_front_wheel = partial(_longitudinal_force, wheel="lf")
eq27_force_on_the_right_rear_wheel = partial(_longitudinal_force, wheel="rr")
eq28_force_on_the_left_rear_wheel = partial(_longitudinal_force, wheel="lr")


def eq29_lateral_force_in_front(c: PaperConstants, s: State) -> Value:
    """(29): 2 mu_dy F_nf sgn(y_f'), over the right denominator."""
    return 2 * c.mu_dy * printed.eq16_normal_force_in_front(c, s) * sign(s.y_f_d)


def eq30_lateral_force_behind(c: PaperConstants, s: State) -> Value:
    """(30): 2 mu_dy F_nr sgn(y_r'), over the right denominator."""
    return 2 * c.mu_dy * printed.eq17_normal_force_behind(c, s) * sign(s.y_r_d)
