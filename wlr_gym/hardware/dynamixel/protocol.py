"""Dynamixel Protocol 2.0: packets to bytes and back, and what can go wrong on a bus. No input or output, no clock.

Packet: FF FF FD 00, id, length (2 bytes: instruction, parameters and CRC), instruction, parameters, CRC-16. Wherever
instruction and parameters hold FF FF FD, a further FD is stuffed in on the line. Numbers are little-endian. Source: ROBOTIS
e-manual, Protocol 2.0 and CRC; fast reads as the servos answer them (one packet from id FE, blocks not stuffed).
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from enum import IntEnum
from typing import NamedTuple

from wlr_gym.hardware.serial_frames import crc16

HEADER = b"\xff\xff\xfd\x00"
BROADCAST = 0xFE
MAX_ID = 252
#: Bytes of a packet before its instruction, and the largest length field a servo or the SDK accepts.
PREFIX = 7
MAX_LENGTH = 1024
#: Bit of a status packet's error byte: the servo has a hardware error, see its Hardware Error Status.
ALERT = 0x80
#: Parameters of CLEAR that bring Present Position back into one turn.
CLEAR_TURNS = bytes([0x01, 0x44, 0x58, 0x4C, 0x22])

_PATTERN = b"\xff\xff\xfd"
_STUFFED = b"\xff\xff\xfd\xfd"


class BusGoneError(ConnectionError):
    """The port does not work any more: unplugged adapter, dead driver."""


class NoAnswerError(TimeoutError):
    """A servo did not answer."""


class RestlessLineError(NoAnswerError):
    """A servo did not answer, or was not heard: the line never falls quiet."""


class RefusedError(RuntimeError):
    """A servo refused an instruction."""


class Instruction(IntEnum):
    """Instruction byte."""

    PING = 0x01
    READ = 0x02
    WRITE = 0x03
    REBOOT = 0x08
    CLEAR = 0x10
    STATUS = 0x55
    SYNC_READ = 0x82
    SYNC_WRITE = 0x83
    FAST_SYNC_READ = 0x8A
    BULK_READ = 0x92
    BULK_WRITE = 0x93
    FAST_BULK_READ = 0x9A


class Error(IntEnum):
    """Low seven bits of a status packet's error byte."""

    NONE = 0
    RESULT_FAIL = 1
    INSTRUCTION = 2
    CRC = 3
    DATA_RANGE = 4
    DATA_LENGTH = 5
    DATA_LIMIT = 6
    ACCESS = 7


class Packet(NamedTuple):
    """One packet as sent, without stuffing."""

    id: int
    instruction: int
    parameters: bytes


class Status(NamedTuple):
    """One servo's answer: id, error byte (with the alert bit), data."""

    id: int
    error: int
    data: bytes

    @property
    def alert(self) -> bool:
        """The servo reports a hardware error. Its data is valid all the same."""
        return bool(self.error & ALERT)

    @property
    def fault(self) -> int:
        """Why the instruction failed: an :class:`Error` value, 0 = it did not."""
        return self.error & ~ALERT


# ---- encoding ----


def word(value: int) -> bytes:
    """Return two bytes, little-endian."""
    return value.to_bytes(2, "little")


def encode(id: int, instruction: int, parameters: bytes = b"") -> bytes:
    """Return one packet as bytes for the line."""
    body = (bytes([instruction]) + parameters).replace(_PATTERN, _STUFFED)
    packet = HEADER + bytes([id]) + word(len(body) + 2) + body
    return packet + word(crc16(packet))


def encode_status(id: int, error: int, data: bytes = b"") -> bytes:
    """Return one servo's answer as bytes for the line."""
    return encode(id, Instruction.STATUS, bytes([error]) + data)


def ping(id: int = BROADCAST) -> bytes:
    """Return a ping of one servo, or of all."""
    return encode(id, Instruction.PING)


def read(id: int, address: int, length: int) -> bytes:
    """Return a read of ``length`` bytes."""
    return encode(id, Instruction.READ, word(address) + word(length))


def write(id: int, address: int, data: bytes) -> bytes:
    """Return a write."""
    return encode(id, Instruction.WRITE, word(address) + data)


