"""The camera: pinhole with radial and tangential lens distortion (OpenCV's k1 k2 p1 p2 k3); load and save.

Pixel coordinates: (0, 0) is the centre of the upper left pixel, x right, y down. Camera frame: x right, y down, z forward.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray
from pydantic import ConfigDict, Field

from wlr_gym.base.compiled import compiled
from wlr_gym.base.errors import InputError
from wlr_gym.base.paths import as_path
from wlr_gym.base.provenance import write_yaml
from wlr_gym.base.settings import SettingsModel, parse_config, read_yaml
from wlr_gym.base.text import quoted

Array = NDArray[np.float64]

SCHEMA = 1
#: Of the longer side; the model does not fit lenses that see more than 136 degrees.
_SHORTEST_FOCAL = 0.2


class Quality(SettingsModel):
    """What a calibration says about itself.

    Attributes:
        views: used; rejected: left out for their reprojection error.
        rms: px, of the corners against the model.
        coverage: share of a 4 x 4 grid over the image that has corners in it.
        focal_std: px, 1 sigma of fx and fy; centre_std: px, of cx and cy.
        readout_std: s, 1 sigma of the readout; None = it was given, or is not known.
    """

    model_config: ClassVar[ConfigDict] = ConfigDict(allow_inf_nan=True)

    views: int
    rejected: int
    rms: float
    coverage: float
    focal_std: tuple[float, float]
    centre_std: tuple[float, float]
    readout_std: float | None = None


class Camera(SettingsModel):
    """Intrinsic parameters.

    Attributes:
        width, height: px; images of another size are refused.
        focal: (fx, fy) px. centre: (cx, cy) px.
        distortion: (k1, k2, p1, p2, k3).
        readout: s from the first row's exposure to the last row's; 0 = global shutter, None = not known: films tell it.
        quality: of the calibration; None for parameters from elsewhere.
    """

    camera_format: int = Field(default=SCHEMA, ge=1, le=SCHEMA)
    width: int = Field(gt=0)
    height: int = Field(gt=0)
    focal: tuple[float, float]
    centre: tuple[float, float]
    distortion: tuple[float, float, float, float, float] = (0.0, 0.0, 0.0, 0.0, 0.0)
    readout: float | None = Field(default=None, gt=-0.1, lt=0.1)
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
    path = as_path(path)
    if not path.is_file():
        new = path if path.suffix in {".yaml", ".yml"} else "camera.yaml"
        raise InputError(f"{path}: no such camera file; make one with: wlr calibrate camera IMAGES --out {quoted(new)}")
    camera = parse_config(Camera, read_yaml(path), str(path))
    if min(camera.focal) < _SHORTEST_FOCAL * max(camera.width, camera.height):
        raise InputError(f"{path}: focal = {list(camera.focal)}: expected pixels; these look like millimetres")
    return camera


def save_camera(path: str | Path, camera: Camera) -> None:
    """Write a camera file (YAML)."""
    write_yaml(Path(path), camera.model_dump(mode="json"))


# --- kernels ----------------------------------------------------------------------------------------------------------


@compiled(inline="always")
def distort(camera: Any, x: float, y: float) -> tuple[float, float]:
    """Pixel of a direction (x, y, 1) in the camera frame."""
    r2 = x * x + y * y
    radial = 1.0 + r2 * (camera[4] + r2 * (camera[5] + r2 * camera[8]))
    px, py = camera[6], camera[7]
    dx = x * radial + 2.0 * px * x * y + py * (r2 + 2.0 * x * x)
    dy = y * radial + px * (r2 + 2.0 * y * y) + 2.0 * py * x * y
    return camera[0] * dx + camera[2], camera[1] * dy + camera[3]


@compiled
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
