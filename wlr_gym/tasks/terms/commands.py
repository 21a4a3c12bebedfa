"""Commands a task can ask the robot to follow."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class CommandTerm:
    """One commanded quantity: name, SI unit, frame, meaning."""

    name: str
    unit: str
    frame: str
    doc: str


COMMANDS = {
    term.name: term
    for term in (
        CommandTerm("linear_velocity_x", "m/s", "body", "forward velocity of the body origin"),
        CommandTerm("yaw_rate", "rad/s", "body", "angular velocity about the body's z axis, positive to the left"),
    )
}
