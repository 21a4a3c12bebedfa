"""The paper's own method, for comparison: mean of the circles' centres on a fixed plane.

Korayem, Nikseresht, Asadi 2024 average the centres of the concentric circles' contours to a virtual frame and scale pixels to
metres once. Here: contours of a global threshold, their mean centres, and the homography of the plane in which the markers lie
at the start, known exactly. There is no sub-pixel edge, no correction of the ellipse's centre, no lens model for the contours,
and the plane stays where it was while the legs move the body up and down.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from wlr_gym.perception.markers.camera import Camera
from wlr_gym.perception.markers.detection import Image
from wlr_gym.perception.markers.targets import Target

Array = NDArray[np.float64]


def paper_pose(
    image: Image, camera: Camera, body: Target, floor_rotation: Array, floor_position: Array, height: float, near: Array
) -> Array | None:
    """Return x, y (m) and yaw (rad) of the body in the floor frame, or None when a marker has no contour.

    Args:
        image: (H, W) grey. camera: focal length and centre; its distortion is not used. body: the markers.
        floor_rotation, floor_position: floor to camera frame. height: m, of the marker plane over the floor, taken as fixed.
        near: (M, 2) px, where each marker is, roughly (identity is given to the method).
    """
    pixels = [pixel for point in near if (pixel := _contour_mean(image, point)) is not None]
    if len(pixels) < len(near):
        return None
    inverse = np.linalg.inv(camera.matrix)
    eye = -floor_rotation.T @ floor_position
    points = []
    for pixel in pixels:
        ray = floor_rotation.T @ inverse @ np.array([*pixel, 1.0])
        points.append((eye + ray * (height - eye[2]) / ray[2])[:2])
    places = np.array(points)
    x, y = places.mean(axis=0)
    layout = body.positions[:, :2] - body.positions[:, :2].mean(axis=0)
    offset = places - places.mean(axis=0)
    turn = math.atan2(np.sum(layout[:, 0] * offset[:, 1] - layout[:, 1] * offset[:, 0]), np.sum(layout * offset))
    return np.array([x, y, turn])


def _contour_mean(image: Image, near: Array, reach: int = 45) -> Array | None:
    """Mean centre (px) of the ellipses through a marker's contours."""
    import cv2

    x0, y0 = max(0, int(near[0]) - reach), max(0, int(near[1]) - reach)
    part = np.ascontiguousarray(image[y0 : y0 + 2 * reach, x0 : x0 + 2 * reach])
    if min(part.shape) < 8:
        return None
    _, dark = cv2.threshold(part, 0, 255, cv2.THRESH_BINARY_INV + cv2.THRESH_OTSU)
    contours, _ = cv2.findContours(dark, cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
    centres = []
    for contour in contours:
        if len(contour) < 8:
            continue
        (x, y), (width, height), _ = cv2.fitEllipseDirect(contour.reshape(-1, 2))
        offset = math.hypot(x + x0 - near[0], y + y0 - near[1])
        if offset < 0.2 * max(width, height, 1.0) + 1.0 and max(width, height) < 1.8 * reach:
            centres.append((x + x0, y + y0))
    return np.mean(centres, axis=0) if centres else None
