"""The signals in which plants are compared, and what the robot's sensors resolve of each."""

from __future__ import annotations

from dataclasses import dataclass

from wlr_gym.data.noise import channel_noise
from wlr_gym.robot import LEGS, WHEELS, Robot


@dataclass(frozen=True)
class ComparedSignal:
    """One compared signal.

    Attributes:
        unit, doc: SI unit, meaning. resolution: what the robot's sensors resolve of it, in ``unit``.
        turns: an angle that may jump by a whole turn.
        shared: how wheels that all stick share a load, which rigid bodies leave open: each plant has an answer of its own,
            and it moves nothing. Their total force and moment are not open.
    """

    unit: str
    resolution: float
    doc: str
    turns: bool = False
    shared: bool = False


def resolutions(robot: Robot) -> dict[str, ComparedSignal]:
    """Return every compared signal with what the robot's sensors resolve of it: one sigma of noise and rounding.

    What no sensor measures directly is given what follows from one that does: forces along the floor from a wheel's effort
    over its radius, slip from its velocity reading times the radius, normal forces from the accelerometer times the mass.
    """
    noise = channel_noise(robot)
    radius, mass = robot.wheel.radius, robot.body.mass + 4 * ((robot.leg.mass or 0.0) + (robot.wheel.mass or 0.0))
    leg, wheel = LEGS[0], WHEELS[0]
    tread, slip = noise[f"eff_{wheel}"] / radius, noise[f"vel_{wheel}"] * radius
    return {
        "pos_leg": ComparedSignal("rad", noise[f"pos_{leg}"], "encoder of a leg"),
        "pos_wheel": ComparedSignal("rad", noise[f"pos_{wheel}"], "encoder of a wheel"),
        "vel_leg": ComparedSignal("rad/s", noise[f"vel_{leg}"], "velocity reading of a leg"),
        "vel_wheel": ComparedSignal("rad/s", noise[f"vel_{wheel}"], "velocity reading of a wheel"),
        "eff_leg": ComparedSignal("N m", noise[f"eff_{leg}"], "effort reading of a leg"),
        "eff_wheel": ComparedSignal("N m", noise[f"eff_{wheel}"], "effort reading of a wheel"),
        "gyro": ComparedSignal("rad/s", noise["gyro_x"], "gyroscope"),
        "acc": ComparedSignal("m/s2", noise["acc_x"], "accelerometer"),
        "cam_xy": ComparedSignal("m", noise["cam_x"], "camera x, y"),
        "cam_yaw": ComparedSignal("rad", noise["cam_yaw"], "camera yaw", turns=True),
        "volt": ComparedSignal("V", noise["volt"], "supply voltage"),
        "true_xy": ComparedSignal("m", noise["cam_x"], "body origin on the floor"),
        "true_z": ComparedSignal("m", noise["cam_z"], "height of the body origin"),
        "true_yaw": ComparedSignal("rad", noise["cam_yaw"], "heading", turns=True),
        "true_tilt": ComparedSignal("rad", noise["cam_pitch"], "pitch and roll"),
        "motor_torque_leg": ComparedSignal("N m", noise[f"eff_{leg}"], "motor torque of a leg"),
        "motor_torque_wheel": ComparedSignal("N m", noise[f"eff_{wheel}"], "motor torque of a wheel"),
        "normal_force": ComparedSignal("N", mass * noise["acc_z"], "floor on a wheel, normal"),
        "total_along": ComparedSignal("N", tread, "floor on all wheels, along their heading"),
        "total_across": ComparedSignal("N", tread, "floor on all wheels, along their axles"),
        "total_turn": ComparedSignal("N m", tread * robot.hip_position.y, "friction of all wheels about the body's vertical"),
        "friction_along": ComparedSignal("N", tread, "floor on a wheel, along its heading", shared=True),
        "friction_across": ComparedSignal("N", tread, "floor on a wheel, along its axle", shared=True),
        "slip_along": ComparedSignal("m/s", slip, "longitudinal slip velocity of a wheel"),
        "slip_across": ComparedSignal("m/s", slip, "lateral slip velocity of a wheel"),
    }
