"""Calibration of the IMU and of the servos' mounting from readings. Pure functions; ``wlr calibrate`` asks for the poses."""

from __future__ import annotations

import contextlib
import os
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import ArrayLike, NDArray

from wlr_gym.base.errors import InputError
from wlr_gym.base.files import replace_file
from wlr_gym.base.paths import named_in
from wlr_gym.base.settings import read_yaml
from wlr_gym.hardware.config import FlowCalibration, Hardware, ImuCalibration, Mounting
from wlr_gym.hardware.imu import STANDARD_GRAVITY
from wlr_gym.robot import JOINTS

Array = NDArray[np.float64]
Vector = tuple[float, float, float]

#: rad/s: standard deviation of the gyroscope above which an IMU is not at rest: ten times the sensor's own at 44 Hz.
GYRO_REST = 0.015
#: m/s2: the same of the accelerometer.
ACCEL_REST = 0.4
#: rad/s that a healthy gyroscope may be off before calibration (data sheet: 20 deg/s).
LARGEST_BIAS = 0.35
#: Part that a healthy accelerometer's scale may be off before calibration (twice the data sheet's 3 %).
LARGEST_SCALE = 0.06
#: m/s2 that a healthy accelerometer may be off before calibration (twice the data sheet's 80 mg).
LARGEST_OFFSET = 1.6
#: Fewest samples of a pose.
SAMPLES = 50
#: rad: from a smaller tilt the forward direction cannot be found.
LEAST_TILT = np.deg2rad(10.0)
#: Part of a turn that a joint must be moved by hand (20 deg).
LEAST_MOVE = 20.0 / 360.0
#: Part of a joint's move by which another one may move.
LARGEST_SHARE = 0.5
#: Counts of a servo's turn, of the X series.
COUNTS = 4096


# ---- IMU -------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class RestPose:
    """An IMU at rest in one pose, sensor axes, uncalibrated."""

    gyro: Array  #: (3,) rad/s, mean
    accelerometer: Array  #: (3,) m/s2, mean
    temperature: float  #: degC


def rest_pose(gyro: ArrayLike, accelerometer: ArrayLike, temperature: float) -> RestPose:
    """Average samples (T, 3) of an IMU at rest.

    Raises:
        InputError: too few samples, or it was moved: told by the spread, and by means that drift from one half to the other.
    """
    rates, forces = np.asarray(gyro, np.float64), np.asarray(accelerometer, np.float64)
    for name, values, limit, unit in (("gyroscope", rates, GYRO_REST, "rad/s"), ("accelerometer", forces, ACCEL_REST, "m/s2")):
        if len(values) < SAMPLES:
            raise InputError(f"{len(values)} readings of the IMU, expected {SAMPLES} or more: check its port with wlr doctor")
        moved = motion(values)
        if moved > limit:
            raise InputError(f"the robot was moved: the {name} varies by {moved:.3g} {unit}, expected below {limit:g}")
    return RestPose(rates.mean(axis=0), forces.mean(axis=0), temperature)


def motion(values: Array) -> float:
    """Return by how much samples (T, 3) vary: standard deviation, or drift from one half to the other, of the worst axis."""
    half = len(values) // 2
    drift = np.abs(values[:half].mean(axis=0) - values[half:].mean(axis=0))
    return float(max(values.std(axis=0).max(), drift.max()))


def gyro_bias(*poses: RestPose) -> Vector:
    """Return what the gyroscope reads at rest, rad/s: the mean of all poses.

    Raises:
        InputError: more than any healthy chip: the robot turned, or the range is not the one in the hardware file.
    """
    bias = np.mean([pose.gyro for pose in poses], axis=0)
    if (worst := float(np.abs(bias).max())) > LARGEST_BIAS:
        raise InputError(f"gyroscope reads {worst:.2f} rad/s at rest, expected below {LARGEST_BIAS:g}: is gyro_range right?")
    return _vector(bias)


