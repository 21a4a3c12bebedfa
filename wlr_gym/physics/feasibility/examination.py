"""What stands against a robot: impossible numbers first; then, if it can be simulated, what it cannot do, by mechanics."""

from __future__ import annotations

import math
from collections.abc import Iterator

from wlr_gym.physics.feasibility.capability import Capability, capability_of, speed_at
from wlr_gym.physics.feasibility.findings import RobotFinding, fault, warning
from wlr_gym.physics.feasibility.plausibility import odd_numbers
from wlr_gym.physics.feasibility.stance import stance_of, stances
from wlr_gym.robot import Robot, physical_faults
from wlr_gym.robot.description import Motor

#: Of the weight; a wheel that carries less is said.
LEAST_SHARE = 0.02
#: rad; a slope of 10 %, which a robot is expected to climb by its motors.
GENTLE_SLOPE = 0.1
#: rad/s; a slower turn on the spot is said.
SLOWEST_TURN = 0.05
#: Part of a leg's stall torque that it may give for long.
LASTING_SHARE = 0.5
#: rad; legs that give way by more under the weight are said.
LARGEST_SAG = 0.2
#: rad; a position error that already asks for the whole supply: a gain in counts of a register.
SHARPEST_LOOP = 0.03
#: s; how long a motor alone takes to reach its speed.
SPIN_UP = (1e-4, 0.5)
#: Damping ratio of the body on its contact springs.
DAMPING_RATIO = (0.02, 3.0)


def examine_robot(robot: Robot) -> list[RobotFinding]:
    """Return all findings, faults first.

    Args:
        robot: loaded with ``check=False``: what :func:`wlr_gym.robot.load_robot` refuses is found here too.
    """
    impossible = [fault(text.partition(" ")[0], None, "", text) for text in physical_faults(robot)]
    found = [*impossible, *odd_numbers(robot), *_motors(robot)]
    if not any(" is missing" in one.text for one in impossible):
        found += _mechanics(robot, capability_of(robot))
    return sorted(found, key=lambda one: one.level)


def _mechanics(robot: Robot, can: Capability) -> Iterator[RobotFinding]:
    if stance_of(robot, robot.home.leg_angle).clearance <= 0.0:
        sine = math.sin(robot.home.leg_angle) * robot.leg.length
        text = f"wheels are {robot.leg.length:.4g} m x sin = {sine:.4g} m below the hips: the body lies on the floor"
        yield fault("home.leg_angle", robot.home.leg_angle, "rad", text)
        return
    yield from _tipping(robot, can)
    yield from _driving(robot, can)
    yield from _turning(robot, can)
    yield from _holding(robot, can)
    yield from _leg_extremes(robot)
    yield from _contact(robot, can)


def _tipping(robot: Robot, can: Capability) -> Iterator[RobotFinding]:
    """Static margin, then acceleration that motors and floor can give against the one that tips it over."""
    home = stance_of(robot, robot.home.leg_angle)
    names = {"ahead": "forward", "behind": "backward", "left": "to the left", "right": "to the right"}
    for name, words in names.items():
        margin = getattr(home, name)
        if margin <= 0.0:
            key = "body.com_offset" + (" x" if name in ("ahead", "behind") else " y")
            value = robot.body.com_offset[0 if name in ("ahead", "behind") else 1]
            yield fault(key, value, "m", f"tips over {words}: centre of mass {-margin:.4g} m beyond the wheels' contacts")
            return
    slope = min(can.tipping_uphill, can.tipping_downhill, can.tipping_sideways)
    if slope < 0.35:
        text = f"tips over on a slope of {math.degrees(slope):.3g} deg: centre of mass {can.com_height:.4g} m above the floor"
        nearest = min(home.ahead, home.behind, home.left, home.right)
        yield warning("tipping", slope, "rad", f"{text}, nearest contacts {nearest:.4g} m aside")
    most = min(can.acceleration_of_motors, can.acceleration_of_grip)
    for limit, words in ((can.tipping_acceleration, "accelerating"), (can.tipping_deceleration, "braking")):
        if limit < most:
            text = f"tips over when {words} with it: motors and floor give {most:.3g} m/s2"
            yield warning(f"tipping_{'ac' if words[0] == 'a' else 'de'}celeration", limit, "m/s2", text)


