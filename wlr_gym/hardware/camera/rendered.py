"""Frames of an emulated robot, rendered from its true pose, and what can go wrong with a camera.

:class:`PoseFeed` brings true poses from the emulator's process to the one that films it: a ring in shared memory. Nothing but
pictures, their time stamps and their arrival leaves this module; the detector finds the pose, as on the robot.
"""

from __future__ import annotations

import math
import mmap
import struct
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from wlr_gym.base.errors import InputError
from wlr_gym.hardware.camera.reading import CameraFile
from wlr_gym.perception.markers.detection import Image
from wlr_gym.perception.scene import (
    Facet,
    Look,
    Renderer,
    ScenePose,
    floor_facets,
    plate_facet,
    robot_facets,
    rotation_of,
    view,
)
from wlr_gym.physics.model.dynamics import rotation_matrix
from wlr_gym.robot import Robot

Array = NDArray[np.float64]

#: Poses that the ring holds.
LENGTH = 512
#: Numbers of a row: time, position, quaternion (w, x, y, z), legs; then per kind of fault its value plus 1, 0 = it is not.
_POSE = 12
FAULT_COLUMNS = 16
_ROW = _POSE + FAULT_COLUMNS
_COUNT = struct.Struct("<Q")


class RobotPose(NamedTuple):
    """Where an emulated robot is."""

    time: float  #: s
    position: Array  #: (3,) m
    quaternion: Array  #: (4,) w, x, y, z
    legs: Array  #: (4,) rad


class PoseFeed:
    """The ring; one process writes, another reads.

    Args:
        path: of its file. create: make it, or begin anew with one that is there.

    Raises:
        InputError: another file is there, or it cannot be made.
    """

    def __init__(self, path: Path, *, create: bool = False) -> None:
        size = _COUNT.size + 8 * _ROW * LENGTH
        if create:
            if path.is_file() and path.stat().st_size != size:
                raise InputError(f"--poses {path}: is there and no file of poses; expected a new file")
            try:
                path.write_bytes(bytes(size))
            except OSError as error:
                raise InputError(f"--poses {path}: cannot be written: {error.strerror}") from None
        with path.open("r+b") as file:
            self._memory = mmap.mmap(file.fileno(), size)
        self._rows = np.frombuffer(self._memory, np.float64, _ROW * LENGTH, _COUNT.size).reshape(LENGTH, _ROW)

    def write(self, pose: RobotPose, faults: Array) -> None:
        """Append a pose, and which faults of the camera hold now (see :data:`FAULT_COLUMNS`)."""
        (count,) = _COUNT.unpack_from(self._memory)
        row = self._rows[count % LENGTH]
        row[0], row[1:4], row[4:8], row[8:12] = pose
        row[_POSE:] = 0.0
        row[_POSE : _POSE + len(faults)] = faults
        _COUNT.pack_into(self._memory, 0, count + 1)

    def last(self) -> tuple[float, Array] | None:
        """Return time (s) and faults of the newest row; None = nothing was written yet."""
        (count,) = _COUNT.unpack_from(self._memory)
        if count == 0:
            return None
        row = self._rows[(count - 1) % LENGTH].copy()
        return float(row[0]), row[_POSE:]

    def at(self, time: float) -> RobotPose | None:
        """Return the newest pose of ``time`` (s) or before; None where the ring does not reach back so far."""
        (count,) = _COUNT.unpack_from(self._memory)
        recent = min(count, LENGTH - 8)  # rows that are not about to be overwritten
        rows = self._rows[np.arange(count - recent, count) % LENGTH]
        k = int(np.searchsorted(rows[:, 0], time, side="right")) - 1
        if k < 0:
            return None
        return RobotPose(float(rows[k, 0]), rows[k, 1:4].copy(), rows[k, 4:8].copy(), rows[k, 8:12].copy())


def scene_pose(pose: RobotPose) -> ScenePose:
    """Return a pose as the renderer takes it."""
    return ScenePose(pose.position, rotation_matrix(pose.quaternion[None])[0], pose.legs)


# ---- pictures ----


#: Instants of an exposure at which the robot is drawn.
_INSTANTS = 2
#: m around the middle of the floor where clutter lies.
_CLUTTER_AREA = (2.0, 1.2)
#: m, where the other sheet lies.
_DECOY = (0.35, 0.35)

#: Name of a fault -> its value while it holds, else None.
Faults = Callable[[str], float | None]


class Exposure(NamedTuple):
    """A frame that will come."""

    number: int
    time: float  #: s of mid-exposure
    shown: float  #: s at which the robot is shown
    stamp: float  #: s that the driver writes on it
    arrival: float  #: s at which it is there
    is_lost: bool  #: it never is


