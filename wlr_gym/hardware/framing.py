"""Frames of fixed size that a microcontroller sends: two bytes of sync, content, CRC-16 of all before it (polynomial 8005, as
the servos use); and how old they are."""

from __future__ import annotations

import struct
from typing import Any, Protocol

from wlr_gym.hardware.dynamixel.protocol import crc16

#: Bytes of the CRC at a frame's end.
CRC_SIZE = 2
#: Bytes taken at once; systems give 4 kB at a time, and keep more for a port that nobody reads.
_CHUNK = 65536
#: Reads until the port must be empty: 256 kB.
_LARGEST_BACKLOG = 64
#: s since the port was last empty, up to which frames are hardly older than that: they relate the clocks.
RECENT = 0.1


class Device(Protocol):
    """What is used of ``serial.Serial`` with a time-out of 0. Failures are ``OSError``."""

    def read(self, size: int) -> bytes: ...
    def reset_input_buffer(self) -> None: ...
    def close(self) -> None: ...


def drained(device: Device) -> bytes:
    """Return all bytes that have come; does not wait."""
    data = b""
    for _ in range(_LARGEST_BACKLOG):
        part = device.read(_CHUNK)
        data += part
        if not part:
            break
    return data


def sealed(body: bytes) -> bytes:
    """Return a frame: its bytes up to the CRC, and the CRC."""
    return body + crc16(body).to_bytes(CRC_SIZE, "little")


class NumberedFrames:
    """Finds whole frames in a stream, and counts by their sequence numbers (modulo 65536) what is missing.

    Noise costs no more than the frames it hits.

    Args:
        layout: of a frame without its CRC: sync, sequence number, and what else is in it.
        sync: how a frame begins.

    Attributes:
        lost: frames missing between the received ones.
        crc_errors: frames dropped because their CRC was wrong.
    """

    def __init__(self, layout: struct.Struct, sync: bytes) -> None:
        self._layout, self._sync, self._size = layout, sync, layout.size + CRC_SIZE
        self._buffer = bytearray()
        self._last: int | None = None
        self.lost = self.crc_errors = 0

    def take(self, data: bytes) -> list[tuple[tuple[Any, ...], bool]]:
        """Take bytes; return the content of the frames they complete, after the sync, and whether it is the last one again."""
        self._buffer += data
        frames = []
        while (place := self._buffer.find(self._sync)) >= 0 and len(self._buffer) >= place + self._size:
            raw = bytes(self._buffer[place : place + self._size])
            if crc16(raw[:-CRC_SIZE]) != int.from_bytes(raw[-CRC_SIZE:], "little"):
                self.crc_errors += 1
                del self._buffer[: place + 1]
                continue
            del self._buffer[: place + self._size]
            content = self._layout.unpack(raw[:-CRC_SIZE])[1:]
            sequence, last, self._last = content[0], self._last, content[0]
            is_repeated = sequence == last
            self.lost += 0 if last is None or is_repeated else (sequence - last - 1) % 65536
            frames.append((content, is_repeated))
        del self._buffer[: max(0, len(self._buffer) - 2 * self._size)]  # noise without a start never piles up
        return frames


class StreamClock:
    """Tells how old a frame is from the microcontroller's microseconds (modulo 2^32) and our clock.

    The frame that came soonest after its stamp sets the offset between the clocks, so ages are short by at most what that one
    took: at a poll, up to one frame period. The microcontroller's clock may be wrong by ``drift`` (a ceramic resonator is by
    0.5 %, an RC oscillator by 2 %). A clock that goes back, or that is ahead of ours by more than ``jump``, restarted.
    """

    drift: float = 0.02  #: part by which the microcontroller's clock may be wrong
    jump: float = 0.1  #: s
    _turn = 2**32 * 1e-6  #: s after which the clock wraps

    def __init__(self) -> None:
        self._offset: float | None = None
        self._time = 0.0
        self._last = 0

    def age(self, microseconds: int, now: float, *, is_recent: bool = True) -> tuple[float | None, bool]:
        """Return the age (s) of a frame that is here at ``now`` (s), and whether the microcontroller restarted.

        Args:
            microseconds: the frame's stamp.
            now: s.
            is_recent: the port was empty a moment ago, so the frame is hardly older. Only such a frame can relate the clocks:
                in a backlog nobody knows how old the newest is. The age is None while they are not related.
        """
        sample = microseconds * 1e-6 - now
        if self._offset is None:
            return self._relate(microseconds, now, is_recent), False
        ahead = (sample - self._offset + self._turn / 2) % self._turn - self._turn / 2
        drift = self.drift * (now - self._time)
        is_back = (microseconds - self._last) % 2**32 > 2**31
        if is_back or ahead > self.jump + drift:
            return self._relate(microseconds, now, is_recent), True
        self._last = microseconds
        if ahead > -drift:
            self._offset, self._time = self._offset + ahead, now
        return max(0.0, -ahead - drift), False

    def _relate(self, microseconds: int, now: float, is_recent: bool) -> float | None:
        self._last, self._time = microseconds, now
        self._offset = microseconds * 1e-6 - now if is_recent else None
        return 0.0 if is_recent else None
