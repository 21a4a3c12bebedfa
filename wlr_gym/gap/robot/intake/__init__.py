"""Whether measured runs can be used, before anything is fitted: :data:`CHECKS`, one after the other, in seconds.

Thresholds come from the robot file, the resolution of its sensors and its kinematics; each stands with its reason in the
module of its check. What is no run at all is refused when it is read (:mod:`wlr_gym.data.check`).
"""

from __future__ import annotations

from wlr_gym.gap.robot.intake import imu, joints, whole_run
from wlr_gym.gap.robot.intake.check import ChannelFault, IntakeCheck, Outcome, Sound, findings_of
from wlr_gym.robot import JOINTS, LEGS, WHEELS

#: In the order in which they are made: what a check compares with has been checked before.
CHECKS: tuple[IntakeCheck, ...] = (
    IntakeCheck("short", ("t",), whole_run.too_short),
    IntakeCheck("missing", ("cmd",), whole_run.motors_off),
    IntakeCheck("still", ("pos",), whole_run.stands_still),
    IntakeCheck("wrap", tuple(f"pos_{joint}" for joint in JOINTS), joints.wrapped),
    IntakeCheck("clock", ("t",), whole_run.clock_rate),
    IntakeCheck("clock", ("t",), whole_run.clock_jumps),
    IntakeCheck("dead", tuple(f"pos_{joint}" for joint in JOINTS), joints.dead),
    IntakeCheck("mirrored", tuple(f"pos_{joint}" for joint in JOINTS), joints.mirrored),
    IntakeCheck("dead", tuple(f"pos_{joint}" for joint in JOINTS), joints.stuck),
    IntakeCheck("mirrored", tuple(f"vel_{joint}" for joint in JOINTS), joints.rate_against_angle),
    IntakeCheck("dead", tuple(f"{kind}_{joint}" for kind in ("vel", "eff") for joint in JOINTS), joints.without_signal),
    IntakeCheck("mirrored", tuple(f"eff_{leg}" for leg in LEGS), joints.leg_effort_against),
    IntakeCheck("mirrored", tuple(f"eff_{wheel}" for wheel in WHEELS), joints.wheel_effort_against),
    IntakeCheck("saturated", imu.IMU, imu.saturated),
    IntakeCheck("dead", imu.IMU, imu.without_signal),
    IntakeCheck("mirrored", ("acc_z",), imu.upside_down),
    IntakeCheck("units", ("gyro_z", "gyro_y", "gyro_x"), imu.in_degrees),
    IntakeCheck("mirrored", ("gyro_z", "gyro_y", "gyro_x"), imu.gyro_against),
)

__all__ = ["CHECKS", "ChannelFault", "IntakeCheck", "Outcome", "Sound", "findings_of"]
