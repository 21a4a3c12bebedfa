"""The paper's symbols: constants of the robot, and the state its equations are evaluated at.

Notation and signs of Korayem, Nikseresht, Asadi 2024, made consistent: x forward, y left, z up in the yaw frame (the body's
frame with its pitch removed); alpha, beta (front and rear legs), psi (body pitch) and the wheel angles are right-handed about
+y, so that legs point down for 0 < angle < pi and a positive pitch is nose down. ``_d`` and ``_dd`` mark first and second time
derivatives. Velocities are yaw-frame components, and ``x_dd``, ``y_dd`` are the rates of these components: the acceleration of
G has the terms of the turning frame besides.

Every value may be a float, a numpy array (they broadcast) or a sympy expression.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np

Value = Any  # float | numpy array | sympy expression
Vector = tuple[Value, Value, Value]
PerWheel = Mapping[str, Value]

#: The paper's names of the wheels: right/left, front/rear.
WHEELS = ("rf", "lf", "rr", "lr")


def _apply(function: str, x: Value) -> Value:
    if isinstance(x, int | float | np.ndarray | np.generic):
        return getattr(np, function)(x)
    import sympy

    return getattr(sympy, function)(x)


sin, cos, sign, root = (partial(_apply, function) for function in ("sin", "cos", "sign", "sqrt"))


def is_front(wheel: str) -> bool:
    """Whether a wheel is in front."""
    return wheel.endswith("f")


def ahead(wheel: str) -> int:
    """+1 in front, -1 behind."""
    return 1 if is_front(wheel) else -1


def to_the_right(wheel: str) -> int:
    """+1 on the right (y = -l_y/2), -1 on the left: the sign of theta'' l_y/2 in the paper."""
    return 1 if wheel.startswith("r") else -1


def _zeros() -> dict[str, Value]:
    return dict.fromkeys(WHEELS, 0.0)


@dataclass(frozen=True)
class PaperConstants:
    """The robot. Table I as printed where it prints a number; else what the audit of the paper recommends.

    Attributes:
        l_x, l_y, l, a: distance of the axles' hips and of the sides, leg, wheel radius; m. M_G: body, kg.
        I_o: wheel about its axle; I_ly: leg across its length; kg m2, about the leg's own centre of mass. I_lx is printed as
            the inertia about x, and multiplies cos^2: it is the one normal to the leg.
        I_Gy, I_Gz: body about y and z; about 1000 times too small for its mass and size.
        m_l: leg, kg: not printed; 0.05 = (3.0 kg total - M_G)/4.
        I_Gx, I_along, m_w, I_t, J_w, J_h, lam: what the paper leaves out: body about x, leg about its own axis, mass and
            diametral inertia of a wheel, rotor inertias of wheel and hip at the output shaft, place of the leg's centre of mass
            over l. Neutral by default: massless wheels, no rotors, mid-leg.
        mu_dx, mu_dy, g: friction (not printed), gravity.
    """

    l_x: Value = 0.35
    l_y: Value = 0.32
    l: Value = 0.135  # noqa: E741 - the paper's symbol
    a: Value = 0.034
    M_G: Value = 2.8
    I_o: Value = 2.8e-4
    I_ly: Value = 1.2e-4
    I_lx: Value = 1.2e-4
    I_Gy: Value = 2.0e-5
    I_Gz: Value = 3.0e-5
    m_l: Value = 0.05
    I_Gx: Value = 0.0
    I_along: Value = 0.0
    m_w: Value = 0.0
    I_t: Value = 0.0
    J_w: Value = 0.0
    J_h: Value = 0.0
    lam: Value = 0.5
    mu_dx: Value = 0.6
    mu_dy: Value = 0.6
    g: Value = 9.81


@dataclass(frozen=True)
class State:
    """Where the robot is, how it moves and accelerates, and how its wheels slip.

    Attributes:
        alpha, beta, psi: front legs, rear legs, pitch; rad. x, y, z: of G, yaw frame, m. yaw: the paper's theta.
        theta_d, theta_dd: wheel rates by wheel, relative to the leg as the encoder reads; rad/s, rad/s2.
        x_s_d, x_s_dd, y_s_d, y_s_dd, z_s_d, z_s_dd: slip of the wheels.
        y_f_d, y_r_d: lateral slip velocity common to both wheels of an axle, m/s.
    """

    alpha: Value = 0.0
    beta: Value = 0.0
    psi: Value = 0.0
    alpha_d: Value = 0.0
    beta_d: Value = 0.0
    psi_d: Value = 0.0
    alpha_dd: Value = 0.0
    beta_dd: Value = 0.0
    psi_dd: Value = 0.0
    x_d: Value = 0.0
    y_d: Value = 0.0
    z_d: Value = 0.0
    yaw_d: Value = 0.0
    x_dd: Value = 0.0
    y_dd: Value = 0.0
    z_dd: Value = 0.0
    yaw_dd: Value = 0.0
    theta_d: PerWheel = field(default_factory=_zeros)
    theta_dd: PerWheel = field(default_factory=_zeros)
    x_s_d: PerWheel = field(default_factory=_zeros)
    x_s_dd: PerWheel = field(default_factory=_zeros)
    y_s_d: PerWheel = field(default_factory=_zeros)
    y_s_dd: PerWheel = field(default_factory=_zeros)
    z_s_d: PerWheel = field(default_factory=_zeros)
    z_s_dd: PerWheel = field(default_factory=_zeros)
    y_f_d: Value = 0.0
    y_r_d: Value = 0.0

    def leg(self, wheel: str) -> tuple[Value, Value, Value]:
        """Angle, rate and acceleration of the wheel's leg relative to the body."""
        front = (self.alpha, self.alpha_d, self.alpha_dd)
        return front if is_front(wheel) else (self.beta, self.beta_d, self.beta_dd)

    def absolute_leg(self, wheel: str) -> tuple[Value, Value, Value]:
        """The same relative to the floor: the paper's alpha + psi, beta + psi, and their derivatives."""
        angle, rate, acceleration = self.leg(wheel)
        return angle + self.psi, rate + self.psi_d, acceleration + self.psi_dd


@dataclass(frozen=True)
class Forces:
    """What acts on the robot: wheel torques, N m, and the floor on each wheel.

    ``x`` along the heading, N. ``n_f``, ``n_r``: normal force on one front and one rear wheel, N.
    """

    tau_theta: PerWheel = field(default_factory=_zeros)
    x: PerWheel = field(default_factory=_zeros)
    n_f: Value = 0.0
    n_r: Value = 0.0

    def n(self, wheel: str) -> Value:
        """Normal force on a wheel."""
        return self.n_f if is_front(wheel) else self.n_r


def wheelbase(c: PaperConstants, s: State) -> Value:
    """Distance of the axles along the floor, L: the denominator of (16) and (17), m."""
    return c.l_x * cos(s.psi) + c.l * (cos(s.alpha + s.psi) - cos(s.beta + s.psi))


def lever(c: PaperConstants, s: State, wheel: str, distance: Value | None = None) -> Value:
    """X_i: how far a point on the wheel's leg, ``distance`` from the hip (None = the wheel's centre), is ahead of G; m."""
    reach = c.l if distance is None else distance
    return ahead(wheel) * c.l_x / 2 * cos(s.psi) + reach * cos(s.leg(wheel)[0] + s.psi)
