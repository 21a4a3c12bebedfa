"""The Dynamixel servo, defined once for every simulator: profile generator, control law in voltage space, DC motor.

Everything is at the output shaft, in SI units. The control law and the profile generator are written with
:mod:`wlr_gym.physics.codegen.ops`, so the same source runs on floats, numpy arrays (any shape that broadcasts, float32 or
float64) and traced nodes. Facts about the servos: ROBOTIS e-manual; what their registers count: ``hardware/dynamixel/tables``.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from wlr_gym.base.errors import InputError
from wlr_gym.physics.codegen import ops
from wlr_gym.robot import JOINTS, LEG_SLICE, LEGS, WHEEL_SLICE, Robot
from wlr_gym.robot.description import Motor
from wlr_gym.robot.parameters import Parameters

Value = Any  # float | numpy array | traced node
Array = NDArray[np.float64]

#: Stands for "no limit" on profile velocity (rad/s) and acceleration (rad/s2). Finite, so that no select meets inf - inf.
NO_LIMIT = 1e6
#: Distance (rad) at which a leg's profile counts as arrived: a few float32 roundings, 1/1500 of an encoder count.
ARRIVAL = 1e-6
#: s. The integral gain counts velocity errors per cycle of the servo's controller. No manual says how long it is: 1 kHz is
#: assumed, and the parameter ``servo.integral_cycle`` is for what was measured.
CYCLE = 1e-3
#: Braking may be this much harder than nominal. In exact arithmetic it is only used when a new goal lies too close to stop at;
#: in float32 it makes up for rounding along the braking curve, without which the profile overshoots by up to 2e-4 rad.
BRAKING_RESERVE = 1.02


# ---- motor -----------------------------------------------------------------------------------------------------------


def motor_constants(stall_torque: Value, no_load_speed: Value, nominal_voltage: Value) -> tuple[Value, Value]:
    """Return torque constant (N m/A = V s/rad) and winding resistance (ohm) of a motor from its data sheet.

    Args:
        stall_torque: N m at ``nominal_voltage``.
        no_load_speed: rad/s at ``nominal_voltage``.
        nominal_voltage: V the data-sheet figures hold for.
    """
    torque_constant = nominal_voltage / no_load_speed
    return torque_constant, torque_constant * nominal_voltage / stall_torque


@dataclass(frozen=True)
class CurrentLaw:
    """How the nominal motors' currents and torques belong together: current = torque/torque_constant + idle rate.

    Two constants of a motor with a gear: its torque constant, and the back-EMF constant of :func:`winding`. The shaft gets
    the torque of the torque-speed line, whatever the currents are.

    Attributes:
        torque_constant: (8,) N m/A.
        idle: (8,) A s/rad, current per rate of a motor that gives no torque.
    """

    torque_constant: Array
    idle: Array

    def current(self, torque: ArrayLike, rate: ArrayLike) -> Array:
        """Return motor currents (..., 8) in A for torques (N m, before gear friction) and rates (rad/s)."""
        return np.asarray(torque, np.float64) / self.torque_constant + self.idle * np.asarray(rate, np.float64)


def line_constants(robot: Robot) -> tuple[Array, Array]:
    """Return slope constants (8,) in V s/rad and ohm of the nominal torque-speed lines; see :func:`motor_constants`."""
    motors = (robot.servo.leg, robot.servo.wheel)
    stall, speed = (np.repeat([getattr(motor, name) for motor in motors], 4) for name in ("stall_torque", "no_load_speed"))
    return motor_constants(stall, speed, robot.servo.supply_voltage)


def current_law(robot: Robot) -> CurrentLaw:
    """Return how currents and torques of a robot's nominal motors belong together.

    The winding is an Ohmic resistor with a back-EMF, so its current is linear in voltage and rate. With the torque-speed line
    T (v/V - w/w0) given, the currents at its two ends leave one such law: I = Is torque/T + I0 w/w0. A robot file without
    currents has one constant for both: that of the line.
    """
    line, _ = line_constants(robot)
    torque_constant, idle = line.copy(), np.zeros(len(JOINTS))
    for motor, joints in ((robot.servo.leg, LEG_SLICE), (robot.servo.wheel, WHEEL_SLICE)):
        if motor.stall_current is not None and motor.no_load_current is not None:
            torque_constant[joints] = motor.stall_torque / motor.stall_current
            idle[joints] = motor.no_load_current / motor.no_load_speed
    return CurrentLaw(torque_constant, idle)


def winding(robot: Robot) -> tuple[Array, Array]:
    """Return back-EMF constants (8,) in V s/rad and resistances (8,) in ohm of the nominal motors: v = R I + K_e w."""
    (line, slope), law = line_constants(robot), current_law(robot)
    resistance = slope * (law.torque_constant / line)
    return line - resistance * law.idle, resistance


def motor_torque(torque_constant: Value, resistance: Value, voltage: Value, velocity: Value) -> Value:
    """Return the motor torque at the output shaft (N m), before gear friction."""
    return (torque_constant / resistance) * (voltage - torque_constant * velocity)


def controller_voltage(
    kp: Value,
    kd: Value,
    reference_position: Value,
    reference_velocity: Value,
    position: Value,
    velocity: Value,
    supply_voltage: Value,
) -> Value:
    """Return the voltage (V) the servo puts on its motor: kp (q_ref - q) + kd (w_ref - w), limited to the supply.

    One law for both modes. Legs (position mode): ``kp`` is the Position P Gain, ``kd`` the D gain. Wheels (velocity mode):
    ``kd`` is the Velocity P Gain and ``kp`` the Velocity I Gain, acting on q_ref - q = integral of the velocity error (see
    :func:`position_gains`).
    """
    wish = kp * (reference_position - position) + kd * (reference_velocity - velocity)
    return ops.clip(wish, -supply_voltage, supply_voltage)


def position_gains(parameters: Parameters) -> Array:
    """Return the gains (N, 8) in V/rad as they act: a wheel's error is summed once a cycle; ``servo.kp`` holds for 1 ms."""
    gains = parameters["servo.kp"].copy()
    gains[:, WHEEL_SLICE] *= CYCLE / parameters["servo.integral_cycle"]
    return gains


