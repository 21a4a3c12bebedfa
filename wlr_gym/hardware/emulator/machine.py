"""The emulated robot, in emulated time: eight servos and sensors around any one-robot plant. No ports, no clock of its own.

:func:`run_command` takes lines of text (faults, ``clear``, ``faults``, ``status``, ``turn``, ``straighten``, ``help``).
:class:`EmulatedStand` holds the robot by springs with its wheels off the ground, with the hands of whoever stands beside it.
"""

from __future__ import annotations

import heapq
import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field

import numpy as np

from wlr_gym.base.errors import InputError, check_name, unknown_name
from wlr_gym.hardware.config import FlowPort, Hardware, check_fit
from wlr_gym.hardware.dynamixel.tables import BAUD_RATES, error_names, load_table
from wlr_gym.hardware.emulator.coupling import PlantCoupling
from wlr_gym.hardware.emulator.faults import FAULTS, Fault, FaultBoard, parse_fault
from wlr_gym.hardware.emulator.line import BusLine, Emission, LineTiming
from wlr_gym.hardware.emulator.servo import FIRMWARE, EmulatedServo
from wlr_gym.hardware.flow import FLOW_FRAMES, FULL_QUALITY, FlowConversion
from wlr_gym.hardware.imu import IMU_FRAMES, Conversion
from wlr_gym.physics.effects import apply_patch, load_patch
from wlr_gym.physics.effects.patch import Source
from wlr_gym.physics.plants import make_plant
from wlr_gym.physics.plants.base import Plant, PlantOptions, PlantState, Sensors, standing_state
from wlr_gym.physics.plants.forces import Force, force_values, make_force
from wlr_gym.physics.plants.simulator import Simulator
from wlr_gym.physics.servo import winding
from wlr_gym.robot import JOINTS, LEGS, WHEELS, Robot
from wlr_gym.robot.description import FlowSensor
from wlr_gym.robot.parameters import Parameters

#: Frames after which the last bit changes of a chip without noise.
IMU_DITHER = 3
#: 30 degC as the chip counts it.
_IMU_TEMPERATURE = round((30.0 - 36.53) * 340)


#: Shutter on a floor of good texture in a lit room, and at its longest.
_SHUTTER, _LONGEST_SHUTTER = 0x0400, 0x1FFF
#: Frames after which the last bit of the surface quality changes, of a plant without noise.
_DITHER = 3


#: m that the body hangs above the floor.
HEIGHT = 0.5
#: N m of a hand that holds a wheel or a leg.
GRIP = 10.0
#: Springs and dampers of the stand: stiff in place, and slow to follow a hand that tilts the body (0.5 s).
_PLACE = {"k": 4000.0, "c": 250.0}
_ATTITUDE = {"k": 40.0, "c": 20.0}
_ANGLES = ("roll", "pitch", "yaw")


