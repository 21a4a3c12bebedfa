"""Whether a robot and its wiring speak of the same servos: the robot file has their numbers, the hardware file their models."""

from __future__ import annotations

import math

from wlr_gym.base.errors import InputError
from wlr_gym.hardware.config import Hardware
from wlr_gym.hardware.dynamixel.tables import ControlTable, load_table
from wlr_gym.physics.servo import measures_current
from wlr_gym.robot import LEGS, Robot

#: Relative difference of a count from its register's that is a rounding of the file.
SAME = 1e-3
#: Most servos on one shaft: a dual joint has two, of which one is on the bus, and its current is a share of the joint's.
MOST_SERVOS = 4


def check_fit(robot: Robot, hardware: Hardware) -> None:
    """Refuse a robot whose servos' numbers are not those of the models that it is wired with.

    Raises:
        InputError: names the first difference: supply voltage, encoder counts, what the servo reports of its torque, or a
            sensor that only one of them has.
    """
    if hardware.flow is not None and robot.sensors.flow is None:
        raise InputError(
            f"hardware '{hardware.name}' has an optical-flow sensor, robot '{robot.name}' has not: its file needs a section "
            "sensors.flow, as in configs/robot/flow.yaml"
        )
    for name, bus in hardware.buses.items():
        table = load_table(bus.model)
        for joint in bus.joints:
            problem = _problem(robot, table, joint)
            if problem:
                raise InputError(
                    f"robot '{robot.name}' on hardware '{hardware.name}', bus '{name}', {joint}: {problem}: name the hardware "
                    "file of this robot (--hardware), or mend one of the two"
                )


def _problem(robot: Robot, table: ControlTable, joint: str) -> str:
    """Return what does not fit; empty where all does."""
    is_leg = joint in LEGS
    group, motor = ("leg", robot.servo.leg) if is_leg else ("wheel", robot.servo.wheel)
    low, high = table.voltage_range()
    if not low <= robot.servo.supply_voltage <= high:
        return f"servo.supply_voltage is {robot.servo.supply_voltage:g} V, {table.model} takes {low:g} to {high:g} V"
    encoder = robot.sensors.encoder
    for key, stated, item in (
        ("position", encoder.position, "present_position"),
        ("velocity", encoder.velocity, "present_velocity"),
    ):
        count = table.per_count(item)
        if stated > 0.0 and not math.isclose(stated, count, rel_tol=SAME):  # 0: an ideal one
            return f"sensors.encoder.{key} is {stated:g}, a count of {table.model} is {count:g}"
    has_current = measures_current(robot)[0 if is_leg else 1]
    if has_current != (table.effort == "present_current"):
        said, has = ("current_count", "no current") if has_current else ("load_count", "its current")
        return f"servo.{group} reports counts of {said}, {table.model} measures {has}"
    if motor.current_count is not None:
        servos = motor.current_count / table.counts.current
        if not (1 <= round(servos) <= MOST_SERVOS and math.isclose(servos, round(servos), rel_tol=SAME)):
            here = f"a count of {table.model} is {table.counts.current:g} A"
            return f"servo.{group}.current_count is {motor.current_count:g} A, {here}"
    return ""
