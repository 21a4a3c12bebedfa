"""Reward terms. Each is dimensionless: quantities are divided by a scale that is a parameter of the term.

A task gives every term a weight per second (negative for costs), so returns do not depend on the control rate.
"""

from __future__ import annotations

from wlr_gym.codegen import ops
from wlr_gym.robot import CORNER_SIGNS
from wlr_gym.tasks.signals import Signals, Value, mean, norm
from wlr_gym.tasks.terms.scalar import ScalarTerm, registered

REWARDS: dict[str, ScalarTerm] = {}


def _kernel(error: Value, width: Value) -> Value:
    ratio = error / width
    return ops.exp(-(ratio * ratio))


@registered(REWARDS)
def track_linear_velocity(signals: Signals, *, width: Value = 0.1) -> Value:
    """exp(-(error / width)^2) of the body's forward velocity; width in m/s."""
    return _kernel(signals.command("linear_velocity_x") - signals.truth("linear_velocity_in_body")[0], width)


@registered(REWARDS)
def track_yaw_rate(signals: Signals, *, width: Value = 0.3) -> Value:
    """exp(-(error / width)^2) of the body's yaw rate; width in rad/s."""
    return _kernel(signals.command("yaw_rate") - signals.truth("angular_velocity_in_body")[2], width)


@registered(REWARDS)
def other_motion(signals: Signals, *, linear: Value = 0.1, angular: Value = 0.5) -> Value:
    """Squared sideways and vertical velocity over ``linear`` (m/s) and roll and pitch rate over ``angular`` (rad/s)."""
    _, lateral, vertical = signals.truth("linear_velocity_in_body")
    roll, pitch, _ = signals.truth("angular_velocity_in_body")
    return (lateral * lateral + vertical * vertical) / (linear * linear) + (roll * roll + pitch * pitch) / (angular * angular)


@registered(REWARDS)
def action_rate(signals: Signals) -> Value:
    """Mean squared change of the action since the tick before."""
    changes = [now - before for now, before in zip(signals.action, signals.previous_action, strict=True)]
    return mean([change * change for change in changes])


@registered(REWARDS)
def leg_posture(signals: Signals, *, scale: Value = 0.5) -> Value:
    """Mean squared leg angle from home over ``scale`` (rad)."""
    home = signals.robot("home.leg_angle")
    offsets = [(angle - home) / scale for angle in signals.truth("joint_position")[:4]]
    return mean([offset * offset for offset in offsets])


@registered(REWARDS)
def energy(signals: Signals, *, power: Value = 10.0) -> Value:
    """Electrical power drawn from the supply over ``power`` (W); braking earns nothing."""
    return ops.maximum(signals.truth("electrical_energy")[0], 0.0) / (signals.control_period * power)


def needed_lateral_slip(signals: Signals) -> list[Value]:
    """Sideways slip speed (m/s) each wheel needs for the present yaw rate: a wheel x ahead of the body origin that turns
    about it moves sideways at yaw rate times x (skid steering cannot do without)."""
    yaw_rate = signals.truth("angular_velocity_in_body")[2]
    hip, length = signals.robot("hip_position.x"), signals.robot("leg.length")
    reach = [hip * signs[0] + length * ops.cos(angle) for signs, angle in zip(CORNER_SIGNS, signals.truth("joint_position")[:4], strict=True)]
    return [ops.absolute(yaw_rate * x) for x in reach]


@registered(REWARDS)
def slip(signals: Signals, *, speed: Value = 0.05) -> Value:
    """Mean wheel slip speed beyond what turning on skids needs, over ``speed`` (m/s); rolling costs nothing.

    Slip is the mean over the tick (slip displacement over the control period). Along its heading a wheel needs no slip;
    across it, :func:`needed_lateral_slip`.
    """
    displacement = signals.truth("slip_displacement")
    period = signals.control_period
    along, across = displacement[0::2], displacement[1::2]
    excess = [
        norm(x / period, ops.maximum(ops.absolute(y / period) - needed, 0.0))
        for x, y, needed in zip(along, across, needed_lateral_slip(signals), strict=True)
    ]
    return mean(excess) / speed


@registered(REWARDS)
def torque_saturation(signals: Signals, *, threshold: Value = 0.8) -> Value:
    """Mean motor torque beyond ``threshold`` of its stall torque, over the rest up to stall."""
    stall = [signals.robot("servo.leg.stall_torque")] * 4 + [signals.robot("servo.wheel.stall_torque")] * 4
    used = [ops.absolute(torque) / limit for torque, limit in zip(signals.truth("motor_torque"), stall, strict=True)]
    return mean([ops.maximum(share - threshold, 0.0) for share in used]) / (1.0 - threshold)


@registered(REWARDS)
def alive(signals: Signals) -> Value:
    """1 while no termination term ended the episode, else 0."""
    return 1.0 - signals.terminated


@registered(REWARDS)
def termination(signals: Signals) -> Value:
    """1 in the tick in which a termination term ends the episode, else 0."""
    return signals.terminated
