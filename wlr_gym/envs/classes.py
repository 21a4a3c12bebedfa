"""Environment classes of the shipped tasks. A task of one's own needs none: see ``register_task``.

Each takes the keywords of :class:`wlr_gym.envs.settings.EnvironmentOptions`. What an environment observes, rewards and measures
is data: ``describe()`` prints its tables, ``wlr envs ID`` and docs/environments.md show them.

Vector classes name Gymnasium's class among their bases a second time: skrl recognises an environment by its direct bases.
"""

# pyright: reportIncompatibleVariableOverride=false
from __future__ import annotations

from typing import ClassVar

from gymnasium.vector import VectorEnv

from wlr_gym.envs.single import WlrEnv
from wlr_gym.envs.vector import WlrVectorEnv


class VelocityEnv(WlrEnv):
    """Follow commands of forward velocity and yaw rate that change a few times within an episode.

    The robot turns on skids, so it cannot turn without slip; what it can learn is to slip no more than the turn needs, on
    floors from slippery to grippy, which it must tell apart from wheel speeds, motor currents and the IMU.

    Version history of ``WLR-Velocity-v0``:

    - v0: first version
    """

    task_name: ClassVar[str | None] = "velocity"


class VelocityVectorEnv(WlrVectorEnv, VectorEnv):
    """A batch of robots on the task of :class:`VelocityEnv`."""

    task_name: ClassVar[str | None] = "velocity"


class PathEnv(WlrEnv):
    """Follow a line, an S-curve or a circle on the floor at a commanded speed, with the least lateral error.

    Where the robot is against its path it knows from its own estimate: odometry and gyroscope drift as wheels slip, which
    turning on skids makes them do, and the camera holds the estimate where there is one. Reward and measures use the true pose.

    Version history of ``WLR-Path-v0``:

    - v0: first version
    """

    task_name: ClassVar[str | None] = "path"


class PathVectorEnv(WlrVectorEnv, VectorEnv):
    """A batch of robots on the task of :class:`PathEnv`."""

    task_name: ClassVar[str | None] = "path"


class PostureEnv(WlrEnv):
    """Drive straight on while the legs sweep from one posture to another: the two tests of the paper as a task.

    First the legs go from home to the first posture; from 4 s on they sweep to the second one, each axle its own way. Legs that
    turn drag their wheels along and load them unevenly, and where the floor grips the wheels unevenly that turns the robot
    aside. The paper's tests are front legs at 30 degrees while rear legs go from 30 to 150, and front legs from 30 to 150 while
    rear legs go from 150 to 30.

    Version history of ``WLR-Posture-v0``:

    - v0: first version
    """

    task_name: ClassVar[str | None] = "posture"


class PostureVectorEnv(WlrVectorEnv, VectorEnv):
    """A batch of robots on the task of :class:`PostureEnv`."""

    task_name: ClassVar[str | None] = "posture"


class SlopeEnv(WlrEnv):
    """Climb a slope at a commanded speed, straight on, then hold.

    Friction and slope are drawn together: the slope is 1.5 to 12 degrees less than the steepest one that the floor's friction
    could hold, atan(mu). The world frame is the floor's; it is gravity that leans. Near the limit every wheel must carry its
    share: wheels that spin, or fight each other, use up what holds the robot.

    Version history of ``WLR-Slope-v0``:

    - v0: first version
    """

    task_name: ClassVar[str | None] = "slope"


class SlopeVectorEnv(WlrVectorEnv, VectorEnv):
    """A batch of robots on the task of :class:`SlopeEnv`."""

    task_name: ClassVar[str | None] = "slope"
