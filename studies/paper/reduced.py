"""The paper's robot as a model that can be simulated: nine velocities, legs pairwise equal, no roll, wheels on the floor.

u9 = (v_x, v_y, yaw rate, alpha', beta', p_lf', p_rf', p_lr', p_rr'), velocities of G in the yaw frame, wheel rates relative to
their leg. Height and pitch follow from the legs. The equations are written in u11, which has v_z and psi' after the yaw rate:

    M u11' + h = E tau + sum_i (J_x,i F_x,i + J_y,i F_y,i + J_n,i N_i),      u11 = B u9,

in closed form (source: audit of the paper, section 4a; tests prove it to be the projection of :mod:`wlr_gym.physics.model`).
The two rows that B leaves over give the normal forces, equal left and right: four loads on three equations of a rigid body.

Everything is batched over N robots. Of asymmetries, the model knows friction, gear drag and radius of single wheels (the last
in rolling only); masses and loads are those of the left side.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from studies.paper.quantities import PaperConstants, State
from wlr_gym.physics import servo
from wlr_gym.robot import Robot
from wlr_gym.robot.parameters import Parameters

Array = NDArray[np.float64]

VX, VY, YAW, VZ, PITCH, FRONT, REAR = range(7)  # indices of u11; the wheels follow
_WHEELS = slice(7, 11)
#: Columns of u9 in u11.
_KEPT = [VX, VY, YAW, FRONT, REAR, 7, 8, 9, 10]
#: One motor of each pair of legs, and all wheels.
PAIRS = [0, 2, 4, 5, 6, 7]
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


# ---- forward dynamics ------------------------------------------------------------------------------------------------


@dataclass
class ReducedState:
    """State of N robots: pose (N, 3: x, y, yaw), legs (N, 2), wheels (N, 4), u (N, 9), servo references (N, 6).

    The last step's ``motor`` torques (N, 6: front pair, rear pair, wheels, N m), ``along`` and ``lateral`` (N, 4) floor forces,
    and ``normal`` (N, 4) loads go with it, N.
    """

    pose: Array
    legs: Array
    wheels: Array
    u: Array
    reference: Array
    reference_rate: Array
    motor: Array
    along: Array
    lateral: Array
    normal: Array


class ReducedModel:
    """N robots with servos, gear friction and Coulomb friction on a level floor.

    Motors' back-EMF and viscous friction are implicit, dry friction of wheels and gears is solved by
    :mod:`studies.paper.reduced` in every step, with the loads of the step before.
    """

    def __init__(self, robot: Robot, parameters: Parameters, step: float = 0.001) -> None:
        self.step, self.constants = step, constants_of(parameters)
        self.parameters = parameters
        nominal = robot.servo.supply_voltage
        self._many = many = np.array([2.0, 2.0, 1.0, 1.0, 1.0, 1.0])
        self._constant, self._resistance = servo.motor_constants(
            parameters["servo.stall_torque"][:, PAIRS], parameters["servo.no_load_speed"][:, PAIRS], nominal
        )
        self._kp, self._kd = servo.position_gains(parameters)[:, PAIRS], parameters["servo.kd"][:, PAIRS]
        self._supply = parameters["servo.supply_voltage"][:, None]
        self._viscous = many * parameters["servo.viscous_friction"][:, PAIRS]
        self._dry = many * parameters["servo.coulomb_friction"][:, PAIRS]
        velocity, acceleration = servo.profile_limits(
            parameters["servo.profile_velocity"], parameters["servo.profile_acceleration"]
        )
        self._speed, self._ramp = velocity[:, PAIRS], acceleration[:, PAIRS]
        self._radius = parameters["wheel.radius"]
        self._mu = np.stack([parameters["ground.mu_x"], parameters["ground.mu_y"]], axis=2)

    def standing(self, front: Array, rear: Array) -> ReducedState:
        """Return robots at rest with leg angles (N,), loads from (16) and (17), motors off."""
        count = len(front)
        p = posture(self.constants, front, rear)
        _, bias = mass_matrix_and_bias(self.constants, front, rear, p.pitch, np.zeros((count, 11)))
        _, _, j_n = contact_rows(self.constants, p, self._radius)
        legs = np.stack([front, rear], axis=1)
        reference = np.concatenate([legs, np.zeros((count, 4))], axis=1)
        zero = [np.zeros((count, size)) for size in (3, 4, 9, 6, 6, 4, 4)]
        return ReducedState(
            zero[0], legs.copy(), zero[1], zero[2], reference, zero[3], zero[4], zero[5], zero[6], normal_forces(bias, j_n)
        )

    def advance(self, state: ReducedState, setpoints: Array, torque_on: NDArray[np.bool_]) -> None:
        """Advance by one step, in place. ``setpoints``, ``torque_on`` (N, 6): front legs, rear legs, wheels lf, rf, lr, rr."""
        h, c = self.step, self.constants
        self._drift(state)
        p = posture(c, *state.legs.T)
        b, b_dot = reduction(c, p, state.u)
        u11 = np.einsum("nij,nj->ni", b, state.u)
        mass, bias = mass_matrix_and_bias(c, state.legs[:, 0], state.legs[:, 1], p.pitch, u11)
        lag = np.einsum("nij,nj->ni", b_dot, state.u)
        small = b.transpose(0, 2, 1) @ mass @ b
        free = np.einsum("nki,nk->ni", b, bias + np.einsum("nij,nj->ni", mass, lag))
        drive, damping = self._motors(state, setpoints, torque_on)
        small_damped = small.copy()
        small_damped[:, range(3, 9), range(3, 9)] += h * damping
        pull = np.einsum("nij,nj->ni", small, state.u) - h * free
        pull[:, 3:] += h * drive
        j_x, j_y, j_n = contact_rows(c, p, self._radius)
        rows = np.ascontiguousarray(np.stack([j_x @ b, j_y @ b], axis=2))
        new, impulse = rub(small_damped, pull, rows, h * state.normal, self._mu, h * self._dry, state.u)
        force = impulse / h
        state.motor = drive - (damping - self._viscous) * new[:, 3:]
        acceleration = np.einsum("nij,nj->ni", b, (new - state.u) / h) + lag
        rest = np.einsum("nij,nj->ni", mass, acceleration) + bias - np.einsum("nwk,nw->nk", j_x, force[:, :, 0])
        state.normal = np.maximum(normal_forces(rest, j_n), 0.0)
        state.along, state.lateral, state.u = force[:, :, 0], force[:, :, 1], new
        self._drift(state)

    def slip(self, state: ReducedState) -> Array:
        """Return slip velocities (N, 4, 2), m/s."""
        p = posture(self.constants, *state.legs.T)
        b, _ = reduction(self.constants, p, state.u)
        j_x, j_y, _ = contact_rows(self.constants, p, self._radius)
        return np.einsum("nwak,nk->nwa", np.stack([j_x @ b, j_y @ b], axis=2), state.u)

    def _drift(self, state: ReducedState) -> None:
        """Move the positions on by half a step."""
        half, (vx, vy, w) = 0.5 * self.step, state.u.T[:3]
        yaw = state.pose[:, 2] + 0.5 * half * w
        state.pose += half * np.stack([vx * np.cos(yaw) - vy * np.sin(yaw), vx * np.sin(yaw) + vy * np.cos(yaw), w], axis=1)
        state.legs += half * state.u[:, 3:5]
        state.wheels += half * state.u[:, 5:]

    def _motors(self, state: ReducedState, setpoints: Array, torque_on: NDArray[np.bool_]) -> tuple[Array, Array]:
        """Torque at rest (N, 6) and implicit damping (N, 6) of both motors of a leg pair and of each wheel's."""
        h = self.step
        position = np.concatenate([state.legs, state.wheels], axis=1)
        old, rate = state.reference, state.reference_rate
        legs = servo.leg_profile_step(old[:, :2], rate[:, :2], setpoints[:, :2], self._speed[:, :2], self._ramp[:, :2], h)
        wheels = servo.wheel_profile_step(
            old[:, 2:], rate[:, 2:], setpoints[:, 2:], self._ramp[:, 2:], h, position[:, 2:], self._kp[:, 2:], self._supply
        )
        place, speed, middle, mean = (np.concatenate(pair, axis=1) for pair in zip(legs, wheels, strict=True))
        state.reference = np.where(torque_on, place, position)
        state.reference_rate = np.where(torque_on, speed, 0.0)
        voltage = servo.controller_voltage(self._kp, self._kd, middle, mean, position, state.u[:, 3:], self._supply)
        on = self._many * torque_on
        return on * servo.motor_torque(self._constant, self._resistance, voltage, 0.0), (
            self._viscous + on * self._constant**2 / self._resistance
        )


