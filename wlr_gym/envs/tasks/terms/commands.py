"""Commands a task can ask the robot to follow."""

from __future__ import annotations

import math
from dataclasses import dataclass


@dataclass(frozen=True)
class CommandTerm:
    """One commanded quantity: name, SI unit, frame, meaning, and the least value that means something."""

    name: str
    unit: str
    frame: str
    doc: str
    least: float = -math.inf


COMMANDS = {
    term.name: term
    for term in (
        CommandTerm("linear_velocity_x", "m/s", "body", "forward velocity of the body origin"),
        CommandTerm("yaw_rate", "rad/s", "body", "angular velocity about the body's z axis, positive to the left"),
        CommandTerm("path_shape", "-", "-", "below 1 a line, below 2 an S-curve, above a circle"),
        CommandTerm("path_curvature", "1/m", "path", "of the circle, and of the S-curve at its start; positive to the left"),
        CommandTerm("path_wavelength", "m", "path", "of the S-curve", least=0.1),
        CommandTerm("path_offset", "m", "start", "where the path begins, to the left of where the robot stands"),
        CommandTerm("path_heading", "rad", "start", "direction of the path where it begins, positive to the left"),
        CommandTerm("front_leg_first", "rad", "joint", "front leg angle before the sweep"),
        CommandTerm("front_leg_second", "rad", "joint", "front leg angle after the sweep"),
        CommandTerm("rear_leg_first", "rad", "joint", "rear leg angle before the sweep"),
        CommandTerm("rear_leg_second", "rad", "joint", "rear leg angle after the sweep"),
        CommandTerm("leg_rate", "rad/s", "joint", "rate of the legs in the sweep", least=0.0),
        CommandTerm("climb_speed", "m/s", "body", "forward velocity of the body origin while climbing", least=0.0),
        CommandTerm("climb_time", "s", "-", "when to stop climbing and hold", least=0.0),
    )
}