def _driving(robot: Robot, can: Capability) -> Iterator[RobotFinding]:
    key = "servo.wheel.stall_torque"
    torque = robot.servo.wheel.stall_torque
    if can.wheel_torque <= 0.0:
        return  # said of the motor
    slope = abs(robot.ground.slope)
    if slope > min(can.climb_of_motors, can.climb_of_grip):
        weaker = "motors" if can.climb_of_motors < can.climb_of_grip else "grip"
        text = f"cannot hold on its own slope: {weaker} allow {min(can.climb_of_motors, can.climb_of_grip):.3g} rad"
        yield fault("ground.slope", robot.ground.slope, "rad", text)
    if can.climb_of_motors < GENTLE_SLOPE:
        text = (
            f"motors too weak for {can.total_mass:.4g} kg: four wheels of {robot.wheel.radius:g} m climb "
            f"{can.climb_of_motors:.3g} rad ({math.degrees(can.climb_of_motors):.2g} deg) and accelerate "
            f"with {can.acceleration_of_motors:.2g} m/s2"
        )
        yield warning(key, torque, "N m", text)
    if not 0.02 <= can.top_speed <= 20.0:
        text = f"top speed {can.top_speed:.3g} m/s with wheels of {robot.wheel.radius:g} m: expected 0.02 to 20 m/s"
        yield warning("servo.wheel.no_load_speed", robot.servo.wheel.no_load_speed, "rad/s", text)


def _turning(robot: Robot, can: Capability) -> Iterator[RobotFinding]:
    if can.wheel_torque <= 0.0 or min(robot.ground.mu_x, robot.ground.mu_y) <= 0.0:
        return
    grip = f"friction {robot.ground.mu_x:g} along, {robot.ground.mu_y:g} across"
    shape = f"hips at x = {robot.hip_position.x:g} m, y = {robot.hip_position.y:g} m"
    if can.turning_torque >= can.wheel_torque:
        text = f"cannot turn on its floor: the skid moment asks {can.turning_torque:.3g} N m of a wheel ({grip}; {shape})"
        yield fault("servo.wheel.stall_torque", robot.servo.wheel.stall_torque, "N m", text)
    elif can.turning_rate < SLOWEST_TURN:
        text = f"turns on the spot at {can.turning_rate:.2g} rad/s at most ({grip}; {shape}): expected {SLOWEST_TURN:g} or more"
        yield warning("servo.wheel.no_load_speed", robot.servo.wheel.no_load_speed, "rad/s", text)


def _holding(robot: Robot, can: Capability) -> Iterator[RobotFinding]:
    key, torque = "servo.leg.stall_torque", robot.servo.leg.stall_torque
    if can.holding_torque > torque:
        text = f"cannot stand: {can.total_mass:.4g} kg ask {can.holding_torque:.3g} N m of a leg at home"
        yield fault(key, torque, "N m", text)
    elif can.holding_torque_at_limits > torque:
        text = f"cannot hold {can.total_mass:.4g} kg at the leg limits: asks {can.holding_torque_at_limits:.3g} N m of a leg"
        yield warning(key, torque, "N m", text)
    elif can.holding_torque_at_limits > LASTING_SHARE * torque:
        share = can.holding_torque_at_limits / torque
        asked = f"{can.total_mass:.4g} kg ask {can.holding_torque_at_limits:.3g} N m of a leg at its limits"
        text = f"{asked}, {share:.0%} of it: the motor gets hot"
        yield warning(key, torque, "N m", text)
    if can.leg_sag > LARGEST_SAG:
        load = f"{can.holding_torque_at_limits:.3g} N m"
        text = f"legs give way by {can.leg_sag:.3g} rad under {load}: expected {LARGEST_SAG:g} rad or less"
        yield warning("servo.leg.kp", robot.servo.leg.kp, "V/rad", text)


