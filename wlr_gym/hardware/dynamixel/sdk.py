"""dynamixel-sdk with its verified defects guarded, each in one method that names it.

Version 4.1.0 was read and tried; the numbers below are those of docs/robot.md. Tests in tests/hardware/test_bus.py show the
defect in the SDK and its absence here. Import only behind ``require_package``: the SDK and pyserial are optional.
"""

from __future__ import annotations

import os
import select
import time
from collections.abc import Mapping, Sequence
from typing import Any, Literal

import dynamixel_sdk as sdk

from wlr_gym.base.errors import InputError
from wlr_gym.hardware.dynamixel import protocol
from wlr_gym.hardware.dynamixel.protocol import BROADCAST, Instruction, Packet, Parser, Status
from wlr_gym.hardware.ports import FAILURES, open_serial

_UNANSWERED = (Instruction.SYNC_WRITE, Instruction.BULK_WRITE)
#: A line that never falls quiet is let talk for the patience and this many times more, yet no longer than these s more.
_MORE_PATIENCE, _MORE_TIME = 3.0, 0.05
SUCCESS, TIMEOUT, CORRUPT = sdk.COMM_SUCCESS, sdk.COMM_RX_TIMEOUT, sdk.COMM_RX_CORRUPT


class BusGoneError(ConnectionError):
    """The port does not work any more: unplugged adapter, dead driver."""


class GuardedPort(sdk.PortHandler):
    """The SDK's serial port.

    Args:
        path: device.
        baud_rate: bit/s.
        patience: s an answer may take beyond its bytes' time on the wire.

    Attributes:
        suspect: the last exchange did not end well; what still comes in belongs to it.
        quiet: the line fell quiet when it was last waited for.
        gone: it has failed since it was opened.
    """

    def __init__(self, path: str, baud_rate: int, patience: float) -> None:
        super().__init__(path)
        self.baudrate = baud_rate
        self.patience = patience
        self.parser = Parser()
        self.queue: list[Packet] = []
        self.suspect = False
        self.quiet = True
        self.gone = False
        self.discarded = 0

    def _lost(self, error: Exception) -> BusGoneError:
        self.gone = True
        return BusGoneError(f"port {self.port_name} is gone: {error}")

    # Defect 8: an exception between sending and receiving left the port marked as in use, and every later call, torque-off
    # included, returned "busy" and did nothing. One thread owns a bus here; the mark is never set.
    @property
    def is_using(self) -> bool:
        """Always False."""
        return False

    @is_using.setter
    def is_using(self, value: bool) -> None:
        pass

    def openPort(self) -> bool:  # noqa: N802
        """Open the device. Defect 11: a missing one raised whatever pyserial had; now an InputError that names it."""
        if not super().openPort():
            raise InputError(f"port {self.port_name}: baud rate {self.baudrate} is not one dynamixel-sdk knows")
        self.gone = False
        return True

    def setupPort(self, cflag_baud: int) -> Literal[True]:  # noqa: N802
        """Set up the device. Defect 13: the SDK sets speed and throws input away, whoever drives servos on the port."""
        self.closePort()
        self.ser = open_serial(self.port_name, self.baudrate)
        self.is_open = True
        self.tx_time_per_byte = 10e3 / self.baudrate
        return True

    def closePort(self) -> None:  # noqa: N802
        """Close the device. Defect 11: closing a port that was never opened raised."""
        if self.ser is not None:
            super().closePort()

    def clearPort(self) -> None:  # noqa: N802
        """Forget what came in. Defect 9: a late answer was taken for the next one; after a time-out, wait for a quiet line."""
        self.parser.clear()
        self.queue.clear()
        self.quiet = not self.suspect or self._falls_quiet()
        try:
            super().clearPort()
        except (*FAILURES, AttributeError) as error:
            raise self._lost(error) from None

    def _falls_quiet(self) -> bool:
        """Let pass what still comes. An end is set to it: on a line that always talks, torque-off must go out all the same."""
        end = self.getCurrentTime() + (self.patience + min(_MORE_PATIENCE * self.patience, _MORE_TIME)) * 1e3
        while self.getCurrentTime() < end:
            data = self._wait_and_read(4096, self.patience)
            if not data:
                return True
            self.discarded += len(data)
        return False

    def readPort(self, length: int) -> bytes:  # noqa: N802
        """Return bytes as soon as there are some. Defect 7: the SDK spins at full load until they come.

        Its scan counts what came down from what can come, and on a line that always talks asks for less than nothing.
        """
        length = max(1, length)
        return self._wait_and_read(length, max(0.0, self.packet_timeout - self.getTimeSinceStart()) * 1e-3)

    def _wait_and_read(self, length: int, seconds: float) -> bytes:
        # Defect 10: an unplugged adapter shows as a time-out, then as one of three kinds of exception.
        device: Any = self.ser
        try:
            number = device.fileno()
            if not select.select([number], [], [], seconds)[0]:
                return b""
            if data := os.read(number, length):
                return data
            raise OSError("it is ready and has nothing: disconnected, or another program reads it")
        except (*FAILURES, ValueError, TypeError, AttributeError) as error:  # pyserial's, on a port that closed meanwhile
            raise self._lost(error) from None

    def writePort(self, packet: Sequence[int]) -> int:  # noqa: N802
        """Send all bytes. Defect 12: pyserial then waits, without end, until the device would take more."""
        try:
            if (sent := self._write(bytes(packet))) < len(packet):
                raise OSError(f"it took {sent} of {len(packet)} bytes")
            return sent
        except (*FAILURES, TypeError, AttributeError) as error:  # the last: a port that was never opened
            raise self._lost(error) from None

    def _write(self, data: bytes) -> int:
        device: Any = self.ser
        return os.write(device.fileno(), data)  # does not block: a full buffer is an OSError, a nearly full one takes a part

    def getCurrentTime(self) -> float:  # noqa: N802
        """Return ms. Defect 7: the SDK's time-outs followed the wall clock, which may be set."""
        return time.monotonic() * 1e3

    def setPacketTimeout(self, packet_length: int) -> None:  # noqa: N802
        """Start the time an answer may take. Defect 6: the SDK's floor is 34 ms, whatever its user asks for."""
        self.setPacketTimeoutMillis(self.tx_time_per_byte * packet_length + self.patience * 1e3)


