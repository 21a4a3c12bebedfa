"""Calibration boards: ChArUco and plain chessboards of any size, and their corners in a picture."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wlr_gym.base.errors import InputError, unknown_name

Array = NDArray[np.float64]

#: Kinds of boards: with coded markers; the same as OpenCV drew them before 4.6 (differs with an even number of rows); plain.
CHARUCO, LEGACY, CHESSBOARD = "charuco", "charuco-legacy", "chessboard"
KINDS = (CHARUCO, LEGACY, CHESSBOARD)
#: Corners that a view needs, and that a board must have.
MINIMUM_CORNERS, FEWEST_CORNERS = 12, 6
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
        if self.kind not in KINDS:
            raise unknown_name("board", self.kind, KINDS)
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
        if self.dictionary.upper() not in names:
            raise unknown_name("dictionary", self.dictionary, names)
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
        seen = np.asarray(ids, np.intp).reshape(-1)
        return self.places[seen], np.asarray(corners, np.float32).reshape(-1, 2)


def _chess_corners(image: NDArray[np.uint8], columns: int, rows: int) -> NDArray[np.float32] | None:
    import cv2

    scale = min(1.0, _CHESS_SIDE / max(image.shape))
    small = cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA) if scale < 1 else image
    found, corners = cv2.findChessboardCornersSB(small, (columns, rows), flags=cv2.CALIB_CB_ACCURACY)
    if not found:
        return None
    pixels = (np.asarray(corners, np.float32).reshape(-1, 2) + 0.5) / scale - 0.5
    if scale == 1:
        return pixels.astype(np.float32)
    pixels = np.ascontiguousarray(pixels, np.float32)
    apart = float(np.linalg.norm(np.diff(pixels.reshape(rows, columns, 2), axis=1), axis=2).min())
    reach = int(np.clip(apart / 4, 2, 15))
    end = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_COUNT, 30, 0.001)
    return np.asarray(cv2.cornerSubPix(image, pixels, (reach, reach), (-1, -1), end), np.float32)
