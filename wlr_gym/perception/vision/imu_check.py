"""Hold a film's turns and tilts against the IMU: what gyroscope and accelerometer contradict is no motion of the body.

Turns are compared as angles. Of each axis the gyroscope's constant, drift and scale (to 10 %) are left open; of pitch and roll
also how the IMU is turned on the body (which shows along the yaw) and how the floor markers' plane is tilted (along its cosine
and sine). Of the accelerometer, starts and stops tell which of its axes is which.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from wlr_gym.data.runs import Run
from wlr_gym.perception.vision.alignment import readings, without_slow
from wlr_gym.perception.vision.motion import smoothed_poses
from wlr_gym.perception.vision.self_calibration import UNSURE
from wlr_gym.perception.vision.tracking import Sample
from wlr_gym.physics.plants.sensors import rotation
from wlr_gym.robot import Robot
from wlr_gym.robot.slip import accumulate

Array = NDArray[np.float64]

#: rad, and sigmas of a frame, by which turn and tilt may differ from the gyroscope's.
TURN_ERROR, TILT_ERROR, SIGMAS = 0.006, 0.012, 6.0
#: rad by which the tilt at rest may differ from the accelerometer's: floors are level to 1 cm per metre, IMUs mounted as well.
LEVEL_ERROR = 0.025
_AT_REST = 0.03  # rad/s of any axis, and m/s2 about the gravity
_FEWEST = 30
_TOGETHER = 5  # frames over which a difference is averaged
_GRAVITY = 9.80665
#: By which a gyroscope's scale may be off; m/s2 by which the median size of the specific force may differ from gravity.
_SCALE_ERROR, _SIZE_ERROR = 0.1, 1.0
#: s; changes of speed with a longer period are the accelerometer's bias, and legs that shake it. How many times better another
#: axis must explain those that the film shows.
_SLOW, _BETTER = 1.0, 2.0


@dataclass(frozen=True)
class TurnDifference:
    """Where film and IMU differ most about one axis: ``yaw``, ``pitch``, ``roll``; time s (servo clock); size rad.

    ``level``: it is the tilt at rest, against the accelerometer; else the turn, against the gyroscope.
    """

    axis: str
    time: float
    size: float
    level: bool = False


def imu_differences(samples: Sequence[Sample], offset: float, run: Run, robot: Robot) -> Iterator[TurnDifference]:
    """Yield what of a film's attitude the IMU contradicts.

    Args:
        samples: of the film. offset: servo time minus camera time, s. run: with gyroscope; without one nothing is compared.
        robot: its IMU's bandwidth delays what it says.
    """
    t = run["t"] - 1 / (2 * math.pi * robot.sensors.imu.bandwidth)
    seen, gyro = _comparable(samples, offset, run, t), _readings(run, "gyro")
    if not seen or gyro is None:
        return
    time = np.array([sample.time for sample in seen]) + offset
    film = np.unwrap(np.stack([sample.pose[3:] for sample in seen]), axis=0)
    own = np.sqrt([np.diag(sample.covariance)[3:] for sample in seen])
    std = np.median(own, axis=0)
    pitch, roll = (np.interp(t, time, film[:, k]) for k in (1, 2))
    turned = np.stack([np.interp(time, t, accumulate(rate, t)) for rate in _angle_rates(gyro, pitch, roll)], axis=1)
    free = [np.ones(len(time)), time]
    for k, axis in enumerate(("yaw", "pitch", "roll")):
        known = np.column_stack(free if k == 0 else [*free, turned[:, 0], np.cos(film[:, 0]), np.sin(film[:, 0])])
        # what is left of both turns without that, and of the film's without the gyroscope's, of a scale near 1
        left, by_gyro = _rest(film[:, k], known), _rest(turned[:, k], known)
        scale = float(left @ by_gyro) / max(float(by_gyro @ by_gyro), 1e-12)
        rest = left - float(np.clip(scale, 1.0 - _SCALE_ERROR, 1.0 + _SCALE_ERROR)) * by_gyro
        limit = np.maximum(TILT_ERROR if k else TURN_ERROR, SIGMAS * np.maximum(own[:, k], std[k]))
        rest, limit = (np.convolve(a, np.full(_TOGETHER, 1 / _TOGETHER), mode="valid") for a in (rest, limit))
        worst = int(np.argmax(np.abs(rest) / limit))
        if abs(rest[worst]) > limit[worst]:
            yield TurnDifference(axis, float(time[worst + _TOGETHER // 2]), float(abs(rest[worst])))
    force = _readings(run, "acc")
    if force is None:
        return
    # the tilt while the robot rests, against the direction of gravity
    still = np.abs(np.linalg.norm(force, axis=1) - _GRAVITY) < 10 * _AT_REST
    rests = np.interp(time, t, (still & (np.abs(gyro).max(axis=1) < _AT_REST)).astype(float)) == 1.0
    x, y, z = force.T
    for k, (axis, tilt) in enumerate((("pitch", np.arctan2(-x, np.hypot(y, z))), ("roll", np.arctan2(y, z))), start=1):
        apart = (film[:, k] - np.interp(time, t, tilt))[rests]
        if len(apart) >= _TOGETHER and (off := float(abs(np.median(apart)))) > max(LEVEL_ERROR, SIGMAS * float(std[k])):
            yield TurnDifference(axis, float(time[rests][len(apart) // 2]), off, level=True)


def imu_compared(samples: Sequence[Sample], offset: float, run: Run, robot: Robot) -> tuple[bool, list[str]]:
    """Whether film and IMU can be compared and do not differ; and how they differ, in words."""
    differences = list(imu_findings(samples, offset, run, robot))
    return bool(_comparable(samples, offset, run, run["t"])) and not differences, differences


def imu_findings(samples: Sequence[Sample], offset: float, run: Run, robot: Robot) -> Iterator[str]:
    """What of a film the IMU contradicts, in words."""
    if (force := _readings(run, "acc")) is not None:
        size = math.copysign(float(np.median(np.linalg.norm(force, axis=1))), float(np.median(force[:, 2])))
        if abs(size - _GRAVITY) > _SIZE_ERROR:
            wrong = f"the accelerometer reads {size:.1f} m/s2 (median), expected 9.8"
            yield f"{wrong}: wrong unit, sign or sensor; the IMU is not used"
    for channel, shown, time in wrong_axes(samples, offset, run, robot):
        yield (
            f"the film shows {shown} where the log has {channel}, most at {time:.2f} s: axes swapped, or a wrong sign; correct "
            "the log's columns (x ahead, y to the left, z up: +9.8 at rest); the IMU is not used"
        )
    for difference in imu_differences(samples, offset, run, robot):
        size, axis, when = f"{1e3 * difference.size:.0f} mrad", difference.axis, f"most at {difference.time:.2f} s"
        if difference.level:
            yield (
                f"at rest the {axis} differs from the accelerometer's by {size}: floor markers not level, a plate or an IMU "
                "that is tilted, or a wrong calibration"
            )
        elif axis == "yaw":
            yield (
                f"camera and gyroscope see turns that differ by {size}, {when}: frame times that jump (frames dropped without "
                f"a trace?), or a wrong run; {UNSURE}"
            )
        else:
            yield (
                f"the {axis} differs from the gyroscope's by {size}, {when}: a marker that gives way, a wrong readout or frame "
                f"times that jump; {UNSURE}"
            )


def _comparable(samples: Sequence[Sample], offset: float, run: Run, t: Array) -> list[Sample]:
    """Samples with a pose within the gyroscope's times; none where they are too few or there is no gyroscope."""
    seen = [sample for sample in samples if math.isfinite(sample.pose[0]) and t[0] < sample.time + offset < t[-1]]
    return seen if _readings(run, "gyro") is not None and len(seen) >= _FEWEST else []


