"""The paper's robot in closed form: nine velocities, legs pairwise equal, no roll, wheels on the floor; its inverse dynamics.

u9 = (v_x, v_y, yaw rate, alpha', beta', p_lf', p_rf', p_lr', p_rr'), velocities of G in the yaw frame, wheel rates relative to
their leg. Height and pitch follow from the legs. The equations are written in u11, which has v_z and psi' after the yaw rate:

    M u11' + h = E tau + sum_i (J_x,i F_x,i + J_y,i F_y,i + J_n,i N_i),      u11 = B u9,

in closed form (source: audit of the paper, section 4a; tests prove it to be the projection of :mod:`wlr_gym.physics.model`).
The two rows that B leaves over give the normal forces, equal left and right: four loads on three equations of a rigid body.

Everything is batched over N robots. Masses and loads are those of the left side.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from studies.paper.quantities import PaperConstants, State
from wlr_gym.robot.parameters import Parameters

Array = NDArray[np.float64]

VX, VY, YAW, VZ, PITCH, FRONT, REAR = range(7)  # indices of u11; the wheels follow
_WHEELS = slice(7, 11)
#: Columns of u9 in u11.
_KEPT = [VX, VY, YAW, FRONT, REAR, 7, 8, 9, 10]
#: The paper's wheels in the order lf, rf, lr, rr.
ORDER = {"lf": 0, "rf": 1, "lr": 2, "rr": 3}
#: Of the corners lf, rf, lr, rr: ahead, to the left, and which leg.
_AHEAD = np.array([1.0, 1.0, -1.0, -1.0])
_LEFT = np.array([1.0, -1.0, 1.0, -1.0])
_LEG = np.array([0, 0, 1, 1])


def constants_of(parameters: Parameters) -> PaperConstants:
    """Return the paper's symbols (N,) of robots with pairwise equal legs; mu of the left front wheel."""
    hip, leg = parameters["hip.position"], parameters["leg.inertia"]
    body, armature = parameters["body.inertia"], parameters["servo.armature"]
    return PaperConstants(
        l_x=2 * hip[:, 0], l_y=2 * hip[:, 1], l=parameters["leg.length"][:, 0], a=parameters["wheel.radius"][:, 0],
        M_G=parameters["body.mass"], I_o=parameters["wheel.spin_inertia"][:, 0], I_ly=leg[:, 1], I_lx=leg[:, 0],
        I_Gy=body[:, 1], I_Gz=body[:, 2], m_l=parameters["leg.mass"][:, 0], I_Gx=body[:, 0], I_along=leg[:, 2],
        m_w=parameters["wheel.mass"][:, 0], I_t=parameters["wheel.transverse_inertia"][:, 0], J_w=armature[:, 4],
        J_h=armature[:, 0], lam=parameters["leg.com_along_leg"][:, 0] / parameters["leg.length"][:, 0],
        mu_dx=parameters["ground.mu_x"][:, 0], mu_dy=parameters["ground.mu_y"][:, 0], g=parameters["gravity"],
    )  # fmt: skip


def state_of(front: Array, rear: Array, pitch: Array, u: Array, u_dot: Array, **slip: dict[str, Array]) -> State:
    """Return a motion in the paper's symbols.

    Args:
        front, rear, pitch: (T,) leg angles relative to the body, body pitch; rad.
        u, u_dot: (T, 11) and its time derivative.
        slip: fields of the state; none = 0.
    """
    return State(
        alpha=front, beta=rear, psi=pitch, alpha_d=u[:, FRONT], beta_d=u[:, REAR], psi_d=u[:, PITCH],
        alpha_dd=u_dot[:, FRONT], beta_dd=u_dot[:, REAR], psi_dd=u_dot[:, PITCH],
        x_d=u[:, VX], y_d=u[:, VY], z_d=u[:, VZ], yaw_d=u[:, YAW],
        x_dd=u_dot[:, VX], y_dd=u_dot[:, VY], z_dd=u_dot[:, VZ], yaw_dd=u_dot[:, YAW],
        theta_d={wheel: u[:, _WHEELS][:, k] for wheel, k in ORDER.items()},
        theta_dd={wheel: u_dot[:, _WHEELS][:, k] for wheel, k in ORDER.items()},
        **slip,
    )  # fmt: skip


