"""Measures: signed errors and other quantities, in SI units, that evaluations report and a task's success is judged by.

They speak of the true motion, and do not enter the reward.
"""

from __future__ import annotations

from wlr_gym.envs.tasks.signals import Signals, Value, mean, norm
from wlr_gym.envs.tasks.terms import references
from wlr_gym.envs.tasks.terms.geometry import true_pose
from wlr_gym.envs.tasks.terms.scalar import ScalarTerm, registered
from wlr_gym.physics.codegen import ops

MEASURES: dict[str, ScalarTerm] = {}


@registered(MEASURES, unit="m/s")
def velocity_error(signals: Signals) -> Value:
    """Forward velocity of the body origin beyond the commanded one."""
    return signals.truth("linear_velocity_in_body")[0] - signals.command("linear_velocity_x")


@registered(MEASURES, unit="rad/s")
def yaw_rate_error(signals: Signals) -> Value:
    """Yaw rate of the body beyond the commanded one."""
    return signals.truth("angular_velocity_in_body")[2] - signals.command("yaw_rate")


@registered(MEASURES, unit="m")
def path_lateral_error(signals: Signals) -> Value:
    """Distance of the body origin from the commanded path, positive to its left."""
    return references.path_error(signals, true_pose(signals)).lateral


@registered(MEASURES, unit="rad")
def path_heading_error(signals: Signals) -> Value:
    """Heading of the body against the path's direction at its nearest point, positive to the left."""
    return references.path_error(signals, true_pose(signals)).heading


@registered(MEASURES, unit="m")
def lateral_error(signals: Signals) -> Value:
    """Distance of the body origin from the line straight ahead of the start, positive to the left."""
    return true_pose(signals).y


@registered(MEASURES, unit="rad")
def heading_error(signals: Signals) -> Value:
    """Heading of the body against that at the start, positive to the left."""
    return true_pose(signals).yaw


@registered(MEASURES, unit="rad")
def leg_error(signals: Signals) -> Value:
    """Root mean square over the legs of true angle minus commanded angle."""
    return ops.sqrt(mean([error * error for error in references.leg_errors(signals)]))


@registered(MEASURES, unit="m/s")
def climb_speed_error(signals: Signals) -> Value:
    """Forward velocity of the body origin beyond that asked for while climbing (then 0, while holding)."""
    return signals.truth("linear_velocity_in_body")[0] - references.climb_speed(signals)


@registered(MEASURES, unit="m/s")
def slip_speed(signals: Signals) -> Value:
    """Mean over the wheels of the slip speed, averaged over the step."""
    slip, period = signals.truth("slip_displacement"), signals.control_period
    return mean([norm(x, y) for x, y in zip(slip[0::2], slip[1::2], strict=True)]) / period
