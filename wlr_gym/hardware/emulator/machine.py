"""The emulated robot: eight servos and sensors around any one-robot Plant, in emulated time. No ports, no clock of its own."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np

from wlr_gym.base.errors import InputError, unknown_name
from wlr_gym.hardware.config import Hardware
from wlr_gym.hardware.dynamixel.tables import BAUD_RATES, load_table
from wlr_gym.hardware.emulator.coupling import PlantCoupling
from wlr_gym.hardware.emulator.faults import Fault, FaultBoard, parse_fault
from wlr_gym.hardware.emulator.flow import EmulatedFlow
from wlr_gym.hardware.emulator.line import BusLine, Emission, LineTiming
from wlr_gym.hardware.emulator.servo import FIRMWARE, EmulatedServo
from wlr_gym.hardware.fit import check_fit
from wlr_gym.hardware.imu.frames import ImuFrame, encode_frame
from wlr_gym.hardware.imu.reading import Conversion
from wlr_gym.physics.plants import make_plant
from wlr_gym.physics.plants.base import Plant, PlantOptions, PlantState
from wlr_gym.physics.plants.forces import Force
from wlr_gym.robot import JOINTS, LEGS, Robot
from wlr_gym.robot.parameters import Parameters

#: Frames after which the last bit changes of a chip without noise.
IMU_DITHER = 3
#: 30 degC as the chip counts it.
_IMU_TEMPERATURE = round((30.0 - 36.53) * 340)


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
        self._flow = self._make_flow()
        self._output: dict[str, list[Emission]] = {name: [] for name in self.sensors}
        self._imu = Conversion(hardware.imu)
        self._frames = 0
        self._paused = 0.0
        self._imu_values = (0, 0, 0), (0, 0, 0)
        self._imu_frame = ImuFrame(0, 0, (0, 0, 0), _IMU_TEMPERATURE, (0, 0, 0))
        self.servos: dict[str, EmulatedServo] = {joint: self._make_servo(joint) for joint in JOINTS}
        servos = list(self.servos.values())
        self.coupling: PlantCoupling = PlantCoupling(robot, hardware, self.plant, servos, parameters, self.options.seed, state)
        for servo in servos:
            servo.boot(0.0)
        self.lines: dict[str, BusLine] = {
            name: BusLine(name, [self.servos[joint] for joint in bus.joints], self.faults, self.options.timing)
            for name, bus in hardware.buses.items()
        }

    def _make_flow(self) -> EmulatedFlow | None:
        port, sensor = self.hardware.flow, self.robot.sensors.flow
        return None if port is None or sensor is None else EmulatedFlow(port, sensor, self.faults, self.options.tick)

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
            self._output["flow"] += self._flow.step(self.time, self._paused, self.coupling.sensors)
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
        if joint not in JOINTS:
            raise unknown_name("joint", joint, JOINTS)
        self.coupling.turn(joint, angle)

    def straighten(self, leg: str) -> None:
        """Turn a leg straight down by hand while torque is off: the leg itself, whatever its encoder says.

        Raises:
            InputError: unknown leg, torque that is on, or a plant whose state cannot be set.
        """
        if leg not in LEGS:
            raise unknown_name("leg", leg, LEGS)
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
            self._imu_frame = ImuFrame(self._frames % 65536, round(stamp * 1e6) % 2**32, force, _IMU_TEMPERATURE, rate)
        frame = self._imu_frame
        raw, delay = self.faults.mangle(self.time, encode_frame(frame), ["imu"])
        if raw and not self.faults.happens(self.time, "dead", ["imu"]):
            self._output["imu"].append(Emission(self.time + delay, raw))

    def take_output(self) -> dict[str, list[Emission]]:
        """Return the frames that the sensors sent since the last call, by their ports."""
        output, self._output = self._output, {name: [] for name in self.sensors}
        return output

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

    def plugged(self, port: str) -> bool:
        """Whether the adapter of a bus, or of a sensor, is in its socket."""
        return self.faults.active(self.time, "unplug", [port]) is None

    def _apply_faults(self) -> None:
        """Let the faults that hold now act on servos and supply."""
        sag = self.faults.active(self.time, "sag", JOINTS)
        self.coupling.supply = max(0.0, self.coupling.nominal_supply - (sag.value if sag else 0.0))
        for line in self.lines.values():
            line.apply_faults(self.time)
