"""Frames of the flow sensor's microcontroller: fixed size, numbered, time-stamped, with a CRC.

A frame is 20 bytes, little-endian: A5 F1, sequence number (u16), microseconds since its boot when the chip's last frame was
taken (u32, wraps), microseconds from the chip's frame before the first counted to that one (u16), counts along the chip's x and
y (i16), SQUAL (u8), one byte that is 0, Shutter (u16), CRC-16 of all before it (polynomial 8005, as the servos use). The
microcontroller polls the chip faster than its 121 frames per second, and sends one for each of the chip's, or for several.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass

from wlr_gym.hardware.framing import CRC_SIZE, FrameFinder, missing_between, sealed

SYNC = b"\xa5\xf1"
_LAYOUT = struct.Struct("<2sHIHhhBxH")
SIZE = _LAYOUT.size + CRC_SIZE


@dataclass(frozen=True)
class FlowFrame:
    """What the chip counted from one of its frames to a later one.

    Attributes:
        sequence: counts up by one per frame, modulo 65536.
        microseconds: the microcontroller's clock at the end, modulo 2^32.
        interval: microseconds from the chip's one frame to the other.
        x, y: counts along the chip's axes.
        quality: SQUAL. shutter: Shutter; both as the chip's registers hold them at the end.
    """

    sequence: int
    microseconds: int
    interval: int
    x: int
    y: int
    quality: int
    shutter: int


def encode_frame(frame: FlowFrame) -> bytes:
    """Return a frame as bytes."""
    numbers = (frame.interval, frame.x, frame.y, frame.quality, frame.shutter)
    return sealed(_LAYOUT.pack(SYNC, frame.sequence & 0xFFFF, frame.microseconds & 0xFFFFFFFF, *numbers))


class FlowFrameParser:
    """Reads the frames of a stream.

    Attributes:
        lost: frames missing between the received ones, by their sequence numbers.
    """

    def __init__(self) -> None:
        self._finder = FrameFinder(SYNC, SIZE)
        self._last: int | None = None
        self.lost = 0

    @property
    def crc_errors(self) -> int:
        """Frames dropped because their CRC was wrong."""
        return self._finder.crc_errors

    def feed(self, data: bytes) -> list[FlowFrame]:
        """Take bytes; return the frames they complete, the same one again left out."""
        return [frame for raw in self._finder.feed(data) if (frame := self._take(raw)) is not None]

    def _take(self, raw: bytes) -> FlowFrame | None:
        frame = FlowFrame(*_LAYOUT.unpack(raw)[1:])
        if frame.sequence == self._last:
            return None
        self.lost += missing_between(self._last, frame.sequence)
        self._last = frame.sequence
        return frame
