"""Calibrate a camera from views of a board (ChArUco, chessboard): its lens, and from a film of a moving board its shutter.

A row v of a frame at time t shows the board where it is at t + readout (v / height - 1/2). With the board's motion known from
the frames before and after, what the corners miss of a pose that all rows share is linear in the readout.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wlr_gym.base.errors import InputError, check_name
from wlr_gym.perception.markers.camera import Camera, Quality

Array = NDArray[np.float64]

#: Kinds of boards: with coded markers; the same as OpenCV drew them before 4.6 (differs with an even number of rows); plain.
CHARUCO, LEGACY, CHESSBOARD = "charuco", "charuco-legacy", "chessboard"
KINDS = (CHARUCO, LEGACY, CHESSBOARD)
MINIMUM_CORNERS, FEWEST_CORNERS = 12, 6  # corners that a view needs, and that a board must have
#: A chessboard is looked for in a picture of at most so many pixels along its longer side, then refined in the whole one.
_CHESS_SIDE = 1280


@dataclass(frozen=True)
class Board:
    """A board of squares.

    Attributes:
        columns, rows: squares along and across. square: their side (m).
        kind: one of :data:`KINDS`. marker: side of a marker (m); None = 0.7 of a square.
        dictionary: of the markers, as OpenCV names it without ``DICT_``, e.g. ``5X5_100``.
    """

    columns: int = 9
    rows: int = 6
    square: float = 0.028
    kind: str = CHARUCO
    marker: float | None = None
    dictionary: str = "5X5_100"

    def __post_init__(self) -> None:
        check_name("board", self.kind, KINDS)
        if min(self.columns, self.rows) < 2 or self.corners < FEWEST_CORNERS:
            raise InputError(
                f"a board of {self.columns} x {self.rows} squares has {max(0, self.corners)} inner corners; at least "
                f"{FEWEST_CORNERS} are needed"
            )
        if self.marker is not None and not 0 < self.marker < self.square:
            raise InputError(f"marker = {self.marker:g} m: expected more than 0 and less than a square ({self.square:g} m)")
        if self.kind != CHESSBOARD:
            known, needed = len(self._words.bytesList), self.columns * self.rows // 2
            if needed > known:
                raise InputError(
                    f"a board of {self.columns} x {self.rows} squares has {needed} markers, but dictionary "
                    f"{self.dictionary} has {known}; name the one that was printed"
                )

    @property
    def corners(self) -> int:
        """Number of inner corners."""
        return (self.columns - 1) * (self.rows - 1)

    @cached_property
    def _words(self) -> Any:
        import cv2

        names = {name.removeprefix("DICT_"): name for name in dir(cv2.aruco) if name.startswith("DICT_")}
        check_name("dictionary", self.dictionary.upper(), names)
        return cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, names[self.dictionary.upper()]))

    def aruco(self) -> Any:
        """Return OpenCV's board of the coded kinds."""
        import cv2

        marker = 0.7 * self.square if self.marker is None else self.marker
        board = cv2.aruco.CharucoBoard((self.columns, self.rows), self.square, marker, self._words)
        board.setLegacyPattern(self.kind == LEGACY)
        return board

    @cached_property
    def places(self) -> NDArray[np.float32]:
        """(C, 3) m, inner corners, row by row."""
        y, x = np.mgrid[1 : self.rows, 1 : self.columns].reshape(2, -1)
        return np.column_stack([self.square * x, self.square * y, np.zeros(len(x))]).astype(np.float32)

    @cached_property
    def _detector(self) -> Any:
        import cv2

        return cv2.aruco.CharucoDetector(self.aruco())

    def find(self, image: NDArray[np.uint8]) -> tuple[NDArray[np.float32], NDArray[np.float32]] | None:
        """Places (N, 3) m and pixels (N, 2) of the corners in a picture; None = too few are seen."""
        if self.kind == CHESSBOARD:
            pixels = _chess_corners(image, self.columns - 1, self.rows - 1)
            return None if pixels is None else (self.places, pixels)
        corners, ids, _, _ = self._detector.detectBoard(image)
        if ids is None or len(ids) < min(MINIMUM_CORNERS, self.corners):
            return None
        return self.places[np.ravel(ids)], np.asarray(corners, np.float32).reshape(-1, 2)


def _chess_corners(image: NDArray[np.uint8], columns: int, rows: int) -> NDArray[np.float32] | None:
    import cv2

    scale = min(1.0, _CHESS_SIDE / max(image.shape))
    small = cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA) if scale < 1 else image
    found, corners = cv2.findChessboardCornersSB(small, (columns, rows), flags=cv2.CALIB_CB_ACCURACY)
    if not found:
        return None
    pixels = ((np.asarray(corners, np.float32).reshape(-1, 2) + 0.5) / scale - 0.5).astype(np.float32)
    if scale < 1:
        apart = float(np.linalg.norm(np.diff(pixels.reshape(rows, columns, 2), axis=1), axis=2).min())
        reach, end = int(np.clip(apart / 4, 2, 15)), (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_COUNT, 30, 0.001)
        pixels = np.asarray(cv2.cornerSubPix(image, pixels, (reach, reach), (-1, -1), end), np.float32)
    return pixels


