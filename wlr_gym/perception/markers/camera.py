"""The camera: pinhole with radial and tangential lens distortion (OpenCV's k1 k2 p1 p2 k3); calibration, load and save.

Pixel coordinates: (0, 0) is the centre of the upper left pixel, x right, y down. Camera frame: x right, y down, z forward.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numba import njit
from numpy.typing import NDArray
from pydantic import ConfigDict, Field

from wlr_gym.base.errors import InputError
from wlr_gym.base.provenance import write_yaml
from wlr_gym.base.settings import SettingsModel, parse_config, read_yaml

if TYPE_CHECKING:
    from wlr_gym.perception.vision.sheets import Board

Array = NDArray[np.float64]

SCHEMA = 1
MINIMUM_VIEWS = 6
MINIMUM_CORNERS = 12
#: A view whose corners miss by more than this many times the median of all views is left out.
_OUTLYING_VIEW = 3.0
#: Of the longer side; the model does not fit lenses that see more than 136 degrees.
_SHORTEST_FOCAL = 0.2
#: rad rms, of the board's tilts about their mean. Parallel views do not tell the focal length, nor does its sigma tell that.
_LEAST_TILT = math.radians(8)


class Quality(SettingsModel):
    """What a calibration says about itself.

    Attributes:
        views: used; rejected: left out for their reprojection error.
        rms: px, of the corners against the model.
        coverage: share of a 4 x 4 grid over the image that has corners in it.
        focal_std: px, 1 sigma of fx and fy; centre_std: px, of cx and cy.
    """

    model_config = ConfigDict(allow_inf_nan=True)

    views: int
    rejected: int
    rms: float
    coverage: float
    focal_std: tuple[float, float]
    centre_std: tuple[float, float]


class Camera(SettingsModel):
    """Intrinsic parameters.

    Attributes:
        width, height: px; images of another size are refused.
        focal: (fx, fy) px. centre: (cx, cy) px.
        distortion: (k1, k2, p1, p2, k3).
        quality: of the calibration; None for parameters from elsewhere.
    """

    camera_format: int = Field(default=SCHEMA, ge=1, le=SCHEMA)
    width: int = Field(gt=0)
    height: int = Field(gt=0)
    focal: tuple[float, float]
    centre: tuple[float, float]
    distortion: tuple[float, float, float, float, float] = (0.0, 0.0, 0.0, 0.0, 0.0)
    quality: Quality | None = None

    @property
    def values(self) -> Array:
        """(9,) fx, fy, cx, cy, k1, k2, p1, p2, k3: what the kernels take."""
        return np.array([*self.focal, *self.centre, *self.distortion])

    @property
    def matrix(self) -> Array:
        """(3, 3) camera matrix."""
        return np.array([[self.focal[0], 0, self.centre[0]], [0, self.focal[1], self.centre[1]], [0, 0, 1.0]])


def load_camera(path: str | Path) -> Camera:
    """Read a camera file.

    Raises:
        InputError: no such file, not a camera, impossible numbers.
    """
    path = Path(path)
    if not path.is_file():
        raise InputError(f"{path}: no such camera file; make one with: wlr calibrate camera IMAGES --out {path}")
    camera = parse_config(Camera, read_yaml(path), str(path))
    if min(camera.focal) < _SHORTEST_FOCAL * max(camera.width, camera.height):
        raise InputError(f"{path}: focal = {list(camera.focal)}: expected pixels; these look like millimetres")
    return camera


def save_camera(path: str | Path, camera: Camera) -> None:
    """Write a camera file (YAML)."""
    content = {key: list(value) if isinstance(value, tuple) else value for key, value in camera.model_dump().items()}
    if camera.quality is not None:
        quality = camera.quality.model_dump()
        content["quality"] = {key: list(value) if isinstance(value, tuple) else value for key, value in quality.items()}
    write_yaml(Path(path), content)


# --- kernels ----------------------------------------------------------------------------------------------------------


@njit(cache=True, nogil=True, inline="always")
def distort(camera: Any, x: float, y: float) -> tuple[float, float]:
    """Pixel of a direction (x, y, 1) in the camera frame."""
    r2 = x * x + y * y
    radial = 1.0 + r2 * (camera[4] + r2 * (camera[5] + r2 * camera[8]))
    px, py = camera[6], camera[7]
    dx = x * radial + 2.0 * px * x * y + py * (r2 + 2.0 * x * x)
    dy = y * radial + px * (r2 + 2.0 * y * y) + 2.0 * py * x * y
    return camera[0] * dx + camera[2], camera[1] * dy + camera[3]


@njit(cache=True, nogil=True)
def undistort(camera: Any, u: float, v: float) -> tuple[float, float]:
    """Direction (x, y, 1) of a pixel: Newton's method on :func:`distort`, to 1e-12."""
    tx, ty = (u - camera[2]) / camera[0], (v - camera[3]) / camera[1]
    k1, k2, p1, p2, k3 = camera[4], camera[5], camera[6], camera[7], camera[8]
    x, y = tx, ty
    for _ in range(30):
        r2 = x * x + y * y
        radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
        slope = 2.0 * (k1 + r2 * (2.0 * k2 + 3.0 * r2 * k3))
        ex = x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x) - tx
        ey = y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y - ty
        a = radial + slope * x * x + 2.0 * p1 * y + 6.0 * p2 * x
        b = slope * x * y + 2.0 * p1 * x + 2.0 * p2 * y
        d = radial + slope * y * y + 6.0 * p1 * y + 2.0 * p2 * x
        determinant = a * d - b * b
        if abs(determinant) < 1e-9:
            return math.nan, math.nan
        dx, dy = (d * ex - b * ey) / determinant, (a * ey - b * ex) / determinant
        x, y = x - dx, y - dy
        if abs(dx) + abs(dy) < 1e-12:
            break
    return x, y


# --- calibration ------------------------------------------------------------------------------------------------------


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
        distortion=tuple(float(k) for k in found["distortion"]),  # type: ignore[arg-type]
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