def wrong_axes(samples: Sequence[Sample], offset: float, run: Run, robot: Robot) -> Iterator[tuple[str, str, float]]:
    """Yield each axis of the accelerometer that another one, or its opposite, would explain the film better.

    That is its channel, what the film shows instead (``-acc_x``), and the time (s, servo clock) where they differ most.
    """
    t = run["t"] - 1 / (2 * math.pi * robot.sensors.imu.bandwidth)
    seen, force = _comparable(samples, offset, run, t), _readings(run, "acc")
    if not seen or force is None:
        return
    time = np.array([sample.time for sample in seen]) + offset
    inside = (t > time[0]) & (t < time[-1])
    moved = smoothed_poses(seen, time, t[inside])
    value, change = (np.stack([getattr(signal, name) for signal in moved], axis=1) for name in ("value", "acceleration"))
    pushed = np.einsum("kji,kj->ki", rotation(*value[:, 3:].T), change[:, :3] + [0.0, 0.0, _GRAVITY])
    project = without_slow(t[inside], _SLOW)
    film, x, y = (project(accumulate(v, t[inside])) for v in (pushed, *force[inside, :2].T))
    for k, channel in enumerate(("acc_x", "acc_y")):
        rest = {name: film[:, k] - speed for name, speed in (("acc_x", x), ("-acc_x", -x), ("acc_y", y), ("-acc_y", -y))}
        best = min(rest, key=lambda name: float(np.linalg.norm(rest[name])))
        if _BETTER * np.linalg.norm(rest[best]) < np.linalg.norm(rest[channel]):
            yield channel, best, float(t[inside][np.argmax(np.abs(rest[channel]))])


def _readings(run: Run, name: str) -> Array | None:
    """Readings (T, 3) of gyroscope or accelerometer; None where one of its axes has too few."""
    columns = [column for axis in "xyz" if (column := readings(run, f"{name}_{axis}")) is not None]
    return np.stack(columns, axis=1) if len(columns) == 3 else None


def _angle_rates(gyro: Array, pitch: Array, roll: Array) -> Array:
    """Rates (3, K) of yaw, pitch and roll from body rates (K, 3); the inverse of a body's rates from its angles."""
    x, y, z = gyro.T
    about = y * np.sin(roll) + z * np.cos(roll)
    return np.stack([about / np.cos(pitch), y * np.cos(roll) - z * np.sin(roll), x + about * np.tan(pitch)])


def _rest(values: Array, known: Array) -> Array:
    size = np.maximum(np.linalg.norm(known, axis=0), 1e-12)
    return values - known @ (np.linalg.lstsq(known / size, values, rcond=1e-6)[0] / size)
