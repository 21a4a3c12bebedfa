"""The robot as data: its description, the table of its physical parameters, slip. No simulator, no equation of motion."""

from wlr_gym.robot.description import (
    Robot,
    RobotSource,
    Vector3,
    load_robot,
    physical_faults,
    robot_content,
    robot_hash,
    servo_hash,
    standing_height,
)
from wlr_gym.robot.parameter_table import (
    CORNER_NAMES,
    CORNER_SIGNS,
    CORNERS,
    FIRST_WHEEL,
    JOINTS,
    LEG_SLICE,
    LEGS,
    SHANK_RADIUS,
    WHEEL_SLICE,
    WHEELS,
    full_name,
)

__all__ = [
    "CORNERS",
    "CORNER_NAMES",
    "CORNER_SIGNS",
    "FIRST_WHEEL",
    "JOINTS",
    "LEGS",
    "LEG_SLICE",
    "SHANK_RADIUS",
    "WHEELS",
    "WHEEL_SLICE",
    "Robot",
    "RobotSource",
    "Vector3",
    "full_name",
    "load_robot",
    "physical_faults",
    "robot_content",
    "robot_hash",
    "servo_hash",
    "standing_height",
]
