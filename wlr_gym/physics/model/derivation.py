"""The equations of motion, derived symbolically by the Gibbs-Appell method (docs/derivation.md is the handout).

The robot is a rigid platform with four leg-and-wheel assemblies. With quasi-velocities u and the Gibbs function
S(u'), the "energy of the accelerations", the equations of motion are dS/du' = Q. S is a sum over bodies, so the platform
and ONE assembly at a general hip are derived; a robot is their sum. Nothing else is needed: no Lagrange multipliers, no
kinetic energy, no free-body diagrams.

Quasi-velocities (body frame: x forward, y left, z up, origin at the platform's geometric centre):
    v            velocity of the origin, body frame, m/s
    w            angular velocity of the platform, body frame, rad/s
    leg_rate     ABSOLUTE pitch rate of a leg   = w_y + hip joint rate, rad/s
    wheel_rate   ABSOLUTE spin rate of a wheel  = leg_rate + wheel joint rate, rad/s
Quasi-acceleration of the origin: a0 = v' + w x v - gravity. Gravity is thus an acceleration of the frame, and neither it
nor v occurs anywhere else: M (a0, w', leg_rate', wheel_rate') + bias(w, leg_rate, wheel_rate, q) = Q.

Only tests and :mod:`wlr_gym.physics.model.generate` import this module; it needs sympy.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import sympy as sp

# sympy's own annotations are too wide to check against
Expression = Any
Matrix = Any

HALF = sp.Rational(1, 2)
PITCH_AXIS: Matrix = sp.Matrix([0, 1, 0])

# Velocities and accelerations of the platform. "_dot" marks a quasi-acceleration.
W: Matrix = sp.Matrix(sp.symbols("wx wy wz"))
W_DOT: Matrix = sp.Matrix(sp.symbols("wx_dot wy_dot wz_dot"))
A0: Matrix = sp.Matrix(sp.symbols("a0x a0y a0z"))
BASE_ACCELERATIONS = (*A0, *W_DOT)

# Platform: mass, first moment mass * com, inertia tensor about the ORIGIN (so jxy = -integral of x y dm).
PLATFORM_PARAMETERS = sp.symbols("mass cx cy cz jxx jyy jzz jxy jxz jyz")

# Assembly: hip, mass, first and second moment of the mass along the leg, principal inertias, rotor inertias.
ASSEMBLY_PARAMETERS = sp.symbols(
    "hx hy hz mass first_moment second_moment leg_ixx leg_iyy leg_izz wheel_transverse wheel_spin armature_leg armature_wheel"
)
SIN_Q, COS_Q = sp.symbols("sin_q cos_q")
LEG_RATE, WHEEL_RATE = sp.symbols("leg_rate wheel_rate")
LEG_RATE_DOT, WHEEL_RATE_DOT = sp.symbols("leg_rate_dot wheel_rate_dot")
ASSEMBLY_ACCELERATIONS = (*BASE_ACCELERATIONS, LEG_RATE_DOT, WHEEL_RATE_DOT)


@dataclass(frozen=True)
class Equations:
    """``mass_matrix @ accelerations + bias = Q``, one row per quasi-velocity."""

    mass_matrix: Matrix
    bias: Matrix


def appell_equations(gibbs: Expression, accelerations: tuple[sp.Symbol, ...]) -> Equations:
    """Appell's equations dS/du' = Q, split into what is linear in u' (mass matrix) and what is left at u' = 0 (bias)."""
    rows: list[Expression] = [sp.expand(sp.diff(gibbs, acceleration)) for acceleration in accelerations]
    at_rest = dict.fromkeys(accelerations, 0)
    mass_matrix = sp.Matrix([[sp.diff(row, acceleration) for acceleration in accelerations] for row in rows])
    return Equations(mass_matrix, sp.Matrix([row.subs(at_rest) for row in rows]))


def translational_gibbs(mass: Expression, acceleration: Matrix) -> Expression:
    """1/2 m a.a of a mass point (or of a body, with the acceleration of its centre of mass)."""
    return HALF * mass * acceleration.dot(acceleration)


def rotational_gibbs(inertia: Matrix, omega: Matrix, alpha: Matrix) -> Expression:
    """1/2 alpha.I alpha + alpha.(omega x I omega) of a body about its centre of mass (terms without alpha are left out)."""
    return HALF * alpha.dot(inertia * alpha) + alpha.dot(omega.cross(inertia * omega))


def acceleration_at(start: Matrix, offset: Matrix, omega: Matrix, alpha: Matrix) -> Matrix:
    """Acceleration of a point of a rigid body, from the acceleration ``start`` of the body's point ``offset`` away from it."""
    return start + alpha.cross(offset) + omega.cross(omega.cross(offset))


def inertia_about_origin(mass: Expression, com: Matrix) -> Matrix:
    """What a mass point at ``com`` adds to the inertia tensor about the origin (parallel axes)."""
    return mass * (com.dot(com) * sp.eye(3) - com * com.T)


