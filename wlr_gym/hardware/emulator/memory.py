"""The emulated robot without ports, in emulated time: for tests and trials that must not depend on a clock.

Bytes go straight to the emulated lines, and waiting for an answer, or for the next control tick, is what lets emulated time
pass. Everything above the serial device is the code that drives a real robot; the same run gives the same bits.
"""

from __future__ import annotations

import heapq
from typing import Any

from wlr_gym.base.errors import InputError
from wlr_gym.hardware.config import ImuPort
from wlr_gym.hardware.dynamixel.port import DynamixelPort
from wlr_gym.hardware.emulator.line import Emission
from wlr_gym.hardware.emulator.machine import Machine
from wlr_gym.hardware.imu.stream import ImuStream


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


class StreamDevice:
    """What a sensor's stream uses of ``serial.Serial``.

    Args:
        world: the robot.
        name: of the sensor.
    """

    def __init__(self, world: EmulatedWorld, name: str) -> None:
        self._world, self._name, self._connection = world, name, world.connect(name)

    def read(self, size: int) -> bytes:
        """Return what has come."""
        self._world.require(self._name, self._connection)
        return self._world.arrived(self._name)

    def reset_input_buffer(self) -> None:
        """Throw away what has come."""
        self.read(0)

    def close(self) -> None:
        """Disconnect."""


class _BusDevice(StreamDevice):
    """What :class:`DynamixelPort` uses of ``serial.Serial``."""

    def __init__(self, world: EmulatedWorld, name: str, baud_rate: int) -> None:
        super().__init__(world, name)
        self._baud_rate = baud_rate

    def write(self, packet: Any) -> int:
        self._world.require(self._name, self._connection)
        data = bytes(packet)
        machine = self._world.machine
        self._world.queue(self._name, machine.lines[self._name].receive(data, machine.time, self._baud_rate))
        return len(data)

    def wait_and_read(self, seconds: float) -> bytes:
        """Return what came in, waiting up to ``seconds``, and a tick at least when there is nothing."""
        world = self._world
        end = world.now() + seconds
        while True:
            world.require(self._name, self._connection)
            if data := world.arrived(self._name):
                return data
            world.step()
            if world.now() > end - 1e-9:
                world.require(self._name, self._connection)
                return world.arrived(self._name)


class MemoryPort(DynamixelPort):
    """The port of one emulated bus.

    Args:
        world: the robot.
        name: of its bus.
        baud_rate: bit/s.
        patience: s of emulated time; see :class:`DynamixelPort`.
    """

    def __init__(self, world: EmulatedWorld, name: str, baud_rate: int, patience: float) -> None:
        super().__init__(name, baud_rate, patience)
        self._world = world

    def openPort(self) -> bool:  # noqa: N802
        """Connect."""
        self.ser: Any = _BusDevice(self._world, self.port_name, self.baudrate)
        self.tx_time_per_byte = 1000.0 / self.baudrate * 10.0
        self.is_open, self.gone = True, False
        return True

    def getCurrentTime(self) -> float:  # noqa: N802
        """Return emulated ms."""
        return self._world.now() * 1e3

    def _write(self, data: bytes) -> int:
        return self.ser.write(data)

    def _wait_and_read(self, length: int, seconds: float) -> bytes:
        try:
            return self.ser.wait_and_read(seconds)
        except (OSError, AttributeError) as error:
            raise self._lost(error) from None


def memory_imu(world: EmulatedWorld, port: ImuPort) -> ImuStream:
    """Return the stream of the emulated IMU; ``port``: ranges and calibration."""
    return ImuStream(port, world.now, lambda *_: StreamDevice(world, "imu"))
