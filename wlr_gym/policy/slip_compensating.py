"""The feedback of ``pid`` with what the slip observer knows: true forward velocity, limited wheel slip, load where the grip is.

Traction limiting: a wheel is asked to run at most so much faster or slower than it travels; more slip gives no more force.
What a steady skid turn needs is allowed on top: yaw rate * reach^2 / side along the heading, see
``envs/tasks/terms/rewards.py``.

Load shift: all four legs lean alike, which moves the wheels under the body. With leg angle phi, hips l_x apart and legs of
length l the front wheels carry the share 1/2 - l cos(phi) / l_x of the body: equations (16) and (17) of the paper, corrected
(``studies/paper/corrected.py``), for parallel legs on a level floor, their own mass neglected. Load goes to the axle
that slips less.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from wlr_gym.policy.control import ESTIMATED_FORWARD, Array, Pid, PidConfig, PidGains
from wlr_gym.robot import WHEELS, Robot


class SlipGains(PidGains):
    """Gains: those of ``pid``, and

    Attributes:
        slip_limit: of a wheel along its heading, beyond a skid turn's, m/s.
        load_shift: share of the load moved per difference of the axles' slip speeds, s/m; 0 = legs stay.
        load_shift_time: time constant of that difference, s.
        largest_shift: of the share.
    """

    slip_limit: float = Field(1.0, gt=0)
    load_shift: float = Field(0.0, ge=0)
    load_shift_time: float = Field(0.5, gt=0)
    largest_shift: float = Field(0.14, ge=0, lt=0.3)


class SlipCompensatingConfig(SlipGains, PidConfig):
    """Settings: the gains, and those of ``pid``."""


class SlipCompensating(Pid):
    """The controller; it remembers what ``pid`` does and the smoothed difference of the axles' slip."""

    def __init__(self, contract: Mapping[str, Any], config: SlipCompensatingConfig) -> None:
        super().__init__(contract, config, "slip_compensating")
        self.settings = config
        self.velocity = self.readings.first((ESTIMATED_FORWARD,))
        self._slip = [self.readings.first((f"estimated_slip_velocity[{wheel},x]",)) for wheel in WHEELS]
        self._share = min(1.0, contract["control_period"] / config.load_shift_time)
        self._difference: Array = np.zeros(0)
        hip = self.chassis.robot.hip_position
        self._reach = hip.x * hip.x / hip.y

    def rolling_speed(self, observations: NDArray[np.floating], forward: Array, turn: Array) -> Array:
        """Return how fast each wheel is to roll ahead (N, 4), m/s: as in ``pid``, within the slip limit of what it travels."""
        travel = self.chassis.rolling_speed(self.velocity(observations), self.gyro(observations))
        allowed = self.settings.slip_limit + self._reach * np.abs(turn / max(self.config.steering, 1.0))
        wanted = super().rolling_speed(observations, forward, turn)
        return np.clip(wanted, travel - allowed[:, None], travel + allowed[:, None])

    def legs(self, observations: NDArray[np.floating]) -> Array:
        """Return the leg setpoints (N, 4), rad: leaning so that the load is on the axle that slips less."""
        home = super().legs(observations)
        slip = np.abs(np.stack([read(observations) for read in self._slip], axis=1))
        difference = (slip * self.chassis.front).sum(axis=1) / 2
        if len(self._difference) != len(difference):
            self._difference = np.zeros(len(difference))
        self._difference = self._difference + self._share * (difference - self._difference)
        bound = self.settings.largest_shift
        shift = np.clip(-self.settings.load_shift * self._difference, -bound, bound)
        return home + lean(self.chassis.robot, shift)[:, None]

    def reset(self, mask: NDArray[np.bool_]) -> None:
        """Forget the robots in ``mask`` (N,)."""
        super().reset(mask)
        known = len(self._difference) == len(mask)
        self._difference = np.where(mask, 0.0, self._difference) if known else np.zeros(len(mask))


def lean(robot: Robot, shift: Array) -> Array:
    """Return by how much all legs lean back (rad) from straight down to put the share 1/2 + ``shift`` of the body in front."""
    return np.arcsin(2 * robot.hip_position.x * shift / robot.leg.length)
