"""Slip of every wheel and of the body from the camera's poses and the encoders, with uncertainty.

Poses and joint angles are smoothed onto the run's rows; their rates give each wheel's slip velocity by :mod:`wlr_gym.slip`.
Two kinds of error are kept apart: random ones (camera, encoders), which the covariances give, and that of the wheels' radius
(``tolerances`` of the robot file), which grows with the distance rolled and dominates long drives.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from wlr_gym.errors import InputError
from wlr_gym.parameters import Parameters
from wlr_gym.robot import CORNER_SIGNS, WHEELS, Robot
from wlr_gym.runs.anchor import quaternion, rotation
from wlr_gym.runs.read import Run
from wlr_gym.slip import accumulate, contact_slip_velocity, no_slip_error, rolling_speed, slip_angle, slip_ratio
from wlr_gym.vision.align import joint_signals, repeated
from wlr_gym.vision.smooth import smooth
from wlr_gym.vision.track import Sample

if TYPE_CHECKING:
    import pandas

Array = NDArray[np.float64]

#: s; rows further than this from a frame with a pose are flagged.
LONGEST_GAP = 0.15
#: Deviations from its neighbours (m, rad) from which on a pose can be an outlier.
_JUMP = (0.01, 0.01, 0.01, 0.03, 0.05, 0.05)


@dataclass(frozen=True, eq=False)
class SlipResult:
    """Motion and slip at the run's rows that the video covers, (K).

    Attributes:
        time: (K,) s, servo clock.
        pose, pose_std: (K, 6) x, y, z, yaw, pitch, roll of the body in the floor frame, smoothed, 1 sigma. rate: (K, 6).
        slip_velocity: (K, 4, 2) m/s of each wheel's contact along its heading and to its left; slip_velocity_std: 1 sigma.
        slip: (K, 4, 2) m, slip velocity accumulated from the first row. slip_std: 1 sigma, random errors.
        slip_radius_std: (K, 4) m, 1 sigma of the longitudinal slip from the wheel radius.
        ratio, angle: (K, 4) slip ratio and angle (rad).
        no_slip_error: share of the predicted path that ignoring slip gets wrong (the paper's measure).
        covered: (K,) False where no frame with a pose is near.
        outliers: (F,) samples left out.
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
    ratio: Array
    angle: Array
    no_slip_error: float
    covered: NDArray[np.bool_]
    outliers: NDArray[np.bool_]

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
            columns[f"slip_longitudinal_radius_std_{wheel}"] = self.slip_radius_std[:, w]
            columns |= {f"slip_ratio_{wheel}": self.ratio[:, w], f"slip_angle_{wheel}": self.angle[:, w]}
        columns |= {"slip_longitudinal_body": self.body_slip[:, 0], "slip_lateral_body": self.body_slip[:, 1]}
        columns["covered"] = self.covered.astype(float)
        return pandas.DataFrame(columns)


def measure_slip(samples: Sequence[Sample], offset: float, run: Run, robot: Robot, parameters: Parameters) -> SlipResult:
    """Slip of a run from the samples of its video.

    Args:
        samples: of :func:`wlr_gym.vision.track.track`. offset: servo time = camera time + offset, s.
        run: encoders. robot: encoder counts, radius tolerance. parameters: (1) geometry.

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
    value, rate, value_std, rate_std, outliers = smoothed_poses(samples, time, rows)
    joints = joint_signals(run, rows, robot)
    angle = joints[0].copy()
    angle[:, :4] -= parameters["joint.zero_offset"]
    batch = repeated(parameters, len(rows))
    yaw, pitch, roll = value[:, 3], value[:, 4], value[:, 5]
    turn = rotation(yaw, pitch, roll)
    linear = np.einsum("nji,nj->ni", turn, rate[:, :3])
    angular = _body_rates(pitch, roll, rate[:, 3:])
    attitude = quaternion(yaw, pitch, roll)
    velocity = contact_slip_velocity(batch, attitude, linear, angular, angle, joints[1])
    rolling = rolling_speed(batch, angular, joints[1])
    travel = velocity[:, :, 0] + rolling
    predicted = contact_slip_velocity(batch, attitude, np.zeros_like(linear), angular, angle, joints[1])
    no_slip_speed = -predicted[:, :, 0].mean(axis=1)
    heading_speed = rate[:, 0] * np.cos(yaw) + rate[:, 1] * np.sin(yaw)
    covered = np.abs(rows[:, None] - time[seen][None]).min(axis=1) < LONGEST_GAP
    contact = _contact_offsets(batch, angle)
    velocity_std, slip_std = _uncertainty(value_std, rate_std, contact, value, robot, parameters)
    tolerance = robot.tolerances.get("wheel.radius", 0.0)
    share = tolerance if isinstance(tolerance, float) else 0.0
    return SlipResult(
        time=rows,
        pose=value,
        pose_std=value_std,
        rate=rate,
        slip_velocity=velocity,
        slip_velocity_std=velocity_std,
        slip=accumulate(velocity, rows),
        slip_std=slip_std,
        slip_radius_std=share * np.abs(accumulate(rolling, rows)),
        ratio=slip_ratio(travel, rolling),
        angle=slip_angle(travel, velocity[:, :, 1]),
        no_slip_error=float(no_slip_error(accumulate(heading_speed, rows)[-1], accumulate(no_slip_speed, rows)[-1])),
        covered=covered,
        outliers=outliers,
    )


def smoothed_poses(samples: Sequence[Sample], time: Array, at: Array) -> tuple[Array, Array, Array, Array, NDArray[np.bool_]]:
    """Poses, rates and 1 sigma of both, each (K, 6), at the times ``at``; and which samples are outliers (F,)."""
    poses = np.stack([sample.pose for sample in samples])
    std = np.sqrt(np.stack([np.diag(sample.covariance) for sample in samples]))
    known = np.isfinite(poses[:, 3])
    poses[known, 3] = np.unwrap(poses[known, 3])
    outliers = np.zeros(len(samples), bool)
    for k in range(6):
        outliers |= smooth(time, poses[:, k], std[:, k], time[:1], _JUMP[k]).outliers
    poses[outliers] = np.nan
    found = [smooth(time, poses[:, k], std[:, k], at) for k in range(6)]
    columns = (np.stack([getattr(f, name) for f in found], axis=1) for name in ("value", "rate", "value_std", "rate_std"))
    return (*columns, outliers)  # type: ignore[return-value]


def _body_rates(pitch: Array, roll: Array, rates: Array) -> Array:
    """Angular velocity in the body frame (K, 3) from rates of yaw, pitch, roll (K, 3)."""
    yaw_rate, pitch_rate, roll_rate = rates.T
    x = roll_rate - yaw_rate * np.sin(pitch)
    y = pitch_rate * np.cos(roll) + yaw_rate * np.cos(pitch) * np.sin(roll)
    z = yaw_rate * np.cos(pitch) * np.cos(roll) - pitch_rate * np.sin(roll)
    return np.stack([x, y, z], axis=1)


def _contact_offsets(parameters: Parameters, angle: Array) -> Array:
    """Places (K, 4, 2) of the wheels in the body frame, x and y."""
    signs = np.array(CORNER_SIGNS)
    hip = parameters["hip.position"][:, None, :2] * signs
    reach = parameters["leg.length"] * np.cos(angle[:, :4])
    return hip + np.stack([reach, np.zeros_like(reach)], axis=-1)


def _uncertainty(
    value_std: Array, rate_std: Array, contact: Array, value: Array, robot: Robot, parameters: Parameters
) -> tuple[Array, Array]:
    """1 sigma of slip velocity and of accumulated slip, both (K, 4, 2), from camera and encoders.

    A contact at (x, y) moves by the body's shift and by (-y, x) times its turn; the encoder adds a count's error at the rim.
    Accumulated slip has the error of the present and of the first pose; a heading error turns the way driven sideways.
    """
    arm = np.abs(contact[:, :, ::-1])
    plane = np.hypot(value_std[:, 0], value_std[:, 1]) / math.sqrt(2)
    speed = np.hypot(rate_std[:, 0], rate_std[:, 1]) / math.sqrt(2)
    rim = parameters["wheel.radius"][0] * robot.sensors.encoder.position / math.sqrt(12)
    encoder = np.stack([rim, np.zeros(4)], axis=-1)
    pace = 10.0  # 1/s: an encoder's error changes over about five ticks
    velocity = speed[:, None, None] ** 2 + (arm * rate_std[:, 3, None, None]) ** 2 + (pace * encoder) ** 2
    now = plane[:, None, None] ** 2 + (arm * value_std[:, 3, None, None]) ** 2 + encoder**2
    way = np.hypot(value[:, 0] - value[0, 0], value[:, 1] - value[0, 1])
    sideways = np.zeros_like(now)
    sideways[:, :, 1] = (way * value_std[:, 3])[:, None] ** 2
    return np.sqrt(velocity), np.sqrt(now + now[:1] + sideways)
