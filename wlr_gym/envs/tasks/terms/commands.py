"""Commands a task can ask the robot to follow."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

from wlr_gym.envs.tasks.scaling import QUANTITIES
from wlr_gym.robot import Robot


def _speed(robot: Robot) -> float:
    """Speed (m/s) that the wheels turn at without load."""
    return QUANTITIES["top_speed"].of(robot)


def _forward(robot: Robot) -> tuple[float, float]:
    return -_speed(robot), _speed(robot)


def _turning(robot: Robot) -> tuple[float, float]:
    """On the spot, rolling."""
    fastest = 2.0 * _speed(robot) / QUANTITIES["track_width"].of(robot)
    return -fastest, fastest


def _legs(robot: Robot) -> tuple[float, float]:
    return robot.leg_limits


def _leg_rate(robot: Robot) -> tuple[float, float]:
    return 0.0, robot.servo.leg.no_load_speed


@dataclass(frozen=True)
class CommandTerm:
    """One commanded quantity: name, SI unit, frame, meaning, the least and most that mean something, and between which values
    a robot can follow it, None = whatever they are."""

    name: str
    unit: str
    frame: str
    doc: str
    least: float = -math.inf
    most: float = math.inf
    reach: Callable[[Robot], tuple[float, float]] | None = None

    def bounds(self, robot: Robot) -> tuple[float, float]:
        """Return the least and the most that a robot can be asked for."""
        low, high = (-math.inf, math.inf) if self.reach is None else self.reach(robot)
        return max(low, self.least), min(high, self.most)

    def words(self, low: float, high: float) -> str:
        """Return bounds in words: ``0.1 m or more``, ``0 to 0.217 m/s``."""
        unit = "" if self.unit == "-" else f" {self.unit}"
        return f"{low:g}{unit} or more" if high == math.inf else f"{low:.3g} to {high:.3g}{unit}"


COMMANDS = {
    term.name: term
    for term in (
        CommandTerm("linear_velocity_x", "m/s", "body", "forward velocity of the body origin", reach=_forward),
        CommandTerm(
            "yaw_rate", "rad/s", "body", "angular velocity about the body's z axis, positive to the left", reach=_turning
        ),
        CommandTerm("path_shape", "-", "-", "below 1 a line, below 2 an S-curve, above a circle", least=0.0, most=3.0),
        CommandTerm(
            "path_curvature",
            "1/m",
            "path",
            "of the circle, and of the S-curve at its start; positive to the left",
            least=-20.0,
            most=20.0,
        ),
        CommandTerm("path_wavelength", "m", "path", "of the S-curve", least=0.1),
        CommandTerm("path_offset", "m", "start", "where the path begins, to the left of where the robot stands"),
        CommandTerm("path_heading", "rad", "start", "direction of the path where it begins, positive to the left"),
        CommandTerm("front_leg_first", "rad", "joint", "front leg angle before the sweep", reach=_legs),
        CommandTerm("front_leg_second", "rad", "joint", "front leg angle after the sweep", reach=_legs),
        CommandTerm("rear_leg_first", "rad", "joint", "rear leg angle before the sweep", reach=_legs),
        CommandTerm("rear_leg_second", "rad", "joint", "rear leg angle after the sweep", reach=_legs),
        CommandTerm("leg_rate", "rad/s", "joint", "rate of the legs in the sweep", least=0.0, reach=_leg_rate),
        CommandTerm(
            "climb_speed", "m/s", "body", "forward velocity of the body origin while climbing", least=0.0, reach=_forward
        ),
        CommandTerm("climb_time", "s", "-", "when to stop climbing and hold", least=0.0),
    )
}
