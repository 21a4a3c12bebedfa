"""Both tests as they are commanded, rolling without slip: what a simulation "with a consistent slip coefficient" of 0 shows.

Front wheels follow their trapezoid to four turns, legs turn at constant speed between short ramps, rear wheels roll along.
Nothing is simulated: motion is given, torques and floor forces follow by inverse dynamics, from the paper's equations as
printed or from the right ones.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from studies.paper import reduced
from studies.paper.experiments import LEG_SPEED, WHEEL_ACCELERATION, WHEEL_SPEED, PaperTest, duration, stop_time
from studies.paper.quantities import PaperConstants, State

Array = NDArray[np.float64]

#: s; the legs' speed is reached, and left, in this time: a rectangular profile on a real leg.
LEG_RAMP = 0.1
_TICK = 0.002


@dataclass(frozen=True, eq=False)
class IdealMotion:
    """One test without slip, one row per time. SI.

    Attributes:
        test, constants, time: which, of which robot, (T,) from the commands on.
        front, rear: (T,) leg angles. wheels: (T, 4) wheel angles relative to their legs, lf, rf, lr, rr.
        posture: pitch and height. x: (T,) travel of G. u, u_dot: (T, 11) as in :mod:`studies.paper.reduced`.
    """

    test: PaperTest
    constants: PaperConstants
    time: Array
    front: Array
    rear: Array
    wheels: Array
    posture: reduced.Posture
    x: Array
    u: Array
    u_dot: Array

    def inverse_dynamics(self, rear_drag: float = 0.0) -> reduced.InverseDynamics:
        """Return the torques and floor forces, with the right equations.

        Args:
            rear_drag: N m, dry friction in the gear of each free rear wheel.
        """
        spin = self.u[:, 9:]
        drag = -rear_drag * np.tanh(spin / 1e-3)
        return reduced.inverse_dynamics(self.constants, self.front, self.rear, self.posture.pitch, self.u, self.u_dot, drag)

    def state(self) -> State:
        """Return the motion in the paper's symbols: its slip is 0."""
        return reduced.state_of(self.front, self.rear, self.posture.pitch, self.u, self.u_dot)


def ideal_motion(test: PaperTest, constants: PaperConstants | None = None) -> IdealMotion:
    """Return one test without slip, of a robot with these constants; None = the paper's."""
    c = constants or PaperConstants()
    time = np.arange(-0.2, duration() + 0.5, _TICK)
    front, front_rate = _leg(time, test.start[0], test.end[0])
    rear, rear_rate = _leg(time, test.start[1], test.end[1])
    turned, spin = _front_wheels(time)
    p = reduced.posture(c, front, rear)
    u9 = np.zeros((len(time), 9))
    u9[:, 3], u9[:, 4], u9[:, 5:7] = front_rate, rear_rate, spin[:, None]
    b, _ = reduced.reduction(c, p, u9)
    j_x = reduced.contact_rows(c, p, np.full((len(time), 4), c.a))[0] @ b
    u9[:, 0] = -np.einsum("tk,tk->t", j_x[:, 0], u9)
    u9[:, 7:] = np.einsum("twk,tk->tw", j_x[:, 2:], u9) / c.a
    u = np.einsum("tij,tj->ti", b, u9)
    wheels = np.stack([turned, turned, *(_integral(u9[:, k]) for k in (7, 8))], axis=1)
    x = _integral(u[:, 0])
    start = int(np.argmin(np.abs(time)))
    u_dot = np.gradient(u, _TICK, axis=0)
    return IdealMotion(test, c, time, front, rear, wheels - wheels[start], p, x - x[start], u, u_dot)


def _leg(time: Array, start: float, end: float) -> tuple[Array, Array]:
    """Angle and rate of a leg: constant speed between two ramps, as long as a rectangular profile plus one ramp."""
    if start == end:
        return np.full_like(time, start), np.zeros_like(time)
    length = abs(end - start) / LEG_SPEED
    acceleration = LEG_SPEED / LEG_RAMP
    up = np.clip(time, 0.0, LEG_RAMP)
    down = np.clip(time - length, 0.0, LEG_RAMP)
    steady = np.clip(time - LEG_RAMP, 0.0, length - LEG_RAMP)
    angle = acceleration * up**2 / 2 + LEG_SPEED * steady + LEG_SPEED * down - acceleration * down**2 / 2
    rate = acceleration * (up - down)
    way = np.sign(end - start)
    return start + way * angle, way * rate


def _front_wheels(time: Array) -> tuple[Array, Array]:
    ramp = WHEEL_SPEED / WHEEL_ACCELERATION
    up = np.clip(time, 0.0, ramp)
    down = np.clip(time - stop_time(), 0.0, ramp)
    steady = np.clip(time - ramp, 0.0, stop_time() - ramp)
    turned = WHEEL_ACCELERATION * up**2 / 2 + WHEEL_SPEED * (steady + down) - WHEEL_ACCELERATION * down**2 / 2
    return turned, WHEEL_ACCELERATION * (up - down)


def _integral(rate: Array) -> Array:
    return np.concatenate([[0.0], np.cumsum(0.5 * _TICK * (rate[1:] + rate[:-1]))])
