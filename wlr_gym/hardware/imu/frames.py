"""Frames of the IMU's microcontroller: fixed size, numbered, time-stamped, with a CRC.

A frame is 24 bytes, little-endian: A5 5A, sequence number (u16), microseconds since its boot (u32, wraps), then the
MPU-6050's burst in the sensor's own counts: accelerometer x, y, z, temperature, gyroscope x, y, z (i16), CRC-16 of all before
it (polynomial 8005, as the servos use). Axes are the body frame's.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from wlr_gym.hardware.framing import NumberedFrames, sealed

SYNC = b"\xa5\x5a"
SIZE = 24
_LAYOUT = struct.Struct("<2sHI7h")
#: One g as the MPU-6050's data sheet counts it, m/s2.
STANDARD_GRAVITY = 9.80665


@dataclass(frozen=True)
class ImuFrame:
    """One reading, in counts.

    Attributes:
        sequence: counts up by one per frame, modulo 65536.
        microseconds: the microcontroller's clock when the sensor was read, modulo 2^32.
        accelerometer, gyroscope: three counts each, body frame.
        temperature: counts; degC = counts/340 + 36.53 (MPU-6050 register map).
    """

    sequence: int
    microseconds: int
    accelerometer: tuple[int, int, int]
    temperature: int
    gyroscope: tuple[int, int, int]


def gyro_per_count(gyro_range: int) -> float:
    """Return rad/s per count at a full scale of ``gyro_range`` deg/s."""
    return float(np.deg2rad(gyro_range)) / 32768


def accel_per_count(accel_range: int) -> float:
    """Return m/s2 per count at a full scale of ``accel_range`` g."""
    return accel_range * STANDARD_GRAVITY / 32768


def to_counts(values: ArrayLike, per_count: float) -> tuple[int, int, int]:
    """Return three SI values as counts, clipped to the sensor's range as the sensor does."""
    x, y, z = (round(min(max(value / per_count, -32768.0), 32767.0)) for value in np.asarray(values, np.float64).tolist())
    return x, y, z


def from_counts(counts: ArrayLike, per_count: float) -> NDArray[np.float64]:
    """Return three counts as SI values."""
    return np.asarray(counts, np.float64) * per_count


def encode_frame(frame: ImuFrame) -> bytes:
    """Return a frame as bytes."""
    numbers = (*frame.accelerometer, frame.temperature, *frame.gyroscope)
    body = _LAYOUT.pack(SYNC, frame.sequence & 0xFFFF, frame.microseconds & 0xFFFFFFFF, *numbers)
    return sealed(body)


class FrameParser(NumberedFrames):
    """Reads the frames of a stream."""

    def __init__(self) -> None:
        super().__init__(_LAYOUT, SYNC)

    def feed(self, data: bytes) -> list[ImuFrame]:
        """Take bytes; return the frames they complete."""
        return [
            ImuFrame(sequence, microseconds, (ax, ay, az), temperature, (gx, gy, gz))
            for (sequence, microseconds, ax, ay, az, temperature, gx, gy, gz), _ in self.take(data)
        ]
