"""Frames of the flow sensor's microcontroller: fixed size, numbered, time-stamped, with a CRC.

A frame is 20 bytes, little-endian: A5 F1, sequence number (u16), microseconds since its boot when the chip's last frame was
taken (u32, wraps), microseconds from the chip's frame before the first counted to that one (u16), counts along the chip's x and
y (i16), SQUAL (u8), one byte that is 0, Shutter (u16), CRC-16 of all before it (polynomial 8005, as the servos use). The
microcontroller polls the chip faster than its 121 frames per second, and sends one for each of the chip's, or for several.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass

from wlr_gym.hardware.framing import CRC_SIZE, NumberedFrames, sealed

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


class FlowFrameParser(NumberedFrames):
    """Reads the frames of a stream."""

    def __init__(self) -> None:
        super().__init__(_LAYOUT, SYNC)

    def feed(self, data: bytes) -> list[FlowFrame]:
        """Take bytes; return the frames they complete, the same one again left out."""
        return [FlowFrame(*content) for content, is_repeated in self.take(data) if not is_repeated]
