"""Servos on a plant: what their firmware asks of the motors becomes setpoints, what the physics did becomes their shafts.

How the plant's own servo model is the physics. A plant takes leg angles and wheel speeds and runs the servo's law itself, every
substep. So a leg in (extended) position mode and a wheel in velocity mode are *native*: goal, torque, gains and profile
registers go straight to the plant, and the motion is bit for bit the simulator's. In any other mode, or with a PWM limit, the
emulator runs that mode's law once per tick and hands the plant the voltage: a leg gets gain 1 V/rad and the setpoint
``angle + voltage``, a wheel gain 1 V s/rad and the setpoint ``speed + voltage``, which the plant's law turns back into that
voltage. It acts half a tick late and is held over the tick; at 1 ms, the servo's own control period, that is what the servo
does too. Position I and D gains and the feed-forward gains are registers without effect.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

import numpy as np
from numpy.typing import NDArray

from wlr_gym.base.errors import InputError, check_name
from wlr_gym.hardware.config import Hardware
from wlr_gym.hardware.dynamixel.tables import (
    CURRENT_MODE,
    CURRENT_POSITION_MODE,
    EXTENDED_POSITION_MODE,
    POSITION_MODE,
    POSITION_MODES,
    PWM_MODE,
    VELOCITY_MODE,
)
from wlr_gym.hardware.emulator.servo import EmulatedServo, MotorDrive
from wlr_gym.physics import servo as law
from wlr_gym.physics.plants.base import Plant, PlantState
from wlr_gym.robot import JOINTS, LEG_SLICE, LEGS, WHEEL_SLICE, Robot
from wlr_gym.robot.parameter_table import SPECS
from wlr_gym.robot.parameters import Parameters

Array = NDArray[np.float64]

_IS_LEG = np.arange(len(JOINTS)) < len(LEGS)
_NATIVE_MODES = {True: (POSITION_MODE, EXTENDED_POSITION_MODE), False: (VELOCITY_MODE,)}
#: Gains that make the plant's law pass a voltage on: (kp, kd, profile velocity, profile acceleration).
_LEG_CARRIER = (1.0, 0.0, 0.0, 0.0)
_WHEEL_CARRIER = (0.0, 1.0, 0.0, 0.0)
_TUNED = ("servo.kp", "servo.kd", "servo.profile_velocity", "servo.profile_acceleration")


class PlantCoupling:
    """Eight servos on a plant of one robot.

    Args:
        robot: the robot.
        hardware: how the servos are mounted.
        plant: steps by one tick.
        servos: in joint order.
        parameters: of the plant. Gains differ from what the registers say by the same factor as they do from nominal.
        seed: of sensor noise.
        state: where the robot starts; None = standing.

    Attributes:
        plant: see above.
        sensors: its last readings.
        supply: V at the servos.
        nominal_supply: V without a fault.
    """

    def __init__(
        self,
        robot: Robot,
        hardware: Hardware,
        plant: Plant,
        servos: Sequence[EmulatedServo],
        parameters: Parameters | None,
        seed: int,
        state: PlantState | None,
    ) -> None:
        self.plant = plant
        self._servos = servos
        self._sign = np.array([hardware.joints[joint].sign for joint in JOINTS], np.float64)
        units = [servo.table.per_count("present_position") for servo in servos]
        self._zero = np.array([hardware.joints[joint].zero * unit for joint, unit in zip(JOINTS, units, strict=True)])
        self._effort_count, self._idle_effort = law.effort_counts(robot), law.idle_effort(robot)
        nominal = Parameters.nominal(robot, 1)
        self._parameters = nominal.copy() if parameters is None else parameters.copy()
        self._gain_factor = self._parameters["servo.kp"][0] / nominal["servo.kp"][0]
        self._damping = self._parameters["servo.kd"][0].copy()
        known = nominal["servo.kd"][0]
        self._damping_factor = np.divide(self._damping, known, where=known > 0, out=np.ones(len(JOINTS)))
        leg, wheel = robot.servo.leg, robot.servo.wheel
        self._nominal_stall = np.where(_IS_LEG, leg.stall_torque, wheel.stall_torque)
        self._nominal_line = law.line_constants(robot)
        self._nominal_winding = np.stack(law.winding(robot), axis=1).tolist()
        self.nominal_supply: float = float(self._parameters["servo.supply_voltage"][0])
        self.supply: float = self.nominal_supply
        seeds = np.array([seed], np.uint64)
        plant.reset(seeds, self._parameters, state=state)
        plant.step(np.zeros((1, len(JOINTS))), np.zeros((1, len(JOINTS)), bool))  # compiles now, not under a client's eyes
        self.sensors = plant.reset(seeds, self._parameters, state=state)
        self._setpoints = np.zeros((1, len(JOINTS)))
        self._torque = np.zeros((1, len(JOINTS)), bool)
        self._own_law = np.zeros(len(JOINTS), bool)
        self._own_voltage = np.zeros(len(JOINTS))  # V, encoder frame, of the emulator's own laws
        self._reference = np.zeros((2, len(JOINTS)))  # of the emulator's own laws
        self._plant_reference: Array | None = None  # of the plant's, at this tick
        self._turned = np.zeros(len(JOINTS))  # rad by which wheels were turned beyond what the plant's encoders count
        self._output: list[tuple[int, float]] | None = None  # of the motors, at this tick
        self._tuning: list[tuple[float, ...]] = [(-1.0,)] * len(JOINTS)
        self._settled: list[MotorDrive | None] = [None] * len(JOINTS)  # what the plant does by itself from tick to tick
        self._plant_supply = self._parameters["servo.supply_voltage"]
        for k, servo in enumerate(servos):
            servo.shaft.reference, servo.shaft.output = partial(self._reference_of, k), partial(self._output_of, k)
        self._show_sensors()

    def step(self) -> None:
        """Let the motors do for one tick what the firmware asks."""
        self._command_plant()
        self.sensors = self.plant.step(self._setpoints, None if self._torque.all() else self._torque)
        self._plant_reference = None
        self._show_sensors()

    # ---- firmware to plant ----

    def _command_plant(self) -> None:
        retune = self.supply != self._plant_supply[0]
        for k, servo in enumerate(self._servos):
            drive, is_well = servo.drive(), servo.shaft.is_well
            if drive is self._settled[k] and is_well:
                continue
            native = drive.mode in _NATIVE_MODES[bool(_IS_LEG[k])] and drive.goal_pwm >= 1.0 and is_well
            comes_back = drive.on and native and self._own_law[k]  # a tick off: the plant's profile generator goes to the joint
            self._settled[k] = None if comes_back or (drive.on and not native) else drive
            self._torque[0, k] = drive.on and not comes_back
            if not self._torque[0, k]:
                self._own_law[k] = False
                continue
            wanted = self._native_setpoint(k, drive) if native else self._voltage_setpoint(k, drive, servo)
            self._setpoints[0, k], tuning = wanted
            if tuning != self._tuning[k]:
                self._tuning[k], retune = tuning, True
        if retune:
            self._tune()

    def _native_setpoint(self, k: int, drive: MotorDrive) -> tuple[float, tuple[float, ...]]:
        """Return the plant's setpoint for a mode that the plant has itself, and its gains and profile."""
        if _IS_LEG[k]:
            gain = drive.position_gain * self._gain_factor[k]
            gains = (gain, self._damping[k], drive.profile_velocity, drive.profile_acceleration)
            return self._sign[k] * (drive.goal_position - self._zero[k]), gains
        integral, gain = drive.velocity_integral_gain * self._gain_factor[k], drive.velocity_gain * self._damping_factor[k]
        gains = (integral, gain, 0.0, drive.profile_acceleration)
        return self._sign[k] * drive.goal_velocity, gains

    def _voltage_setpoint(self, k: int, drive: MotorDrive, servo: EmulatedServo) -> tuple[float, tuple[float, ...]]:
        """Return the setpoint that makes the plant put a mode's voltage on the motor, and the gains that do it."""
        self._own_voltage[k] = self._voltage(k, drive, servo)
        voltage = self._sign[k] * self._own_voltage[k]
        if _IS_LEG[k]:
            return self._sign[k] * (servo.shaft.true_position - self._zero[k]) + voltage, _LEG_CARRIER
        return self._sign[k] * servo.shaft.true_velocity + voltage, _WHEEL_CARRIER

    def _voltage(self, k: int, drive: MotorDrive, servo: EmulatedServo) -> float:
        """Return the voltage (V, encoder frame) of a law the plant has not got, and move its profile on by a tick."""
        shaft, supply, step = servo.shaft, servo.shaft.strength * self.supply, self.plant.options.control_period
        if not self._own_law[k]:
            self._reference[:, k] = shaft.reference()
            self._own_law[k] = True
        constant, resistance = self._nominal_winding[k]
        back_emf = constant * shaft.true_velocity
        if drive.mode == PWM_MODE:
            return drive.goal_pwm * supply
        limit = drive.goal_pwm * supply
        if drive.mode == CURRENT_MODE:
            return float(np.clip(back_emf + resistance * drive.goal_current, -limit, limit))
        acceleration = drive.profile_acceleration or law.NO_LIMIT
        stood, moved = self._reference[:, k].tolist()
        if drive.mode in POSITION_MODES:
            speed = drive.profile_velocity or law.NO_LIMIT
            acceleration = acceleration if drive.profile_velocity else law.NO_LIMIT
            new = law.leg_profile_step(stood, moved, drive.goal_position, speed, acceleration, step)
            kp, kd = drive.position_gain, 0.0
        else:
            kp, kd = drive.velocity_integral_gain, drive.velocity_gain
            new = law.wheel_profile_step(stood, moved, drive.goal_velocity, acceleration, step, shaft.position, kp, supply)
        self._reference[0, k], self._reference[1, k] = new[0], new[1]
        voltage = law.controller_voltage(kp, kd, new[0], new[1], shaft.position, shaft.velocity, limit)
        if drive.mode == CURRENT_POSITION_MODE:
            room = resistance * abs(drive.goal_current)
            voltage = np.clip(voltage, back_emf - room, back_emf + room)
        return float(voltage)

    def _tune(self) -> None:
        """Hand gains, profiles and supply to the plant."""
        for k, values in enumerate(self._tuning):
            if len(values) == len(_TUNED):
                for name, value in zip(_TUNED, values, strict=True):  # registers go beyond what a plant takes
                    self._parameters[name][0, k] = np.clip(value, SPECS[name].low, SPECS[name].high)
        self._plant_supply[0] = self.supply
        self.plant.set_parameters(self._parameters)

    # ---- plant to firmware ----

    def _show_sensors(self) -> None:
        sensors, self._output = self.sensors, None
        position = self._zero + self._sign * (sensors.joint_position[0] + self._turned)
        velocity = self._sign * sensors.joint_velocity[0]
        load = self._sign * sensors.joint_effort[0] / self._nominal_stall
        volt = float(sensors.supply_voltage[0])
        columns = zip(self._servos, position.tolist(), velocity.tolist(), load.tolist(), strict=True)
        for servo, p, v, strain in columns:
            shaft = servo.shaft
            shaft.load, shaft.voltage = strain, volt
            shaft.move(p, v)

    def _output_of(self, k: int) -> tuple[int, float]:
        """Return counts of current or load, and part of the supply, of motor ``k``; worked out when a register is read."""
        if self._output is None:
            effort, velocity = self._sign * self.sensors.joint_effort[0], self._sign * self.sensors.joint_velocity[0]
            counts = np.rint((effort + self._torque[0] * self._idle_effort * velocity) / self._effort_count)
            constant, resistance = self._nominal_line
            inferred = resistance / constant * effort + constant * velocity  # the plant does not tell its voltage
            voltage = np.where(self._own_law, self._own_voltage, inferred)
            pwm = np.where(self._torque[0], voltage / max(self._plant_supply[0], 1e-3), 0.0)
            self._output = list(zip(counts.astype(int).tolist(), pwm.tolist(), strict=True))
        return self._output[k]

    def _reference_of(self, k: int) -> tuple[float, float]:
        """Return where the profile generator of joint ``k`` stands: rad and rad/s, encoder frame."""
        if self._own_law[k] or not self.plant.capabilities.can_set_state:
            return self._reference[0, k], self._reference[1, k]
        if self._plant_reference is None:
            state = self.plant.mechanical_state()
            position = state.reference_position[0].copy()
            position[LEG_SLICE] += self.plant.parameters["joint.zero_offset"][0]
            position += self._turned
            self._plant_reference = np.stack([self._zero + self._sign * position, self._sign * state.reference_velocity[0]])
        return self._plant_reference[0, k], self._plant_reference[1, k]

    # ---- a hand ----

    def set_friction(self, joint: str, torque: float) -> None:
        """Let a joint's dry friction be ``torque`` (N m) from now on: what a hand does that holds it.

        Raises:
            InputError: no such joint, or a torque beyond the parameter's bounds.
        """
        check_name("joint", joint, JOINTS)
        self._parameters["servo.coulomb_friction"][0, JOINTS.index(joint)] = torque
        self.plant.set_parameters(self._parameters)

    def turn(self, joint: str, angle: float) -> None:
        """Turn a joint by hand while torque is off.

        Args:
            joint: name.
            angle: rad, in the joint's positive direction.

        Raises:
            InputError: torque is on, or the plant's state cannot be set.
        """
        if not self.plant.capabilities.can_set_state or any(servo["torque_enable"] for servo in self._servos):
            raise InputError(f"turn {joint}: motors are on, or this plant's state cannot be set")
        k = JOINTS.index(joint)
        wheels = self.sensors.joint_position[0, WHEEL_SLICE].copy()
        if _IS_LEG[k]:
            state = self.plant.mechanical_state()
            state.joint_position[0, k] += angle
            self.sensors = self.plant.reset(state=state)
            self._turned[WHEEL_SLICE] += wheels  # a reset plant counts its wheels from zero
        else:
            self._turned[k] += angle
        self._show_sensors()