def six_positions(poses: list[RestPose]) -> tuple[Vector, Vector]:
    """Return offset (m/s2) and scale of the accelerometer from six or more poses at rest, each axis up and down once.

    Only the length of gravity is used, so the poses need not be exact: |scale (measured - offset)| = g in each.

    Raises:
        InputError: fewer than six poses, poses too alike to tell the six numbers apart, or numbers no healthy chip has.
    """
    if len(poses) < 6:
        raise InputError(f"{len(poses)} poses, expected 6: each side of the sensor up once")
    measured = np.array([pose.accelerometer for pose in poses])
    offset, scale = np.zeros(3), np.ones(3)
    for _ in range(20):
        inner = scale * (measured - offset)
        length = np.linalg.norm(inner, axis=1)
        direction = inner / length[:, None]
        jacobian = np.concatenate([-direction * scale, direction * (measured - offset)], axis=1)
        step, _, rank, singular = np.linalg.lstsq(jacobian, STANDARD_GRAVITY - length, rcond=1e-6)
        if rank < 6 or singular[-1] < 0.05:
            raise InputError("the poses are too alike: turn the robot so that each side of the sensor is up once")
        offset, scale = offset + step[:3], scale + step[3:]
        if not (np.abs(offset) < 20.0).all() or not (np.abs(scale - 1.0) < 0.5).all():
            break
    if np.abs(offset).max() > LARGEST_OFFSET or np.abs(scale - 1.0).max() > LARGEST_SCALE:
        raise InputError(
            f"accelerometer: offset {np.round(offset, 2).tolist()} m/s2, scale {np.round(scale, 3).tolist()}: no healthy chip "
            f"has that; was a pose repeated or the robot moved, is accel_range right?"
        )
    return _vector(offset), _vector(scale)


def mounting(level: Array, nose_down: Array) -> Vector:
    """Return roll, pitch, yaw (rad) of sensor to body axes from gravity in two poses: level, and nose down.

    Args:
        level: (3,) accelerometer with the body level, sensor axes, offset and scale taken off.
        nose_down: (3,) the same with the nose down by 10 degrees or more, without roll.

    Raises:
        InputError: the two are too alike.
    """
    up = level / np.linalg.norm(level)
    tilted = nose_down / np.linalg.norm(nose_down)
    behind = tilted - (tilted @ up) * up  # nose down, specific force leans towards the tail
    if np.linalg.norm(behind) < np.sin(LEAST_TILT):
        angle = np.rad2deg(np.arcsin(min(1.0, float(np.linalg.norm(behind)))))
        raise InputError(f"the second pose is tilted by {angle:.1f} deg only, expected {np.rad2deg(LEAST_TILT):g} or more")
    forward = -behind / np.linalg.norm(behind)
    return _angles(np.stack([forward, np.cross(up, forward), up]))


def _angles(to_body: NDArray[Any]) -> Vector:
    pitch = -np.arcsin(np.clip(to_body[2, 0], -1.0, 1.0))
    if abs(to_body[2, 0]) > 1.0 - 1e-9:  # straight up or down: roll and yaw turn about the same axis
        return 0.0, float(pitch), float(np.arctan2(-to_body[0, 1], to_body[1, 1]))
    return (
        float(np.arctan2(to_body[2, 1], to_body[2, 2])),
        float(pitch),
        float(np.arctan2(to_body[1, 0], to_body[0, 0])),
    )


def level_offset(pose: RestPose, known: ImuCalibration, to_body: Array) -> Vector:
    """Return the accelerometer's offset (m/s2) that makes a level robot read (0, 0, g); scale and mounting stay.

    One pose cannot tell offset from tilt: on a floor that is off level by 1 degree the offset is wrong by 0.17 m/s2.

    Raises:
        InputError: an offset no healthy chip has: the robot is not level, or mounted otherwise than the file says.
    """
    wanted = to_body.T @ np.array([0.0, 0.0, STANDARD_GRAVITY]) / np.array(known.accel_scale)
    offset = pose.accelerometer - wanted
    if (worst := float(np.abs(offset).max())) > LARGEST_OFFSET:
        raise InputError(
            f"accelerometer is {worst:.1f} m/s2 off what a level robot reads, expected below {LARGEST_OFFSET:g}: stand it on a "
            f"level floor; if the sensor is mounted otherwise, calibrate with --mounting"
        )
    return _vector(offset)


def _vector(values: Array) -> Vector:
    x, y, z = (round(float(value), 6) for value in values)
    return x, y, z


# ---- servos ----------------------------------------------------------------------------------------------------------


