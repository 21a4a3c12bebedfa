"""The serial port of one bus: dynamixel-sdk's port driver without its verified defects, and packets in and out of it.

Of the SDK, ``PortHandler`` is used and nothing else: the speeds it knows, and its book-keeping of time-outs. Version 4.1.0 was
read and tried. Its defects are numbered below. A test in tests/hardware/test_bus.py shows each in the SDK and its absence here:
an SDK that has mended one fails that test, and the guard can go. Import only behind ``require_package``: the SDK is optional.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from typing import Any, Literal

import dynamixel_sdk as sdk

from wlr_gym.base.errors import InputError
from wlr_gym.hardware.dynamixel import protocol
from wlr_gym.hardware.dynamixel.protocol import BusGoneError, Instruction, Packet, Parser, Status
from wlr_gym.hardware.serial_frames import Device, SerialDevice

#: After an exchange was given up, the line is waited on to fall quiet before so many exchanges.
_GIVEN_UP = 2
#: A line that never falls quiet is waited for during the patience and this many times more ...
_MORE_PATIENCE = 3.0
#: ... yet no longer than this beyond the patience, s.
_MORE_TIME = 0.05


class DynamixelPort(sdk.PortHandler):
    """A serial port, and the packets on it.

    Args:
        path: device.
        baud_rate: bit/s.
        patience: s an answer may take beyond its bytes' time on the wire.
        clock: s; what time-outs are told by.
        make_device: opens the device; the emulator in memory puts its own here.

    Attributes:
        suspect: an exchange did not end well, and what still comes in may belong to it: so many good ones until it cannot.
        quiet: the line fell quiet when it was last waited for.
        gone: it has failed since it was opened.
        discarded: bytes thrown away because they belonged to an exchange that was given up.
    """

    def __init__(
        self,
        path: str,
        baud_rate: int,
        patience: float,
        clock: Callable[[], float] = time.monotonic,
        make_device: Callable[[str, int], Device] = SerialDevice,
    ) -> None:
        super().__init__(path)
        self.baudrate = baud_rate
        self.patience = patience
        self.parser: Parser = Parser()
        self.queue: list[Packet] = []
        self.suspect = 0
        self.quiet = True
        self.gone = False
        self.discarded = 0
        self._clock, self._make_device = clock, make_device

    def _do(self, act: Callable[[Any], Any]) -> Any:
        """Do something with the device. Defect 4: an unplugged adapter shows as a time-out, then as one of three exceptions."""
        try:
            return act(self.ser)
        except (OSError, AttributeError) as error:  # the last: a port that was never opened
            self.gone = True
            raise BusGoneError(f"port {self.port_name} is gone: {error}") from None

    def openPort(self) -> bool:  # noqa: N802
        """Open the device. Defect 5: a missing one raised whatever pyserial had; now an InputError that names it."""
        if not super().openPort():
            raise InputError(f"port {self.port_name}: baud rate {self.baudrate} is not one dynamixel-sdk knows")
        self.gone = False
        return True

    def setupPort(self, cflag_baud: int) -> Literal[True]:  # noqa: N802
        """Set up the device. Defect 7: the SDK sets speed and throws input away, whoever drives servos on the port."""
        self.closePort()
        self.ser: Any = self._make_device(self.port_name, self.baudrate)
        self.is_open = True
        self.tx_time_per_byte = 10e3 / self.baudrate
        return True

    def closePort(self) -> None:  # noqa: N802
        """Close the device. Defect 5: closing a port that was never opened raised."""
        if self.ser is not None:
            super().closePort()

    def clearPort(self) -> None:  # noqa: N802
        """Forget what came in. Defect 3: a late answer was taken for the next one; after a time-out, wait for a quiet line."""
        self.parser.clear()
        self.queue.clear()
        self.quiet = not self.suspect or self._falls_quiet()
        self._do(lambda device: device.reset_input_buffer())

    def _falls_quiet(self) -> bool:
        """Let pass what still comes. An end is set to it: on a line that always talks, torque-off must go out all the same."""
        end = self.getCurrentTime() + (self.patience + min(_MORE_PATIENCE * self.patience, _MORE_TIME)) * 1e3
        while self.getCurrentTime() < end:
            data = self._do(lambda device: device.wait(self.patience))
            if not data:
                return True
            self.discarded += len(data)
        return False

    def readPort(self, length: int) -> bytes:  # noqa: N802
        """Return bytes as soon as there are some. Defect 2: the SDK spins at full load until they come."""
        seconds = max(0.0, self.packet_timeout - self.getTimeSinceStart()) * 1e-3
        return self._do(lambda device: device.wait(seconds))

    def writePort(self, packet: bytes) -> int:  # noqa: N802
        """Send all bytes. Defect 6: pyserial then waits, without end, until the device would take more."""

        def send(device: Any) -> int:
            if (sent := device.write(packet)) < len(packet):
                raise OSError(f"it took {sent} of {len(packet)} bytes")
            return sent

        return self._do(send)

    def getCurrentTime(self) -> float:  # noqa: N802
        """Return ms. Defect 2: the SDK's time-outs followed the wall clock, which may be set."""
        return self._clock() * 1e3

    def setPacketTimeout(self, packet_length: int) -> None:  # noqa: N802
        """Start the time an answer may take. Defect 1: the SDK's floor is 34 ms, whatever its user asks for."""
        self.setPacketTimeoutMillis(self.tx_time_per_byte * packet_length + self.patience * 1e3)

    # ---- packets ----

    def send_packet(self, raw: bytes, *, is_answered: bool) -> None:
        """Send a packet; what came in before it is forgotten where that could be taken for its answer."""
        if is_answered or self.suspect:
            self.clearPort()
        self.suspect = _GIVEN_UP if is_answered else 0
        self.writePort(raw)

    def next_answer(self) -> Packet | None:
        """Return the next status packet before the time is over, else None; echoes and noise are passed over."""
        while True:
            while self.queue:
                packet = self.queue.pop(0)
                if packet.instruction == Instruction.STATUS:
                    return packet
            late = self.isPacketTimeout()  # what lies in the buffer is taken even then: another bus may have kept us waiting
            self.queue += self.parser.feed(self.readPort(4096))
            if late and not self.queue:
                return None

    def exchange(self, raw: bytes, length: int) -> Status | None:
        """Send an instruction to one servo and return its answer; None where none came.

        Args:
            raw: instruction.
            length: data bytes of a good answer.
        """
        before = self.suspect
        self.send_packet(raw, is_answered=True)
        self.setPacketTimeout(len(raw) + 11 + (length or 3))
        while (packet := self.next_answer()) is not None:
            status = protocol.as_status(packet)
            if status is not None and status.id == raw[4] and (status.fault or len(status.data) == length):
                self.suspect = max(0, before - 1)  # it may be the late answer to the same question; the second one still comes
                return status
        return None

    def collect(self, wanted: Mapping[int, int]) -> dict[int, Status]:
        """Return id -> answer to a sync read, in any order, fast or not, when all are there or the time is over.

        Args:
            wanted: id -> data bytes; an answer of another length is passed over.
        """
        answers: dict[int, Status] = {}
        while len(answers) < len(wanted) and (packet := self.next_answer()) is not None:
            fast = protocol.split_fast_status(packet, list(wanted.values()))
            single = protocol.as_status(packet)
            for status in fast or ([single] if single else []):
                if wanted.get(status.id) == len(status.data):
                    answers[status.id] = status
        self.suspect = 0 if len(answers) == len(wanted) else _GIVEN_UP
        return answers