def sync_read(address: int, length: int, ids: Iterable[int], fast: bool = False) -> bytes:
    """Return a read of the same block from several servos."""
    instruction = Instruction.FAST_SYNC_READ if fast else Instruction.SYNC_READ
    return encode(BROADCAST, instruction, word(address) + word(length) + bytes(ids))


def sync_write(address: int, data: Mapping[int, bytes]) -> bytes:
    """Return a write of the same block to several servos: id -> bytes, all of one length."""
    (length,) = {len(block) for block in data.values()}
    blocks = b"".join(bytes([id]) + block for id, block in data.items())
    return encode(BROADCAST, Instruction.SYNC_WRITE, word(address) + word(length) + blocks)


def encode_fast_status(answers: Sequence[Status]) -> list[bytes]:
    """Return the pieces several servos put on the line, one after the other, to answer one fast read.

    The first piece starts the packet; each ends with the CRC of everything since the packet began.
    """
    length = 1 + sum(len(answer.data) + 4 for answer in answers)
    pieces = []
    crc = 0
    start = HEADER + bytes([BROADCAST]) + word(length) + bytes([Instruction.STATUS])
    for answer in answers:
        piece = start + bytes([answer.error, answer.id]) + answer.data
        crc = crc16(piece, crc)
        end = word(crc)
        crc = crc16(end, crc)
        pieces.append(piece + end)
        start = b""
    return pieces


# ---- decoding ----


def as_status(packet: Packet) -> Status | None:
    """Return a packet as one servo's answer; None where it is none."""
    if packet.instruction != Instruction.STATUS or packet.id == BROADCAST or not packet.parameters:
        return None
    return Status(packet.id, packet.parameters[0], packet.parameters[1:])


def split_fast_status(packet: Packet, lengths: Sequence[int]) -> list[Status] | None:
    """Return the answers inside the one packet that answers a fast read.

    Args:
        packet: as parsed.
        lengths: data bytes expected from each servo, in the order asked.

    Returns:
        One answer per servo, or None where the packet is none or has another size.
    """
    is_fast = packet.instruction == Instruction.STATUS and packet.id == BROADCAST
    if not is_fast or len(packet.parameters) != sum(lengths) + 4 * len(lengths) - 2:
        return None
    answers = []
    start = 0
    for length in lengths:
        error, id = packet.parameters[start], packet.parameters[start + 1]
        answers.append(Status(id, error, packet.parameters[start + 2 : start + 2 + length]))
        start += length + 4
    return answers


class Parser:
    """Finds packets in a stream of bytes; noise and broken packets cost no more than themselves.

    Attributes:
        crc_errors: packets dropped because their CRC was wrong.
    """

    def __init__(self) -> None:
        self._buffer = bytearray()
        self.crc_errors = 0

    def feed(self, data: bytes) -> list[Packet]:
        """Take bytes from the line; return the packets they complete."""
        buffer, packets = self._buffer, []
        buffer += data
        while (place := buffer.find(HEADER)) >= 0:
            del buffer[:place]
            if len(buffer) < PREFIX:
                return packets
            id, length = buffer[4], int.from_bytes(buffer[5:PREFIX], "little")
            size, packet = PREFIX + length, None
            if (id <= MAX_ID or id == BROADCAST) and 3 <= length <= MAX_LENGTH:
                if len(buffer) < size:
                    return packets
                raw = bytes(buffer[:size])
                if crc16(raw[:-2]) == int.from_bytes(raw[-2:], "little"):
                    packet = _decode(raw)
                else:
                    self.crc_errors += 1
            if packet is None:
                del buffer[:1]
            else:
                packets.append(packet)
                del buffer[:size]
        del buffer[:-3]  # they may begin a header
        return packets

    def clear(self) -> None:
        """Forget everything received so far."""
        self._buffer.clear()


def _decode(raw: bytes) -> Packet | None:
    """Return a packet whose CRC is right; None where FF FF FD stands in it unstuffed, which restarts every receiver."""
    body = raw[PREFIX:-2]
    if raw[4] == BROADCAST and body[0] == Instruction.STATUS:  # answer to a fast read: never stuffed
        return Packet(raw[4], body[0], body[1:])
    if _PATTERN in body.replace(_STUFFED, b"\0"):
        return None
    plain = body.replace(_STUFFED, _PATTERN)
    return Packet(raw[4], plain[0], plain[1:])
