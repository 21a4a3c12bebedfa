"""Find ring markers anywhere in an image, in two stages.

First the whole image: adaptive threshold, contours that are ellipses. Then each of them on its own: its brightness profile is
held against every code, taking the contour for any of the marker's three edges, and the edges are located to sub-pixels
(:mod:`wlr_gym.perception.markers.rings`). The second stage needs no threshold, so uneven light, tilt and blur do not stop it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from wlr_gym.base.compiled import inner_kernel
from wlr_gym.perception.markers.camera import Camera
from wlr_gym.perception.markers.rings import CONTRAST, RADIUS_ERROR, RESIDUAL, SHARE, brightness, fit_marker
from wlr_gym.perception.markers.targets import CODE_NAMES, ring_radii

Array = NDArray[np.float64]
Image = NDArray[np.uint8]

SMALLEST_RADIUS = 5.0  # px, of a marker's outer circle
#: Shrinking of the image and block (px) of the adaptive threshold: large markers, usual ones, ones beside a shadow's edge.
_PASSES = ((1, 51), (2, 51), (1, 21))
#: Grey levels below the mean of the block from which on a pixel is dark.
_OFFSET = 6
_LARGEST_AXIS_RATIO = 4.0
_ELLIPSE_TOLERANCE = 0.15  # of the area
_LEAST_MATCH = 0.78  # correlation of a brightness profile with a code
_RADII = np.array([ring_radii(code) for code in range(len(CODE_NAMES))])
#: Profile of every code: +1 white, -1 black, at these shares of the outer radius.
_GRID = (np.arange(26) + 0.5) / 20
_PROFILES = np.array([[1.0 if rho > 1 or r3 < rho < r2 else -1.0 for rho in _GRID] for _, r2, r3 in _RADII])


@dataclass(frozen=True, eq=False)
class Detection:
    """One marker found in an image.

    Attributes:
        code: number in :data:`CODE_NAMES`.
        ellipse: (6,) image of the outer circle, px: centre, shape (2 x 2) that maps the unit circle to it.
        centres: (3, 2) centres of the three circles' ellipses, undistorted coordinates; NaN = circle not used.
        covariances: (3, 2, 2) of them.
        shape: (6,) the outer ellipse in undistorted coordinates.
        contrast: grey levels. residual: px rms. share: of the edge points that were usable.
    """

    code: int
    ellipse: Array
    centres: Array
    covariances: Array
    shape: Array
    contrast: float
    residual: float
    share: float

    @property
    def radius(self) -> float:
        """Mean radius in the image, px."""
        return math.sqrt(abs(self.ellipse[2] * self.ellipse[5] - self.ellipse[3] * self.ellipse[4]))


def refine(image: Image, camera: Array, ellipse: Array, code: int) -> Detection | None:
    """Fit a marker of a known code near a guessed ellipse (6,), px; None where there is none. ``camera``: its ``values``."""
    guess, shape, quality = np.array(ellipse, float), np.empty(6), np.empty(4)
    centres, covariances = np.full((3, 2), np.nan), np.full((3, 2, 2), np.nan)
    if not fit_marker(image, camera, guess, _RADII[code], centres, covariances, shape, quality):
        return None
    if quality[RADIUS_ERROR] > 0.1:
        return None
    found = Detection(code, guess, centres, covariances, shape, quality[CONTRAST], quality[RESIDUAL], quality[SHARE])
    return found if found.residual < max(0.5, 0.06 * found.radius) else None


def detect(image: Image, camera: Camera, box: tuple[int, int, int, int] | None = None) -> list[Detection]:
    """Return all markers in an image, or in its part (x0, y0, x1, y1), the clearest first.

    Args:
        image: (H, W) grey. camera: its lens. box: px.
    """
    x0, y0, x1, y1 = box or (0, 0, image.shape[1], image.shape[0])
    part = np.ascontiguousarray(image[y0:y1, x0:x1])
    if min(part.shape) < 16:
        return []
    found: list[Detection] = []
    for factor, block in _PASSES:
        for ellipse in _ellipses(part, factor, block, (x0, y0)):
            if any(_same_place(ellipse, other) for other in found):
                continue
            candidate = _identify(image, camera.values, ellipse)
            if candidate is not None:
                found.append(candidate)
    return _distinct(found)


def _ellipses(part: Image, factor: int, block: int, corner: tuple[int, int]) -> list[Array]:
    """Contours that are ellipses, the largest first, in px of the whole image."""
    import cv2

    grey = part if factor == 1 else cv2.resize(part, None, fx=1 / factor, fy=1 / factor, interpolation=cv2.INTER_AREA)
    grey = cv2.GaussianBlur(grey, (3, 3), 0)
    dark = cv2.adaptiveThreshold(grey, 255, cv2.ADAPTIVE_THRESH_MEAN_C, cv2.THRESH_BINARY_INV, block, _OFFSET)
    contours, _ = cv2.findContours(dark, cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
    result = []
    for contour in contours:
        if len(contour) < 14:
            continue
        area = cv2.contourArea(contour)
        if area < 30.0 or area < 0.02 * len(contour) ** 2:  # an ellipse of axis ratio 4 has 0.04
            continue
        # centre of OpenCV's ellipse axes: (width, height) are full axes, the angle is that of the width
        (x, y), (width, height), angle = cv2.fitEllipseDirect(contour.reshape(-1, 2))
        if not 0 < max(width, height) < _LARGEST_AXIS_RATIO * min(width, height):
            continue
        if abs(area / (math.pi / 4 * width * height) - 1) > _ELLIPSE_TOLERANCE + 4 / min(width, height):
            continue
        c, s = math.cos(math.radians(angle)), math.sin(math.radians(angle))
        a, b = factor * width / 2, factor * height / 2
        shift = 0.5 * (factor - 1)
        result.append(np.array([factor * x + shift + corner[0], factor * y + shift + corner[1], a * c, -b * s, a * s, b * c]))
    return sorted(result, key=lambda e: -abs(e[2] * e[5] - e[3] * e[4]))


def _same_place(ellipse: Array, other: Detection) -> bool:
    return math.hypot(ellipse[0] - other.ellipse[0], ellipse[1] - other.ellipse[1]) < 0.7 * other.radius


def _identify(image: Image, camera: Array, ellipse: Array) -> Detection | None:
    """Try the codes and edges whose profile fits, the best first."""
    scores = np.empty((len(_RADII), 3))
    _match(image, ellipse, _RADII, _PROFILES, _GRID, scores)
    for index in np.argsort(-scores, axis=None)[:2]:
        code, edge = divmod(int(index), 3)
        if not scores[code, edge] > _LEAST_MATCH:
            return None
        guess = ellipse.copy()
        guess[2:] /= _RADII[code, edge]
        found = refine(image, camera, guess, code)
        if found is not None and found.radius > SMALLEST_RADIUS:
            return found
    return None


def _distinct(found: list[Detection]) -> list[Detection]:
    """Drop the worse of two at one place."""
    ranked = sorted(found, key=lambda d: -d.contrast * d.share)
    kept: list[Detection] = []
    for candidate in ranked:
        if not any(_same_place(candidate.ellipse, other) for other in kept):
            kept.append(candidate)
    return kept


@njit(cache=True, nogil=True)
def _match(image: Any, ellipse: Any, radii: Any, profiles: Any, grid: Any, scores: Any) -> None:
    """Correlate the mean profile around an ellipse with every code, taking the ellipse for each of its edges."""
    profile = np.empty(grid.shape[0])
    for edge in range(3):
        for code in range(radii.shape[0]):
            if edge > 0 or code == 0:  # taken for the outer edge, the profile is the same for every code
                _profile(image, ellipse, grid, radii[code, edge], profile)
            scores[code, edge] = _correlation(profile, profiles, code)


@inner_kernel
def _profile(image: Any, ellipse: Any, grid: Any, radius: float, profile: Any) -> None:
    """Mean brightness along ellipses scaled by ``grid`` / ``radius``; NaN where half of one lies outside the image."""
    for i in range(grid.shape[0]):
        rho, total, known = grid[i] / radius, 0.0, 0
        for j in range(16):
            angle = 2.0 * math.pi * j / 16
            c, s = math.cos(angle), math.sin(angle)
            x = ellipse[0] + rho * (ellipse[2] * c + ellipse[3] * s)
            y = ellipse[1] + rho * (ellipse[4] * c + ellipse[5] * s)
            value = brightness(image, x, y)
            if not math.isnan(value):
                total += value
                known += 1
        profile[i] = total / known if known >= 8 else math.nan


@inner_kernel
def _correlation(profile: Any, profiles: Any, code: int) -> float:
    count = profile.shape[0]
    mean, mean_code = 0.0, 0.0
    for i in range(count):
        mean += profile[i] / count
        mean_code += profiles[code, i] / count
    xx, xy, yy = 0.0, 0.0, 0.0
    for i in range(count):
        x, y = profile[i] - mean, profiles[code, i] - mean_code
        xx += x * x
        xy += x * y
        yy += y * y
    return xy / math.sqrt(xx * yy) if xx * yy > 0.0 else -1.0