def derive_platform() -> Equations:
    """The platform's share in the rows (a0, w'): mass matrix 6 x 6 and bias."""
    mass, cx, cy, cz, jxx, jyy, jzz, jxy, jxz, jyz = PLATFORM_PARAMETERS
    com = sp.Matrix([cx, cy, cz]) / mass
    about_origin = sp.Matrix([[jxx, jxy, jxz], [jxy, jyy, jyz], [jxz, jyz, jzz]])
    about_com = about_origin - inertia_about_origin(mass, com)
    gibbs = translational_gibbs(mass, acceleration_at(A0, com, W, W_DOT)) + rotational_gibbs(about_com, W, W_DOT)
    return appell_equations(gibbs, BASE_ACCELERATIONS)


def leg_frame() -> tuple[Matrix, Matrix]:
    """Unit vectors of the leg in the body frame: from hip to wheel, and across it (x of a leg that hangs down)."""
    return sp.Matrix([COS_Q, 0, -SIN_Q]), sp.Matrix([SIN_Q, 0, COS_Q])


def with_pitch_rate(vector: Matrix, rate: Expression) -> Matrix:
    """Turn on the pitch axis relative to the platform: same x and z components, pitch component ``rate``."""
    return sp.Matrix([vector[0], rate, vector[2]])


def leg_rotation() -> tuple[Matrix, Matrix]:
    """Angular velocity and acceleration of the leg; its components change in the turning body frame, hence w x."""
    omega = with_pitch_rate(W, LEG_RATE)
    return omega, with_pitch_rate(W_DOT, LEG_RATE_DOT) + W.cross(omega)


def wheel_rotation() -> tuple[Matrix, Matrix]:
    """Angular velocity and acceleration of the wheel, likewise."""
    omega = with_pitch_rate(W, WHEEL_RATE)
    return omega, with_pitch_rate(W_DOT, WHEEL_RATE_DOT) + W.cross(omega)


def acceleration_along_leg(distance: Expression) -> Matrix:
    """Acceleration of the leg's point ``distance`` from the hip: affine in the distance."""
    hip = sp.Matrix(ASSEMBLY_PARAMETERS[:3])
    axis, _ = leg_frame()
    return acceleration_at(acceleration_at(A0, hip, W, W_DOT), distance * axis, *leg_rotation())


def translation_by_moments() -> Expression:
    """Translational Gibbs function of all mass on the leg line (leg at its centre of mass, wheel at the leg's end).

    The acceleration is affine in the distance rho, so 1/2 sum m a.a is a polynomial of degree 2 in rho: the masses enter
    only through sum m, sum m rho and sum m rho^2.
    """
    mass, first_moment, second_moment = ASSEMBLY_PARAMETERS[3:6]
    rho = sp.Symbol("rho")
    per_unit_mass = sp.Poly(translational_gibbs(sp.Integer(1), acceleration_along_leg(rho)), rho)
    constant, linear, quadratic = (per_unit_mass.coeff_monomial(rho**power) for power in range(3))
    assert per_unit_mass.degree() == 2
    return mass * constant + first_moment * linear + second_moment * quadratic


def rotation_of_assembly() -> Expression:
    """Rotational Gibbs function of leg, wheel and the two rotors.

    Rotors count with the square of the joint's RELATIVE acceleration; their gyroscopic moments are left out, as the usual
    "armature" of robot simulators does.
    """
    leg_ixx, leg_iyy, leg_izz, transverse, spin, armature_leg, armature_wheel = ASSEMBLY_PARAMETERS[6:]
    axis, across = leg_frame()
    leg_inertia = leg_ixx * across * across.T + leg_iyy * PITCH_AXIS * PITCH_AXIS.T + leg_izz * axis * axis.T
    rotors = armature_leg * (LEG_RATE_DOT - W_DOT[1]) ** 2 + armature_wheel * (WHEEL_RATE_DOT - LEG_RATE_DOT) ** 2
    leg = rotational_gibbs(leg_inertia, *leg_rotation())
    wheel = rotational_gibbs(sp.diag(transverse, spin, transverse), *wheel_rotation())
    return leg + wheel + HALF * rotors


def derive_assembly() -> Equations:
    """One leg with its wheel: mass matrix 8 x 8 and bias in the rows (a0, w', leg_rate', wheel_rate')."""
    return appell_equations(translation_by_moments() + rotation_of_assembly(), ASSEMBLY_ACCELERATIONS)


def is_zero(expression: Expression) -> bool:
    """True if the expression vanishes identically, given sin^2 + cos^2 = 1."""
    numerator = sp.numer(sp.together(sp.expand(expression)))
    return sp.rem(sp.expand(numerator), COS_Q**2 + SIN_Q**2 - 1, COS_Q) == 0