# ---- equations in u11 ------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Posture:
    """Where the legs put the body. All (N,): pitch (nose down +), absolute leg angles f and r, wheelbase, height of G."""

    pitch: Array
    f: Array
    r: Array
    wheelbase: Array
    height: Array


def posture(c: PaperConstants, front: Array, rear: Array) -> Posture:
    """Return the posture with all wheels on a level floor, for leg angles (N,) relative to the body."""
    pitch = np.arctan2(c.l * (np.sin(rear) - np.sin(front)), c.l_x + c.l * (np.cos(front) - np.cos(rear)))
    return pitched(c, front, rear, pitch)


def pitched(c: PaperConstants, front: Array, rear: Array, pitch: Array) -> Posture:
    """Return the posture at a body pitch (N,) that was measured."""
    f, r = front + pitch, rear + pitch
    base = c.l_x * np.cos(pitch) + c.l * (np.cos(f) - np.cos(r))
    return Posture(pitch, f, r, base, c.a + c.l / 2 * (np.sin(f) + np.sin(r)))


def mass_matrix_and_bias(c: PaperConstants, front: Array, rear: Array, pitch: Array, u: Array) -> tuple[Array, Array]:
    """Return M (N, 11, 11) and h (N, 11), gravity included, at any pitch.

    Args:
        c: constants, floats or (N,).
        front, rear, pitch: (N,) leg angles relative to the body, body pitch; rad.
        u: (N, 11).
    """
    vx, vy, w, _, rate = u.T[:5]
    f, r, fr, rr = front + pitch, rear + pitch, u[:, FRONT] + rate, u[:, REAR] + rate
    sf, cf, sr, cr, sp, cp = np.sin(f), np.cos(f), np.sin(r), np.cos(r), np.sin(pitch), np.cos(pitch)
    mb, k1, k2 = c.m_l + c.m_w, (c.lam * c.m_l + c.m_w) * c.l, (c.lam**2 * c.m_l + c.m_w) * c.l**2
    total, spin = c.M_G + 4 * mb, 2 * (c.I_ly + k2 + c.I_o)
    dl, db = c.I_along - c.I_lx, c.I_Gx - c.I_Gz
    spread = mb * c.l_x**2 / 2 * cp**2 + k1 * c.l_x * cp * (cf - cr) + k2 * (cf**2 + cr**2)
    spread_rate = (
        -mb * c.l_x**2 * sp * cp * rate - k1 * c.l_x * sp * rate * (cf - cr)
        - k1 * c.l_x * cp * (sf * fr - sr * rr) - 2 * k2 * (sf * cf * fr + sr * cr * rr)
    )  # fmt: skip
    legs_yaw = c.I_along * (sf**2 + sr**2) + c.I_lx * (cf**2 + cr**2)
    m = np.zeros((len(f), 11, 11))
    m[:, VX, VX] = m[:, VY, VY] = m[:, VZ, VZ] = total
    _put(m, VX, PITCH, -2 * k1 * (sf + sr))
    _put(m, VX, FRONT, -2 * k1 * sf)
    _put(m, VX, REAR, -2 * k1 * sr)
    _put(m, VZ, PITCH, -2 * k1 * (cf + cr))
    _put(m, VZ, FRONT, -2 * k1 * cf)
    _put(m, VZ, REAR, -2 * k1 * cr)
    _put(m, VY, YAW, 2 * k1 * (cf + cr))
    m[:, YAW, YAW] = c.I_Gx * sp**2 + c.I_Gz * cp**2 + 2 * (spread + legs_yaw + 2 * c.I_t) + mb * c.l_y**2
    m[:, PITCH, PITCH] = c.I_Gy + mb * c.l_x**2 + 2 * spin + 2 * k1 * c.l_x * (np.cos(front) - np.cos(rear))
    _put(m, PITCH, FRONT, spin + k1 * c.l_x * np.cos(front))
    _put(m, PITCH, REAR, spin - k1 * c.l_x * np.cos(rear))
    m[:, FRONT, FRONT] = m[:, REAR, REAR] = spin + 2 * c.J_h
    for wheel in range(4):
        m[:, 7 + wheel, 7 + wheel] = c.I_o + c.J_w
        _put(m, 7 + wheel, PITCH, c.I_o)
        _put(m, 7 + wheel, FRONT + int(_LEG[wheel]), c.I_o)

    def leg_bias(side: float, angle: Array, s: Array, co: Array) -> Array:
        swing = side * c.l_x / 2 * rate**2 * np.sin(angle) + w * vy * s - c.g * co
        return 2 * (k1 * swing + w**2 * s * (side * k1 * c.l_x / 2 * cp + k2 * co) - dl * w**2 * s * co)

    h = np.zeros((len(f), 11))
    h[:, VX] = -2 * k1 * (fr**2 * cf + rr**2 * cr) - w * (total * vy + 2 * k1 * w * (cf + cr))
    h[:, VY] = w * total * vx - 4 * k1 * w * (fr * sf + rr * sr)
    h[:, VZ] = 2 * k1 * (fr**2 * sf + rr**2 * sr) + total * c.g
    h[:, YAW] = w * (
        2 * k1 * vx * (cf + cr) + 2 * spread_rate + 2 * db * sp * cp * rate + 4 * dl * (sf * cf * fr + sr * cr * rr)
    )
    h[:, FRONT], h[:, REAR] = leg_bias(1.0, front, sf, cf), leg_bias(-1.0, rear, sr, cr)
    h[:, PITCH] = (
        h[:, FRONT] + h[:, REAR] - k1 * c.l_x * (fr**2 * np.sin(front) - rr**2 * np.sin(rear))
        + w**2 * c.l_x * sp * (mb * c.l_x * cp + k1 * (cf - cr)) - db * w**2 * sp * cp
    )  # fmt: skip
    return m, h


