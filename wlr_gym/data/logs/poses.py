"""Headings and pitches from quaternions of a log, in whatever frame it has them."""

from __future__ import annotations

import re
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from wlr_gym.data.body_pose import euler_angles
from wlr_gym.data.logs.topics import Topic
from wlr_gym.robot.parameter_table import XYZ

Array = NDArray[np.float64]
Times = NDArray[np.int64]

#: Angles that can be taken of a quaternion.
ANGLES = ("yaw", "pitch", "roll", "tilt")


def pose_angle(topic: Topic, field: str, use: str, axes: Sequence[str] | None, where: str) -> tuple[Times, Array]:
    """Return times (ns) and an angle (rad) of a quaternion: ``yaw``, ``pitch``, ``roll``, or ``tilt`` off upright.

    Lost frames, whose quaternion is no rotation, are left out.

    Args:
        topic: that has it.
        field: name of the angle.
        use: clock of the topic.
        axes: axes of the log that our x, y and z are, of the floor's frame and of the body's; None = the same.
        where: for messages.

    Raises:
        InputError: no such quaternion.
    """
    stem, _, angle = field.rpartition(".")
    at, quaternion, lost = _rotations(topic, stem, use, where)
    at, quaternion = at[~lost], quaternion[~lost]
    w, *vector = (quaternion / np.linalg.norm(quaternion, axis=1)[:, None]).T
    if axes is not None:  # a proper turn of both frames: the quaternion's vector turns with them
        vector = [vector[XYZ.index(axis[-1])] * (-1.0 if axis.startswith("-") else 1.0) for axis in axes]
    yaw, pitch, roll = euler_angles(np.stack([w, *vector], axis=1))
    x, y, _ = vector
    angles = {"yaw": yaw, "pitch": pitch, "roll": roll, "tilt": np.arccos(np.clip(1 - 2 * (x * x + y * y), -1, 1))}
    values = angles[angle]
    return at, np.unwrap(values) if angle == "yaw" else values


def lost_frames(topic: Topic, field: str, use: str, where: str) -> Times:
    """Return the times (ns) at which the quaternion of an angle is no rotation: not known, or of length 0.

    Its message's position is not one, either. Of a field that is no angle of a quaternion there are none.
    """
    stem, _, angle = field.rpartition(".")
    if field in topic.fields or angle not in ANGLES:
        return np.zeros(0, np.int64)
    at, _, lost = _rotations(topic, stem, use, where)
    return at[lost]


def _rotations(topic: Topic, stem: str, use: str, where: str) -> tuple[Times, Array, NDArray[np.bool_]]:
    """Return times, quaternions (n, 4), and which of them are no rotations: of a table's row some parts may be missing."""
    names = next((names for names in _quaternions(stem) if names[0] in topic.fields), _quaternions(stem)[0])
    parts = [topic.series(name, use, where) for name in names]
    every = np.unique(np.concatenate([at for at, _ in parts]))
    quaternion = np.full((len(every), len(parts)), np.nan)
    for part, (at, values) in enumerate(parts):
        quaternion[np.searchsorted(every, at), part] = values
    return every, quaternion, ~(np.linalg.norm(quaternion, axis=1) >= 0.5)


def quaternion_names(stem: str) -> set[str]:
    """Return the names that the parts of a quaternion may have."""
    return {name for names in _quaternions(stem) for name in names}


def _quaternions(stem: str) -> list[list[str]]:
    """Return names of w, x, y and z of a quaternion.

    Of ``q`` they are ``q.w``, or in tables ``q_w`` or ``qw``; a list without names says its order: ``q[xyzw]`` has its w in
    ``q[3]``.
    """
    ordered = re.fullmatch(r"(.*)\[([wxyz]{4})\]", stem)
    if ordered and sorted(ordered.group(2)) == list("wxyz"):
        return [[f"{ordered.group(1)}[{ordered.group(2).index(part)}]" for part in "wxyz"]]
    return [[f"{stem}{joint}{part}" for part in "wxyz"] for joint in (".", "_", "")]
