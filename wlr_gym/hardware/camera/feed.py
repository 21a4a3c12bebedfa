"""True poses of an emulated robot, from its process to the one that films it by rendering: a ring in shared memory."""

from __future__ import annotations

import mmap
import struct
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from wlr_gym.base.errors import InputError
from wlr_gym.perception.scene import ScenePose
from wlr_gym.physics.model.dynamics import rotation_matrix

Array = NDArray[np.float64]

#: Poses that the ring holds.
LENGTH = 512
#: Numbers of a row: time, position, quaternion (w, x, y, z), legs; then per kind of fault its value plus 1, 0 = it is not.
_POSE = 12
FAULT_COLUMNS = 16
_ROW = _POSE + FAULT_COLUMNS
_COUNT = struct.Struct("<Q")


class RobotPose(NamedTuple):
    """Where an emulated robot is.

    Attributes:
        time: s. position: (3,) m. quaternion: (4,) w, x, y, z. legs: (4,) rad.
    """

    time: float
    position: Array
    quaternion: Array
    legs: Array


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
