"""The robot as data: its description, the table of its physical parameters, slip. No simulator, no equation of motion."""

from wlr_gym.robot.description import (
    CORNER_SIGNS,
    CORNERS,
    JOINTS,
    LEGS,
    WHEELS,
    Robot,
    Vector3,
    load_robot,
    physical_faults,
    robot_hash,
    servo_hash,
    standing_height,
)

__all__ = [
    "CORNERS",
    "CORNER_SIGNS",
    "JOINTS",
    "LEGS",
    "WHEELS",
    "Robot",
    "Vector3",
    "load_robot",
    "physical_faults",
    "robot_hash",
    "servo_hash",
    "standing_height",
]