def reference_per_effort(robot: Robot, parameters: Parameters) -> Array:
    """Return by how much the joints' references (N, 8) lie ahead per reported effort, rad/(N m); beside it per rate."""
    constant, _ = line_constants(robot)
    stall, speed = parameters["servo.stall_torque"], parameters["servo.no_load_speed"]
    _, resistance = motor_constants(stall, speed, robot.servo.supply_voltage)
    return resistance / constant / np.maximum(position_gains(parameters), 1e-9)


def reference_per_rate(robot: Robot, parameters: Parameters) -> Array:
    """Return by how much the joints' references (N, 8) lie ahead per rate of the joint, s: for the motor's back-EMF."""
    stall, speed = parameters["servo.stall_torque"], parameters["servo.no_load_speed"]
    constant, _ = motor_constants(stall, speed, robot.servo.supply_voltage)
    return constant / np.maximum(position_gains(parameters), 1e-9)


# ---- profile generator -----------------------------------------------------------------------------------------------


def profile_limits(profile_velocity: ArrayLike, profile_acceleration: ArrayLike) -> tuple[Array, Array]:
    """Translate profile registers, where 0 means "off", into finite limits for the profile steps below.

    Legs: velocity 0 turns the whole profile off (step), acceleration 0 makes it rectangular. Wheels use the acceleration
    only; 0 = step (e-manual, Profile Velocity 112 and Profile Acceleration 108).

    Args:
        profile_velocity, profile_acceleration: (..., 8) in joint order, rad/s and rad/s2.

    Returns:
        Velocity and acceleration limits, (..., 8).
    """
    velocity, acceleration = np.broadcast_arrays(
        np.asarray(profile_velocity, dtype=np.float64), np.asarray(profile_acceleration, dtype=np.float64)
    )
    if velocity.shape[-1:] != (len(JOINTS),):
        raise InputError(f"servo profile has shape {velocity.shape}, expected (..., {len(JOINTS)}): one value per joint")
    is_leg = np.arange(len(JOINTS)) < len(LEGS)
    stepping = (acceleration == 0) | (is_leg & (velocity == 0))
    return np.where(velocity == 0, NO_LIMIT, velocity), np.where(stepping, NO_LIMIT, acceleration)


def wheel_profile_step(
    reference_position: Value,
    reference_velocity: Value,
    goal: Value,
    acceleration: Value,
    step: Value,
    position: Value,
    kp: Value,
    supply: Value,
) -> tuple[Value, Value, Value, Value]:
    """Advance a wheel's profile generator (velocity mode) by one substep.

    The reference velocity ramps to the goal; the reference position is its exact integral over the substep, also where the
    ramp ends within it. Before that the reference is pulled to within supply/kp of the shaft, which is the servo's
    anti-windup: the integral term alone never asks for more than the supply.

    Args:
        reference_position, reference_velocity: where the generator stands, rad and rad/s.
        goal: rad/s.
        acceleration: rad/s2, ``NO_LIMIT`` = step.
        step: s.
        position: shaft angle at the start of the substep as the servo reads it, rad.
        kp: V/rad on the integral of the velocity error.
        supply: V.

    Returns:
        New reference position and velocity, and both as the controller uses them in the middle of the substep.
    """
    reach = supply * (1.0 / ops.maximum(kp, 1e-9))
    start = position + ops.clip(reference_position - position, -reach, reach)
    room = acceleration * step
    velocity = ops.clip(goal, reference_velocity - room, reference_velocity + room)
    change = velocity - reference_velocity
    mean_velocity = velocity - change * ops.absolute(change) * (0.5 / room)
    travel = step * mean_velocity
    return start + travel, velocity, start + 0.5 * travel, mean_velocity


