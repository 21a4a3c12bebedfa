"""Links to an emulated robot in this process and in emulated time: for tests and trials that must not depend on a clock.

Bytes go straight to the emulated lines, and waiting for an answer, or for the next control tick, is what lets emulated time
pass. Everything above the serial device is the code that drives a real robot; the same run gives the same bits.
"""

from __future__ import annotations

from functools import partial

from wlr_gym.base.errors import InputError, require_package
from wlr_gym.hardware.camera.reading import CameraFile
from wlr_gym.hardware.config import FlowPort, Hardware
from wlr_gym.hardware.emulator.line import NO_TIME
from wlr_gym.hardware.emulator.machine import Machine, MachineOptions
from wlr_gym.hardware.flow import FlowStream
from wlr_gym.hardware.imu import ImuStream
from wlr_gym.hardware.link import Link
from wlr_gym.hardware.serial_frames import SharedPorts
from wlr_gym.hardware.servos import Servos
from wlr_gym.physics.effects.patch import Source
from wlr_gym.physics.floor import FloorSource
from wlr_gym.robot import Robot


class MemoryDevice:
    """A serial device of the emulated robot; see :class:`wlr_gym.hardware.serial_frames.Device`.

    Args:
        machine: the robot.
        name: of a bus or a sensor.
        baud_rate: bit/s, of a bus.

    Raises:
        InputError: it is unplugged.
    """

    def __init__(self, machine: Machine, name: str, baud_rate: int = 0) -> None:
        if not machine.plugged(name):
            raise InputError(f"port of {name}: cannot be opened: the emulated adapter is unplugged")
        self._machine, self._name, self._baud_rate = machine, name, baud_rate
        self._pulls = machine.pulls[name]

    def received(self) -> bytes:
        """Return what has come."""
        self._require()
        return self._machine.arrived(self._name)

    def wait(self, seconds: float) -> bytes:
        """Return what came in, waiting up to ``seconds``, and a tick at least when there is nothing."""
        machine, end = self._machine, self._machine.time + seconds
        while not (data := self.received()):
            machine.step()
            if machine.time > end - 1e-9:
                return self.received()
        return data

    def write(self, data: bytes) -> int:
        """Send bytes to the servos."""
        self._require()
        self._machine.receive(self._name, data, self._machine.time, self._baud_rate)
        return len(data)

    def reset_input_buffer(self) -> None:
        """Throw away what has come."""
        self.received()

    def close(self) -> None:
        """Disconnect."""

    def _require(self) -> None:
        """Raise :class:`OSError` when the adapter was pulled out since it was connected."""
        if self._machine.pulls[self._name] != self._pulls or not self._machine.is_plugged[self._name]:
            raise OSError("the emulated adapter is unplugged")


def emulated_link(machine: Machine, camera: CameraFile | None = None) -> Link:
    """Return a link to an emulated robot in this process and in emulated time: the same bits each time.

    Args:
        machine: the robot.
        camera: above its floor; None = there is none.
    """
    require_package("dynamixel_sdk", "robot")
    from wlr_gym.hardware.dynamixel.port import DynamixelPort

    robot, hardware = machine.robot, machine.hardware
    names = {bus.port: name for name, bus in hardware.buses.items()}

    def make_port(path: str, baud_rate: int, patience: float) -> DynamixelPort:
        return DynamixelPort(names[path], baud_rate, patience, machine.now, partial(MemoryDevice, machine))

    sensors = {} if hardware.flow is None else {hardware.flow.port: "flow"}
    sensors[hardware.imu.port] = "imu"
    ports = SharedPorts(lambda path, *_: MemoryDevice(machine, sensors[path]))
    flow = eye = None
    if hardware.flow is not None and robot.sensors.flow is not None:
        flow = FlowStream(hardware.flow, robot.sensors.flow, machine.now, ports)
    if camera is not None:
        from wlr_gym.hardware.emulator.camera import EmulatedCamera

        require_package("cv2", "vision")
        eye = EmulatedCamera(machine, camera)
    return Link(
        servos=Servos(robot, hardware, hardware.safety.patience, machine.now, make_port),
        imu=ImuStream(hardware.imu, machine.now, ports),
        clock=machine,
        is_serial=False,
        finish=machine.close,
        flow=flow,
        camera=eye,
        seed=machine.options.seed,
    )


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
    floor: FloorSource = None,
    sensor_noise: bool = True,
    camera: CameraFile | None = None,
    seed: int = 0,
) -> Link:
    """Return a link to a new emulated robot whose lines and adapters take no time.

    Args:
        robot: the robot.
        hardware: wiring and mounting.
        effects: what the emulated robot has that its file does not say.
        floor: that it drives on, drawn by the seed.
        sensor_noise, seed: of the simulator behind it.
        camera: above its floor; None = there is none.
    """
    options = MachineOptions(timing=NO_TIME, sensor_noise=sensor_noise, seed=seed)
    return emulated_link(Machine(robot, with_flow_port(robot, hardware), options, effects=effects, floor=floor), camera)
