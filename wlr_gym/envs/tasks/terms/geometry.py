"""Where a robot is, from its true state or from the slip observer's estimate: the same terms run on both."""

from __future__ import annotations

from dataclasses import dataclass

from wlr_gym.envs.tasks.signals import Signals, Value
from wlr_gym.physics.codegen import ops


@dataclass(frozen=True)
class PlanarPose:
    """Pose of the body origin. Frame: that of the episode's start (x ahead of the robot as it stood there).

    Attributes:
        x, y: m.
        yaw: rad.
    """

    x: Value
    y: Value
    yaw: Value


def true_pose(signals: Signals) -> PlanarPose:
    """What the simulator knows."""
    x, y, _ = signals.truth("position")
    x0, y0, yaw0 = signals.start
    cos, sin = ops.cos(yaw0), ops.sin(yaw0)
    return PlanarPose(
        x=cos * (x - x0) + sin * (y - y0),
        y=cos * (y - y0) - sin * (x - x0),
        yaw=wrapped(yaw_of(*signals.truth("quaternion")) - yaw0),
    )


def estimated_pose(signals: Signals) -> PlanarPose:
    """What the slip observer makes of the sensors."""
    x, y = signals.estimate("position")
    (yaw,) = signals.estimate("yaw")
    return PlanarPose(x, y, yaw)


def yaw_of(w: Value, x: Value, y: Value, z: Value) -> Value:
    """Heading of the body's x axis in the floor frame, rad, of a quaternion from body to floor frame."""
    return ops.arctan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))


def wrapped(angle: Value) -> Value:
    """The same angle in (-pi, pi]."""
    return ops.arctan2(ops.sin(angle), ops.cos(angle))
