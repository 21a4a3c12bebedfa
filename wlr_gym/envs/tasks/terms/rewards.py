"""Reward terms. Each is dimensionless: quantities are divided by a scale that is a parameter of the term.

A task gives every term a weight per second (negative for costs), so returns do not depend on the control rate.
"""

from __future__ import annotations

import math

from wlr_gym.envs.tasks.signals import Signals, Value, climb_speed, error_from_path, leg_errors, mean, norm, true_pose
from wlr_gym.envs.tasks.terms.measures import POSITIVE, ScalarTerm, registered
from wlr_gym.physics.codegen import ops
from wlr_gym.robot import CORNER_SIGNS, LEG_SLICE, LEGS, WHEEL_SLICE, WHEELS

REWARDS: dict[str, ScalarTerm] = {}


def _kernel(error: Value, width: Value) -> Value:
    ratio = error / width
    return ops.exp(-(ratio * ratio))


def _levelling(ratio: Value) -> Value:
    """|ratio| / (1 + |ratio| / 8): the ratio's size near 0, towards 8 far off."""
    size = ops.absolute(ratio)
    return size / (1.0 + 0.125 * size)


@registered(REWARDS, width=POSITIVE)
def track_linear_velocity(signals: Signals, *, width: Value = 0.1) -> Value:
    """exp(-(error / width)^2) of the body's forward velocity; width in m/s."""
    return _kernel(signals.command("linear_velocity_x") - signals.truth("linear_velocity_in_body")[0], width)


@registered(REWARDS, width=POSITIVE)
def track_yaw_rate(signals: Signals, *, width: Value = 0.3) -> Value:
    """exp(-(error / width)^2) of the body's yaw rate; width in rad/s."""
    return _kernel(signals.command("yaw_rate") - signals.truth("angular_velocity_in_body")[2], width)


@registered(REWARDS, linear=POSITIVE, angular=POSITIVE)
def velocity_error(signals: Signals, *, linear: Value = 0.02, angular: Value = 0.06) -> Value:
    """|error| of forward velocity over ``linear`` (m/s) plus |error| of yaw rate over ``angular`` (rad/s)."""
    forward = signals.command("linear_velocity_x") - signals.truth("linear_velocity_in_body")[0]
    turning = signals.command("yaw_rate") - signals.truth("angular_velocity_in_body")[2]
    return ops.absolute(forward) / linear + ops.absolute(turning) / angular


@registered(REWARDS, linear=POSITIVE, angular=POSITIVE)
def squared_velocity_error(signals: Signals, *, linear: Value = 0.02, angular: Value = 0.06) -> Value:
    """(error / ``linear``)^2 of forward velocity (m/s) plus (error / ``angular``)^2 of yaw rate (rad/s), each at most 25."""
    forward = (signals.command("linear_velocity_x") - signals.truth("linear_velocity_in_body")[0]) / linear
    turning = (signals.command("yaw_rate") - signals.truth("angular_velocity_in_body")[2]) / angular
    return ops.minimum(forward * forward, 25.0) + ops.minimum(turning * turning, 25.0)


@registered(REWARDS, scale=POSITIVE)
def estimate_error(signals: Signals, *, scale: Value = 0.01) -> Value:
    """|error| of the slip observer's forward velocity over ``scale`` (m/s), as |r| / (1 + |r| / 8).

    How one drives decides what can be observed: without a camera wheels that all slip alike hide the velocity.
    """
    error = signals.estimate("linear_velocity_in_body")[0] - signals.truth("linear_velocity_in_body")[0]
    return _levelling(error / scale)


@registered(REWARDS, lateral=POSITIVE, heading=POSITIVE)
def path_error(signals: Signals, *, lateral: Value = 0.015, heading: Value = 0.2) -> Value:
    """Distance from the path over ``lateral`` (m), heading error over ``heading`` (rad), each r as |r| / (1 + |r| / 8)."""
    error = error_from_path(signals, true_pose(signals))
    return _levelling(error.lateral / lateral) + _levelling(error.heading / heading)


@registered(REWARDS, lateral=POSITIVE, heading=POSITIVE)
def course_error(signals: Signals, *, lateral: Value = 0.01, heading: Value = 0.025) -> Value:
    """Distance from the start's line over ``lateral`` (m), heading over ``heading`` (rad), each r as |r| / (1 + |r| / 8)."""
    pose = true_pose(signals)
    return _levelling(pose.y / lateral) + _levelling(pose.yaw / heading)


@registered(REWARDS, scale=POSITIVE)
def leg_error(signals: Signals, *, scale: Value = 0.1) -> Value:
    """Mean |error| of the leg angles over ``scale`` (rad)."""
    return mean([ops.absolute(error) for error in leg_errors(signals)]) / scale


@registered(REWARDS, width=POSITIVE)
def track_climb_speed(signals: Signals, *, width: Value = 0.03) -> Value:
    """exp(-(error / width)^2) of the forward velocity, while climbing and while holding; width in m/s."""
    return _kernel(climb_speed(signals) - signals.truth("linear_velocity_in_body")[0], width)


@registered(REWARDS, scale=POSITIVE)
def climb_speed_error(signals: Signals, *, scale: Value = 0.015) -> Value:
    """|error| of the forward velocity over ``scale`` (m/s), while climbing and while holding."""
    return ops.absolute(climb_speed(signals) - signals.truth("linear_velocity_in_body")[0]) / scale


