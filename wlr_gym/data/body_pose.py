"""Pose of the body: attitude as quaternion and as angles, and how the body stands on four wheels."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from wlr_gym.robot import CORNER_SIGNS
from wlr_gym.robot.parameters import Parameters

Array = NDArray[np.float64]


def rest_pose(parameters: Parameters, legs: Array) -> Array:
    """Return height of the body origin, pitch and roll (N, 3) that put four wheels on a flat floor, least squares.

    Args:
        parameters: (N).
        legs: (N, 4) true leg angles, rad.
    """
    signs = np.array(CORNER_SIGNS)
    hip, length, radius = parameters["hip.position"], parameters["leg.length"], parameters["wheel.radius"]
    x = signs[:, 0] * hip[:, :1] + length * np.cos(legs)
    y = signs[:, 1] * hip[:, 1:2] + np.zeros_like(legs)
    z = hip[:, 2:] - length * np.sin(legs)
    pose = np.zeros((len(legs), 3))
    for _ in range(5):  # Gauss-Newton; the problem is almost linear
        height, pitch, roll = pose[:, :1], pose[:, 1:2], pose[:, 2:]
        up = np.sin(roll) * y + np.cos(roll) * z
        gap = height - np.sin(pitch) * x + np.cos(pitch) * up - radius
        along = np.cos(pitch) * (np.cos(roll) * y - np.sin(roll) * z)
        slope = np.stack([np.ones_like(x), -np.cos(pitch) * x - np.sin(pitch) * up, along], axis=2)
        pose = pose - np.einsum("nij,nj->ni", np.linalg.pinv(slope), gap)
    return pose


def euler_angles(q: Array) -> tuple[Array, Array, Array]:
    """Yaw, pitch and roll (N,) of quaternions (N, 4), (w, x, y, z): Rz(yaw) Ry(pitch) Rx(roll), body to floor frame."""
    w, x, y, z = q.T
    yaw = np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
    pitch = np.arcsin(np.clip(2 * (w * y - x * z), -1, 1))
    roll = np.arctan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
    return yaw, pitch, roll


def quaternion(yaw: Array, pitch: Array, roll: Array) -> Array:
    """Quaternions (N, 4) of Rz(yaw) Ry(pitch) Rx(roll)."""
    (cy, sy), (cp, sp), (cr, sr) = ((np.cos(a / 2), np.sin(a / 2)) for a in (yaw, pitch, roll))
    w, x = cy * cp * cr + sy * sp * sr, cy * cp * sr - sy * sp * cr
    y, z = cy * sp * cr + sy * cp * sr, sy * cp * cr - cy * sp * sr
    return np.stack([w, x, y, z], axis=1)
