"""What ``wlr doctor`` looks at in a camera before it is driven with: frames, rate, age, floor and robot."""

from __future__ import annotations

from collections import Counter

import numpy as np

from wlr_gym.base.errors import InputError
from wlr_gym.hardware.camera.config import CameraFile
from wlr_gym.hardware.camera.live import LiveCamera
from wlr_gym.hardware.camera.reading import CameraReader, CameraReading
from wlr_gym.hardware.safety.camera import LARGEST_AGE, LARGEST_SIGMA
from wlr_gym.hardware.safety.check import Check
from wlr_gym.hardware.timing import Clock
from wlr_gym.perception.vision.live_pose import MEANINGS, NO_FLOOR

#: s for which the camera is looked at, and between two looks.
_TIME, _LOOK = 1.5, 0.005
#: Part of the frames asked for that must come, and of those with a floor that must show the robot.
_LEAST_RATE, _LEAST_POSES = 0.8, 0.8
_REMEDIES = {
    "rate": "Lower the resolution or the exposure time, or write the rate that comes into the camera's file (rate).",
    "shutter": "Calibrate from a video of a moving board, or write its readout (s; 0 = global shutter) into that file.",
    "floor": "Are all floor markers in the picture, flat, lit, and where the floor's file says?",
    "robot": "Is the robot in the picture, its plate on, and its markers as the body's file says?",
    "age": "Use USB 3, fewer pixels, a shorter exposure; find out who else uses the computer.",
    "accuracy": "Bring the camera nearer, use more pixels, focus it, or print larger markers.",
}


def check_camera(camera: CameraReader, file: CameraFile, clock: Clock) -> list[Check]:
    """Return the checks of a camera, which is opened for them; closing the link closes it.

    Only a camera without frames is a fault; a robot drives without poses.
    """
    where = f"camera {file.name}"
    try:
        camera.open()
    except InputError as error:
        return [
            Check(where, "frames", False, str(error), "a camera that gives frames", "Check its plug, number and user group.")
        ]
    readings = _listen(camera, clock)
    checks = [Check(where, "frames", bool(readings), f"{len(readings)} in {_TIME:g} s", "frames", "Check its plug.")]
    if not readings:
        return checks
    rate = len(readings) / _TIME
    checks.append(_warning(where, "rate", rate >= _LEAST_RATE * file.rate, f"{rate:.1f} per second", f"{file.rate:g}"))
    age = float(np.median([reading.found - reading.time for reading in readings]))
    stamps = f" (dated by {camera.stamps})" if isinstance(camera, LiveCamera) else ""
    checks.append(
        _warning(where, "age", age < LARGEST_AGE / 2, f"{1e3 * age:.0f} ms{stamps}", f"< {1e3 * LARGEST_AGE / 2:.0f} ms")
    )
    found = file.doubt or f"readout {1e3 * (file.calibration.readout or 0.0):g} ms"
    checks.append(_warning(where, "shutter", not file.doubt, found, "its readout"))
    return [*checks, *_check_poses(where, readings)]


def _listen(camera: CameraReader, clock: Clock) -> list[CameraReading]:
    readings, end = [], clock.now() + _TIME
    while clock.now() < end:
        if (reading := camera.read(clock.now())) is not None:
            readings.append(reading)
        clock.wait_until(clock.now() + _LOOK)
    return readings


def _check_poses(where: str, readings: list[CameraReading]) -> list[Check]:
    located = [reading for reading in readings if reading.status != NO_FLOOR]
    checks = [_warning(where, "floor", bool(located), "found" if located else MEANINGS[NO_FLOOR], "its markers found")]
    if not located:
        return checks
    seen = [reading for reading in located if reading.has_pose]
    lost = Counter(MEANINGS.get(reading.status, reading.status) for reading in located if not reading.has_pose)
    found = f"in {len(seen)} of {len(located)} frames" + "".join(f"; {why}: {count}" for why, count in lost.most_common())
    checks.append(_warning(where, "robot", len(seen) >= _LEAST_POSES * len(located), found, "seen in all"))
    if seen:
        sigma = np.sqrt(np.median([np.diag(reading.covariance) for reading in seen], axis=0))
        text = f"{1e3 * max(sigma[:2]):.2f} mm, {sigma[3]:.4f} rad (1 sigma)"
        is_sharp = max(sigma[:2]) < LARGEST_SIGMA[0] / 2 and sigma[3] < LARGEST_SIGMA[1] / 2
        checks.append(
            _warning(where, "accuracy", bool(is_sharp), text, f"{500 * LARGEST_SIGMA[0]:g} mm, {LARGEST_SIGMA[1] / 2:g} rad")
        )
    return checks


def _warning(where: str, what: str, ok: bool, found: str, expected: str) -> Check:
    return Check(where, what, ok, found, expected, _REMEDIES[what], False)
