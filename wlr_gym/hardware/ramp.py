"""The way to the start pose: a minimum-jerk path of the legs, wheels at rest."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from wlr_gym.base.errors import InputError
from wlr_gym.hardware.limits import SafetyLimits
from wlr_gym.robot import LEGS, WHEELS, Robot

Array = NDArray[np.float64]

#: s the shortest ramp takes.
SHORTEST_RAMP = 0.5
#: Fastest over mean speed of a minimum-jerk path.
PEAK_SPEED = 1.875


@dataclass(frozen=True)
class Ramp:
    """A minimum-jerk path of the legs.

    Attributes:
        begin, target: (4,) leg angles, rad.
        steps: control steps it takes.
    """

    begin: Array
    target: Array
    steps: int

    def setpoints(self, step: int) -> Array:
        """Return the setpoints (8,) of a step, 1 to ``steps``; rad and rad/s."""
        s = step / self.steps
        share = s**3 * (10.0 - 15.0 * s + 6.0 * s * s)
        return np.concatenate([self.begin + share * (self.target - self.begin), np.zeros(len(WHEELS))])


def make_ramp(begin: Array, target: Array, speed: float, period: float) -> Ramp:
    """Return the path between two poses (4,), at a mean speed (rad/s) of the leg with the longest way."""
    duration = max(SHORTEST_RAMP, float(np.abs(target - begin).max()) / speed)
    return Ramp(begin, target, int(np.ceil(duration / period)))


def ramp_speed(limits: SafetyLimits, profile_velocity: float) -> float:
    """Return a mean speed (rad/s) that legs with a velocity profile (rad/s; 0 = none) can follow."""
    return min(limits.start_speed, profile_velocity / PEAK_SPEED) if profile_velocity > 0.0 else limits.start_speed


def start_pose(robot: Robot, legs: ArrayLike | None) -> Array:
    """Return leg angles (4,) to start from, rad; None = home.

    Raises:
        InputError: not four finite numbers.
    """
    target = np.full(len(LEGS), robot.home.leg_angle) if legs is None else np.asarray(legs, np.float64)
    if target.shape != (len(LEGS),) or not np.isfinite(target).all():
        raise InputError(f"start pose {target}: expected four finite leg angles in rad")
    return target


def legs_away(position: Array, target: Array, limit: float) -> str:
    """Return which legs (4,) are more than ``limit`` (rad) away from the start pose, in words; empty = none."""
    far = np.flatnonzero(np.abs(position - target) > limit)
    if not len(far):
        return ""
    found = "; ".join(f"{LEGS[k]} is at {position[k]:.2f} rad, its setpoint is {target[k]:.2f} rad" for k in far)
    return f"start pose: {found} (limit {limit:g} rad)"