class RenderedCamera:
    """A camera over an emulated robot.

    Args:
        file: how it is set up. robot: what is filmed. faults: what is wrong now.
    """

    def __init__(self, file: CameraFile, robot: Robot, faults: Faults = lambda _: None) -> None:
        self.file, self.robot, self._faults = file, robot, faults
        self._renderers: dict[tuple[float, bool], Renderer] = {}
        self._phase = float(np.random.default_rng([file.emulated.seed, 1]).uniform())
        self._last: Image | None = None
        self._waiting = 0.0
        self.renderer()

    def exposure(self, number: int) -> Exposure:
        """Return when a frame is exposed, stamped and there, with the faults that hold now; frames are asked for in order."""
        scene, rate, faults = self.file.emulated, self.file.rate, self._faults
        time = (number + self._phase) / rate
        growth = faults("camera_late")
        self._waiting = 0.0 if growth is None else self._waiting + growth / rate
        arrival = time + scene.latency + self._waiting
        is_lost = bool(np.random.default_rng([scene.seed, 2, number]).uniform() < scene.dropout)
        is_lost = is_lost or faults("camera_stalled") is not None
        stamp = time + (faults("camera_stamps") or 0.0)
        return Exposure(number, time, time - (faults("camera_lag") or 0.0), stamp, arrival, is_lost)

    def instants(self, exposure: Exposure) -> list[float]:
        """Return the times (s) at which the robot's pose must be known for a frame."""
        width = self.file.emulated.exposure
        return [exposure.shown + width * ((k + 0.5) / _INSTANTS - 0.5) for k in range(_INSTANTS)]

    def picture(self, exposure: Exposure, poses: list[RobotPose]) -> Image:
        """Render the frame of an exposure that shows the robot at :meth:`instants`."""
        scene, faults = self.file.emulated, self._faults
        if self._last is not None and faults("camera_frozen") is not None:
            return self._last
        if faults("camera_covered") is not None:
            noise = np.random.default_rng([scene.seed, 3, exposure.number])
            shape = self.file.calibration.height, self.file.calibration.width
            return np.clip(np.rint(noise.normal(12.0, 2.0, shape)), 0, 255).astype(np.uint8)
        plate = plate_facet(self.file.body)
        circles = plate.circles.copy()
        if (scale := faults("camera_sheet")) is not None:
            circles *= scale
        if faults("camera_back_to_front") is not None:
            circles[:, :2] *= -1.0
        parts = [*robot_facets(self.robot, poses[0].legs), replace(plate, circles=circles)]
        moving = [[facet.moved(at.position, at.rotation) for facet in parts] for at in map(scene_pose, poses)]
        blur = faults("camera_blurred")
        look = Look(blur=scene.blur if blur is None else blur, noise=scene.noise)
        seed = int(np.random.default_rng([scene.seed, 4, exposure.number]).integers(2**62))
        image = self.renderer().frame(moving, look, seed)
        if faults("camera_glare") is not None:
            image = _glaring(image)
        if faults("camera_mirrored") is not None:
            image = np.ascontiguousarray(image[:, ::-1])
        if faults("camera_rotated") is not None:
            image = np.ascontiguousarray(image[::-1, ::-1])
        self._last = image
        return image

    def renderer(self) -> Renderer:
        """Return the renderer of where the camera hangs now, and of what lies on the floor."""
        turned, decoy = self._faults("camera_moved") or 0.0, self._faults("camera_decoy") is not None
        if (turned, decoy) not in self._renderers:
            scene = self.file.emulated
            still = [*floor_facets(self.file.floor), *_clutter(scene.clutter, scene.seed)]
            if decoy:
                still.append(replace(plate_facet(self.file.body), centre=np.array([*_DECOY, 2e-4])))
            eye = view(scene.tilt, scene.height / math.cos(scene.tilt), (0.0, 0.0, 0.0))
            knock = rotation_of(turned, 0.3 * turned)  # about the camera's own axes: z is its optical axis
            floor = ScenePose(knock @ eye.position, knock @ eye.rotation)
            self._renderers[turned, decoy] = Renderer(self.file.calibration, floor, still, scene.samples)
        return self._renderers[turned, decoy]


def _glaring(image: Image) -> Image:
    """A bright spot with a wide halo over the middle of the picture."""
    height, width = image.shape
    x, y = (np.arange(width) - width / 2) / (0.3 * width), (np.arange(height) - height / 2) / (0.3 * height)
    halo = 500.0 * np.exp(-0.5 * (x[None, :] ** 2 + y[:, None] ** 2))
    return np.clip(image + halo, 0, 255).astype(np.uint8)


def _clutter(count: int, seed: int) -> list[Facet]:
    """Things on the floor that are no markers: boxes, discs, and rings whose radii are those of no code."""
    random, flat, found = np.random.default_rng([seed, 5]), np.eye(3)[:2], []
    for k in range(count):
        centre = np.array([*random.uniform(-1, 1, 2) * _CLUTTER_AREA, 5e-5])
        size, shade = random.uniform(0.02, 0.07), random.uniform(30.0, 220.0)
        rings = np.zeros((0, 5))
        if k % 3 == 0:
            rings = np.array([[0.0, 0.0, 0.9 * size, 0.4 * size, 0.3 * size]])
        found.append(Facet(centre, flat, (size, random.uniform(0.5, 1.0) * size), shade, disc=k % 3 == 1, circles=rings))
    return found
