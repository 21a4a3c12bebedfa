"""Would the supervision stop the robot? Its own rules on simulated episodes: the simulator has none, and drives on."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wlr_gym.envs.core import Core
from wlr_gym.hardware.config import load_hardware
from wlr_gym.hardware.safety.rules import ratings_of
from wlr_gym.hardware.safety.state import RobotStatus
from wlr_gym.hardware.safety.supervision import JointMemory, judge, remember
from wlr_gym.hardware.servos import UNREAD
from wlr_gym.learning.evaluation.rollout import roll_out
from wlr_gym.learning.evaluation.subjects import make_player
from wlr_gym.robot import JOINTS

#: Rules that look at what joints do; the others look at registers, sensors and bus, which no simulator has.
RULES = ("frozen", "tracking")


def stopped_episodes(policy: str, environment: str, keywords: Mapping[str, Any], episodes: int, seed: int) -> NDArray[np.bool_]:
    """Return in which episodes (N,) the supervision would stop a robot that a policy drives.

    Args:
        policy, environment: who drives, and what. keywords: of the environment.
        episodes: N. seed: of the first one; the others count up from it.
    """
    core, player = make_player(environment, policy, episodes, keywords)
    try:
        watched = _Watched(core)
        roll_out(core, player, seed, on_tick=watched.look)
        return watched.stopped
    finally:
        core.close()


def more_often(new: NDArray[np.bool_], old: NDArray[np.bool_]) -> bool:
    """Whether the first is stopped in more of the same episodes (N,) than the second, beyond the 95 % interval."""
    more = new.astype(float) - old
    return bool(more.mean() > 1.96 * more.std() / np.sqrt(len(more)))


class _Watched:
    """The supervision of all robots of a batch."""

    def __init__(self, core: Core) -> None:
        self._core, self._on = core, np.ones(len(JOINTS), bool)
        self._limits = load_hardware("nominal").safety
        self._ratings = ratings_of(core.task.robot, core.task.config.control_period)
        self._memories = [JointMemory() for _ in range(core.count)]
        self.stopped: NDArray[np.bool_] = np.zeros(core.count, bool)

    def look(self) -> None:
        """Judge the robots whose episodes go on and that were not stopped."""
        core, limits, ratings = self._core, self._limits, self._ratings
        for row in np.flatnonzero(~(self.stopped | core.terminated | core.truncated)).tolist():
            status, memory = self._status(row), self._memories[row]
            memory = remember(limits, ratings, status, memory, core.actions.setpoints[row], self._on)
            self._memories[row] = memory
            self.stopped[row] = any(one.rule in RULES for one in judge(limits, ratings, status, memory, self._on))

    def _status(self, row: int) -> RobotStatus:
        """What a robot's servos say; a leg's effort tells nothing without the voltage on its motor, so it is not believed."""
        sensors, none = self._core.sensors, np.zeros(len(JOINTS))  # copied: they are read anew in place
        return RobotStatus(
            time=0.0,
            position=sensors.joint_position[row].copy(),
            velocity=sensors.joint_velocity[row].copy(),
            effort=none,
            silence=none,
            alert=none > 0,
            restarted=none > 0,
            voltage=none + self._ratings.supply,
            temperature=none,
            gyro=sensors.gyro[row].copy(),
            accelerometer=sensors.accelerometer[row].copy(),
            imu_silence=0.0,
            up=np.array([0.0, 0.0, 1.0]),
            registers=UNREAD._replace(torque=np.ones(len(JOINTS))),
        )
