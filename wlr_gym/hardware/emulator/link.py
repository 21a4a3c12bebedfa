"""Links to an emulated robot in this process and in emulated time."""

from __future__ import annotations

from wlr_gym.base.errors import require_package
from wlr_gym.hardware.camera.config import CameraFile
from wlr_gym.hardware.config import Hardware
from wlr_gym.hardware.emulator.line import NO_TIME
from wlr_gym.hardware.emulator.machine import Machine, MachineOptions
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
    from wlr_gym.hardware.emulator.memory import EmulatedWorld, MemoryImu, MemoryPort

    world, hardware = EmulatedWorld(machine), machine.hardware
    names = {bus.port: name for name, bus in hardware.buses.items()}
    servos = Servos(
        machine.robot,
        hardware,
        hardware.safety.patience,
        world.now,
        lambda port, baud_rate, patience: MemoryPort(world, names[port], baud_rate, patience),
    )
    eye = None
    if camera is not None:
        from wlr_gym.hardware.emulator.camera import EmulatedCamera

        require_package("cv2", "vision")
        eye = EmulatedCamera(machine, camera)
    return Link(servos, MemoryImu(world, hardware.imu), world, is_serial=False, finish=machine.close, camera=eye)


def emulated_robot(
    robot: Robot,
    hardware: Hardware,
    effects: Source = None,
    *,
    sensor_noise: bool = True,
    camera: CameraFile | None = None,
) -> Link:
    """Return a link to a new emulated robot whose lines and adapters take no time.

    Args:
        robot: the robot.
        hardware: wiring and mounting.
        effects: what the emulated robot has that its file does not say.
        sensor_noise: of the simulator behind it.
        camera: above its floor; None = there is none.

    Raises:
        InputError: effects that cannot be read or that this robot cannot have.
    """
    patch = load_patch(effects)
    options = MachineOptions(timing=NO_TIME, sensor_noise=sensor_noise)
    parameters = apply_patch(patch, Parameters.nominal(robot))
    return emulated_link(Machine(robot, hardware, options, parameters=parameters, forces=patch.forces), camera)
