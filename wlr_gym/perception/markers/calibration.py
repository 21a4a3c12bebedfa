"""Calibrate a camera from views of a ChArUco board."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wlr_gym.base.errors import InputError
from wlr_gym.perception.markers.camera import Camera, Quality

Array = NDArray[np.float64]

MINIMUM_VIEWS = 6
MINIMUM_CORNERS = 12
#: A view whose corners miss by more than this many times the median of all views is left out.
_OUTLYING_VIEW = 3.0
#: rad rms, of the board's tilts about their mean. Parallel views do not tell the focal length, nor does its sigma tell that.
_LEAST_TILT = math.radians(8)


@dataclass(frozen=True)
class Board:
    """A ChArUco board: squares along and across, their side (m). A marker's side is 0.7 of it."""

    columns: int = 9
    rows: int = 6
    square: float = 0.028

    def aruco(self) -> Any:
        """Return OpenCV's board."""
        import cv2

        dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_5X5_100)
        return cv2.aruco.CharucoBoard((self.columns, self.rows), self.square, 0.7 * self.square, dictionary)


def calibrate(images: Iterable[tuple[str, NDArray[np.uint8]]], board: Board) -> Camera:
    """Calibrate from views of a ChArUco board.

    Args:
        images: (name, grey image) pairs, all of one size.
        board: the board that was printed.

    Raises:
        InputError: images of different sizes, too few views with enough corners, corners only in part of the image, or tilts
            too much alike to tell the focal length.
    """
    size, points, names = _find_corners(images, board)
    if len(points) < MINIMUM_VIEWS:
        raise InputError(
            f"the board ({board.columns} x {board.rows} squares) is seen well in {len(points)} of {len(names)} images; "
            f"at least {MINIMUM_VIEWS} are needed, each with {MINIMUM_CORNERS} corners, sharp, from different angles"
        )
    object_points, image_points = [places for places, _ in points], [corners for _, corners in points]
    coverage = _coverage(np.concatenate(image_points), size)
    if coverage < 0.5:
        raise InputError(
            f"the board's corners cover {100 * coverage:.0f} % of the image; show it in every corner (50 % or more)"
        )
    first = _solve(object_points, image_points, size)
    keep = first["view_errors"] <= _OUTLYING_VIEW * np.median(first["view_errors"])
    good = np.flatnonzero(keep)
    found = first if keep.all() else _solve([object_points[k] for k in good], [image_points[k] for k in good], size)
    matrix, deviations = found["matrix"], found["deviations"]
    k1, k2, p1, p2, k3 = (float(k) for k in found["distortion"])
    tilt = math.sqrt(2 * max(0.0, 1 - float(np.linalg.norm(found["normals"].mean(axis=0)))))
    if tilt < _LEAST_TILT:
        raise InputError(
            f"the board's tilts differ by {math.degrees(tilt):.0f} degrees only (rms), which does not tell the focal length; "
            "tilt it by up to 40 degrees, to every side"
        )
    return Camera(
        width=size[0],
        height=size[1],
        focal=(float(matrix[0, 0]), float(matrix[1, 1])),
        centre=(float(matrix[0, 2]), float(matrix[1, 2])),
        distortion=(k1, k2, p1, p2, k3),
        quality=Quality(
            views=int(keep.sum()),
            rejected=int((~keep).sum()),
            rms=found["rms"],
            coverage=coverage,
            focal_std=(float(deviations[0]), float(deviations[1])),
            centre_std=(float(deviations[2]), float(deviations[3])),
        ),
    )


def _find_corners(images: Iterable[tuple[str, NDArray[np.uint8]]], board: Board) -> tuple[tuple[int, int], list, list[str]]:
    import cv2

    detector = cv2.aruco.CharucoDetector(board.aruco())
    size: tuple[int, int] | None = None
    points, names = [], []
    for name, image in images:
        height, width = image.shape
        if size is not None and size != (width, height):
            raise InputError(f"{name}: {width} x {height} px, the images before it {size[0]} x {size[1]}; use one camera mode")
        size = (width, height)
        names.append(name)
        corners, ids, _, _ = detector.detectBoard(image)
        if ids is None or len(ids) < MINIMUM_CORNERS:
            continue
        corners = np.asarray(corners, np.float32).reshape(-1, 2)
        places = np.asarray(board.aruco().getChessboardCorners(), np.float32)[np.asarray(ids, np.intp).reshape(-1)]
        points.append((places, corners))
    if size is None:
        raise InputError("no images to calibrate from")
    return size, points, names


def _solve(object_points: list, image_points: list, size: tuple[int, int]) -> dict[str, Any]:
    import cv2

    # the default solver can end in a poor minimum without a first guess; k3 stays 0, as it trades off against k2
    guess = np.array([[size[0], 0, 0.5 * (size[0] - 1)], [0, size[0], 0.5 * (size[1] - 1)], [0, 0, 1.0]])
    flags = cv2.CALIB_USE_INTRINSIC_GUESS | cv2.CALIB_FIX_K3
    rms, matrix, distortion, turns, _, deviations, _, view_errors = cv2.calibrateCameraExtended(
        object_points, image_points, size, guess, np.zeros(5), flags=flags
    )
    return {
        "rms": float(rms),
        "matrix": matrix,
        "distortion": np.asarray(distortion).reshape(-1)[:5],
        "normals": np.stack([cv2.Rodrigues(turn)[0][:, 2] for turn in turns]),
        "deviations": np.asarray(deviations).reshape(-1),
        "view_errors": np.asarray(view_errors).reshape(-1),
    }


def _coverage(corners: Array, size: tuple[int, int]) -> float:
    cells = np.floor(4 * corners / np.array(size)).astype(int).clip(0, 3)
    return len({(x, y) for x, y in cells}) / 16