# --- the shutter ------------------------------------------------------------------------------------------------------


#: s, 1 sigma up to which a readout counts as known; from where on a shutter is not global, and by so many sigmas.
LARGEST_STD, LEAST_READOUT, SURE = 0.00025, 0.001, 4.0
LONGEST = 0.1  # s; longer ones are not readouts
#: Share of the image's width that corners may move by from the frame before to the frame after; more is another board.
_LARGEST_MOTION = 0.5
_FEWEST_VIEWS = 3
_SINGULAR = 1e12
_LENS = 8  # focal lengths, centre, k1, k2, p1, p2


@dataclass(frozen=True, eq=False)
class BoardView:
    """Corners of a board in one frame: time s, places (N, 3) m on the board, pixels (N, 2)."""

    time: float
    places: Array
    pixels: Array


@dataclass(frozen=True)
class Readout:
    """s from the first row to the last, and 1 sigma; infinite where no view tells."""

    value: float = 0.0
    std: float = math.inf

    @property
    def known(self) -> float | None:
        """The readout to write into a camera file, 0 = a global shutter; None = these views do not tell."""
        if not (self.std <= LARGEST_STD and abs(self.value) < LONGEST):
            return None
        return self.value if abs(self.value) > max(LEAST_READOUT, SURE * self.std) else 0.0


def board_motion(before: BoardView, view: BoardView, after: BoardView, camera: Camera) -> Array | None:
    """Velocity (N, 2) px/s of a view's corners, from the views before and after; None where they do not belong together."""
    step = after.time - before.time
    poses = [_board_pose(v, camera) for v in (before, view, after)]
    if step <= 0 or any(pose is None for pose in poses):
        return None
    first, middle, last = (pose for pose in poses if pose is not None)
    for pose in (first, last):  # by the rotation vector of the same turn that is nearest to the middle one
        angle = float(np.linalg.norm(pose[:3]))
        turns = [pose[:3] * (1 + 2 * math.pi * k / max(angle, 1e-9)) for k in (-1, 0, 1)]
        pose[:3] = min(turns, key=lambda turn: float(np.linalg.norm(turn - middle[:3])))
    velocity: Array = (_slopes(view, middle, camera)[1][:, :6] @ ((last - first) / step)).reshape(-1, 2)
    return velocity if np.abs(velocity).max() * step < _LARGEST_MOTION * camera.width else None


def readout_of(views: Sequence[tuple[BoardView, Array]], camera: Camera) -> Readout:
    """Readout that explains best what the corners miss; its sigma from what every view does to it (jackknife).

    Args:
        views: with the velocities (N, 2) px/s of their corners. camera: its lens.
    """
    if len(views) < _FEWEST_VIEWS:
        return Readout()
    columns = [_without_pose(view, velocity, camera) for view, velocity in views]
    sizes = np.linalg.norm(np.concatenate(columns), axis=0)
    scaled = [part / np.maximum(sizes, 1e-12) for part in columns]
    products = np.stack([part.T @ part for part in scaled])  # a lens can look like a shutter: both are solved for
    total = products.sum(axis=0)
    if np.linalg.cond(total[1:, 1:]) > _SINGULAR:
        return Readout()
    values = [np.linalg.solve(part[1:, 1:], part[1:, 0])[0] for part in (total, *(total - products))]
    value, *without = np.array(values) * sizes[0] / sizes[1]
    count = len(without)
    return Readout(float(value), math.sqrt((count - 1) ** 2 / count) * float(np.std(without)))


def at_frame_time(view: BoardView, velocity: Array, camera: Camera, readout: float) -> BoardView:
    """The view as a shutter that is open for all rows at the frame's time would show it."""
    return replace(view, pixels=view.pixels - readout * (view.pixels[:, [1]] / camera.height - 0.5) * velocity)


def _without_pose(view: BoardView, velocity: Array, camera: Camera) -> Array:
    """(2 N, 2 + L) px: what the corners miss, and their derivatives by readout and lens, less what a pose can explain."""
    pose = _board_pose(view, camera)
    if pose is None:
        return np.zeros((0, 2 + _LENS))
    predicted, slopes = _slopes(view, pose, camera)
    by_readout = (view.pixels[:, [1]] / camera.height - 0.5) * velocity
    columns = np.column_stack([(view.pixels - predicted).ravel(), by_readout.ravel(), slopes[:, 6:]])
    basis = np.linalg.qr(slopes[:, :6])[0]
    return columns - basis @ (basis.T @ columns)


def _board_pose(view: BoardView, camera: Camera) -> Array | None:
    """(6,) rotation vector (rad) and position (m) of the board in the camera frame."""
    import cv2

    solved, turn, place = cv2.solvePnP(view.places, view.pixels, camera.matrix, np.array(camera.distortion))
    return np.concatenate([turn.ravel(), place.ravel()]).astype(np.float64) if solved else None