def _put(m: Array, row: int, column: int, value: Array) -> None:
    m[:, row, column] = m[:, column, row] = value


def reduction(c: PaperConstants, p: Posture, u: Array) -> tuple[Array, Array]:
    """Return B (N, 11, 9) and its time derivative: psi' and v_z of wheels that stay on the floor. ``u`` (N, 9)."""
    sf, cf, sr, cr = np.sin(p.f), np.cos(p.f), np.sin(p.r), np.cos(p.r)
    by_front, by_rear = -c.l * cf / p.wheelbase, c.l * cr / p.wheelbase
    rate = by_front * u[:, 3] + by_rear * u[:, 4]
    fr, rr = u[:, 3] + rate, u[:, 4] + rate
    base_rate = -c.l_x * np.sin(p.pitch) * rate - c.l * (sf * fr - sr * rr)
    front_rate = (c.l * sf * fr - by_front * base_rate) / p.wheelbase
    rear_rate = (-c.l * sr * rr - by_rear * base_rate) / p.wheelbase
    b, b_dot = np.zeros((2, len(u), 11, 9))
    b[:, _KEPT, range(9)] = 1.0
    b[:, PITCH, 3], b[:, PITCH, 4] = by_front, by_rear
    b_dot[:, PITCH, 3], b_dot[:, PITCH, 4] = front_rate, rear_rate
    both, both_rate = cf + cr, -sf * fr - sr * rr
    b[:, VZ, 3], b[:, VZ, 4] = c.l / 2 * (cf + both * by_front), c.l / 2 * (cr + both * by_rear)
    b_dot[:, VZ, 3] = c.l / 2 * (-sf * fr + both_rate * by_front + both * front_rate)
    b_dot[:, VZ, 4] = c.l / 2 * (-sr * rr + both_rate * by_rear + both * rear_rate)
    return b, b_dot


