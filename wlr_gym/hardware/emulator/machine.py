"""The emulated robot, in emulated time: eight servos and sensors around any one-robot plant. No ports.

:class:`PlantCoupling` joins servos and plant: what their firmware asks of the motors becomes setpoints, what the physics did
becomes their shafts. The plant's own servo model is the physics: it takes leg angles and wheel speeds and runs the servo's law
itself, every substep. So a leg in (extended) position mode and a wheel in velocity mode are *native*: goal, torque, gains and
profile registers go straight to the plant, and the motion is bit for bit the simulator's. In any other mode, or with a PWM
limit, the emulator runs that mode's law once per tick and hands the plant the voltage: a leg gets gain 1 V/rad and the setpoint
``angle + voltage``, a wheel gain 1 V s/rad and the setpoint ``speed + voltage``, which the plant's law turns back into that
voltage. It acts half a tick late and is held over the tick; at 1 ms, the servo's own control period, so it is in the servo.
Position I and D gains and the feed-forward gains are registers without effect.
"""

from __future__ import annotations

import heapq
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial

import numpy as np
from numpy.typing import NDArray

from wlr_gym.base.errors import InputError, check_name
from wlr_gym.hardware.config import FlowCalibration, FlowPort, Hardware, check_fit
from wlr_gym.hardware.dynamixel.tables import (
    BAUD_RATES,
    CURRENT_MODE,
    CURRENT_POSITION_MODE,
    EXTENDED_POSITION_MODE,
    POSITION_MODE,
    POSITION_MODES,
    PWM_MODE,
    VELOCITY_MODE,
    load_table,
)
from wlr_gym.hardware.emulator.faults import Fault, FaultBoard, parse_fault
from wlr_gym.hardware.emulator.line import BusLine, Emission, LineTiming
from wlr_gym.hardware.emulator.servo import FIRMWARE, EmulatedServo, MotorDrive
from wlr_gym.hardware.flow import FULL_QUALITY, FlowConversion
from wlr_gym.hardware.imu import IDENTITY, Conversion, Counts
from wlr_gym.hardware.serial_frames import (
    FIRMWARE_VERSION,
    FLOW_FRAMES,
    IMU_FRAMES,
    SENSORS,
    STATUS_FRAMES,
    STATUS_REQUEST,
)
from wlr_gym.physics import servo as law
from wlr_gym.physics.effects.patch import Source, apply_patch, load_patch
from wlr_gym.physics.floor import FloorSource, lay_floor, load_floor
from wlr_gym.physics.plants import make_plant
from wlr_gym.physics.plants.base import Plant, PlantOptions, PlantState, Sensors
from wlr_gym.robot import JOINTS, LEG_SLICE, LEGS, WHEEL_SLICE, Robot
from wlr_gym.robot.description import FlowSensor
from wlr_gym.robot.parameter_table import SPECS
from wlr_gym.robot.parameters import Parameters

Array = NDArray[np.float64]

#: Frames after which the last bit changes of the IMU's values, and of the flow sensor's surface quality, without noise.
DITHER = 3
#: 30 degC as the IMU's chip counts it.
_IMU_TEMPERATURE = round((30.0 - 36.53) * 340)
#: Shutter on a floor of good texture in a lit room, and at its longest.
_SHUTTER, _LONGEST_SHUTTER = 0x0400, 0x1FFF


@dataclass(frozen=True)
class MachineOptions:
    """How the robot is emulated."""

    backend: str = "gibbs_appell"  #: simulator behind it
    tick: float = 0.001  #: s of emulated time per step; setpoints written in between act at the next one
    seed: int = 0  #: of sensor noise and fault choices
    sensor_noise: bool = True  #: the plant's
    firmware: int = FIRMWARE  #: version the servos report; fast reads need 45
    factory: bool = False  #: EEPROM as out of the box (id 1, 57600 bit/s, ...) instead of what the hardware file says
    timing: LineTiming = field(default_factory=LineTiming)  #: of lines and adapters

    def plant_options(self) -> PlantOptions:
        """Return the options of the plant behind it."""
        substeps = max(1, round(self.tick / 0.001))
        return PlantOptions(control_period=self.tick, physics_step=self.tick / substeps, sensor_noise=self.sensor_noise)


