"""The emulated robot: eight servos and an IMU around any one-robot Plant, in emulated time. No ports, no clock of its own.

How the plant's own servo model is the physics. A plant takes leg angles and wheel speeds and runs the servo's law itself, every
substep. So a leg in (extended) position mode and a wheel in velocity mode are *native*: goal, torque, gains and profile
registers go straight to the plant, and the motion is bit for bit the simulator's. In any other mode, or with a PWM limit, the
emulator runs that mode's law once per tick and hands the plant the voltage: a leg gets gain 1 V/rad and the goal
``angle + voltage``, a wheel gain 1 V s/rad and the goal ``speed + voltage``, which the plant's law turns back into that
voltage. It acts half a tick late and is held over the tick; at 1 ms, the servo's own control period, that is what the servo
does too. Position I and D gains and the feed-forward gains are registers without effect.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from wlr_gym.base.errors import InputError, unknown_name
from wlr_gym.hardware.config import Bus, Hardware
from wlr_gym.hardware.dynamixel.tables import BAUD_RATES, HARDWARE_ERRORS, ControlTable, load_table
from wlr_gym.hardware.emulator.faults import FAULTS, Fault, FaultBoard, parse_fault
from wlr_gym.hardware.emulator.line import Emission, Line, LineTiming
from wlr_gym.hardware.emulator.servo import (
    CURRENT_MODE,
    CURRENT_POSITION_MODE,
    EXTENDED_POSITION_MODE,
    FIRMWARE,
    OVERLOADED,
    POSITION_MODE,
    POSITION_MODES,
    PWM_MODE,
    VELOCITY_MODE,
    Drive,
    EmulatedServo,
)
from wlr_gym.hardware.imu.frames import ImuFrame, encode_frame
from wlr_gym.hardware.imu.reading import Conversion
from wlr_gym.physics import servo as law
from wlr_gym.physics.plants import make_plant
from wlr_gym.physics.plants.base import Plant, PlantOptions, PlantState
from wlr_gym.physics.plants.forces import Force
from wlr_gym.robot import JOINTS, LEGS, Robot
from wlr_gym.robot.parameters import SPECS, Parameters

Array = NDArray[np.float64]

_IS_LEG = np.arange(len(JOINTS)) < len(LEGS)
_NATIVE_MODES = {True: (POSITION_MODE, EXTENDED_POSITION_MODE), False: (VELOCITY_MODE,)}
#: Gains that make the plant's law pass a voltage on: (kp, kd, profile velocity, profile acceleration).
_LEG_CARRIER = (1.0, 0.0, 0.0, 0.0)
_WHEEL_CARRIER = (0.0, 1.0, 0.0, 0.0)
_TUNED = ("servo.kp", "servo.kd", "servo.profile_velocity", "servo.profile_acceleration")
_IMU_TEMPERATURE = round((30.0 - 36.53) * 340)


@dataclass(frozen=True)
class MachineOptions:
    """How the robot is emulated.

    Attributes:
        backend: simulator behind it.
        tick: s of emulated time per step; goals written in between act at the next one.
        seed: of sensor noise and fault choices.
        sensor_noise: the plant's.
        firmware: version the servos report; fast reads need 45.
        factory: EEPROM as out of the box (id 1, 57600 bit/s, ...) instead of what the hardware file says.
        timing: of lines and adapters.
    """

    backend: str = "gibbs_appell"
    tick: float = 0.001
    seed: int = 0
    sensor_noise: bool = True
    firmware: int = FIRMWARE
    factory: bool = False
    timing: LineTiming = field(default_factory=LineTiming)


class Machine:
    """Eight servos on their lines, an IMU, and a plant.

    Args:
        robot: the robot; its ``dynamixel_ids`` are the servos' ids.
        hardware: wiring and mounting.
        options: see :class:`MachineOptions`.
        plant: one robot with ``control_period`` = ``options.tick``; None makes the options' backend.
        parameters: of the plant (effects included); None = nominal. Gains differ from what the registers say by the same
            factor as they do from nominal.
        forces: formula forces of the plant that is made.
        state: where the robot starts; None = standing.

    Attributes:
        time: s of emulated time since the start.
        servos: joint -> servo.
        lines: bus name -> line.
        faults: what is wrong right now.

    Raises:
        InputError: a plant of another size or period.
    """

    def __init__(
        self,
        robot: Robot,
        hardware: Hardware,
        options: MachineOptions | None = None,
        *,
        plant: Plant | None = None,
        parameters: Parameters | None = None,
        forces: Sequence[Force] = (),
        state: PlantState | None = None,
    ) -> None:
        self.options = options or MachineOptions()
        self.robot = robot
        self.hardware = hardware
        self.plant = plant or make_plant(self.options.backend, robot, 1, _plant_options(self.options), forces)
        if self.plant.count != 1 or abs(self.plant.options.control_period - self.options.tick) > 1e-12:
            raise InputError(
                f"the emulator needs a plant of 1 robot stepped every {self.options.tick:g} s, got {self.plant.count} "
                f"stepped every {self.plant.options.control_period:g} s"
            )
        self.time = 0.0
        self.ticks = 0
        self.faults = FaultBoard(self.options.seed)
        self._imu_output: list[Emission] = []
        self._imu = Conversion(hardware.imu)
        self._frames = 0
        self._sign = np.array([hardware.joints[joint].sign for joint in JOINTS], np.float64)
        self._zero = np.array(
            [hardware.joints[joint].zero * self._table(joint).per_count("present_position") for joint in JOINTS]
        )
        self._effort_count = law.effort_counts(robot)
        nominal = Parameters.nominal(robot, 1)
        self._parameters = nominal.copy() if parameters is None else parameters.copy()
        self._gain_factor = self._parameters["servo.kp"][0] / nominal["servo.kp"][0]
        self._damping = self._parameters["servo.kd"][0].copy()
        self._damping_factor = np.divide(
            self._damping, nominal["servo.kd"][0], where=nominal["servo.kd"][0] > 0, out=np.ones(8)
        )
        motors = (robot.servo.leg, robot.servo.wheel)
        self._nominal_stall = np.repeat([motor.stall_torque for motor in motors], 4)
        speed = np.repeat([motor.no_load_speed for motor in motors], 4)
        self._nominal_motor = law.motor_constants(self._nominal_stall, speed, robot.servo.supply_voltage)
        self._nominal_supply = float(self._parameters["servo.supply_voltage"][0])
        seeds = np.array([self.options.seed], np.uint64)
        self.plant.reset(seeds, self._parameters, state=state)
        self.plant.step(np.zeros((1, len(JOINTS))), np.zeros((1, len(JOINTS)), bool))  # compiles now, not under a client's eyes
        self._sensors = self.plant.reset(seeds, self._parameters, state=state)
        self._own_law = np.zeros(len(JOINTS), bool)
        self._reference = np.zeros((2, len(JOINTS)))
        self._references_of: tuple[int, Array] = (-1, self._reference)
        self._turned = np.zeros(len(JOINTS))  # rad by which wheels were turned beyond what the plant's encoders count
        self._tuning: list[tuple[float, ...]] = [(-1.0,)] * len(JOINTS)
        self._supply = self._nominal_supply
        self._goals = np.zeros((1, len(JOINTS)))
        self._torque = np.zeros((1, len(JOINTS)), bool)
        self.servos = {joint: self._make_servo(joint) for joint in JOINTS}
        self._show_sensors()
        for servo in self.servos.values():
            servo.boot(0.0)
        self.lines = {
            name: Line(name, [self.servos[joint] for joint in bus.joints], self.faults, self.options.timing)
            for name, bus in hardware.buses.items()
        }

    def _bus(self, joint: str) -> Bus:
        return next(bus for bus in self.hardware.buses.values() if joint in bus.joints)

    def _table(self, joint: str) -> ControlTable:
        return load_table(self._bus(joint).model)

    def _make_servo(self, joint: str) -> EmulatedServo:
        bus = self._bus(joint)
        ours = {"id": self.robot.dynamixel_ids[joint], "baud_rate": BAUD_RATES.index(bus.baud_rate), **bus.eeprom}
        eeprom: Mapping[str, int] = {} if self.options.factory else ours
        servo = EmulatedServo(joint, self._table(joint), eeprom, self.options.firmware)
        column = JOINTS.index(joint)
        servo.shaft.reference = lambda: self._reference_of(column)
        return servo

    @property
    def places(self) -> tuple[str, ...]:
        """Names a fault may be at."""
        return (*JOINTS, *self.hardware.buses, "imu")

    # ---- time ----

    def advance(self, duration: float) -> None:
        """Let ``duration`` seconds of emulated time pass, in whole ticks."""
        for _ in range(round(duration / self.options.tick)):
            self.step()

    def step(self) -> None:
        """Let one tick pass: faults, firmware, motors, physics, sensors."""
        tick = self.options.tick
        if self.faults.any:
            self._suffer()
        for servo in self.servos.values():
            servo.advance(tick)
        self._command_plant()
        self._sensors = self.plant.step(self._goals, self._torque)
        self.ticks += 1
        self.time = self.ticks * tick
        self._show_sensors()
        while self.time >= (self._frames + 1) / self.hardware.imu.rate - 1e-9:
            self._read_imu()

    # ---- firmware to plant ----

    def _command_plant(self) -> None:
        tuning = list(self._tuning)
        for k, servo in enumerate(self.servos.values()):
            drive = servo.drive()
            self._torque[0, k] = drive.on
            native = drive.mode in _NATIVE_MODES[bool(_IS_LEG[k])] and drive.goal_pwm >= 1.0
            if drive.on and self._own_law[k] and native:
                self._torque[0, k] = False  # one tick, in which the plant's profile generator comes back to the joint
            if not self._torque[0, k]:
                self._own_law[k] = False
                continue
            goal = self._native_goal if native else self._voltage_goal
            self._goals[0, k], tuning[k] = goal(k, drive, servo)
        if tuning != self._tuning or self._supply != self._parameters["servo.supply_voltage"][0]:
            self._tune(tuning)

    def _native_goal(self, k: int, drive: Drive, servo: EmulatedServo) -> tuple[float, tuple[float, ...]]:
        """Return the plant's goal for a mode that the plant has itself, and its gains and profile."""
        if _IS_LEG[k]:
            gain = drive.position_gain * self._gain_factor[k]
            gains = (gain, self._damping[k], drive.profile_velocity, drive.profile_acceleration)
            return self._sign[k] * (drive.goal_position - self._zero[k]), gains
        integral, gain = drive.velocity_integral_gain * self._gain_factor[k], drive.velocity_gain * self._damping_factor[k]
        gains = (integral, gain, 0.0, drive.profile_acceleration)
        return self._sign[k] * drive.goal_velocity, gains

    def _voltage_goal(self, k: int, drive: Drive, servo: EmulatedServo) -> tuple[float, tuple[float, ...]]:
        """Return the goal that makes the plant put a mode's voltage on the motor, and the gains that do it."""
        voltage = self._sign[k] * self._voltage(k, drive, servo)
        if _IS_LEG[k]:
            return self._sign[k] * (servo.shaft.position - self._zero[k]) + voltage, _LEG_CARRIER
        return self._sign[k] * servo.shaft.velocity + voltage, _WHEEL_CARRIER

    def _voltage(self, k: int, drive: Drive, servo: EmulatedServo) -> float:
        """Return the voltage (V, encoder frame) of a law the plant has not got, and move its profile on by a tick."""
        shaft, supply, step = servo.shaft, self._supply, self.options.tick
        if not self._own_law[k]:
            self._reference[:, k] = shaft.reference()
            self._own_law[k] = True
        constant, resistance = (values[k] for values in self._nominal_motor)
        back_emf = constant * shaft.velocity
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
        self._reference[:, k] = new[:2]
        voltage = law.controller_voltage(kp, kd, new[0], new[1], shaft.position, shaft.velocity, limit)
        if drive.mode == CURRENT_POSITION_MODE:
            room = resistance * abs(drive.goal_current)
            voltage = np.clip(voltage, back_emf - room, back_emf + room)
        return float(voltage)

    def _tune(self, tuning: list[tuple[float, ...]]) -> None:
        """Hand gains, profiles and supply to the plant."""
        for k, values in enumerate(tuning):
            if len(values) == len(_TUNED):
                for name, value in zip(_TUNED, values, strict=True):  # registers go beyond what a plant takes
                    self._parameters[name][0, k] = np.clip(value, SPECS[name].low, SPECS[name].high)
        self._parameters["servo.supply_voltage"][0] = self._supply
        self._tuning = tuning
        self.plant.set_parameters(self._parameters)

    # ---- plant to firmware ----

    def _show_sensors(self) -> None:
        sensors = self._sensors
        effort = self._sign * sensors.joint_effort[0]
        position = self._zero + self._sign * (sensors.joint_position[0] + self._turned)
        velocity = self._sign * sensors.joint_velocity[0]
        counts = np.rint(effort / self._effort_count)
        volt = float(sensors.supply_voltage[0])
        constant, resistance = self._nominal_motor
        pwm = np.where(self._torque[0], (resistance / constant * effort + constant * velocity) / max(self._supply, 1e-3), 0.0)
        load = effort / self._nominal_stall
        columns = zip(position.tolist(), velocity.tolist(), counts.tolist(), pwm.tolist(), load.tolist(), strict=True)
        for servo, (p, v, e, u, strain) in zip(self.servos.values(), columns, strict=True):
            shaft = servo.shaft
            shaft.position, shaft.velocity, shaft.effort, shaft.pwm, shaft.load, shaft.voltage = p, v, int(e), u, strain, volt

    def _reference_of(self, k: int) -> tuple[float, float]:
        """Return where the profile generator of joint ``k`` stands: rad and rad/s, encoder frame."""
        if self._own_law[k] or not self.plant.capabilities.can_set_state:
            return self._reference[0, k], self._reference[1, k]
        if self._references_of[0] != self.ticks:
            state = self.plant.get_state()
            position = state.reference_position[0].copy()
            position[: len(LEGS)] += self.plant.parameters["joint.zero_offset"][0]
            position += self._turned
            both = np.stack([self._zero + self._sign * position, self._sign * state.reference_velocity[0]])
            self._references_of = (self.ticks, both)
        return self._references_of[1][0, k], self._references_of[1][1, k]

    # ---- a hand ----

    def turn(self, joint: str, angle: float) -> None:
        """Turn a limp joint by hand.

        Args:
            joint: name.
            angle: rad, in the joint's positive direction.

        Raises:
            InputError: unknown joint, motors that are on, or a plant whose state cannot be set.
        """
        if joint not in JOINTS:
            raise unknown_name("joint", joint, JOINTS)
        if not self.plant.capabilities.can_set_state or any(servo["torque_enable"] for servo in self.servos.values()):
            raise InputError(f"turn {joint}: motors are on, or this plant's state cannot be set")
        k = JOINTS.index(joint)
        wheels = self._sensors.joint_position[0, len(LEGS) :].copy()
        if k < len(LEGS):
            state = self.plant.get_state()
            state.joint_position[0, k] += angle
            self._sensors = self.plant.reset(state=state)
            self._turned[len(LEGS) :] += wheels  # a reset plant counts its wheels from zero
        else:
            self._turned[k] += angle
        self._show_sensors()

    # ---- IMU ----

    def _read_imu(self) -> None:
        sensors = self._sensors
        self._frames += 1
        stamp = self._frames / self.hardware.imu.rate
        force, rate = self._imu.counts(sensors.accelerometer[0], sensors.gyro[0])
        frame = ImuFrame(self._frames % 65536, round(stamp * 1e6) % 2**32, force, _IMU_TEMPERATURE, rate)
        raw, delay = self.faults.mangle(self.time, encode_frame(frame), ["imu"])
        if raw and not self.faults.happens(self.time, "dead", ["imu"]):
            self._imu_output.append(Emission(self.time + delay, raw))

    def take_imu_output(self) -> list[Emission]:
        """Return the frames sent since the last call."""
        output, self._imu_output = self._imu_output, []
        return output

    # ---- faults and commands ----

    def inject(self, fault: Fault | str) -> Fault:
        """Make something go wrong.

        Raises:
            InputError: unknown kind, place or key.
        """
        fault = parse_fault(fault, self.places) if isinstance(fault, str) else fault
        self.faults.add(fault, self.time)
        return fault

    def clear(self, kind: str | None = None) -> None:
        """End all faults, or those of one kind; servos without power come back rebooted."""
        self.faults.clear(kind)
        self._suffer()

    def plugged(self, port: str) -> bool:
        """Whether the adapter of a bus, or of the IMU, is in its socket."""
        return self.faults.active(self.time, "unplug", [port]) is None

    def _suffer(self) -> None:
        """Let the faults that hold now act on servos and supply."""
        active = self.faults.active
        sag = active(self.time, "sag", JOINTS)
        self._supply = max(0.0, self._nominal_supply - (sag.value if sag else 0.0))
        for line in self.lines.values():
            for servo in line.servos:
                places = (servo.name, line.name)
                unpowered = bool(active(self.time, "dead", places) or active(self.time, "brownout", places))
                if servo.dead and not unpowered:
                    servo.boot()
                servo.set_power(not unpowered)
                heat = active(self.time, "overheat", places)
                servo.heating_rate = heat.value if heat else 0.0
                if active(self.time, "overload", places) and not unpowered:
                    servo.raise_error(OVERLOADED)

    def command(self, text: str) -> str:
        """Carry out one line of text and return the answer: a fault, ``clear``, ``faults``, ``status``, ``turn``, ``help``.

        Raises:
            InputError: it cannot be understood.
        """
        word, *rest = text.split() or ["help"]
        if word in FAULTS:
            return f"{self.time:.3f} s: {self.inject(text)}"
        if word == "clear":
            if rest and rest[0] not in FAULTS:
                raise unknown_name("fault", rest[0], FAULTS)
            self.clear(rest[0] if rest else None)
            return "cleared"
        if word == "turn":
            return self._turn_by_command(text, rest)
        actions = {"faults": self._list_faults, "status": self.status, "help": help_text}
        if word not in actions:
            raise unknown_name("command", word, [*actions, "clear", "turn", *FAULTS])
        return actions[word]()

    def _turn_by_command(self, text: str, words: list[str]) -> str:
        try:
            joint, degrees = words
            angle = float(np.deg2rad(float(degrees)))
        except ValueError:
            raise InputError(f"'{text}': expected turn JOINT DEGREES") from None
        self.turn(joint, angle)
        return f"{joint} turned by {degrees} deg"

    def _list_faults(self) -> str:
        return "\n".join(self.faults.listing(self.time)) or "no faults"

    def status(self) -> str:
        """Return one line per servo: torque, mode, position, velocity, supply, temperature, errors."""
        lines = [f"{self.time:.3f} s"]
        for joint, servo in self.servos.items():
            bits = servo["hardware_error_status"]
            errors = ", ".join(name for bit, name in HARDWARE_ERRORS.items() if bits & bit) or "no error"
            power = "no power" if servo.dead else "torque on" if servo["torque_enable"] else "torque off"
            lines.append(
                f"{joint:9} id {servo['id']:3}  {power:10}  mode {servo['operating_mode']:2}"
                f"  position {servo['present_position']:6}  velocity {servo['present_velocity']:4}"
                f"  {servo['present_input_voltage'] / 10:4.1f} V  {servo['present_temperature']:3} degC  {errors}"
            )
        return "\n".join(lines)

    def close(self) -> None:
        """Release the plant."""
        self.plant.close()


def help_text() -> str:
    """Return what :meth:`Machine.command` understands."""
    lines = [
        "status | faults | clear [KIND] | turn JOINT DEGREES | help",
        "KIND [WHERE ...] [probability=] [value=] [after=] [duration=]",
    ]
    for name, kind in FAULTS.items():
        value = f" (value: {kind.unit}, default {kind.value:g})" if kind.unit else ""
        lines.append(f"  {name:9} {kind.doc}{value}")
    return "\n".join(lines)


def _plant_options(options: MachineOptions) -> PlantOptions:
    substeps = max(1, round(options.tick / 0.001))
    return PlantOptions(control_period=options.tick, physics_step=options.tick / substeps, sensor_noise=options.sensor_noise)
