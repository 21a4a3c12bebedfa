"""The verdict on every equation of the paper, with its functions as printed, with misprints undone, and corrected.

Verdicts: ``correct``; ``conditional`` (true under a condition the paper does not state); ``misprint`` (print or OCR: which of
the two cannot be told from the text); ``incomplete`` (terms are missing); ``wrong`` (physics). studies/tests/paper proves
each of them. The functions here undo the misprints: each equation as the paper's own S, V, D and (18) give it, still not a
model of the robot. The physics that the paper's S, V and D leave out is in :mod:`studies.paper.corrected`.

Source: Korayem, Nikseresht, Asadi 2024, "Vision-based dynamic modeling of wheeled-legged robot considering slippage using
Gibbs-Appell formulation", Robotica.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any

from studies.paper import corrected, printed
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


# ---- the verdicts ----------------------------------------------------------------------------------------------------


CORRECT = "correct"
CONDITIONAL = "conditional"
MISPRINT = "misprint"
INCOMPLETE = "incomplete"
WRONG = "wrong"


@dataclass(frozen=True)
class Equation:
    """One equation of the paper.

    Attributes:
        number, title: in the paper. verdicts: of the words above.
        remark: what is right or wrong with it, in a sentence.
        correction: the right form, as text.
        printed, repaired, corrected: functions; ``repaired`` is None where nothing, or only a last bracket, is misprinted.
    """

    number: int
    title: str
    verdicts: tuple[str, ...]
    remark: str
    correction: str
    printed: Callable[..., Any] | None
    corrected: Callable[..., Any] | None
    repaired: Callable[..., Any] | None = None


def _rows() -> list[tuple[int, str, tuple[str, ...], str, str]]:
    wheels = ("right front wheel", "left front wheel", "right rear wheel", "left rear wheel")
    slip = (
        "called the wheel's velocity, it is (contact point) - (slip): 0 on every true motion; leg and pitch rates are missing"
    )
    true_slip = "x_s' = x' - y_i th' + X_i' - a (th_i' + leg' + psi'), y_s' = y' + th' X_i, z_s' = 0"
    torque = (
        "= dS/dth_i'' once its bracket is closed; that bracket is 0 on a true motion, and the traction a F_x, most of the "
        "torque, is missing"
    )
    true_torque = "tau_i = I_o (th_i'' + leg'' + psi'') + J_w th_i'' + a F_x,i"
    force = "lost sgn(x_s'); = left side of (18), which is 0 on a true motion, not a force"
    true_force = "F_x,i = (tau_i - I_o (th_i'' + leg'' + psi'') - J_w th_i'')/a, at most mu N_i; -mu N_i sgn(x_s') when sliding"
    denominator = "denominator lost 'l(': adds metres to a pure number"
    no_inertia = f"{denominator}; lost sgn(y'); lateral inertia dropped; = left side of (18) again, not a force"
    lateral = "the rows of y and th give it: F_f + F_r = inertia of y, X_f F_f + X_r F_r = inertia of th - moment of the F_x,i"
    return [
        (1, "velocity of a wheel centre", (CORRECT,), "relative velocity taken in the yaw frame", "as printed"),
        (
            2, "velocity of the body", (CONDITIONAL,),
            "true for components of the yaw frame only, which is not said",
            "x' = X' cos th + Y' sin th, y' = Y' cos th - X' sin th",
        ),
        *((n, wheel, (CONDITIONAL, INCOMPLETE), slip, true_slip) for n, wheel in enumerate(wheels, 3)),
        (
            7, "Gibbs function of the wheels", (CONDITIONAL, INCOMPLETE),
            "right for absolute wheel angles; wheel mass and diametral inertia are missing",
            "I_o/2 (th_i'' + leg'' + psi'')^2 + J_w/2 th_i''^2 + I_t/2 th''^2 + m_w/2 a_i^2",
        ),
        (
            8, "Gibbs function of the legs", (WRONG,),
            "leg spin and angle are relative, velocity terms missing, a_i is the residual of (3)-(6), not a leg's acceleration",
            "absolute alpha'' + psi'', cos^2(alpha + psi), I_along sin^2, coupling terms, acceleration of the mid-leg point",
        ),
        (
            9, "Gibbs function of the body", (MISPRINT, INCOMPLETE),
            "Psi'^2 for Psi''^2; inertia about x and velocity terms of a pitched body are missing",
            "I_yaw = I_Gx sin^2 psi + I_Gz cos^2 psi; + I_yaw' psi' th' th'' - I_yaw'/2 th'^2 psi''",
        ),
        (10, "Gibbs function", (INCOMPLETE, WRONG), "sum of (7)-(9), Psi''^2 right; has their faults", "sum of them"),
        (
            11, "acceleration of the body", (WRONG,),
            "drops -th' y': true without lateral velocity only", "(x'' - th' y') i + (y'' + th' x') j + z'' k",
        ),
        (
            12, "potential", (MISPRINT,),
            "legs' term without psi; and psi must be eliminated before differentiating",
            "V = g l (m_l + M_G/2)(sin(alpha + psi) + sin(beta + psi)) + constants",
        ),
        (
            13, "Dahl friction", (INCOMPLETE,), "state equation missing; sigma_0 is a stiffness, not a roughness",
            "F = -sigma_0 z, z' = v - sigma_0 |v| z/(mu F_n)",
        ),
        (
            14, "Coulomb friction", (CONDITIONAL,),
            "steady sliding limit of (13), with v the slip velocity, not the wheel's; says nothing of sticking",
            "F = -mu F_n s/|s| for slip s; |F| <= mu F_n at rest",
        ),
        (
            15, "dissipation", (MISPRINT, CONDITIONAL),
            "bracket after mu_dx is not closed; adds x and y to a square: up to sqrt(2) mu F_n",
            "sum F_n sqrt((mu_x x_s')^2 + (mu_y y_s')^2), F_n not differentiated",
        ),
        (16, "normal force in front", (CORRECT,), "at rest, mass of the leg at mid-leg, massless wheels", "+ m_w g"),
        (17, "normal force behind", (CORRECT,), "likewise", "+ m_w g"),
        (18, "Gibbs-Appell with slip", (CORRECT,), "for slip coordinates the right side is 0", "as printed"),
        (
            19, "torque of the front legs", (MISPRINT, INCOMPLETE, WRONG),
            "z-part lost a factor 2 and has the leg inside its 1/2; gravity, normal forces and traction are missing",
            "tau_alpha = 2 (J_l + I_o + J_h) alpha'' + ... + 2 l cos f (N_f - m_l g/2) + (l sin f + a)(F_rf + F_lf)",
        ),
        (20, "torque of the rear legs", (MISPRINT, INCOMPLETE, WRONG), "as (19)", "as (19) with beta"),
        *((n, f"torque of the {wheel}", (MISPRINT, WRONG), torque, true_torque) for n, wheel in enumerate(wheels, 21)),
        *((n, f"force on the {wheel}", (MISPRINT, WRONG), force, true_force) for n, wheel in enumerate(wheels[:2], 25)),
        (27, "force on the right rear wheel", (MISPRINT, WRONG), f"sign of th'' l_y; {force}", true_force),
        (28, "force on the left rear wheel", (MISPRINT, WRONG), f"{denominator}; {force}", true_force),
        (29, "lateral force in front", (MISPRINT, INCOMPLETE, WRONG), no_inertia, lateral),
        (30, "lateral force behind", (MISPRINT, INCOMPLETE, WRONG), no_inertia, lateral),
    ]  # fmt: skip


def _function(names: Mapping[str, Any], number: int) -> Callable[..., Any] | None:
    """The function of an equation among the names of a module; None = there is none."""
    return next((value for name, value in names.items() if name.startswith(f"eq{number}_")), None)


#: Every equation by its number.
EQUATIONS: dict[int, Equation] = {
    row[0]: Equation(*row, *(_function(names, row[0]) for names in (vars(printed), vars(corrected), globals())))
    for row in _rows()
}


def verdict_table() -> list[str]:
    """Return the verdicts as lines of a Markdown table; equations of one verdict, remark and correction share a line."""
    groups: dict[tuple[tuple[str, ...], str, str], list[Equation]] = {}
    for equation in EQUATIONS.values():
        groups.setdefault((equation.verdicts, equation.remark, equation.correction), []).append(equation)
    lines = ["| | equation | verdict | why | correct |", "|---|---|---|---|---|"]
    for (verdicts, remark, right), same in groups.items():
        numbers, titles = ", ".join(f"({e.number})" for e in same), "; ".join(e.title for e in same)
        why, form = remark.replace("|", "\\|").replace("*", "\\*"), right.replace("|", "\\|")
        lines.append(f"| {numbers} | {titles} | {', '.join(verdicts)} | {why} | `{form}` |")
    return lines