@dataclass(frozen=True)
class MachineOptions:
    """How the robot is emulated.

    Attributes:
        backend: simulator behind it.
        tick: s of emulated time per step; setpoints written in between act at the next one.
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
        parameters: of the plant (effects included); None = nominal. See :class:`PlantCoupling`.
        forces: formula forces of the plant that is made.
        state: where the robot starts; None = standing.

    Attributes:
        time: s of emulated time since the start.
        servos: joint -> servo.
        coupling: of the servos and the plant.
        lines: bus name -> line.
        faults: what is wrong right now.
        is_plugged, pulls: bus or sensor -> its adapter was in its socket at the last tick; times that it was pulled out.
        watchers: called at the end of every tick (what looks at the robot from outside: a camera).

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
        self.options: MachineOptions = options or MachineOptions()
        check_fit(robot, hardware)
        self.robot = robot
        self.hardware = hardware
        self.plant: Plant = plant or make_plant(self.options.backend, robot, 1, self.options.plant_options(), forces)
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
        self.is_plugged: dict[str, bool] = dict.fromkeys([*hardware.buses, *self.sensors], True)
        self.pulls: dict[str, int] = dict.fromkeys(self.is_plugged, 0)
        self._due: dict[str, list[tuple[float, int, bytes]]] = {name: [] for name in self.is_plugged}
        self._sent = 0
        self._imu = Conversion(hardware.imu)
        self._frames = 0
        self._paused = 0.0
        self._imu_values = (0, 0, 0), (0, 0, 0)
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

    @property
    def sensors(self) -> tuple[str, ...]:
        """Names of the sensors that have a port of their own."""
        return ("imu",) if self._flow is None else ("imu", "flow")

    def _make_servo(self, joint: str) -> EmulatedServo:
        bus = next(bus for bus in self.hardware.buses.values() if joint in bus.joints)
        ours = {"id": self.robot.dynamixel_ids[joint], "baud_rate": BAUD_RATES.index(bus.baud_rate), **bus.eeprom}
        table = load_table(bus.model).at(self.robot.servo.supply_voltage)
        return EmulatedServo(joint, table, {} if self.options.factory else ours, self.options.firmware)

    @property
    def places(self) -> tuple[str, ...]:
        """Names a fault may be at."""
        return (*JOINTS, *self.hardware.buses, *self.sensors, "camera")

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
            self._send("flow", self._flow.step(self.time, self._paused, self.coupling.sensors))
        if self.faults.any or not all(self.is_plugged.values()):
            self._pull_and_plug()
        for watcher in self.watchers:
            watcher()

    def pause(self, duration: float) -> None:
        """Let ``duration`` s pass in which nothing happens (a busy computer): quartzes do not stop, so all clocks go on."""
        self._paused += duration
        for servo in self.servos.values():
            servo.pause(duration)

    def turn(self, joint: str, angle: float) -> None:
        """Turn a joint by hand while torque is off; see :meth:`PlantCoupling.turn`.

        Raises:
            InputError: unknown joint, torque that is on, or a plant whose state cannot be set.
        """
        check_name("joint", joint, JOINTS)
        self.coupling.turn(joint, angle)

    def straighten(self, leg: str) -> None:
        """Turn a leg straight down by hand while torque is off: the leg itself, whatever its encoder says.

        Raises:
            InputError: unknown leg, torque that is on, or a plant whose state cannot be set.
        """
        check_name("leg", leg, LEGS)
        self.turn(leg, float(np.pi / 2 - self.plant.mechanical_state().joint_position[0, JOINTS.index(leg)]))

    # ---- IMU ----

    def _read_imu(self) -> None:
        sensors = self.coupling.sensors
        self._frames += 1
        stamp = self._frames / self.hardware.imu.rate + self._paused
        if not self.faults.active(self.time, "imu_frozen", ["imu"]):
            force, (x, y, z) = self._imu.counts(sensors.accelerometer[0], sensors.gyro[0])
            # the chip's last bit never rests, also where the plant's sensors have no noise
            self._imu_values = force, (x, y, z if self.options.sensor_noise else z + self._frames // IMU_DITHER % 2)
        force, rate = self._imu_values
        if not self.faults.active(self.time, "imu_stale", ["imu"]):
            self._imu_frame = IMU_FRAMES.encode((self._frames, round(stamp * 1e6), *force, _IMU_TEMPERATURE, *rate))
        raw, delay = self.faults.mangle(self.time, self._imu_frame, ["imu"])
        if raw and not self.faults.happens(self.time, "dead", ["imu"]):
            self._send("imu", [Emission(self.time + delay, raw)])

    # ---- the adapters ----

    def receive(self, bus: str, data: bytes, now: float, baud_rate: int | None) -> None:
        """Take bytes that the host sent to a bus at ``now`` (s); see :meth:`BusLine.receive`."""
        self._send(bus, self.lines[bus].receive(data, now, baud_rate))

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
        port: the chip's axes; of its calibration nothing: what is wrong with the sensor is the plant's.
        sensor: of the robot's file.
        faults: shared with the rest of the robot.
        tick: s of emulated time.
    """

    def __init__(self, port: FlowPort, sensor: FlowSensor, faults: FaultBoard, tick: float) -> None:
        self._convert = FlowConversion(port.model_copy(update={"calibration": type(port.calibration)()}), sensor)
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
        is_valid = bool(sensors.flow_is_new[0])
        if not is_valid and time - self._sent_at < 1.0 / self._sensor.rate + self._tick:
            return []
        self._sent_at = time
        self._frames += 1
        interval = 1.0 / self._sensor.rate
        end = time - float(sensors.flow_age[0]) if is_valid else time
        flow = sensors.flow[0] if is_valid else np.zeros(2)
        quality = float(sensors.flow_quality[0]) if is_valid else 0.0
        self._last = self._counted(time, flow, quality, interval)
        stamp = round((end + paused) * 1e6)
        frame = FLOW_FRAMES.encode((self._frames, stamp, round(interval * 1e6), *self._last))
        raw, delay = self._faults.mangle(time, frame, ["flow"])
        if not raw or self._faults.happens(time, "dead", ["flow"]):
            return []
        return [Emission(time + delay, raw)]

    def _counted(self, time: float, flow: np.ndarray, quality: float, interval: float) -> tuple[int, int, int, int]:
        """Return counts along x and y, SQUAL and Shutter, with what the faults make of them."""
        active = self._faults.active
        if active(time, "flow_frozen", ["flow"]) is not None:
            return self._last
        if (turned := active(time, "flow_turned", ["flow"])) is not None:
            c, s = math.cos(turned.value), math.sin(turned.value)
            flow = np.array([c * flow[0] + s * flow[1], c * flow[1] - s * flow[0]])
        if (scale := active(time, "flow_scale", ["flow"])) is not None:
            flow = scale.value * flow
        x, y = self._convert.counts(flow, interval)
        if (stuck := active(time, "flow_saturated", ["flow"])) is not None:
            x = y = round(stuck.value)
        squal, shutter = round(quality * FULL_QUALITY), _SHUTTER if quality > 0.0 else _LONGEST_SHUTTER
        squal += self._frames // _DITHER % 2 if squal else 0
        if (bare := active(time, "flow_texture", ["flow"])) is not None:
            x, y, squal, shutter = 0, 0, round(bare.value), _LONGEST_SHUTTER
        return x, y, min(squal, 255), shutter


