"""A camera above the floor: its file (``configs/camera/*.yaml``), its readings, and when each frame was exposed.

One reading per frame, with a pose or with the reason why there is none.
"""

from __future__ import annotations

import math
import struct
from collections import deque
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from wlr_gym.base.paths import named_by, named_in
from wlr_gym.base.settings import SettingsModel, parse_config, read_config, require_keys
from wlr_gym.perception.markers.camera import Camera, load_camera
from wlr_gym.perception.markers.targets import Target, load_target
from wlr_gym.perception.vision.tracking import MEANINGS, OK, PARTIAL, Sample

#: What a calibration without a readout costs: a film tells it, a live pose cannot.
UNKNOWN_READOUT = "its calibration states no readout: with a rolling shutter its poses are off while the robot moves"
#: Faults of a camera: what happens, a default value and its unit.
CAMERA_FAULTS: dict[str, tuple[str, float, str]] = {
    "camera_covered": ("something dark lies on the lens", 0.0, ""),
    "camera_frozen": ("the driver repeats the same picture, newly stamped", 0.0, ""),
    "camera_stalled": ("no frame comes: camera or driver hangs", 0.0, ""),
    "camera_dead": ("the camera's process is killed", 0.0, ""),
    "camera_moved": ("somebody knocks against the camera: it is turned by this", 0.03, "rad"),
    "camera_sheet": ("the markers on the robot are printed at this scale", 0.8, "of it"),
    "camera_back_to_front": ("the plate is mounted back to front", 0.0, ""),
    "camera_mirrored": ("the picture is mirrored", 0.0, ""),
    "camera_rotated": ("the picture is upside down", 0.0, ""),
    "camera_stamps": ("the time stamps jump ahead by this", 0.3, "s"),
    "camera_late": ("frames wait longer and longer before they arrive, by this per second", 0.2, "s/s"),
    "camera_lag": ("pictures are older than their stamps say, by this", 0.3, "s"),
    "camera_glare": ("a lamp shines into the lens", 0.0, ""),
    "camera_blurred": ("the lens is out of focus: 1 sigma of the blur", 5.0, "px"),
    "camera_decoy": ("another sheet with the robot's markers lies on the floor", 0.0, ""),
}


class EmulatedScene(SettingsModel):
    """How the camera of an emulated robot is set up; of no meaning to a real one.

    Attributes:
        height: m of the lens above the floor. tilt: rad from straight down.
        blur: px, 1 sigma of the lens's blur. noise: grey levels, 1 sigma.
        exposure: s. latency: s from mid-exposure until the frame has arrived.
        dropout: share of frames that are lost on the way.
        clutter: things on the floor that are no markers: discs, rings of other radii, boxes.
        samples: rays a side in pixels with an edge.
        seed: of noise, losses, clutter.
    """

    height: float = Field(default=2.5, gt=0.2, le=20.0)
    tilt: float = Field(default=0.0, ge=-1.2, le=1.2)
    blur: float = Field(default=0.8, ge=0.0, le=10.0)
    noise: float = Field(default=4.0, ge=0.5, le=50.0)
    exposure: float = Field(default=0.005, ge=0.0, le=0.05)
    latency: float = Field(default=0.04, ge=0.0, le=0.5)
    dropout: float = Field(default=0.0, ge=0.0, lt=1.0)
    clutter: int = Field(default=0, ge=0, le=500)
    samples: int = Field(default=4, ge=1, le=16)
    seed: int = Field(default=0, ge=0)


class CameraFile(SettingsModel):
    """A camera above the floor, as one ``configs/camera/*.yaml`` describes it.

    Attributes:
        name: of it.
        device: number of the camera (0 = /dev/video0), or its path; a path that ends in ``.npy`` is a recorded film, an array
            (frames, H, W) of grey levels that is shown over and over.
        calibration: file of ``wlr calibrate camera``, seen from this file first, or its content.
        body, floor: markers on the robot and on the floor: files, seen from this file first, or names in ``configs/vision/``.
        rate: frames per second that are asked for.
        delay: s from mid-exposure to a frame's time stamp (or, where the driver has none, to its arrival), where it is known.
        emulated: how it is set up over an emulated robot.
    """

    name: str
    device: int | str = 0
    calibration: Camera
    body: Target
    floor: Target
    rate: float = Field(default=30.0, gt=1.0, le=500.0)
    delay: float = Field(default=0.0, ge=0.0, le=0.2)
    emulated: EmulatedScene = EmulatedScene()

    @property
    def doubt(self) -> str:
        """What is not known of the camera that its poses suffer from; empty = nothing."""
        return "" if self.calibration.readout is not None else UNKNOWN_READOUT

    @property
    def is_film(self) -> bool:
        """Whether it is a recorded film."""
        return isinstance(self.device, str) and self.device.endswith(".npy")


