"""Links to an emulated robot in this process and in emulated time: for tests and trials that must not depend on a clock.

Bytes go straight to the emulated lines, and waiting for an answer, or for the next control tick, is what lets emulated time
pass. Everything above the serial device is the code that drives a real robot; the same run gives the same bits.
"""

from __future__ import annotations

import heapq
from functools import partial

from wlr_gym.base.errors import InputError, require_package
from wlr_gym.hardware.camera.reading import CameraFile
from wlr_gym.hardware.config import FlowPort, Hardware
from wlr_gym.hardware.emulator.line import NO_TIME, Emission
from wlr_gym.hardware.emulator.machine import Machine, MachineOptions
from wlr_gym.hardware.flow import FlowStream
from wlr_gym.hardware.imu import ImuStream
from wlr_gym.hardware.link import Link
from wlr_gym.hardware.servos import Servos
from wlr_gym.physics.effects import apply_patch, load_patch
from wlr_gym.physics.effects.patch import Source
from wlr_gym.robot import Robot
from wlr_gym.robot.parameters import Parameters


class EmulatedWorld:
    """A machine, the bytes on their way, and the clock that passes when somebody waits.

    Args:
        machine: the robot.
    """

    def __init__(self, machine: Machine) -> None:
        self.machine = machine
        self._plugged = dict.fromkeys([*machine.hardware.buses, *machine.sensors], True)
        self._sockets = dict.fromkeys(self._plugged, 0)
        self._due: dict[str, list[tuple[float, int, bytes]]] = {name: [] for name in self._plugged}
        self._sent = 0

    def now(self) -> float:
        """Return emulated time, s."""
        return self.machine.time

    def wait_until(self, moment: float) -> None:
        """Let emulated time pass until ``moment`` (s)."""
        while self.machine.time < moment - 1e-9:
            self.step()

    def step(self) -> None:
        """Let one tick pass."""
        self.machine.step()
        for name, emissions in self.machine.take_output().items():
            self.queue(name, emissions)
        if not self.machine.faults.any and all(self._plugged.values()):
            return
        for name, was in self._plugged.items():
            self._plugged[name] = self.machine.plugged(name)
            if was and not self._plugged[name]:
                self._sockets[name] += 1
                self._due[name].clear()
                if name in self.machine.lines:
                    self.machine.lines[name].forget()

    def queue(self, name: str, emissions: list[Emission]) -> None:
        """Send bytes on their way to the host."""
        for emission in emissions:
            self._sent += 1  # keeps bytes of one moment in order
            heapq.heappush(self._due[name], (emission.time, self._sent, emission.data))

    def connect(self, name: str) -> int:
        """Return a connection to the adapter of a bus, or of a sensor.

        Raises:
            InputError: it is unplugged.
        """
        if not self.machine.plugged(name):
            raise InputError(f"port of {name}: cannot be opened: the emulated adapter is unplugged")
        return self._sockets[name]

    def require(self, name: str, connection: int) -> None:
        """Raise :class:`OSError` when the adapter was pulled out since it was connected."""
        if self._sockets[name] != connection or not self._plugged[name]:
            raise OSError("the emulated adapter is unplugged")

    def arrived(self, name: str) -> bytes:
        """Take the bytes that have reached the host."""
        queue, data = self._due[name], b""
        while queue and queue[0][0] <= self.machine.time + 1e-9:
            data += heapq.heappop(queue)[2]
        return data


class MemoryDevice:
    """A serial device of the emulated robot; see :class:`wlr_gym.hardware.serial_frames.Device`.

    Args:
        world: the robot.
        name: of a bus or a sensor.
        baud_rate: bit/s, of a bus.

    Raises:
        InputError: it is unplugged.
    """

    def __init__(self, world: EmulatedWorld, name: str, baud_rate: int = 0) -> None:
        self._world, self._name, self._baud_rate = world, name, baud_rate
        self._connection = world.connect(name)

    def received(self) -> bytes:
        """Return what has come."""
        self._world.require(self._name, self._connection)
        return self._world.arrived(self._name)

    def wait(self, seconds: float) -> bytes:
        """Return what came in, waiting up to ``seconds``, and a tick at least when there is nothing."""
        world, end = self._world, self._world.now() + seconds
        while not (data := self.received()):
            world.step()
            if world.now() > end - 1e-9:
                return self.received()
        return data

    def write(self, data: bytes) -> int:
        """Send bytes to the servos."""
        self._world.require(self._name, self._connection)
        machine = self._world.machine
        self._world.queue(self._name, machine.lines[self._name].receive(data, machine.time, self._baud_rate))
        return len(data)

    def reset_input_buffer(self) -> None:
        """Throw away what has come."""
        self.received()

    def close(self) -> None:
        """Disconnect."""


def emulated_link(machine: Machine, camera: CameraFile | None = None) -> Link:
    """Return a link to an emulated robot in this process and in emulated time: the same bits each time.

    Args:
        machine: the robot.
        camera: above its floor; None = there is none.

    Raises:
        MissingPackageError: dynamixel-sdk is not installed.
    """
    require_package("dynamixel_sdk", "robot")
    from wlr_gym.hardware.dynamixel.port import DynamixelPort

    robot, hardware, world = machine.robot, machine.hardware, EmulatedWorld(machine)
    names = {bus.port: name for name, bus in hardware.buses.items()}

    def make_port(path: str, baud_rate: int, patience: float) -> DynamixelPort:
        return DynamixelPort(names[path], baud_rate, patience, world.now, partial(MemoryDevice, world))

    servos = Servos(robot, hardware, hardware.safety.patience, world.now, make_port)
    imu = ImuStream(hardware.imu, world.now, lambda *_: MemoryDevice(world, "imu"))
    flow = eye = None
    if hardware.flow is not None and robot.sensors.flow is not None:
        flow = FlowStream(hardware.flow, robot.sensors.flow, world.now, lambda *_: MemoryDevice(world, "flow"))
    if camera is not None:
        from wlr_gym.hardware.emulator.camera import EmulatedCamera

        require_package("cv2", "vision")
        eye = EmulatedCamera(machine, camera)
    seed = machine.options.seed
    return Link(servos, imu, world, is_serial=False, finish=machine.close, flow=flow, camera=eye, seed=seed)


def with_flow_port(robot: Robot, hardware: Hardware) -> Hardware:
    """Return the hardware with a port for the optical-flow sensor that the robot's file has, where it names none."""
    if hardware.flow is not None or robot.sensors.flow is None:
        return hardware
    return hardware.model_copy(update={"flow": FlowPort(port="emulated")})


def emulated_robot(
    robot: Robot,
    hardware: Hardware,
    effects: Source = None,
    *,
    sensor_noise: bool = True,
    camera: CameraFile | None = None,
    seed: int = 0,
) -> Link:
    """Return a link to a new emulated robot whose lines and adapters take no time.

    Args:
        robot: the robot.
        hardware: wiring and mounting.
        effects: what the emulated robot has that its file does not say.
        sensor_noise, seed: of the simulator behind it.
        camera: above its floor; None = there is none.

    Raises:
        InputError: effects that cannot be read or that this robot cannot have.
    """
    patch = load_patch(effects)
    options = MachineOptions(timing=NO_TIME, sensor_noise=sensor_noise, seed=seed)
    parameters = apply_patch(patch, Parameters.nominal(robot))
    hardware = with_flow_port(robot, hardware)
    return emulated_link(Machine(robot, hardware, options, parameters=parameters, forces=patch.forces), camera)
