"""What a control loop is connected to: servos, IMU and clock; over serial ports, or to an emulated robot in this process."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol

from wlr_gym.hardware.config import Hardware
from wlr_gym.hardware.imu.driver import Imu
from wlr_gym.hardware.servos import Servos
from wlr_gym.robot import Robot

if TYPE_CHECKING:
    from wlr_gym.hardware.emulator.machine import Machine
    from wlr_gym.physics.effects.patch import Source


class Clock(Protocol):
    """Time as the robot sees it."""

    def now(self) -> float:
        """Return s since any start; never goes back."""
        ...

    def wait_until(self, moment: float) -> None:
        """Return at ``moment`` (s), or at once when it is later."""
        ...


class MonotonicClock:
    """This computer's monotonic clock."""

    def now(self) -> float:
        """Return s."""
        return time.monotonic()

    def wait_until(self, moment: float) -> None:
        """Sleep until then."""
        if (left := moment - time.monotonic()) > 0.0:
            time.sleep(left)


@dataclass
class Link:
    """Connections of one robot.

    Attributes:
        servos: closed at first.
        imu: closed at first.
        clock: what deadlines and ages are told by.
        is_serial: there are real ports, which a guard process can open.
        finish: called after closing.
    """

    servos: Servos
    imu: Imu
    clock: Clock
    is_serial: bool
    finish: Callable[[], None] = lambda: None

    def open(self) -> None:
        """Open all ports, or none.

        Raises:
            InputError: a port is not there, or cannot be opened.
        """
        with contextlib.ExitStack() as stack:
            self.servos.open()
            stack.callback(self.servos.close)
            self.imu.open()
            stack.pop_all()

    def close(self) -> None:
        """Close all ports; servos stay as they are."""
        self.servos.close()
        self.imu.close()
        self.finish()

    def __enter__(self) -> Link:
        self.open()
        return self

    def __exit__(self, *error: object) -> None:
        self.close()


def serial_link(robot: Robot, hardware: Hardware) -> Link:
    """Return a link over the hardware file's ports."""
    from wlr_gym.hardware.imu.driver import make_imu

    clock = MonotonicClock()
    servos = Servos(robot, hardware, hardware.safety.patience, clock.now)
    return Link(servos, make_imu(hardware.imu, clock.now), clock, is_serial=True)


def emulated_link(machine: Machine) -> Link:
    """Return a link to an emulated robot in this process and in emulated time: the same bits each time."""
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
    return Link(servos, MemoryImu(world, hardware.imu), world, is_serial=False, finish=machine.close)


def emulated_robot(robot: Robot, hardware: Hardware, effects: Source = None, *, sensor_noise: bool = True) -> Link:
    """Return a link to a new emulated robot whose lines and adapters take no time.

    Args:
        robot: the robot.
        hardware: wiring and mounting.
        effects: what the emulated robot has that its file does not say.
        sensor_noise: of the simulator behind it.

    Raises:
        InputError: effects that cannot be read or that this robot cannot have.
    """
    from wlr_gym.hardware.emulator.line import NO_TIME
    from wlr_gym.hardware.emulator.machine import Machine, MachineOptions
    from wlr_gym.physics.effects import apply_patch, load_patch
    from wlr_gym.robot.parameters import Parameters

    patch = load_patch(effects)
    options = MachineOptions(timing=NO_TIME, sensor_noise=sensor_noise)
    parameters = apply_patch(patch, Parameters.nominal(robot))
    return emulated_link(Machine(robot, hardware, options, parameters=parameters, forces=patch.forces))