class Machine:
    """Eight servos on their lines, an IMU, an optical-flow sensor where robot and wiring have one, and a plant.

    Args:
        robot: the robot; its ``dynamixel_ids`` are the servos' ids.
        hardware: wiring and mounting.
        options: see :class:`MachineOptions`.
        plant: one robot with ``control_period`` = ``options.tick``; None makes the options' backend.
        parameters: of the plant; None = nominal. See :class:`PlantCoupling`.
        effects: what the robot has that file and parameters do not say; their forces are for the plant that is made.
        floor: that it drives on, as ``floor=`` of an environment, drawn by the options' seed.
        state: where the robot starts; None = standing.

    Attributes:
        time: s of emulated time since the start.
        servos: joint -> servo.
        coupling: of the servos and the plant.
        lines: bus name -> line.
        faults: what is wrong right now.
        sensors: names of the sensors that have a port of their own. places: names a fault may be at.
        is_plugged, pulls: bus or sensor -> its adapter was in its socket at the last tick; times that it was pulled out.
        watchers: called at the end of every tick (what looks at the robot from outside: a camera).

    Raises:
        InputError: a plant of another size or period, effects that cannot be read or that this robot cannot have.
    """

    def __init__(
        self,
        robot: Robot,
        hardware: Hardware,
        options: MachineOptions | None = None,
        *,
        plant: Plant | None = None,
        parameters: Parameters | None = None,
        effects: Source = None,
        floor: FloorSource = None,
        state: PlantState | None = None,
    ) -> None:
        self.options: MachineOptions = options or MachineOptions()
        check_fit(robot, hardware)
        self.robot = robot
        self.hardware = hardware
        patch = load_patch(effects)
        on_floor = lay_floor(load_floor(floor, robot).drawn(self.options.seed), parameters or Parameters.nominal(robot))
        parameters = apply_patch(patch, on_floor)
        self.plant: Plant = plant or make_plant(self.options.backend, robot, 1, self.options.plant_options(), patch.forces)
        if self.plant.count != 1 or abs(self.plant.options.control_period - self.options.tick) > 1e-12:
            raise InputError(
                f"the emulator needs a plant of 1 robot stepped every {self.options.tick:g} s, got {self.plant.count} "
                f"stepped every {self.plant.options.control_period:g} s"
            )
        self.time = 0.0
        self.ticks = 0
        self.faults: FaultBoard = FaultBoard(self.options.seed)
        self.watchers: list[Callable[[], None]] = []
        port, sensor = hardware.flow, robot.sensors.flow
        self._flow: EmulatedFlow | None = None
        if port is not None and sensor is not None:
            self._flow = EmulatedFlow(port, sensor, self.faults, self.options.tick)
        sensors = ("imu",) if self._flow is None else ("imu", "flow")
        self._flow_line = "imu" if port is not None and port.port == hardware.imu.port else "flow"
        self.sensors: tuple[str, ...] = sensors if self._flow_line == "flow" else ("imu",)
        self.places: tuple[str, ...] = (*JOINTS, *hardware.buses, *sensors, "camera")
        self.is_plugged: dict[str, bool] = dict.fromkeys([*hardware.buses, *self.sensors], True)
        self.pulls: dict[str, int] = dict.fromkeys(self.is_plugged, 0)
        self._due: dict[str, list[tuple[float, int, bytes]]] = {name: [] for name in self.is_plugged}
        self._sent = 0
        self._imu = Conversion(hardware.imu)
        self._frames = 0
        self._paused = 0.0
        self._imu_values: tuple[Counts, Counts] = (0, 0, 0), (0, 0, 0)
        self._imu_last = [0] * 6
        self._imu_frame = IMU_FRAMES.encode((0, 0, 0, 0, 0, _IMU_TEMPERATURE, 0, 0, 0))
        self.servos: dict[str, EmulatedServo] = {joint: self._make_servo(joint) for joint in JOINTS}
        servos = list(self.servos.values())
        self.coupling: PlantCoupling = PlantCoupling(robot, hardware, self.plant, servos, parameters, self.options.seed, state)
        for servo in servos:
            servo.boot(0.0)
        self.lines: dict[str, BusLine] = {
            name: BusLine(name, [self.servos[joint] for joint in bus.joints], self.faults, self.options.timing)
            for name, bus in hardware.buses.items()
        }

    def _make_servo(self, joint: str) -> EmulatedServo:
        bus = next(bus for bus in self.hardware.buses.values() if joint in bus.joints)
        ours = {"id": self.robot.dynamixel_ids[joint], "baud_rate": BAUD_RATES.index(bus.baud_rate), **bus.eeprom}
        table = load_table(bus.model).at(self.robot.servo.supply_voltage)
        return EmulatedServo(joint, table, {} if self.options.factory else ours, self.options.firmware)

    def close(self) -> None:
        """Release the plant."""
        self.plant.close()

    # ---- time ----

    def advance(self, duration: float) -> None:
        """Let ``duration`` seconds of emulated time pass, in whole ticks."""
        for _ in range(round(duration / self.options.tick)):
            self.step()

    def step(self) -> None:
        """Let one tick pass: faults, firmware, motors, physics, sensors."""
        tick = self.options.tick
        if self.faults.any:
            self._apply_faults()
        for servo in self.servos.values():
            servo.advance(tick)
        self.coupling.step()
        self.ticks += 1
        self.time = self.ticks * tick
        while self.time >= (self._frames + 1) / self.hardware.imu.rate - 1e-9:
            self._read_imu()
        if self._flow is not None:
            self._send(self._flow_line, self._flow.step(self.time, self._paused, self.coupling.sensors))
        if self.faults.any or not all(self.is_plugged.values()):
            self._pull_and_plug()
        for watcher in self.watchers:
            watcher()

    def now(self) -> float:
        """Return emulated time, s: who drives the robot in emulated time has it for a clock."""
        return self.time

    def wait_until(self, moment: float) -> None:
        """Let emulated time pass until ``moment`` (s)."""
        while self.time < moment - 1e-9:
            self.step()

    def pause(self, duration: float) -> None:
        """Let ``duration`` s pass in which nothing happens (a busy computer): quartzes do not stop, so all clocks go on."""
        self._paused += duration
        for servo in self.servos.values():
            servo.pause(duration)

    def turn(self, joint: str, angle: float) -> None:
        """Turn a joint by hand while torque is off, by ``angle`` (rad) in its positive direction.

        Raises:
            InputError: unknown joint, torque that is on, or a plant whose state cannot be set.
        """
        check_name("joint", joint, JOINTS)
        self.coupling.turn(joint, angle)

    def straighten(self, leg: str) -> None:
        """Turn a leg straight down by hand, as :meth:`turn`: the leg itself, whatever its encoder says."""
        check_name("leg", leg, LEGS)
        self.turn(leg, float(np.pi / 2 - self.plant.mechanical_state().joint_position[0, JOINTS.index(leg)]))

    # ---- IMU ----

    def _read_imu(self) -> None:
        sensors = self.coupling.sensors
        self._frames += 1
        stamp = self._frames / self.hardware.imu.rate + self._paused
        if not self.faults.active(self.time, "imu_frozen", ["imu"]):
            counts = self._imu.counts(sensors.accelerometer[0], sensors.gyro[0])
            # the chip's last bits never rest, also where the plant's sensors have no noise
            bit = 0 if self.options.sensor_noise else self._frames // DITHER % 2
            (a, b, c), (x, y, z) = counts
            self._imu_values = (a + bit, b + bit, c + bit), (x + bit, y + bit, z + bit)
        force, rate = self._imu_values = self._lying_axes(*self._imu_values)
        if not self.faults.active(self.time, "imu_stale", ["imu"]):
            self._imu_frame = IMU_FRAMES.encode((self._frames, round(stamp * 1e6), *force, _IMU_TEMPERATURE, *rate))
        raw, delay = self.faults.mangle(self.time, self._imu_frame, ["imu"])
        if raw and not self.faults.happens(self.time, "dead", ["imu"]):
            self._send("imu", [Emission(self.time + delay, raw)])

    def _lying_axes(self, force: Counts, rate: Counts) -> tuple[Counts, Counts]:
        """Return the counts of the IMU with those of axes that lie (a fault)."""
        kinds = {"imu_axis_dead": 0, "imu_axis_saturated": 32767, "imu_axis_constant": None}
        counts = [*force, *rate]
        for kind, lie in kinds.items():
            if fault := self.faults.active(self.time, kind, ["imu"]):
                axis = min(round(fault.value), 5)
                counts[axis] = self._imu_last[axis] if lie is None else lie
        self._imu_last = counts
        return (counts[0], counts[1], counts[2]), (counts[3], counts[4], counts[5])

    # ---- the adapters ----

    def receive(self, bus: str, data: bytes, now: float, baud_rate: int | None) -> None:
        """Take bytes that the host sent to a bus (see :meth:`BusLine.receive`) or a sensor's board at ``now`` (s)."""
        if bus in self.lines:
            self._send(bus, self.lines[bus].receive(data, now, baud_rate))
        elif STATUS_REQUEST in data:
            self._send(bus, [Emission(self.time, self._board_status(bus))])

    def _board_status(self, port: str) -> bytes:
        """Return the status frame of the board on a sensor's line: an untroubled one, set up as the hardware file says."""
        imu, microseconds = self.hardware.imu, round((self.time + self._paused) * 1e6)
        here = {port, *(["flow"] if self._flow is not None and port == self._flow_line else [])}
        status = dict.fromkeys(STATUS_FRAMES.fields, 0) | dict(
            zip(("version_major", "version_minor"), FIRMWARE_VERSION, strict=True)
        )
        status |= {"microseconds": microseconds, "sensors": sum(SENSORS[name] for name in here), "imu_identity": IDENTITY}
        status |= {"imu_rate": round(imu.rate)} | imu.model_dump(
            include={"gyro_range", "accel_range", "bandwidth", "baud_rate"}
        )
        return STATUS_FRAMES.encode(status.values())

    def arrived(self, port: str, now: float | None = None) -> bytes:
        """Take the bytes of a bus or a sensor that have reached the host at ``now`` (s); None = at emulated time."""
        queue, data = self._due[port], b""
        while queue and queue[0][0] <= (self.time if now is None else now) + 1e-9:
            data += heapq.heappop(queue)[2]
        return data

    @property
    def next_arrival(self) -> float:
        """Time (s) at which the next bytes reach the host; infinite = none are on their way."""
        return min((queue[0][0] for queue in self._due.values() if queue), default=math.inf)

    def _send(self, port: str, emissions: Iterable[Emission]) -> None:
        for emission in emissions:
            self._sent += 1  # keeps bytes of one moment in order
            heapq.heappush(self._due[port], (emission.time, self._sent, emission.data))

    def plugged(self, port: str) -> bool:
        """Whether the adapter of a bus, or of a sensor, is in its socket now."""
        return self.faults.active(self.time, "unplug", [port]) is None

    def _pull_and_plug(self) -> None:
        for name, was in self.is_plugged.items():
            self.is_plugged[name] = self.plugged(name)
            if was and not self.is_plugged[name]:
                self.pulls[name] += 1
                self._due[name].clear()
                if name in self.lines:
                    self.lines[name].forget()

    # ---- faults ----

    def inject(self, text: str) -> Fault:
        """Make something go wrong: a line of text that :func:`parse_fault` understands."""
        fault = parse_fault(text, self.places)
        self.faults.add(fault, self.time)
        return fault

    def clear(self, kind: str | None = None) -> None:
        """End all faults, or those of one kind; servos without power come back rebooted."""
        self.faults.clear(kind)
        self._apply_faults()

    def _apply_faults(self) -> None:
        """Let the faults that hold now act on servos and supply."""
        sag = self.faults.active(self.time, "sag", JOINTS)
        self.coupling.supply = max(0.0, self.coupling.nominal_supply - (sag.value if sag else 0.0))
        for line in self.lines.values():
            line.apply_faults(self.time)


