"""Would the supervision stop the robot? Its own rules on simulated episodes: the simulator has none, and drives on."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import closing
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wlr_gym.envs.core import Core
from wlr_gym.hardware.config import load_hardware
from wlr_gym.hardware.safety.rules import JointMemory, RobotStatus, is_frozen, is_lost, ratings_of, remember_joints
from wlr_gym.hardware.servos import UNREAD
from wlr_gym.learning.evaluation.rollout import roll_out
from wlr_gym.learning.evaluation.subjects import make_player
from wlr_gym.robot import JOINTS

#: Share of episodes by which a new policy may be stopped more often than the old one.
LARGEST_RISE = 0.02


def stopped_episodes(policy: str, environment: str, keywords: Mapping[str, Any], episodes: int, seed: int) -> NDArray[np.bool_]:
    """Return in which episodes (N,) the supervision would stop a robot that a policy drives.

    Args:
        policy, environment: who drives, and what. keywords: of the environment.
        episodes: N. seed: of the first one; the others count up from it.
    """
    core, player = make_player(environment, policy, episodes, keywords)
    with closing(core):
        watched = _Watched(core)
        roll_out(core, player, seed, on_tick=watched.look)
        return watched.stopped


def may_stop_more(new: NDArray[np.bool_], old: NDArray[np.bool_]) -> bool:
    """Whether it is not shown that the first is stopped in at most 2 % more of the same episodes (N,) than the second.

    The upper end of the 95 % interval of the difference of two paired shares (Bonett and Price 2012) is compared.
    """
    more, less, count = int((new & ~old).sum()) + 1, int((old & ~new).sum()) + 1, len(new) + 2
    rise = (more - less) / count
    return rise + 1.96 * np.sqrt((more + less - count * rise**2) / count**2) > LARGEST_RISE


class _Watched:
    """The supervision's rules on what joints do, on all robots of a batch; it has others for registers, sensors and bus."""

    def __init__(self, core: Core) -> None:
        free = core.actions.torque_on  # of tasks whose wheels have no torque
        self._core, self._on = core, np.ones((core.count, len(JOINTS)), bool) if free is None else free
        self._limits = load_hardware("nominal").safety
        self._ratings = ratings_of(core.task.robot, core.task.config.control_period)
        self._memory = JointMemory()
        self.stopped: NDArray[np.bool_] = np.zeros(core.count, bool)

    def look(self) -> None:
        """Judge the robots whose episodes go on."""
        core, limits, ratings = self._core, self._limits, self._ratings
        self._memory = remember_joints(limits, ratings, self._status(), self._memory, core.actions.setpoints.copy(), self._on)
        bad = is_frozen(limits, self._memory) | is_lost(limits, ratings, self._memory)
        self.stopped |= bad.any(axis=1) & ~(core.terminated | core.truncated)

    def _status(self) -> RobotStatus:
        """What the servos say, copied, since sensors are read in place; that legs' motors draw current is not looked at."""
        sensors, none, unknown = self._core.sensors, np.zeros(self._on.shape), np.full(3, np.nan)
        return RobotStatus(
            time=0.0,
            position=sensors.joint_position.copy(),
            velocity=sensors.joint_velocity.copy(),
            effort=none,
            silence=none,
            alert=none > 0,
            restarted=none > 0,
            voltage=none + self._ratings.supply,
            temperature=none,
            gyro=unknown,
            accelerometer=unknown,
            imu_silence=0.0,
            up=unknown,
            registers=UNREAD._replace(torque=np.ones(self._on.shape)),
        )