def find_sign(joint: str, before: ArrayLike, after: ArrayLike, turn: int = COUNTS) -> int:
    """Return the sign of a joint that was moved by hand in its positive direction.

    Args:
        before, after: (8,) counts of all joints. turn: counts per turn.

    Raises:
        InputError: it moved too little, or another joint moved instead.
    """
    moved = np.asarray(after, np.float64) - np.asarray(before, np.float64)
    own = moved[JOINTS.index(joint)]
    others = {name: abs(way) for name, way in zip(JOINTS, moved.tolist(), strict=True) if name != joint}
    other = max(others, key=lambda name: others[name])
    least = round(LEAST_MOVE * turn)
    if others[other] > max(least, LARGEST_SHARE * abs(own)):
        raise InputError(
            f"{other} moved by {others[other]:.0f} counts while {joint} was asked for: hold it still, or its id is swapped"
        )
    if abs(own) < least:
        raise InputError(f"{joint} moved by {abs(own):.0f} counts, expected {least} (20 deg) or more")
    return 1 if own > 0 else -1


def find_zero(joint: str, sign: int, straight_down: float, leg_limits: tuple[float, float], turn: int = COUNTS) -> int:
    """Return the zero count of a leg that was held straight down (pi/2); ``turn``: counts per turn of its servo.

    Raises:
        InputError: the leg's range does not fit into the servo's turn; the horn must be moved.
    """
    count = 2 * np.pi / turn
    zero = round(straight_down - sign * (np.pi / 2) / count)
    ends = [zero + sign * angle / count for angle in leg_limits]
    if not (0 <= zero < turn and all(0 <= end < turn for end in ends)):
        raise InputError(
            f"{joint} reads {straight_down:.0f} counts straight down, expected about {turn // 2}: its range would leave the "
            f"servo's turn; take the horn off and put it back so that straight down reads {turn // 2} +- {turn * 900 // 4096}"
        )
    return zero


# ---- the file --------------------------------------------------------------------------------------------------------


def with_mountings(hardware: Hardware, mountings: dict[str, Mounting]) -> Hardware:
    """Return the hardware with some joints mounted otherwise."""
    return hardware.model_copy(update={"joints": {joint: mountings.get(joint, hardware.joints[joint]) for joint in JOINTS}})


def with_calibration(hardware: Hardware, calibration: ImuCalibration | FlowCalibration) -> Hardware:
    """Return the hardware with another calibration of its IMU or optical-flow sensor."""
    name = "imu" if isinstance(calibration, ImuCalibration) else "flow"
    return hardware.model_copy(update={name: getattr(hardware, name).model_copy(update={"calibration": calibration})})


def save_hardware(path: Path, source: Path, hardware: Hardware, section: str, note: str) -> None:
    """Write a hardware file in one step: the source's text with one section replaced, so that comments elsewhere stay.

    Args:
        path: file to write; may be the source, which the hardware was loaded from.
        hardware: what its section (``joints``, ``imu``, ``flow`` or ``measured``) shall say. note: comment for it.
    """
    changed = hardware.model_dump(mode="json", exclude_unset=True)[section]
    content = {**read_yaml(source), section: changed}
    patched = _replace_section(source.read_text(encoding="utf-8"), section, f"# {note}\n" + _yaml({section: changed}))
    if path.parent.resolve() != source.parent.resolve():  # files beside the source are named as they are seen from here

        def seen(name: str) -> str:
            file = named_in(source, name)
            return os.path.relpath(file, path.parent.resolve()) if file.is_absolute() else name

        if content.get("robot") and seen(content["robot"]) != content["robot"]:
            content["robot"] = seen(content["robot"])
            line = _yaml({"robot": content["robot"]}).strip()
            patched = re.sub(r"^robot:.*$", lambda _: line, patched, count=1, flags=re.MULTILINE)
        for bus in content["buses"].values():
            bus["model"] = seen(bus["model"])

    def write(temporary: Path) -> None:
        temporary.write_text(patched, encoding="utf-8")
        with contextlib.suppress(InputError):
            if read_yaml(temporary) == content:
                return
        temporary.write_text(f"# {note}\n" + _yaml(content), encoding="utf-8")  # a layout that cannot be patched

    replace_file(path, write)


def _yaml(content: dict[str, Any]) -> str:
    return yaml.safe_dump(content, sort_keys=False, default_flow_style=None, width=120)


def _replace_section(text: str, section: str, new: str) -> str:
    """Replace a top-level key of a YAML text, with all that is indented under it and the note before it; add a new one."""
    indented = r"(?:(?:[ \t]*\n)*[ \t]+\S.*\n)*"
    pattern = rf"^(?:# .* by wlr (?:calibrate|commission)\b.*\n)?{section}:.*\n{indented}"
    text = text if text.endswith("\n") else text + "\n"
    patched, count = re.subn(pattern, lambda _: new, text, count=1, flags=re.MULTILINE)
    return patched if count else f"{text}\n{new}"