def run_command(machine: Machine, text: str) -> str:
    """Carry out one line of text and return the answer.

    Raises:
        InputError: it cannot be understood.
    """
    word, *rest = text.split() or ["help"]
    if word in FAULTS:
        return f"{machine.time:.3f} s: {machine.inject(text)}"
    if word == "clear":
        if rest:
            check_name("fault", rest[0], FAULTS)
        machine.clear(rest[0] if rest else None)
        return "cleared"
    if word == "turn":
        return _turn(machine, text, rest)
    if word == "straighten":
        machine.straighten(" ".join(rest))
        return f"{rest[0]} hangs straight down"
    if word == "faults":
        return "\n".join(machine.faults.listing(machine.time)) or "no faults"
    if word == "status":
        return _status(machine)
    if word == "help":
        return _help()
    raise unknown_name("command", word, ["faults", "status", "help", "clear", "turn", "straighten", *FAULTS])


def _turn(machine: Machine, text: str, words: list[str]) -> str:
    try:
        joint, degrees = words
        angle = float(np.deg2rad(float(degrees)))
    except ValueError:
        raise InputError(f"'{text}': expected turn JOINT DEGREES") from None
    machine.turn(joint, angle)
    return f"{joint} turned by {degrees} deg"


def _status(machine: Machine) -> str:
    """One line per servo: torque, mode, position, velocity, supply, temperature, errors."""
    lines = [f"{machine.time:.3f} s"]
    for joint, servo in machine.servos.items():
        errors = ", ".join(error_names(servo["hardware_error_status"])) or "no error"
        power = "no power" if servo.dead else "torque on" if servo["torque_enable"] else "torque off"
        lines.append(
            f"{joint:9} id {servo['id']:3}  {power:10}  mode {servo['operating_mode']:2}"
            f"  position {servo['present_position']:6}  velocity {servo['present_velocity']:4}"
            f"  {servo['present_input_voltage'] / 10:4.1f} V  {servo['present_temperature']:3} degC  {errors}"
        )
    return "\n".join(lines)