class EmulatedFlow:
    """Chip and microcontroller.

    Args:
        port: the chip's axes. Its calibration does not count: what is wrong with the sensor is the plant's.
        sensor: of the robot's file.
        faults: shared with the rest of the robot.
        tick: s of emulated time.
    """

    def __init__(self, port: FlowPort, sensor: FlowSensor, faults: FaultBoard, tick: float) -> None:
        self._convert = FlowConversion(port.model_copy(update={"calibration": FlowCalibration()}), sensor)
        self._sensor, self._faults, self._tick = sensor, faults, tick
        self._frames = 0
        self._sent_at = 0.0
        self._last = (0, 0, 0, 0)  # counts along x and y, SQUAL, Shutter

    def step(self, time: float, paused: float, sensors: Sensors) -> list[Emission]:
        """Return what is sent at a tick, s: a frame for each of the chip's.

        Args:
            time: s of emulated time.
            paused: s for which it stood still while quartzes went on.
            sensors: of the plant at this tick.
        """
        is_valid, interval = bool(sensors.flow_is_new[0]), 1.0 / self._sensor.rate
        if not is_valid and time - self._sent_at < interval + self._tick:
            return []
        self._sent_at = time
        self._frames += 1
        faults = self._faults.values(time, ["flow"])
        if "flow_frozen" not in faults:
            self._last = self._counted(sensors if is_valid else None, faults)
        end = time - float(sensors.flow_age[0]) if is_valid else time
        stamp = round((end + paused) * 1e6)
        frame = FLOW_FRAMES.encode((self._frames, stamp, round(interval * 1e6), *self._last))
        raw, delay = self._faults.mangle(time, frame, ["flow"])
        if not raw or self._faults.happens(time, "dead", ["flow"]):
            return []
        return [Emission(time + delay, raw)]

    def _counted(self, sensors: Sensors | None, faults: Mapping[str, float]) -> tuple[int, int, int, int]:
        """Return counts along x and y, SQUAL and Shutter of a reading (None = no valid one), and what faults make of them."""
        if "flow_texture" in faults:
            return 0, 0, min(round(faults["flow_texture"]), FULL_QUALITY), _LONGEST_SHUTTER
        flow, quality = (np.zeros(2), 0.0) if sensors is None else (sensors.flow[0], float(sensors.flow_quality[0]))
        if "flow_turned" in faults:
            c, s = math.cos(faults["flow_turned"]), math.sin(faults["flow_turned"])
            flow = np.array([c * flow[0] + s * flow[1], c * flow[1] - s * flow[0]])
        x, y = self._convert.counts(faults.get("flow_scale", 1.0) * flow, 1.0 / self._sensor.rate)
        if "flow_saturated" in faults:
            x = y = round(faults["flow_saturated"])
        squal, shutter = round(quality * FULL_QUALITY), _SHUTTER if quality > 0.0 else _LONGEST_SHUTTER
        squal += self._frames // DITHER % 2 if squal else 0
        return x, y, min(squal, FULL_QUALITY), shutter


