"""A camera above the floor: its file (``configs/camera/*.yaml``), its readings, and the process that takes them, from outside.

One reading per frame, with a pose or with the reason why there is none.
"""

from __future__ import annotations

import contextlib
import json
import os
import select
import struct
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from wlr_gym.base.errors import InputError
from wlr_gym.base.paths import named_by, named_in
from wlr_gym.base.settings import SettingsModel, parse_config, read_config, require_keys
from wlr_gym.perception.markers.camera import Camera, load_camera
from wlr_gym.perception.markers.targets import Target, load_target
from wlr_gym.robot import Robot

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
    """How the camera of an emulated robot is set up; of no meaning to a real one."""

    height: float = Field(default=2.5, gt=0.2, le=20.0)  #: m of the lens above the floor
    tilt: float = Field(default=0.0, ge=-1.2, le=1.2)  #: rad from straight down
    blur: float = Field(default=0.8, ge=0.0, le=10.0)  #: px, 1 sigma of the lens's blur
    noise: float = Field(default=4.0, ge=0.5, le=50.0)  #: grey levels, 1 sigma
    exposure: float = Field(default=0.005, ge=0.0, le=0.05)  #: s
    latency: float = Field(default=0.04, ge=0.0, le=0.5)  #: s from mid-exposure until the frame has arrived
    dropout: float = Field(default=0.0, ge=0.0, lt=1.0)  #: share of frames that are lost on the way
    clutter: int = Field(default=0, ge=0, le=500)  #: things on the floor: discs, boxes, rings that are no markers
    samples: int = Field(default=4, ge=1, le=16)  #: rays a side in pixels with an edge
    seed: int = Field(default=0, ge=0)  #: of noise, losses, clutter


class CameraFile(SettingsModel):
    """A camera above the floor, as one ``configs/camera/*.yaml`` describes it.

    ``device`` is the number of the camera (0 = /dev/video0), or its path; a path that ends in ``.npy`` is a recorded film, an
    array (frames, H, W) of grey levels that is shown over and over. ``calibration`` is the file of ``wlr calibrate camera``,
    or its content; ``body`` and ``floor`` are the markers: files, or names in ``configs/vision/``. Files are seen from this
    one first.
    """

    name: str
    device: int | str = 0
    calibration: Camera
    body: Target
    floor: Target
    rate: float = Field(default=30.0, gt=1.0, le=500.0)  #: frames per second that are asked for
    #: s from mid-exposure to a frame's time stamp (or, where the driver has none, to its arrival), where it is known
    delay: float = Field(default=0.0, ge=0.0, le=0.2)
    emulated: EmulatedScene = EmulatedScene()  #: how it is set up over an emulated robot

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

#: A packed reading: number, three times, why there is no pose, pose, covariance.
_PACKED = struct.Struct("<Qddd64s6d36d")
#: Bytes of a packed reading.
SIZE = _PACKED.size


@dataclass(frozen=True, eq=False)
class CameraReading:
    """One frame; times are on this computer's monotonic clock."""

    number: int  #: of frames until this one; 0 = none yet
    time: float  #: s, mid-exposure
    arrival: float  #: s, when it was there
    found: float  #: s, when its pose was
    reason: str  #: why it has no pose, in words; empty = it has one
    pose: Array  #: (6,) x, y, z (m), yaw, pitch, roll (rad) of the body in the floor frame; NaN without one
    covariance: Array  #: (6, 6) of it

    def pack(self) -> bytes:
        """Return it as :data:`SIZE` bytes."""
        times, numbers = (self.time, self.arrival, self.found), (*self.pose, *self.covariance.ravel())
        return _PACKED.pack(self.number, *times, self.reason.encode(), *numbers)

    @classmethod
    def unpack(cls, data: bytes) -> CameraReading:
        """Return the reading in packed bytes."""
        number, time, arrival, found, reason, *values = _PACKED.unpack(data)
        pose, covariance = np.array(values[:6]), np.array(values[6:]).reshape(6, 6)
        return cls(number, time, arrival, found, reason.rstrip(b"\0").decode(), pose, covariance)


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


# ---- the camera process, seen from the one that drives the robot ----


#: s that the camera may take until its first frame.
START_TIME = 60.0


class LiveCamera:
    """A :class:`CameraReader` in a process of its own: :mod:`wlr_gym.hardware.camera.process`.

    Args:
        file: the camera. robot: what it films where it is an emulated one.
        feed: file with the poses of an emulated robot, which is filmed by rendering.

    Attributes:
        process: None = not open.
        stamps: whose time stamps count: ``driver``, ``driver's own clock`` or ``arrival``.
    """

    def __init__(self, file: CameraFile, robot: Robot, feed: Path | None = None) -> None:
        self.file = file
        self.process: subprocess.Popen[bytes] | None = None
        self.stamps = ""
        self._spec = {
            "camera": file.model_dump(mode="json"),
            "robot": robot.model_dump(mode="json"),
            "feed": None if feed is None else str(feed),
        }

    def open(self) -> None:
        """Start the process, and wait for its first frame.

        Raises:
            InputError: the camera gives none.
        """
        command, pipe = [sys.executable, "-m", "wlr_gym.hardware.camera.process"], subprocess.PIPE
        self.process = process = subprocess.Popen(command, stdin=pipe, stdout=pipe, bufsize=0, start_new_session=True)
        try:
            assert process.stdin is not None
            assert process.stdout is not None
            with contextlib.suppress(OSError):
                process.stdin.write(json.dumps(self._spec).encode() + b"\n")
            is_up = select.select([process.stdout], [], [], START_TIME)[0]
            answer = process.stdout.readline().decode("utf-8", "replace").strip() if is_up else ""
            if not answer.startswith("ready"):
                raise InputError(answer.removeprefix("error: ") or f"camera '{self.file.name}': no frame in {START_TIME:g} s")
            os.set_blocking(process.stdout.fileno(), False)
        except BaseException:
            self.close()
            raise
        self.stamps = answer.removeprefix("ready ")

    def close(self) -> None:
        """End the process."""
        process, self.process = self.process, None
        if process is None:
            return
        assert process.stdin is not None
        assert process.stdout is not None
        with contextlib.suppress(OSError):
            process.stdin.close()
        try:
            process.wait(0.5)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
        process.stdout.close()

    def read(self, now: float) -> CameraReading | None:
        """Return the newest reading that was not returned yet; None = there is none."""
        newest = b""
        if self.process is not None and self.process.stdout is not None:
            with contextlib.suppress(BlockingIOError):
                while data := os.read(self.process.stdout.fileno(), 100 * SIZE):
                    newest = data[-SIZE:]
        return CameraReading.unpack(newest) if newest else None

    @property
    def trouble(self) -> str:
        """Why no reading will come any more; empty = the process runs."""
        if self.process is None:
            return "the camera process does not run"
        if self.process.poll() is None:
            return ""
        return f"the camera process has ended (exit code {self.process.returncode})"
