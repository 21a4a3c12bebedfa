"""Links to an emulated robot in this process and in emulated time."""

from __future__ import annotations

from wlr_gym.base.errors import require_package
from wlr_gym.hardware.camera.config import CameraFile
from wlr_gym.hardware.config import FlowPort, Hardware
from wlr_gym.hardware.emulator.line import NO_TIME
from wlr_gym.hardware.emulator.machine import Machine, MachineOptions
from wlr_gym.hardware.flow.stream import FlowStream
from wlr_gym.hardware.link import Link
from wlr_gym.hardware.servos import Servos
from wlr_gym.physics.effects import apply_patch, load_patch
from wlr_gym.physics.effects.patch import Source
from wlr_gym.robot import Robot
from wlr_gym.robot.parameters import Parameters


def emulated_link(machine: Machine, camera: CameraFile | None = None) -> Link:
    """Return a link to an emulated robot in this process and in emulated time: the same bits each time.

    Args:
        machine: the robot.
        camera: above its floor; None = there is none.

    Raises:
        MissingPackageError: dynamixel-sdk is not installed.
    """
    require_package("dynamixel_sdk", "robot")
    from wlr_gym.hardware.emulator.memory import EmulatedWorld, MemoryPort, StreamDevice, memory_imu

    world, hardware = EmulatedWorld(machine), machine.hardware
    names = {bus.port: name for name, bus in hardware.buses.items()}
    servos = Servos(
        machine.robot,
        hardware,
        hardware.safety.patience,
        world.now,
        lambda port, baud_rate, patience: MemoryPort(world, names[port], baud_rate, patience),
    )
    flow, sensor = hardware.flow, machine.robot.sensors.flow
    stream = eye = None
    if flow is not None and sensor is not None:
        stream = FlowStream(flow, sensor, world.now, lambda *_: StreamDevice(world, "flow"))
    if camera is not None:
        from wlr_gym.hardware.emulator.camera import EmulatedCamera

        require_package("cv2", "vision")
        eye = EmulatedCamera(machine, camera)
    imu, seed = memory_imu(world, hardware.imu), machine.options.seed
    return Link(servos, imu, world, is_serial=False, finish=machine.close, flow=stream, camera=eye, seed=seed)


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