def _help() -> str:
    lines = [
        "status | faults | clear [KIND] | turn JOINT DEGREES | straighten LEG | help",
        "KIND [WHERE ...] [probability=] [value=] [after=] [duration=]",
    ]
    for name, kind in FAULTS.items():
        value = f" (value: {kind.unit}, default {kind.value:g})" if kind.unit else ""
        lines.append(f"  {name:9} {kind.doc}{value}")
    return "\n".join(lines)


class EmulatedStand:
    """An emulated robot on a stand.

    Args:
        robot, hardware: as for :class:`Machine`.
        effects: what the robot has that its file does not say.
        parameters: of the robot before the effects; None = nominal.
        options: of the machine.

    Attributes:
        machine: the robot.
        stall_current: A of a wheel's motor at stall.

    Raises:
        InputError: effects that cannot be read or that this robot cannot have.
    """

    def __init__(
        self,
        robot: Robot,
        hardware: Hardware,
        effects: Source = None,
        parameters: Parameters | None = None,
        options: MachineOptions | None = None,
    ) -> None:
        patch, options = load_patch(effects), options or MachineOptions()
        changed = apply_patch(patch, parameters or Parameters.nominal(robot))
        self._forces = patch.forces
        plant = make_plant(options.backend, robot, 1, options.plant_options(), [*_stand_forces(), *patch.forces])
        assert isinstance(plant, Simulator), "the emulator runs on simulators only"
        self._plant: Simulator = plant
        state = standing_state(robot, changed)
        state.position[0, 2] = HEIGHT
        self.machine: Machine = Machine(robot, hardware, options, plant=plant, parameters=changed, state=state)
        self._friction = dict(zip(JOINTS, changed["servo.coulomb_friction"][0].tolist(), strict=True))
        self.stall_current: float = robot.servo.supply_voltage / float(winding(robot)[1][-1])

    def tilt(self, **angles: float) -> None:
        """Begin to turn the body to ``roll``, ``pitch`` and ``yaw`` (rad; the others to 0); it gets there in about 2 s."""
        self._plant.set_force_values(force_values([*_stand_forces(**angles), *self._forces])[None])

    def brake(self, joint: str) -> None:
        """Hold a wheel or a leg by hand."""
        self.machine.coupling.set_friction(joint, GRIP)

    def release(self, joint: str) -> None:
        """Let go of it."""
        self.machine.coupling.set_friction(joint, self._friction.get(joint, 0.0))

    def wheel_current(self) -> float:
        """Return what the wheels draw from the supply, A: motor currents times the part of the time they are switched on."""
        shafts = [self.machine.servos[wheel].shaft for wheel in WHEELS]
        return sum(abs(shaft.output()[1]) * abs(shaft.load) for shaft in shafts) * self.stall_current


def _stand_forces(**angles: float) -> list[Force]:
    """Return what holds the body in place, at ``roll``, ``pitch`` and ``yaw`` (rad); 0 where one is not named."""
    units = {"k": "N/m", "c": "N s/m"}
    height = "k * (height - position_z) - c * velocity_z"
    forces = [
        make_force(["floor_force_z"], height, {**_PLACE, "height": HEIGHT}, {**units, "height": "m"}),
        make_force(["floor_force_x"], "-k * position_x - c * floor_velocity_x", _PLACE, units),
        make_force(["floor_force_y"], "-k * position_y - c * floor_velocity_y", _PLACE, units),
    ]
    units = {"k": "N m/rad", "c": "N m s/rad", "tilt": "rad"}
    for name in _ANGLES:
        formula = f"k * (tilt - {name}) - c * {name}_rate"
        forces.append(make_force([f"body_torque_{name}"], formula, {**_ATTITUDE, "tilt": angles.get(name, 0.0)}, units))
    return forces
