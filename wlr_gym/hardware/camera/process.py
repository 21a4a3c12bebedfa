"""The process that takes frames and finds poses in them: ``python -m wlr_gym.hardware.camera.process``.

It reads one line of JSON (camera, robot, feed), answers ``ready`` once the camera gives a frame, or ``error: why``, and then
writes a packed reading for each frame, until its standard input ends. A process of its own: neither a slow picture nor a driver
that hangs can hold up a control step, and it runs at a lower priority than the loop. It never waits for the loop, either: what
the pipe has no room for is lost.
"""

from __future__ import annotations

import contextlib
import json
import os
import select
import signal
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

from wlr_gym.base.errors import InputError, require_package
from wlr_gym.hardware.camera.reading import CAMERA_FAULTS, CameraFile, StampClock, pack, reading_of
from wlr_gym.hardware.camera.rendered import PoseFeed, RenderedCamera
from wlr_gym.perception.markers.detection import Image
from wlr_gym.perception.vision.tracking import PoseFinder, VideoFrame
from wlr_gym.perception.vision.video import grey, open_device
from wlr_gym.robot import Robot

#: How much less urgent than the control loop it is.
_NICE = 5
#: s without a frame from the driver after which the camera counts as gone.
_GONE = 2.0


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


def rendered_frames(file: CameraFile, robot: Robot, feed: PoseFeed) -> Iterator[Taken | None]:
    """Yield frames of an emulated robot at the pace of the clock; those that take too long to render are left out."""

    def fault(kind: str) -> float | None:
        last = feed.last()
        value = 0.0 if last is None else float(last[1][list(CAMERA_FAULTS).index(kind)])
        return value - 1.0 if value > 0.0 else None

    camera = RenderedCamera(file, robot, fault)
    while feed.last() is None:
        time.sleep(0.01)
        yield None
    number = int(time.monotonic() * file.rate) + 1
    while True:
        exposure = camera.exposure(number)
        if (wait := exposure.time + file.emulated.exposure - time.monotonic()) > 0.0:
            time.sleep(wait)
        if fault("camera_dead") is not None:
            os.kill(os.getpid(), signal.SIGKILL)
        poses = [pose for instant in camera.instants(exposure) if (pose := feed.at(instant)) is not None]
        if exposure.is_lost or not poses:
            yield None
        else:
            image = camera.picture(exposure, poses)
            if (wait := exposure.arrival - time.monotonic()) > 0.0:
                time.sleep(wait)
            yield Taken(image, exposure.stamp, time.monotonic())
        number = max(number + 1, int(time.monotonic() * file.rate))


def frames_of_film(file: CameraFile) -> Iterator[Taken | None]:
    """Yield the pictures of a recorded film over and over, at the camera's rate.

    Raises:
        InputError: it cannot be read.
    """
    import numpy as np

    rate = file.rate
    try:
        film = np.load(Path(str(file.device)))
    except (OSError, ValueError) as error:
        raise InputError(f"camera {file.device}: no film: {error}") from None
    number = int(time.monotonic() * rate) + 1
    while True:
        if (wait := number / rate - time.monotonic()) > 0.0:
            time.sleep(wait)
        yield Taken(np.array(film[number % len(film)]), number / rate, time.monotonic())
        number = max(number + 1, int(time.monotonic() * rate))


def serve(frames: Iterator[Taken | None], file: CameraFile) -> None:
    """Find poses and hand them on until the standard input ends.

    Raises:
        InputError: see :func:`frames_of_device`.
    """
    finder, clock = PoseFinder(file.calibration, file.body, file.floor), StampClock(file.delay)
    number = 0
    for taken in frames:
        if select.select([sys.stdin], [], [], 0.0)[0]:
            return
        if taken is None:
            continue
        number += 1
        moment = clock.time(taken.stamp, taken.arrival)
        sample = finder(VideoFrame(number, moment, taken.image))
        reading = reading_of(sample, number, taken.arrival, time.monotonic())
        if number == 1:
            _answer(f"ready {clock.source}")
            os.set_blocking(sys.stdout.fileno(), False)
        with contextlib.suppress(BlockingIOError):
            os.write(sys.stdout.fileno(), pack(reading))  # shorter than PIPE_BUF: whole, or not at all


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
