"""The process that takes frames and finds poses in them: ``python -m wlr_gym.hardware.camera.process``.

It reads one line of JSON (camera, robot, feed), answers ``ready`` once the camera gives a frame, or ``error: why``, and then
writes a packed reading for each frame, until its standard input ends. A process of its own: neither a slow picture nor a driver
that hangs can hold up a control step, and it runs at a lower priority than the loop. It never waits for the loop, either: what
the pipe has no room for is lost.
"""

from __future__ import annotations

import contextlib
import json
import math
import os
import select
import signal
import sys
import time
from collections import deque
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

from wlr_gym.base.errors import InputError, require_package
from wlr_gym.hardware.camera.reading import CAMERA_FAULTS, CameraFile, CameraReading
from wlr_gym.hardware.camera.rendered import PoseFeed, RenderedCamera
from wlr_gym.hardware.timing import MonotonicClock
from wlr_gym.perception.markers.detection import Image
from wlr_gym.perception.vision.tracking import MEANINGS, PoseFinder, VideoFrame
from wlr_gym.perception.vision.video import grey, open_device
from wlr_gym.robot import Robot

#: How much less urgent than the control loop it is.
_NICE = 5
#: s without a frame from the driver after which the camera counts as gone.
_GONE = 2.0


# ---- when a frame was exposed, and where the robot is in it ----


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


class FrameReader:
    """Finds the robot in the frames of a camera, in the order in which they come; ``clock`` tells when each was exposed."""

    def __init__(self, file: CameraFile) -> None:
        self.clock: StampClock = StampClock(file.delay)
        self._finder = PoseFinder(file.calibration, file.body, file.floor)

    def read(self, number: int, image: Image, stamp: float, arrival: float, found: float | None = None) -> CameraReading:
        """Return the reading of a frame that the driver dates ``stamp`` (s, 0 = not) and that came at ``arrival`` (s).

        ``found`` (s) is when its pose is there; None = now.
        """
        sample = self._finder(VideoFrame(number, self.clock.time(stamp, arrival), image))
        found, reason = time.monotonic() if found is None else found, MEANINGS.get(sample.status, "")
        return CameraReading(number, sample.time, arrival, found, reason, sample.pose, sample.covariance)


# ---- frames ----


class Taken(NamedTuple):
    """A frame of the driver: the picture, its time stamp (s, 0 = none), and when it was there (s, monotonic clock)."""

    image: Image
    stamp: float
    arrival: float


def frames_of_device(file: CameraFile) -> Iterator[Taken | None]:
    """Yield the frames of a camera; None where one could not be taken.

    Raises:
        InputError: it cannot be opened, is gone, or gives pictures of another size.
    """
    import cv2

    capture = open_device(file.device, file.calibration)
    capture.set(cv2.CAP_PROP_FPS, file.rate)
    capture.set(cv2.CAP_PROP_BUFFERSIZE, 1)  # the newest frame, not the oldest that waits
    last = time.monotonic()
    try:
        while True:
            grabbed = capture.grab()
            arrival = time.monotonic()
            decoded, image = capture.retrieve() if grabbed else (False, None)
            if decoded:
                last = arrival
                yield Taken(grey(image), capture.get(cv2.CAP_PROP_POS_MSEC) / 1e3, arrival)
            elif arrival - last > _GONE:
                raise InputError(f"camera {file.device}: gives no more frames; was it unplugged?")
            else:
                time.sleep(0.01)
                yield None
    finally:
        capture.release()


def due_frames(rate: float) -> Iterator[int]:
    """Yield the numbers of the frames that are due by this computer's clock; those for which there was no time are left out."""
    number = int(time.monotonic() * rate) + 1
    while True:
        yield number
        number = max(number + 1, int(time.monotonic() * rate))


def rendered_frames(file: CameraFile, robot: Robot, feed: PoseFeed) -> Iterator[Taken | None]:
    """Yield frames of an emulated robot at the pace of the clock; those that take too long to render are left out."""
    clock = MonotonicClock()

    def fault(kind: str) -> float | None:
        last = feed.last()
        value = 0.0 if last is None else float(last[1][list(CAMERA_FAULTS).index(kind)])
        return value - 1.0 if value > 0.0 else None

    camera = RenderedCamera(file, robot, fault)
    while feed.last() is None:
        time.sleep(0.01)
        yield None
    for number in due_frames(file.rate):
        exposure = camera.exposure(number)
        clock.wait_until(exposure.time + file.emulated.exposure)
        if fault("camera_dead") is not None:
            os.kill(os.getpid(), signal.SIGKILL)
        poses = [pose for instant in camera.instants(exposure) if (pose := feed.at(instant)) is not None]
        if exposure.is_lost or not poses:
            yield None
        else:
            image = camera.picture(exposure, poses)
            clock.wait_until(exposure.arrival)
            yield Taken(image, exposure.stamp, time.monotonic())


def frames_of_film(file: CameraFile) -> Iterator[Taken | None]:
    """Yield the pictures of a recorded film over and over, at the camera's rate.

    Raises:
        InputError: it cannot be read.
    """
    import numpy as np

    try:
        film = np.load(Path(str(file.device)))
    except (OSError, ValueError) as error:
        raise InputError(f"camera {file.device}: no film: {error}") from None
    for number in due_frames(file.rate):
        MonotonicClock().wait_until(number / file.rate)
        yield Taken(np.array(film[number % len(film)]), number / file.rate, time.monotonic())


def serve(frames: Iterator[Taken | None], file: CameraFile) -> None:
    """Find poses and hand them on until the standard input ends.

    Raises:
        InputError: see :func:`frames_of_device`.
    """
    reader, number = FrameReader(file), 0
    for taken in frames:
        if select.select([sys.stdin], [], [], 0.0)[0]:
            return
        if taken is None:
            continue
        number += 1
        reading = reader.read(number, *taken)
        if number == 1:
            _answer(f"ready {reader.clock.source}")
            os.set_blocking(sys.stdout.fileno(), False)
        with contextlib.suppress(BlockingIOError):
            os.write(sys.stdout.fileno(), reading.pack())  # shorter than PIPE_BUF: whole, or not at all


def main() -> int:
    """Run the process; 0 = it was told to end, 1 = the camera failed."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # a Ctrl-C at the terminal is for the driving process
    spec: dict[str, Any] = json.loads(sys.stdin.readline())
    with contextlib.suppress(OSError):
        os.nice(_NICE)
    try:
        require_package("cv2", "vision")
        import cv2

        cv2.setNumThreads(1)
        file = CameraFile.model_validate(spec["camera"])
        if file.is_film:
            frames = frames_of_film(file)
        elif spec.get("feed"):
            frames = rendered_frames(file, Robot.model_validate(spec["robot"]), PoseFeed(Path(spec["feed"])))
        else:
            frames = frames_of_device(file)
        serve(frames, file)
    except InputError as error:
        _answer(f"error: {error}")
        return 1
    return 0


def _answer(text: str) -> None:
    print(" ".join(text.split()), flush=True)


if __name__ == "__main__":
    sys.exit(main())