@registered(REWARDS, linear=POSITIVE, angular=POSITIVE)
def other_motion(signals: Signals, *, linear: Value = 0.1, angular: Value = 0.5) -> Value:
    """Squared sideways and vertical velocity over ``linear`` (m/s) and roll and pitch rate over ``angular`` (rad/s)."""
    _, lateral, vertical = signals.truth("linear_velocity_in_body")
    roll, pitch, _ = signals.truth("angular_velocity_in_body")
    return (lateral * lateral + vertical * vertical) / (linear * linear) + (roll * roll + pitch * pitch) / (angular * angular)


@registered(REWARDS)
def action_rate(signals: Signals) -> Value:
    """Mean squared change of the action since the step before."""
    changes = [now - before for now, before in zip(signals.action, signals.previous_action, strict=True)]
    return mean([change * change for change in changes])


@registered(REWARDS, scale=POSITIVE)
def leg_posture(signals: Signals, *, scale: Value = 0.5) -> Value:
    """Mean squared leg angle from home over ``scale`` (rad)."""
    home = signals.robot("home.leg_angle")
    offsets = [(angle - home) / scale for angle in signals.truth("joint_position")[LEG_SLICE]]
    return mean([offset * offset for offset in offsets])


@registered(REWARDS, power=POSITIVE)
def energy(signals: Signals, *, power: Value = 10.0) -> Value:
    """Electrical power drawn from the supply over ``power`` (W); braking earns nothing."""
    return ops.maximum(signals.truth("electrical_energy")[0], 0.0) / (signals.control_period * power)


def skid_turn_slip(signals: Signals) -> list[tuple[Value, Value]]:
    """Slip speeds (m/s) that each wheel needs for the present yaw rate: along its heading, along its axle.

    A wheel x ahead of the body origin and y beside it moves sideways at yaw rate * x, which skid steering cannot avoid. In a
    steady turn on even friction its forward force must balance the moment of that sideways friction, F_x y = F_y x, and
    friction points against slip: so it slips yaw rate * x^2 / y along its heading.
    """
    yaw_rate = ops.absolute(signals.truth("angular_velocity_in_body")[2])
    hip, side, length = signals.robot("hip_position.x"), signals.robot("hip_position.y"), signals.robot("leg.length")
    needed = []
    for (front, _), angle in zip(CORNER_SIGNS, signals.truth("joint_position")[LEG_SLICE], strict=True):
        reach = ops.absolute(hip * front + length * ops.cos(angle))
        needed.append((yaw_rate * reach * reach / side, yaw_rate * reach))
    return needed


@registered(REWARDS, speed=POSITIVE)
def slip(signals: Signals, *, speed: Value = 0.05) -> Value:
    """Mean wheel slip speed beyond what skid steering needs, over ``speed`` (m/s); rolling costs nothing.

    Slip is the mean over the step (slip displacement over the control period); what a turn needs: :func:`skid_turn_slip`.
    """
    displacement, period = signals.truth("slip_displacement"), signals.control_period
    excess = [
        norm(_beyond(along / period, needed_along), _beyond(across / period, needed_across))
        for along, across, (needed_along, needed_across) in zip(
            displacement[0::2], displacement[1::2], skid_turn_slip(signals), strict=True
        )
    ]
    return mean(excess) / speed


def _beyond(value: Value, free: Value) -> Value:
    return ops.maximum(ops.absolute(value) - free, 0.0)


@registered(REWARDS, threshold=(-math.inf, 1.0))
def torque_saturation(signals: Signals, *, threshold: Value = 0.8) -> Value:
    """Mean motor torque beyond ``threshold`` of its stall torque, over the rest up to stall."""
    stall = [signals.robot("servo.leg.stall_torque")] * len(LEGS) + [signals.robot("servo.wheel.stall_torque")] * len(WHEELS)
    used = [ops.absolute(torque) / limit for torque, limit in zip(signals.truth("motor_torque"), stall, strict=True)]
    return mean([ops.maximum(share - threshold, 0.0) for share in used]) / (1.0 - threshold)


@registered(REWARDS, still=POSITIVE, scale=POSITIVE)
def stuck_wheels(signals: Signals, *, still: Value = 0.25, scale: Value = 1.0) -> Value:
    """Mean over wheels of |setpoint| over ``scale`` (rad/s), of those that turn slower than ``still`` (rad/s).

    A wheel that stands against its setpoint looks blocked, or its encoder frozen: where that lasts, supervision stops a robot.
    """
    setpoints = [signals.task("action.wheel_scale") * action for action in signals.action[WHEEL_SLICE]]
    speeds = signals.truth("joint_velocity")[WHEEL_SLICE]
    pairs = zip(setpoints, speeds, strict=True)
    return mean([ops.where_positive(still - ops.absolute(v), ops.absolute(u), 0.0) for u, v in pairs]) / scale


@registered(REWARDS)
def alive(signals: Signals) -> Value:
    """1 while no termination term ended the episode, else 0."""
    return 1.0 - signals.terminated


@registered(REWARDS)
def termination(signals: Signals) -> Value:
    """1 in the step in which a termination term ends the episode, else 0."""
    return signals.terminated