# ---- servos on the plant ----

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
        floor: that it drives on, as ``floor=`` of an environment, drawn by the options' seed.
        state: where the robot starts; None = standing.

    Attributes:
        sensors: the plant's last readings.
        supply: V at the servos.
        nominal_supply: V without a fault.
    """

    def __init__(
        self,
        robot: Robot,
        hardware: Hardware,
        plant: Plant,
        servos: Sequence[EmulatedServo],
        parameters: Parameters,
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
        self._parameters = parameters.copy()
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
        voltage = self._sign[k] * self._own_voltage[k] * math.copysign(1.0, servo.shaft.strength)
        if _IS_LEG[k]:
            return self._sign[k] * (servo.shaft.true_position - self._zero[k]) + voltage, _LEG_CARRIER
        return self._sign[k] * servo.shaft.true_velocity + voltage, _WHEEL_CARRIER

    def _voltage(self, k: int, drive: MotorDrive, servo: EmulatedServo) -> float:
        """Return the voltage (V, encoder frame) of a law the plant has not got, and move its profile on by a tick."""
        shaft, supply, step = servo.shaft, abs(servo.shaft.strength) * self.supply, self.plant.options.control_period
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
            shaft.move(p, v, self.plant.options.control_period)

    def _output_of(self, k: int) -> tuple[int, float]:
        """Return counts of current or load, and part of the supply, of motor ``k``; worked out when a register is read."""
        if self._output is None:
            effort, velocity = self._sign * self.sensors.joint_effort[0], self._sign * self.sensors.joint_velocity[0]
            turned = np.array([math.copysign(1.0, servo.shaft.strength) for servo in self._servos])  # -1: swapped wires
            counts = np.rint(turned * (effort + self._torque[0] * self._idle_effort * velocity) / self._effort_count)
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
        """Let a joint's dry friction be ``torque`` (N m) from now on: what a hand does that holds it."""
        check_name("joint", joint, JOINTS)
        self._parameters["servo.coulomb_friction"][0, JOINTS.index(joint)] = torque
        self.plant.set_parameters(self._parameters)

    def turn(self, joint: str, angle: float) -> None:
        """See :meth:`Machine.turn`."""
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
