"""Calibrate a camera from views of a board: its lens, and from a film of a moving board its shutter."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wlr_gym.base.errors import InputError
from wlr_gym.perception.markers.boards import MINIMUM_CORNERS, Board
from wlr_gym.perception.markers.camera import Camera, Quality
from wlr_gym.perception.markers.shutter import LONGEST, BoardView, Readout, at_frame_time, board_motion, readout_of

Array = NDArray[np.float64]

MINIMUM_VIEWS = 6
#: A view whose corners miss by more than this many times the median of all views is left out.
_OUTLYING_VIEW = 3.0
#: rad rms, of the board's tilts about their mean. Parallel views do not tell the focal length, nor does its sigma tell that.
_LEAST_TILT = math.radians(8)
#: s; a readout less certain than this is not followed.
_LOOSEST_STD = 0.005
#: Lens and shutter are found in turns, at most so many, until the readout stays (s).
_TURNS, _SAME_READOUT = 8, 2e-5


def calibrate(images: Iterable[tuple[str, NDArray[np.uint8]]], board: Board) -> Camera:
    """Calibrate from pictures of a board.

    Args:
        images: (name, grey image) pairs, all of one size.
        board: the board that was printed.

    Raises:
        InputError: images of different sizes, too few views with enough corners, corners only in part of the image, or tilts
            too much alike to tell the focal length.
    """
    size, views = _find_corners(((name, 0.0, image) for name, image in images), board)
    return _calibrated([view for view in views if view is not None], len(views), size, board)


def calibrate_film(
    frames: Iterable[tuple[str, float, NDArray[np.uint8]]], board: Board, every: int, readout: float | None = None
) -> tuple[Camera, Readout]:
    """Calibrate from a film: lens and shutter.

    Args:
        frames: (name, time in s, grey image) of every frame. board: the board that was printed.
        every: each n-th frame is a view; the ones before and after it tell how the board moves.
        readout: s, where it is known; None = the film tells it, if the board moves fast enough.

    Returns:
        The camera, with its readout where that is known, and what the film tells of it.

    Raises:
        InputError: see :func:`calibrate`.
    """
    wanted = (frame for k, frame in enumerate(frames) if min(k % every, -k % every) <= 1)
    size, found = _find_corners(wanted, board)
    middles = range(0, len(found), min(3, every))
    views = {k: view for k in middles if (view := found[k]) is not None}
    camera = plain = _calibrated(list(views.values()), len(middles), size, board)
    told = Readout() if readout is None else Readout(readout, 0.0)
    for _ in range(_TURNS):
        moving = {k: motion for k in views if (motion := _motion(found, k, camera)) is not None}
        before = told
        told = readout_of([(views[k], motion) for k, motion in moving.items()], camera) if readout is None else told
        if readout is None and not (abs(told.value) < LONGEST and told.std < _LOOSEST_STD):
            break  # a board that hardly moves
        still = [at_frame_time(v, moving[k], camera, told.value) if k in moving else v for k, v in views.items()]
        camera = _calibrated(still, len(middles), size, board)
        if abs(told.value - before.value) < _SAME_READOUT:
            break
    if not told.known:
        camera = plain
    quality = camera.quality and camera.quality.model_copy(update={"readout_std": told.std or None})
    return camera.model_copy(
        update={"readout": told.known, "quality": quality if told.known is not None else camera.quality}
    ), told


def _motion(found: Sequence[BoardView | None], k: int, camera: Camera) -> Array | None:
    before, view, after = (found[i] if 0 <= i < len(found) else None for i in (k - 1, k, k + 1))
    if before is None or view is None or after is None:
        return None
    return board_motion(before, view, after, camera)


def _calibrated(views: Sequence[BoardView], pictures: int, size: tuple[int, int], board: Board) -> Camera:
    if len(views) < MINIMUM_VIEWS:
        raise InputError(
            f"the board ({board.kind}, {board.columns} x {board.rows} squares) is seen well in {len(views)} of {pictures} "
            f"images; at least {MINIMUM_VIEWS} are needed, each with {min(MINIMUM_CORNERS, board.corners)} corners, sharp, "
            "from different angles"
        )
    object_points = [np.asarray(view.places, np.float32) for view in views]
    image_points = [np.asarray(view.pixels, np.float32) for view in views]
    coverage = _coverage(np.concatenate([view.pixels for view in views]), size)
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


def _find_corners(
    images: Iterable[tuple[str, float, NDArray[np.uint8]]], board: Board
) -> tuple[tuple[int, int], list[BoardView | None]]:
    """Size of the images, and what each shows of the board; None = too little."""
    size: tuple[int, int] | None = None
    views: list[BoardView | None] = []
    for name, time, image in images:
        height, width = image.shape
        if size is not None and size != (width, height):
            raise InputError(f"{name}: {width} x {height} px, the images before it {size[0]} x {size[1]}; use one camera mode")
        size = (width, height)
        found = board.find(image)
        views.append(None if found is None else BoardView(name, time, *(np.asarray(part, np.float64) for part in found)))
    if size is None:
        raise InputError("no images to calibrate from")
    return size, views


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