def contact_rows(c: PaperConstants, p: Posture, radius: Array) -> tuple[Array, Array, Array]:
    """Return J_x, J_y, J_n (N, 4, 11): velocity of each wheel's contact point along its heading, to its left, and up."""
    phi = np.where(_LEG == 0, p.f[:, None], p.r[:, None])
    l_x, l_y, length = (np.broadcast_to(value, p.f.shape)[:, None] for value in (c.l_x, c.l_y, c.l))
    ahead = _AHEAD * l_x / 2 * np.cos(p.pitch)[:, None] + length * np.cos(phi)
    depth = length * np.sin(phi) + radius
    j_x, j_y, j_n = np.zeros((3, len(phi), 4, 11))
    j_x[:, :, VX], j_y[:, :, VY], j_n[:, :, VZ] = 1.0, 1.0, 1.0
    j_x[:, :, YAW], j_y[:, :, YAW] = -_LEFT * l_y / 2, ahead
    j_x[:, :, PITCH] = -(_AHEAD * l_x / 2 * np.sin(p.pitch)[:, None] + depth)
    j_n[:, :, PITCH] = -ahead
    for wheel in range(4):
        leg = FRONT + int(_LEG[wheel])
        j_x[:, wheel, leg] = -depth[:, wheel]
        j_n[:, wheel, leg] = -(length * np.cos(phi))[:, wheel]
        j_x[:, wheel, 7 + wheel] = -radius[:, wheel]
    return j_x, j_y, j_n


def normal_forces(residual: Array, j_n: Array) -> Array:
    """Return the loads (N, 4) that leave no rest in the rows of v_z and psi'; equal on both wheels of an axle.

    Args:
        residual: (N, 11) M u11' + h minus what friction and torques do.
        j_n: (N, 4, 11).
    """
    rows = np.stack([j_n[:, :2].sum(axis=1), j_n[:, 2:].sum(axis=1)], axis=2)[:, [VZ, PITCH]]
    loads = np.linalg.solve(rows, residual[:, [VZ, PITCH], None])[:, :, 0]
    return np.asarray(np.repeat(loads, 2, axis=1), dtype=np.float64)


# ---- inverse dynamics ------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class InverseDynamics:
    """What must have acted on a robot that moved so. (N, ...): both hips of an axle together, single wheels lf, rf, lr, rr.

    Attributes:
        leg_torque: (N, 2) front and rear pair, N m. wheel_torque: (N, 4), N m.
        along: (N, 4) and lateral: (N, 2, both wheels of an axle) the floor's forces, N. normal: (N, 4) N.
    """

    leg_torque: Array
    wheel_torque: Array
    along: Array
    lateral: Array
    normal: Array


def inverse_dynamics(
    c: PaperConstants, front: Array, rear: Array, pitch: Array, u: Array, u_dot: Array, rear_wheel_torque: Array
) -> InverseDynamics:
    """Return torques and floor forces from measured motion: the paper's use of its equations, with the right ones.

    Body motion is given, so nothing is integrated. The rear wheels are free: what their gears do to them must be known, and
    gives the force on them; the front pair has the rest, shared equally (twelve unknowns, eleven equations).

    Args:
        c: constants. front, rear, pitch: (N,) rad. u, u_dot: (N, 11) and its time derivative.
        rear_wheel_torque: (N, 2) torque on the rear wheels lr, rr, N m: minus the drag of their gears.
    """
    p = pitched(c, front, rear, pitch)
    mass, bias = mass_matrix_and_bias(c, front, rear, pitch, u)
    needed = np.einsum("nij,nj->ni", mass, u_dot) + bias
    radius = np.broadcast_to(np.asarray(c.a)[..., None] if np.ndim(c.a) else c.a, (len(u), 4))
    j_x, j_y, j_n = contact_rows(c, p, radius)
    along = np.zeros((len(u), 4))
    along[:, 2:] = (rear_wheel_torque - needed[:, 9:]) / radius[:, 2:]
    along[:, :2] = ((needed[:, VX] - along[:, 2:].sum(axis=1)) / 2)[:, None]
    moment = needed[:, YAW] - np.einsum("nw,nw->n", j_x[:, :, YAW], along)
    axles = np.stack([np.ones((len(u), 2)), j_y[:, ::2, YAW]], axis=1)
    lateral = np.asarray(
        np.linalg.solve(axles, np.stack([needed[:, VY], moment], axis=1)[:, :, None])[:, :, 0], dtype=np.float64
    )
    rest = needed - np.einsum("nwk,nw->nk", j_x, along)
    normal = normal_forces(rest, j_n)
    rest -= np.einsum("nwk,nw->nk", j_n, normal)
    return InverseDynamics(rest[:, [FRONT, REAR]], rest[:, _WHEELS], along, lateral, normal)