class GuardedHandler(sdk.Protocol2PacketHandler):
    """The SDK's packet handler."""

    def txPacket(self, port: GuardedPort, txpacket: Sequence[int]) -> Any:  # noqa: N802
        """Send a packet. Defect 1: the SDK works out the stuffed packet and sends the other one."""
        length = txpacket[5] | txpacket[6] << 8
        raw = protocol.encode(txpacket[4], txpacket[7], bytes(txpacket[8 : 8 + length - 3]))
        is_answered = txpacket[4] != BROADCAST or txpacket[7] not in _UNANSWERED
        if is_answered or port.suspect:
            port.clearPort()
        port.suspect = is_answered
        port.writePort(raw)
        return SUCCESS

    def rxPacket(self, port: GuardedPort, fast_option: bool) -> tuple[list[int], Any]:  # noqa: N802
        """Receive one answer in the SDK's form. Defect 2: its removal of stuffing loses bytes in some patterns."""
        packet = self.next_answer(port)
        if packet is None:
            return [], CORRUPT if port.parser.pending else TIMEOUT
        port.suspect = False
        body = bytes([packet.instruction]) + packet.parameters
        return [*protocol.HEADER, packet.id, *protocol.word(len(body) + 2), *body, 0, 0], SUCCESS

    def next_answer(self, port: GuardedPort) -> Packet | None:
        """Return the next status packet before the time is over, else None; echoes and noise are passed over."""
        while True:
            while port.queue:
                packet = port.queue.pop(0)
                if packet.instruction == Instruction.STATUS:
                    return packet
            late = port.isPacketTimeout()  # what lies in the buffer is taken even then: another bus may have kept us waiting
            port.queue += port.parser.feed(port.readPort(4096))
            if late and not port.queue:
                return None

    def collect(self, port: GuardedPort, wanted: Mapping[int, int]) -> dict[int, Status]:
        """Receive the answers to a sync or bulk read, in any order, fast or not, until all are there or the time is over.

        Defects 3, 4, 5, 9: the SDK's groups lose each servo's error byte, read 0 where there is nothing, drop every servo
        when one is missing, and take an answer of another length or from another servo.

        Args:
            port: with the time already running.
            wanted: id -> data bytes.

        Returns:
            id -> answer, for those that came.
        """
        answers: dict[int, Status] = {}
        while len(answers) < len(wanted) and (packet := self.next_answer(port)) is not None:
            fast = protocol.split_fast_status(packet, list(wanted.values()))
            single = protocol.as_status(packet)
            for status in fast or ([single] if single else []):
                if wanted.get(status.id) == len(status.data):
                    answers[status.id] = status
        port.suspect = len(answers) < len(wanted)
        return answers

    def exchange(self, port: GuardedPort, raw: Packet, length: int | None) -> Status | None:
        """Send an instruction to one servo and return its answer; None where none came.

        Args:
            port: open port.
            raw: instruction.
            length: data bytes of a good answer; None = any.
        """
        body: list[Any] = [0, 0, 0, 0, raw.id, *protocol.word(len(raw.parameters) + 3), raw.instruction, *raw.parameters, 0, 0]
        self.txPacket(port, body)
        port.setPacketTimeout(len(body) + 11 + (length or 3))
        while (packet := self.next_answer(port)) is not None:
            status = protocol.as_status(packet)
            fits = status is not None and (status.fault or length in (None, len(status.data)))
            if status is not None and status.id == raw.id and fits:
                port.suspect = False
                return status
        return None
