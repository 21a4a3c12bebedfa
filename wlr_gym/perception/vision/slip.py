"""Slip of every wheel and of the body from the camera's poses and the encoders, with uncertainty; and what the IMU contradicts.

Poses (with IMU and legs, :mod:`wlr_gym.perception.vision.motion`) and joint angles are smoothed onto the run's rows; their
rates give each wheel's slip velocity by :mod:`wlr_gym.robot.slip`.

Three kinds of error are kept apart. Random ones: of frames, IMU and legs, of which the smoother knows the joint covariance of
all slips, and of the offset of the clocks; so heading errors that turn the way driven sideways, and tilts that move the
contacts, are in it. That of the wheels' radius (``tolerances`` of the robot file), and that of the layout of the markers on the
body (its scale and heading): both grow with the distance driven and dominate long drives.

What gyroscope and accelerometer contradict is no motion of the body. Turns are compared as angles. Of each axis the gyroscope's
constant, drift and scale (to 10 %) are left open; of pitch and roll also how the IMU is turned on the body (which shows along
the yaw) and how the floor markers' plane is tilted (along its cosine and sine). Of the accelerometer, starts and stops tell
which of its axes is which.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from wlr_gym.base.errors import InputError
from wlr_gym.data.run_states import quaternion
from wlr_gym.data.runs import Run
from wlr_gym.perception.vision.alignment import joint_signals, readings, without_slow
from wlr_gym.perception.vision.motion import (
    body_rates,
    imu_readings,
    leg_findings,
    leg_readings,
    repeated,
    smooth_motion,
    smoothed_poses,
    without_outliers,
)
from wlr_gym.perception.vision.self_calibration import UNSURE
from wlr_gym.perception.vision.tracking import Sample
from wlr_gym.physics.plants.sensors import rotation
from wlr_gym.robot import LEG_SLICE, WHEELS, Robot
from wlr_gym.robot.parameters import Parameters
from wlr_gym.robot.slip import accumulate, contact_slip_velocity, no_slip_error, rolling_speed, slip_angle, slip_ratio

if TYPE_CHECKING:
    import pandas

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
        off = float(abs(np.median(apart))) if len(apart) >= _TOGETHER else 0.0
        if off > max(LEVEL_ERROR, SIGMAS * float(std[k])):
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


# --- slip ---------------------------------------------------------------------------------------------------------------


LONGEST_GAP = 0.15  # s; rows further than this from a frame with a pose are flagged
_ENCODER_PACE = 20.0  # 1/s; an encoder's error changes over two or three control steps


@dataclass(frozen=True, eq=False)
class SlipResult:
    """Motion and slip at the run's rows that the video covers, (K).

    Attributes:
        time: (K,) s, servo clock.
        pose, pose_std: (K, 6) x, y, z, yaw, pitch, roll of the body in the floor frame, smoothed, 1 sigma. rate: (K, 6).
        slip_velocity: (K, 4, 2) m/s of each wheel's contact along its heading and to its left; slip_velocity_std: 1 sigma.
        slip: (K, 4, 2) m, slip velocity accumulated from the first row. slip_std: 1 sigma, random errors.
        slip_radius_std: (K, 4) m, 1 sigma of the longitudinal slip from the wheel radius.
        slip_layout_std: (K, 4, 2) m, 1 sigma of both from the places of the markers on the body.
        covariance: (8, 8) m2 of the slip at the end, longitudinal and lateral of each wheel in turn: random errors and layout.
        ratio, angle: (K, 4) slip ratio and angle (rad).
        no_slip_error: share of the predicted path that ignoring slip gets wrong (the paper's measure).
        covered: (K,) False where no frame with a pose is near.
        outliers: (F,) samples left out. contradictions: between film, IMU and legs, in words.
    """

    time: Array
    pose: Array
    pose_std: Array
    rate: Array
    slip_velocity: Array
    slip_velocity_std: Array
    slip: Array
    slip_std: Array
    slip_radius_std: Array
    slip_layout_std: Array
    covariance: Array
    ratio: Array
    angle: Array
    no_slip_error: float
    covered: NDArray[np.bool_]
    outliers: NDArray[np.bool_]
    contradictions: tuple[str, ...]

    @property
    def body_slip(self) -> Array:
        """(K, 2) m, accumulated slip of the body: mean over the wheels, along the heading and to the left."""
        return self.slip.mean(axis=1)

    def table(self) -> pandas.DataFrame:
        """One row per run row: time, pose, slip of every wheel and of the body, with 1 sigma."""
        import pandas

        columns: dict[str, Array] = {"t": self.time}
        for k, name in enumerate(("x", "y", "z", "yaw", "pitch", "roll")):
            columns |= {name: self.pose[:, k], f"{name}_std": self.pose_std[:, k], f"{name}_rate": self.rate[:, k]}
        for w, wheel in enumerate(WHEELS):
            for a, axis in enumerate(("longitudinal", "lateral")):
                columns[f"slip_velocity_{axis}_{wheel}"] = self.slip_velocity[:, w, a]
                columns[f"slip_velocity_{axis}_std_{wheel}"] = self.slip_velocity_std[:, w, a]
                columns[f"slip_{axis}_{wheel}"] = self.slip[:, w, a]
                columns[f"slip_{axis}_std_{wheel}"] = self.slip_std[:, w, a]
                columns[f"slip_{axis}_layout_std_{wheel}"] = self.slip_layout_std[:, w, a]
            columns[f"slip_longitudinal_radius_std_{wheel}"] = self.slip_radius_std[:, w]
            columns |= {f"slip_ratio_{wheel}": self.ratio[:, w], f"slip_angle_{wheel}": self.angle[:, w]}
        columns |= {"slip_longitudinal_body": self.body_slip[:, 0], "slip_lateral_body": self.body_slip[:, 1]}
        columns["covered"] = self.covered.astype(float)
        return pandas.DataFrame(columns)


def measure_slip(
    samples: Sequence[Sample],
    offset: float,
    run: Run,
    robot: Robot,
    parameters: Parameters,
    offset_std: float = 0.0,
    layout_std: tuple[float, float] = (0.0, 0.0),
) -> SlipResult:
    """Slip of a run from the samples of its video.

    Args:
        samples: of :func:`wlr_gym.perception.vision.tracking.track`.
        offset: servo time = camera time + offset, s; offset_std: 1 sigma.
        run: encoders. robot: encoder counts, radius tolerance. parameters: (1) geometry.
        layout_std: 1 sigma of the body target's scale and of its heading
            (:class:`wlr_gym.perception.vision.adjustment.Adjustment`).

    Raises:
        InputError: fewer than 10 rows of the run lie within the video.
    """
    seen = np.array([math.isfinite(sample.pose[0]) for sample in samples])
    time = np.array([sample.time for sample in samples]) + offset
    if seen.sum() < 10:
        raise InputError(f"only {int(seen.sum())} frames have a pose; at least 10 are needed")
    rows = run["t"][(run["t"] >= time[seen][0]) & (run["t"] <= time[seen][-1])]
    if len(rows) < 10:
        raise InputError(
            f"{run.path}: {len(rows)} rows lie within the video, which covers {time[seen][0]:.2f} to {time[seen][-1]:.2f} s of "
            "the run's clock; does it belong to this run?"
        )
    joints = joint_signals(run, rows, robot)
    joints[0][:, LEG_SLICE] -= parameters["joint.zero_offset"]
    batch = repeated(parameters, len(rows))
    fine = without_outliers(samples, time)
    agrees, contradictions = imu_compared(fine, offset, run, robot)
    pace = np.sqrt(np.mean(joint_signals(run, run["t"], robot)[1][:, LEG_SLICE] ** 2, axis=1))
    imu = imu_readings(run, pace, robot) if agrees else None
    film, joined = (
        smooth_motion(samples, time, rows, lambda value, rate: _contacts(value, rate, joints, batch)[0], imu, legs)
        for legs in (None, leg_readings(rows, joints, robot, parameters))
    )
    other = list(leg_findings(rows, film, joined, fine))
    motion = film if other else joined
    value, rate = motion.value, motion.rate
    velocity, rolling, no_slip_speed = _contacts(value, rate, joints, batch)
    travel = velocity[:, :, 0] + rolling
    heading_speed = rate[:, 0] * np.cos(value[:, 3]) + rate[:, 1] * np.sin(value[:, 3])
    slip = accumulate(velocity, rows)
    encoder = _encoder_variance(joints[0], robot, parameters)
    late = _contacts(value + offset_std * rate, rate + offset_std * motion.acceleration, joints, batch)[0] - velocity
    late_slip = accumulate(late, rows)
    velocity_std = motion.velocity_variance.reshape(velocity.shape) + late**2
    slip_std = np.diagonal(motion.slip_covariance, axis1=1, axis2=2).reshape(slip.shape) + late_slip**2
    covariance = motion.slip_covariance[-1] + np.outer(late_slip[-1], late_slip[-1])
    sideways = _squared_turns(value[:, 3], joints[0][:, LEG_SLICE], robot) * encoder[:, :, 1]
    counts = np.stack([encoder[:, :, 0] + encoder[0, :, 0], sideways], axis=2)
    velocity_std += np.stack([_ENCODER_PACE**2 * encoder[:, :, 0], rate[:, [3]] ** 2 * encoder[:, :, 1]], axis=2)
    slip_std += counts
    covariance += np.diag(counts[-1].ravel())
    known = robot.tolerances.get("wheel.radius")
    share = 0.0 if known is None else known.share("wheel.radius", robot.wheel.radius)
    side_speed = rate[:, 1] * np.cos(value[:, 3]) - rate[:, 0] * np.sin(value[:, 3])
    way = np.stack([accumulate(heading_speed, rows), accumulate(side_speed, rows)], axis=1)
    for std, shift in zip(layout_std, (way[-1], way[-1, ::-1] * (1, -1)), strict=True):  # the same for all wheels
        covariance += std**2 * np.outer(np.tile(shift, 4), np.tile(shift, 4))
    frames = time[seen]
    after = np.clip(np.searchsorted(frames, rows), 1, len(frames) - 1)
    layout = np.hypot(layout_std[0] * way, layout_std[1] * way[:, ::-1])  # wrong scales err along the way, headings across
    return SlipResult(
        time=rows,
        pose=value,
        pose_std=np.hypot(motion.value_std, offset_std * rate),
        rate=rate,
        slip_velocity=velocity,
        slip_velocity_std=np.sqrt(velocity_std),
        slip=slip,
        slip_std=np.sqrt(slip_std),
        slip_radius_std=share * np.abs(accumulate(rolling, rows)),
        slip_layout_std=np.repeat(layout[:, None], 4, axis=1),
        covariance=covariance,
        ratio=slip_ratio(travel, rolling),
        angle=slip_angle(travel, velocity[:, :, 1]),
        no_slip_error=float(no_slip_error(accumulate(heading_speed, rows)[-1], accumulate(no_slip_speed, rows)[-1])),
        covered=np.minimum(np.abs(rows - frames[after - 1]), np.abs(frames[after] - rows)) < LONGEST_GAP,
        outliers=motion.outliers,
        contradictions=(*contradictions, *other),
    )


def _contacts(value: Array, rate: Array, joints: tuple[Array, Array], batch: Parameters) -> tuple[Array, Array, Array]:
    """Slip velocity (K, 4, 2) and rolling speed (K, 4) of the wheels; and the body's speed (K,) if none of them slipped."""
    yaw, pitch, roll = value[:, 3:].T
    linear = np.einsum("nji,nj->ni", rotation(yaw, pitch, roll), rate[:, :3])
    angular = body_rates(pitch, roll, rate[:, 3:])
    attitude = quaternion(yaw, pitch, roll)
    velocity = contact_slip_velocity(batch, attitude, linear, angular, *joints)
    predicted = contact_slip_velocity(batch, attitude, np.zeros_like(linear), angular, *joints)
    return velocity, rolling_speed(batch, angular, joints[1]), -predicted[:, :, 0].mean(axis=1)


def _encoder_variance(angle: Array, robot: Robot, parameters: Parameters) -> Array:
    """Variance (K, 4, 2) in m2 of a contact's place: along its heading, by the wheel's count at its rim and the leg's at hip
    height; and sideways per radian of a turn, by the leg's: the contact is that much further ahead of the hip."""
    radius, reach = parameters["wheel.radius"], parameters["leg.length"] * np.sin(angle[:, LEG_SLICE])
    arms = np.stack([radius**2 + (reach + radius) ** 2, reach**2], axis=2)
    return arms * robot.sensors.encoder.position**2 / 12


def _squared_turns(yaw: Array, legs: Array, robot: Robot) -> Array:
    """Squares (K, 4) of the turns made while a leg showed one count, whose error is one, summed over the counts."""
    counts = np.rint(legs / robot.sensors.encoder.position) if robot.sensors.encoder.position else legs
    other = np.diff(counts, axis=0, prepend=math.nan) != 0
    since = np.maximum.accumulate(np.where(other, np.arange(len(yaw))[:, None], 0), axis=0)
    before = np.concatenate([since[:1], since[:-1]])
    finished = np.cumsum(np.where(other, (yaw[:, None] - yaw[before]) ** 2, 0.0), axis=0)
    return finished + (yaw[:, None] - yaw[since]) ** 2