def run(
    model: ReducedModel, state: ReducedState, setpoints: Array, torque_on: NDArray[np.bool_], period: float
) -> Iterator[ReducedState]:
    """Hold each row of ``setpoints`` (ticks, N, 6) for ``period`` s and yield the states before the first and after each."""
    yield state
    for goal, on in zip(setpoints, torque_on, strict=True):
        for _ in range(round(period / model.step)):
            model.advance(state, goal, on)
        yield state


# ---- dry friction: the velocities that minimise 1/2 (u - u*)' A (u - u*) + h D(u) ------------------------------------
#
# D sums mu N |s| over wheels (an ellipse) and bound |rate| over gears, each rounded to sqrt(s^2 + creep^2). Reweighting: with
# the roots held, the sum is quadratic; solve, take the roots anew, repeat.


#: m/s and rad/s: what sticks may creep at most: 20 um in a test, far below an encoder count at the tread.
CREEP = 1e-6
JOINT_CREEP = 1e-5
_ITERATIONS = 60
_TOLERANCE = 1e-7
#: Wheels; index of the first joint among the velocities.
_CONTACTS, _FIRST_JOINT = 4, 3


@njit(cache=True)
def rub(a: Array, pull: Array, rows: Array, load: Array, mu: Array, dry: Array, start: Array) -> tuple[Array, Array]:
    """Return velocities (N, 9) and impulses of the floor on the wheels (N, 4, 2), along and across.

    Args:
        a: (N, 9, 9) mass matrix with implicit damping. pull: (N, 9) momentum without dry friction.
        rows: (N, 4, 2, 9) slip velocity of every wheel along and across. load: (N, 4) normal impulse, N s.
        mu: (N, 4, 2). dry: (N, 6) friction impulse of the joints, N m s. start: (N, 9) first guess.
    """
    count = len(a)
    velocity, impulse = start.copy(), np.zeros((count, _CONTACTS, 2))
    weight = np.empty((_CONTACTS, 2))
    for n in range(count):
        u = velocity[n]
        for _ in range(_ITERATIONS):
            matrix = a[n].copy()
            for wheel in range(_CONTACTS):
                squared = (mu[n, wheel, 0] * CREEP) ** 2 + 1e-30
                for axis in range(2):
                    squared += (mu[n, wheel, axis] * (rows[n, wheel, axis] * u).sum()) ** 2
                for axis in range(2):
                    weight[wheel, axis] = load[n, wheel] * mu[n, wheel, axis] ** 2 / np.sqrt(squared)
                    row = rows[n, wheel, axis]
                    matrix += weight[wheel, axis] * np.outer(row, row)
            for joint in range(dry.shape[1]):
                i = _FIRST_JOINT + joint
                matrix[i, i] += dry[n, joint] / np.sqrt(u[i] ** 2 + JOINT_CREEP**2)
            new = np.linalg.solve(matrix, pull[n])
            change = np.abs(new - u).max()
            u[:] = new
            if change < _TOLERANCE:
                break
        for wheel in range(_CONTACTS):
            for axis in range(2):
                impulse[n, wheel, axis] = -weight[wheel, axis] * (rows[n, wheel, axis] * u).sum()
    return velocity, impulse
