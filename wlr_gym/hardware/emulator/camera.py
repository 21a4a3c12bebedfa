"""A camera over an emulated robot in emulated time: frames arrive exactly when they should; a run gives the same bits again."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from pathlib import Path

import numpy as np

from wlr_gym.hardware.camera.process import FrameReader
from wlr_gym.hardware.camera.reading import CAMERA_FAULTS, CameraFile, CameraReading
from wlr_gym.hardware.camera.rendered import Exposure, PoseFeed, RenderedCamera, RobotPose
from wlr_gym.hardware.emulator.machine import Machine
from wlr_gym.robot import LEG_SLICE

#: s between two poses in the feed of an emulated robot in real time.
FEED_PERIOD = 0.002
#: s of poses that are kept for pictures that are old.
_REMEMBERED = 0.6


def true_pose(machine: Machine) -> RobotPose:
    """Return where an emulated robot is."""
    truth = machine.plant.truth()
    legs = truth.joint_position[0, LEG_SLICE].copy()
    return RobotPose(machine.time, truth.position[0].copy(), truth.quaternion[0].copy(), legs)


def camera_fault(machine: Machine, kind: str) -> float | None:
    """Return the value of a fault of the camera that holds now; None = it does not."""
    fault = machine.faults.active(machine.time, kind, ["camera"])
    return None if fault is None else fault.value


class EmulatedCamera:
    """See :class:`wlr_gym.hardware.camera.reading.CameraReader`. Its machine calls :meth:`look` at every tick."""

    def __init__(self, machine: Machine, file: CameraFile) -> None:
        self.machine, self.file = machine, file
        self._camera = RenderedCamera(file, machine.robot, lambda kind: camera_fault(machine, kind))
        self._reader = FrameReader(file)
        self._poses: deque[RobotPose] = deque(maxlen=max(2, round(_REMEMBERED / machine.options.tick)))
        self._due: deque[tuple[Exposure, list[RobotPose]]] = deque()
        self._number = 0
        self._next: Exposure | None = None
        self._is_dead = False

    def open(self) -> None:
        """Begin with the next frame."""
        self._number = int(self.machine.time * self.file.rate) + 1
        self._next = self._camera.exposure(self._number)
        self.machine.watchers.append(self.look)

    def close(self) -> None:
        """End."""
        if self.look in self.machine.watchers:
            self.machine.watchers.remove(self.look)

    def look(self) -> None:
        """Take a tick: remember where the robot is, and expose the frame whose time has come."""
        self._poses.append(true_pose(self.machine))
        now = self.machine.time
        self._is_dead = self._is_dead or camera_fault(self.machine, "camera_dead") is not None
        while self._next is not None and self._next.time + self.file.emulated.exposure < now:
            self._due.append((self._next, [self._at(time) for time in self._camera.instants(self._next)]))
            self._number += 1
            self._next = self._camera.exposure(self._number)

    def read(self, now: float) -> CameraReading | None:
        """Return the newest reading that is there; the frames before it are looked at, too, as on the robot."""
        reading = None
        while self._due and self._due[0][0].arrival <= now + 1e-9:
            exposure, poses = self._due.popleft()
            if not (exposure.is_lost or self._is_dead):
                image = self._camera.picture(exposure, poses)
                reading = self._reader.read(exposure.number, image, exposure.stamp, exposure.arrival, exposure.arrival)
        return reading

    def _at(self, time: float) -> RobotPose:
        """The pose of the tick nearest to a time."""
        return min(self._poses, key=lambda pose: abs(pose.time - time))

    @property
    def trouble(self) -> str:
        """Why no reading will come any more; empty = nothing is known of that."""
        return "the camera process has ended (exit code -9)" if self._is_dead else ""


class FeedWriter:
    """Writes the true pose of an emulated robot, and the faults of its camera, into a feed.

    Args:
        machine: the robot. path: of the feed's file, which is made.
        offset: returns this computer's monotonic clock minus emulated time, s.
    """

    def __init__(self, machine: Machine, path: Path, offset: Callable[[], float]) -> None:
        self._machine, self._feed, self._last = machine, PoseFeed(path, create=True), -np.inf
        self._offset = offset

    def __call__(self) -> None:
        """Take a tick."""
        machine = self._machine
        if machine.time < self._last + FEED_PERIOD - 1e-9:
            return
        self._last = machine.time
        values = (camera_fault(machine, kind) for kind in CAMERA_FAULTS)
        faults = np.array([0.0 if value is None else value + 1.0 for value in values])
        self._feed.write(true_pose(machine)._replace(time=machine.time + self._offset()), faults)