def _leg_extremes(robot: Robot) -> Iterator[RobotFinding]:
    length = robot.leg.length
    nearest = 2.0 * robot.hip_position.x - length * (_most(robot, 1.0) + _most(robot, -1.0))
    if nearest < 2.0 * robot.wheel.radius:
        words = "cross" if nearest < 0 else "touch"
        apart = f"front and rear axles are {nearest:.4g} m apart, wheels need {2 * robot.wheel.radius:.4g} m"
        low, high = robot.leg_limits
        text = f"legs {words}: at the limits [{low:.3g}, {high:.3g}] rad {apart}"
        yield warning("leg.length", length, "m", text)
    for pose in stances(robot):
        where = f"with front legs at {pose.front:.3g} and rear legs at {pose.rear:.3g} rad"
        if pose.front == pose.rear and pose.clearance < 0.0:
            yield warning("leg_limits", pose.front, "rad", f"body {-pose.clearance:.3g} m in the floor {where}")
        elif pose.ahead + pose.behind > 0.0 and pose.smallest_wheel_share < LEAST_SHARE:
            words = "tips over" if pose.smallest_wheel_share < 0.0 else "a wheel is unloaded"
            text = f"{words} {where}: the least loaded wheel carries {100 * pose.smallest_wheel_share:.2g} % of the weight"
            yield warning("leg_limits", pose.front, "rad", text)


def _most(robot: Robot, sign: float) -> float:
    """Largest of sign x cos over the leg limits."""
    low, high = robot.leg_limits
    middle = 0.0 if sign > 0 else math.pi
    inside = any(low <= middle + turn * math.tau <= high for turn in (-1, 0, 1))
    return 1.0 if inside else max(sign * math.cos(low), sign * math.cos(high))


def _contact(robot: Robot, can: Capability) -> Iterator[RobotFinding]:
    ground = robot.ground
    if can.contact_sag > 0.25 * robot.wheel.radius:
        text = f"the weight presses the wheels {can.contact_sag:.3g} m into the floor; their radius is {robot.wheel.radius:g} m"
        yield warning("ground.normal_stiffness", ground.normal_stiffness, "N/m", text)
    ratio = ground.normal_damping / math.sqrt(ground.normal_stiffness * can.total_mass)
    if not DAMPING_RATIO[0] <= ratio <= DAMPING_RATIO[1]:
        low, high = DAMPING_RATIO
        text = f"damping ratio {ratio:.3g} of {can.total_mass:.4g} kg on four wheels: expected {low:g} to {high:g}"
        yield warning("ground.normal_damping", ground.normal_damping, "N s/m", text)


# --- motors -----------------------------------------------------------------------------------------------------------


def _motors(robot: Robot) -> Iterator[RobotFinding]:
    for name, motor in (("leg", robot.servo.leg), ("wheel", robot.servo.wheel)):
        yield from _motor(f"servo.{name}", motor, robot.servo.supply_voltage)


def _motor(where: str, motor: Motor, supply: float) -> Iterator[RobotFinding]:
    friction, torque = motor.coulomb_friction, motor.stall_torque
    if friction >= torque:
        text = f"does not move: its gear friction is not less than its stall torque, {torque:.4g} N m"
        yield fault(f"{where}.coulomb_friction", friction, "N m", text)
    elif friction > 0.5 * torque:
        text = f"is {friction / torque:.0%} of the stall torque, {torque:.4g} N m"
        yield warning(f"{where}.coulomb_friction", friction, "N m", text)
    if motor.viscous_friction > torque / motor.no_load_speed:
        text = f"halves the speed and more: {speed_at(motor, 0.0):.3g} of {motor.no_load_speed:.3g} rad/s are left"
        yield warning(f"{where}.viscous_friction", motor.viscous_friction, "N m s/rad", text)
    spin_up = motor.armature * motor.no_load_speed / torque
    if not SPIN_UP[0] <= spin_up <= SPIN_UP[1]:
        text = f"the motor alone takes {spin_up:.2g} s to reach its speed: expected {SPIN_UP[0]:g} to {SPIN_UP[1]:g} s"
        yield warning(f"{where}.armature", motor.armature, "kg m2", text)
    if motor.kp > 0.0 and supply / motor.kp < SHARPEST_LOOP:
        text = f"an error of {supply / motor.kp:.2g} rad asks for the whole {supply:g} V: is it in counts of a register?"
        yield warning(f"{where}.kp", motor.kp, "V/rad", text)
    if motor.kd * motor.no_load_speed > 20.0 * supply:
        text = f"an error of {supply / motor.kd:.2g} rad/s asks for the whole {supply:g} V: is it in counts of a register?"
        yield warning(f"{where}.kd", motor.kd, "V s/rad", text)
    if motor.kp == 0.0 and (where.endswith("leg") or motor.kd == 0.0):
        yield fault(f"{where}.kp", motor.kp, "V/rad", "no gain: the servo follows no setpoint")