def leg_profile_step(
    reference_position: Value,
    reference_velocity: Value,
    goal: Value,
    velocity_limit: Value,
    acceleration: Value,
    step: Value,
) -> tuple[Value, Value, Value, Value]:
    """Advance a leg's profile generator (position mode) by one substep: step, rectangle or trapezoid.

    The goal may change at any time; the generator brakes, overshoots if it must, and comes back. It stops exactly at the
    goal, without chatter, in float32 too.

    Args:
        reference_position, reference_velocity: where the generator stands, rad and rad/s.
        goal: rad.
        velocity_limit: rad/s; ``NO_LIMIT`` = none.
        acceleration: rad/s2; ``NO_LIMIT`` = rectangular profile.
        step: s.

    Returns:
        New reference position and velocity, and both as the controller uses them in the middle of the substep. A jump of
        the position (no limit at all) has reference velocity 0, so it gives the same answer at every step size.
    """
    to_goal = goal - reference_position
    smooth = _trapezoid(to_goal, reference_velocity, velocity_limit, acceleration, step)
    sharp = _rectangle(to_goal, velocity_limit, step)
    is_sharp = acceleration - 0.5 * NO_LIMIT
    travel, velocity, mean_velocity, arrived = (ops.where_positive(is_sharp, a, b) for a, b in zip(sharp, smooth, strict=True))
    position = ops.where_positive(arrived, goal, reference_position + travel)
    return position, velocity, 0.5 * (reference_position + position), mean_velocity


def _trapezoid(to_goal: Value, velocity: Value, limit: Value, acceleration: Value, step: Value) -> tuple[Value, ...]:
    """Travel, new velocity, mean velocity and whether (> 0) the goal is reached, with the acceleration limited.

    The fastest speed v from which braking still ends at the goal, after a trapezoid-rule step, solves
    v^2/(2 a) + v step/2 = distance - velocity step/2. Braking along it changes v by exactly a step, so the limit holds
    up to the last step, which lands on the goal.
    """
    direction = ops.where_positive(to_goal, 1.0, -1.0)
    distance = ops.absolute(to_goal)
    along = direction * velocity
    room = acceleration * step
    left = ops.maximum(distance - 0.5 * step * along, 0.0)
    braking = 2.0 * left / (0.5 * step + ops.sqrt(0.25 * step * step + left * (2.0 / acceleration)))
    new_along = ops.clip(ops.minimum(limit, braking), along - BRAKING_RESERVE * room, along + room)
    near = ops.maximum(0.5 * step * room, ARRIVAL)
    arrived = ops.minimum(near - distance, 8.0 * acceleration * near - along * along)
    new_velocity = ops.where_positive(arrived, 0.0, direction * new_along)
    mean_velocity = 0.5 * (velocity + new_velocity)
    return step * mean_velocity, new_velocity, mean_velocity, arrived


def _rectangle(to_goal: Value, limit: Value, step: Value) -> tuple[Value, ...]:
    """The same four values with the acceleration unlimited: constant speed, then stop; a jump where there is no limit."""
    room = limit * step
    travel = ops.clip(to_goal, -room, room)
    arrived = ops.where_positive(ops.absolute(to_goal) - room, 0.0, 1.0)
    speed = ops.where_positive(limit - 0.5 * NO_LIMIT, 0.0, travel * (1.0 / step))
    return travel, speed, speed, arrived


# ---- readings --------------------------------------------------------------------------------------------------------


def effort_counts(robot: Robot) -> Array:
    """Return one count of reported effort per joint (8,), N m.

    A servo that measures its current reports counts of that, and the nominal torque constant says what torque it is; one that
    does not reports parts of its stall torque.
    """
    counts = np.empty(len(JOINTS))
    constant = current_law(robot).torque_constant
    for motor, joints, default in _effort_sensors(robot):
        current, load = motor.current_count, motor.load_count
        if current is None and load is None:
            current, load = default
        counts[joints] = current * constant[joints] if current is not None else motor.stall_torque * (load or 0.0)
    return counts


def idle_effort(robot: Robot) -> Array:
    """Return what :func:`effort_counts` alone would read too much per rate (8,), N m s/rad: the idle current.

    It is 0 where a servo measures no current: its load is of torque, as the servo infers it.
    """
    law = current_law(robot)
    effort = law.torque_constant * law.idle
    for joints, has_current in zip((LEG_SLICE, WHEEL_SLICE), measures_current(robot), strict=True):
        if not has_current:
            effort[joints] = 0.0
    return effort


def measures_current(robot: Robot) -> tuple[bool, bool]:
    """Whether the servos of legs and wheels measure their current."""
    legs, wheels = (
        (motor.current_count if motor.current_count or motor.load_count else default[0]) is not None
        for motor, _, default in _effort_sensors(robot)
    )
    return legs, wheels


def _effort_sensors(robot: Robot) -> tuple[tuple[Motor, slice, tuple[float | None, float | None]], ...]:
    """Motors, their joints, and counts of current and load where the robot file says neither: of XM540-W150 and XL430-W250."""
    return (robot.servo.leg, LEG_SLICE, (2.69e-3, None)), (robot.servo.wheel, WHEEL_SLICE, (None, 1e-3))