def _slopes(view: BoardView, pose: Array, camera: Camera) -> tuple[Array, Array]:
    """Pixels (N, 2) of the corners at a pose, and their derivatives (2 N, 6 + L) by it and by the lens without k3."""
    import cv2

    found = cv2.projectPoints(view.places, pose[:3], pose[3:], camera.matrix, np.array(camera.distortion))
    return np.asarray(found[0], np.float64).reshape(-1, 2), np.asarray(found[1], np.float64)[:, : 6 + _LENS]


# --- lens and shutter together ----------------------------------------------------------------------------------------


MINIMUM_VIEWS = 6
#: A view whose corners miss by more than this many times the median of all views is left out.
_OUTLYING_VIEW = 3.0
#: rad rms, of the board's tilts about their mean. Parallel views do not tell the focal length, nor does its sigma tell that.
_LEAST_TILT = math.radians(8)
_LOOSEST_STD = 0.005  # s; a readout less certain than this is not followed
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
        moving = {}
        for k, view in views.items():
            before, after = (found[i] if 0 <= i < len(found) else None for i in (k - 1, k + 1))
            motion = board_motion(before, view, after, camera) if before and after else None
            if motion is not None:
                moving[k] = motion
        last = told
        told = readout_of([(views[k], motion) for k, motion in moving.items()], camera) if readout is None else told
        if readout is None and not (abs(told.value) < LONGEST and told.std < _LOOSEST_STD):
            break  # a board that hardly moves
        still = [at_frame_time(v, moving[k], camera, told.value) if k in moving else v for k, v in views.items()]
        camera = _calibrated(still, len(middles), size, board)
        if abs(told.value - last.value) < _SAME_READOUT:
            break
    camera = camera if told.known else plain
    quality = camera.quality
    if quality is not None and told.known is not None:
        quality = quality.model_copy(update={"readout_std": told.std or None})
    return camera.model_copy(update={"readout": told.known, "quality": quality}), told


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
        views.append(None if found is None else BoardView(time, *(np.asarray(part, np.float64) for part in found)))
    if size is None:
        raise InputError("no images to calibrate from")
    return size, views


def _calibrated(views: Sequence[BoardView], pictures: int, size: tuple[int, int], board: Board) -> Camera:
    import cv2

    if len(views) < MINIMUM_VIEWS:
        raise InputError(
            f"the board ({board.kind}, {board.columns} x {board.rows} squares) is seen well in {len(views)} of {pictures} "
            f"images; at least {MINIMUM_VIEWS} are needed, each with {min(MINIMUM_CORNERS, board.corners)} corners, sharp, "
            "from different angles"
        )
    cells = np.floor(4 * np.concatenate([view.pixels for view in views]) / np.array(size)).astype(int).clip(0, 3)
    coverage = len(np.unique(cells, axis=0)) / 16
    if coverage < 0.5:
        raise InputError(
            f"the board's corners cover {100 * coverage:.0f} % of the image; show it in every corner (50 % or more)"
        )

    def solve(views: Sequence[BoardView]) -> Any:
        # the default solver can end in a poor minimum without a first guess; k3 stays 0, as it trades off against k2
        guess = np.array([[size[0], 0, 0.5 * (size[0] - 1)], [0, size[0], 0.5 * (size[1] - 1)], [0, 0, 1.0]])
        flags = cv2.CALIB_USE_INTRINSIC_GUESS | cv2.CALIB_FIX_K3
        places, pixels = ([getattr(view, name).astype(np.float32) for view in views] for name in ("places", "pixels"))
        return cv2.calibrateCameraExtended(places, pixels, size, guess, np.zeros(5), flags=flags)

    found = solve(views)
    misses = np.ravel(found[-1])
    keep = misses <= _OUTLYING_VIEW * np.median(misses)
    if not keep.all():
        found = solve([view for view, fine in zip(views, keep, strict=True) if fine])
    rms, matrix, distortion, turns, _, deviations, _, _ = found
    normals = np.stack([cv2.Rodrigues(turn)[0][:, 2] for turn in turns])
    tilt = math.sqrt(2 * max(0.0, 1 - float(np.linalg.norm(normals.mean(axis=0)))))
    if tilt < _LEAST_TILT:
        raise InputError(
            f"the board's tilts differ by {math.degrees(tilt):.0f} degrees only (rms), which does not tell the focal length; "
            "tilt it by up to 40 degrees, to every side"
        )
    std = np.ravel(deviations).tolist()
    return Camera(
        width=size[0],
        height=size[1],
        focal=(float(matrix[0, 0]), float(matrix[1, 1])),
        centre=(float(matrix[0, 2]), float(matrix[1, 2])),
        distortion=np.ravel(distortion)[:5].tolist(),
        quality=Quality(
            views=int(keep.sum()),
            rejected=int((~keep).sum()),
            rms=float(rms),
            coverage=coverage,
            focal_std=(std[0], std[1]),
            centre_std=(std[2], std[3]),
        ),
    )
