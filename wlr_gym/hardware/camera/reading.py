"""What the camera hands to the control loop: one reading per frame, with a pose or with the reason why there is none."""

from __future__ import annotations

import struct
import zlib
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from wlr_gym.hardware.camera.config import CameraFile
from wlr_gym.perception.vision.tracking import MEANINGS, OK, PARTIAL, Sample

Array = NDArray[np.float64]

#: Status by its number in a packed reading.
STATUSES = (OK, PARTIAL, *MEANINGS)
_NUMBERS = struct.Struct("<QdddB6d36d")
_CHECKSUM = struct.Struct("<I")
#: Bytes of a packed reading.
SIZE = _NUMBERS.size + _CHECKSUM.size


@dataclass(frozen=True, eq=False)
class CameraReading:
    """One frame.

    Attributes:
        number: of frames until this one; 0 = none yet.
        time: s, mid-exposure. arrival: when it was there. found: when its pose was. All on this computer's monotonic clock.
        status: ``ok``, ``partial``, or a key of :data:`wlr_gym.perception.vision.tracking.MEANINGS`.
        pose: (6,) x, y, z (m), yaw, pitch, roll (rad) of the body in the floor frame; NaN without one.
        covariance: (6, 6) of it.
    """

    number: int
    time: float
    arrival: float
    found: float
    status: str
    pose: Array
    covariance: Array

    @property
    def has_pose(self) -> bool:
        """Whether the frame shows where the robot is."""
        return self.status in (OK, PARTIAL)


class CameraReader(Protocol):
    """Where the control loop gets readings from; nothing in it waits.

    Attributes:
        file: the camera, and what is not known of it.
    """

    file: CameraFile

    def open(self) -> None:
        """Begin; readings may come a while later."""
        ...

    def close(self) -> None:
        """End."""
        ...

    def read(self, now: float) -> CameraReading | None:
        """Return the newest reading that was not returned yet, at ``now`` (s); None = there is none."""
        ...

    @property
    def trouble(self) -> str:
        """Why no reading will come any more; empty = nothing is known of that."""
        ...


def reading_of(sample: Sample, number: int, arrival: float, found: float) -> CameraReading:
    """Return a sample whose time is on this computer's clock as a reading."""
    return CameraReading(number, sample.time, arrival, found, sample.status, sample.pose, sample.covariance)


def pack(reading: CameraReading) -> bytes:
    """Return a reading as :data:`SIZE` bytes that show whether they are whole."""
    status = STATUSES.index(reading.status)
    times = (reading.time, reading.arrival, reading.found)
    data = _NUMBERS.pack(reading.number, *times, status, *reading.pose, *reading.covariance.ravel())
    return data + _CHECKSUM.pack(zlib.crc32(data))


def unpack(data: bytes) -> CameraReading | None:
    """Return the reading in packed bytes; None where they are not whole, or empty."""
    body, (checksum,) = data[: _NUMBERS.size], _CHECKSUM.unpack(data[_NUMBERS.size : SIZE])
    if zlib.crc32(body) != checksum:
        return None
    number, time, arrival, found, status, *values = _NUMBERS.unpack(body)
    if number == 0:
        return None
    return CameraReading(
        number, time, arrival, found, STATUSES[status], np.array(values[:6]), np.array(values[6:]).reshape(6, 6)
    )