def load_camera_file(source: str | Path | CameraFile) -> CameraFile:
    """Load a camera by config name or path, with the files that it names.

    Raises:
        InputError: unreadable file, unknown or missing key, a calibration or target that cannot be read.
    """
    if isinstance(source, CameraFile):
        return source
    data, where = read_config("camera", source)
    require_keys(CameraFile, data, where)
    content = dict(data)
    for key in ("body", "floor"):
        if isinstance(target := data.get(key, key), str):
            with named_by(where, key):
                content[key] = load_target(named_in(where, target))
    if isinstance(calibration := data.get("calibration"), str):
        with named_by(where, "calibration"):
            content["calibration"] = load_camera(named_in(where, calibration))
    return parse_config(CameraFile, content, where)


# ---- readings ----


Array = NDArray[np.float64]

#: Status by its number in a packed reading.
STATUSES = (OK, PARTIAL, *MEANINGS)
_NUMBERS = struct.Struct("<QdddB6d36d")
#: Bytes of a packed reading.
SIZE = _NUMBERS.size


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
    """Return a reading as :data:`SIZE` bytes."""
    times, status = (reading.time, reading.arrival, reading.found), STATUSES.index(reading.status)
    return _NUMBERS.pack(reading.number, *times, status, *reading.pose, *reading.covariance.ravel())


def unpack(data: bytes) -> CameraReading:
    """Return the reading in packed bytes."""
    number, time, arrival, found, status, *values = _NUMBERS.unpack(data)
    pose, covariance = np.array(values[:6]), np.array(values[6:]).reshape(6, 6)
    return CameraReading(number, time, arrival, found, STATUSES[status], pose, covariance)


# ---- when a frame was exposed ----


#: s within which a driver's stamp and the arrival are taken to be of one clock (Linux drivers stamp by the monotonic one).
SAME_CLOCK = 0.5
#: Frames over which the offset of another clock is the least (arrival - stamp).
WINDOW = 300


class StampClock:
    """Tell capture times from time stamps and arrivals.

    A driver that stamps by this computer's monotonic clock is believed. One with a clock of its own is related to it by the
    least of (arrival - stamp) over the last frames: what is on top of it is delay on the way, and the least delay cannot be
    told from the offset (``delay`` of the camera's file is for that). Without stamps (0, or none that move) arrivals count.

    Args:
        delay: s from mid-exposure to the stamp or, at the least, to the arrival.

    Attributes:
        source: ``driver``, ``driver's own clock`` or ``arrival``, as the last frame was dated.
        offset: s, this computer's clock minus the stamps'; 0 where they are of one clock.
    """

    def __init__(self, delay: float) -> None:
        self.delay, self.source, self.offset = delay, "arrival", 0.0
        self._lags: deque[float] = deque(maxlen=WINDOW)
        self._last = math.nan

    def time(self, stamp: float, arrival: float) -> float:
        """Return when a frame was exposed (s) that the driver dates ``stamp`` and that came at ``arrival``."""
        moves = stamp != self._last and stamp > 0.0 and math.isfinite(stamp)
        self._last = stamp
        if not moves:
            self.source = "arrival"
            return arrival - self.delay
        if -0.001 <= arrival - stamp < SAME_CLOCK:
            self.source, self.offset = "driver", 0.0
            self._lags.clear()
            return stamp - self.delay
        self._lags.append(arrival - stamp)
        self.source, self.offset = "driver's own clock", min(self._lags)
        return stamp + self.offset - self.delay
