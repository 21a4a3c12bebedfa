"""Find ring markers anywhere in an image, and the ellipses of their three circles to sub-pixels.

First the whole image: adaptive threshold, contours that are ellipses. Then each of them on its own: its brightness profile is
held against every code, taking the contour for any of the marker's three edges. That stage needs no threshold, so uneven
light, tilt and blur do not stop it.

Along 64 rays from the centre of a guessed ellipse every edge is located by area: the mean brightness between the middles of
two neighbouring rings tells where between them the edge lies, and symmetric blur cancels. The edge points, not the image, are
undistorted, and one ellipse per circle is fitted to them (least squares over radial residuals, Huber weights). Its centre is
not the image of the circle's centre: :mod:`wlr_gym.perception.markers.pose` predicts the centre of the projected circle
instead.

Ellipses are affine maps of the unit circle, as (6,) arrays: centre (2), shape (2 x 2, row by row).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wlr_gym.base.compiled import compiled, inner_kernel
from wlr_gym.perception.markers.camera import Camera, undistort
from wlr_gym.perception.markers.targets import CODE_NAMES, ring_radii

RAYS = 64
RINGS = 3
# Columns of the quality row.
CONTRAST = 0  # least contrast of the used edges, grey levels
RESIDUAL = 1  # rms of the edges about the ellipses, px
SHARE = 2  # share of the edge points that are used
#: Worst error of a circle's radius over the outer radius (blur moves edges of narrow rings).
RADIUS_ERROR = 3

_ANGLES = 2.0 * np.pi * np.arange(RAYS) / RAYS
_COS = np.cos(_ANGLES)
_SIN = np.sin(_ANGLES)
_MINIMUM_CONTRAST = 12.0
_MINIMUM_RADIUS = 3.0  # px; smaller circles are too blurred to help
_MINIMUM_SHARE = 0.4  # of the rays, per ring
_LARGEST_WINDOW = 6.0  # px to either side of an edge
_GRAIN = 2.5  # px; edge points closer than this see the same pixels, and have the same error
_EDGE_FLOOR = 0.02  # px; 1 sigma no edge point is trusted below
_CENTRE_FLOOR = 0.008  # px; likewise for a centre


@compiled(inline="always")
def brightness(image: Any, x: float, y: float) -> float:
    """Bilinear brightness; NaN outside the image."""
    height, width = image.shape
    if not (0.0 <= x < width - 1.0 and 0.0 <= y < height - 1.0):
        return math.nan
    i, j = int(x), int(y)
    a, b = x - i, y - j
    top = (1.0 - a) * image[j, i] + a * image[j, i + 1]
    return (1.0 - b) * top + b * ((1.0 - a) * image[j + 1, i] + a * image[j + 1, i + 1])


@inner_kernel
def solve_normal(normal: Any, right: Any) -> bool:
    """Solve ``normal`` x = ``right`` in place (Cholesky; (N, N) and (N,)); the inverse goes to ``normal``. False = singular."""
    size = right.shape[0]
    lower, inverse, answer = np.empty((size, size)), np.empty((size, size)), np.empty(size)
    for i in range(size):
        for j in range(i + 1):
            rest = normal[i, j]
            for k in range(j):
                rest -= lower[i, k] * lower[j, k]
            if i > j:
                lower[i, j] = rest / lower[j, j]
            elif rest <= 1e-12 * (1.0 + normal[i, i]):
                return False
            else:
                lower[i, i] = math.sqrt(rest)
    for column in range(size):
        for i in range(column, size):
            rest = 1.0 if i == column else 0.0
            for k in range(column, i):
                rest -= lower[i, k] * inverse[k, column]
            inverse[i, column] = rest / lower[i, i]
    for i in range(size):
        answer[i] = 0.0
        for j in range(size):
            total = 0.0
            for k in range(max(i, j), size):
                total += inverse[k, i] * inverse[k, j]
            normal[i, j] = total
            answer[i] += total * right[j]
    for i in range(size):  # assigning to a slice takes seconds to compile
        right[i] = answer[i]
    return True


@inner_kernel
def _set_row(rows: Any, i: int, radius: float, c: float, s: float) -> None:
    """How the radius of an ellipse changes, in the direction (c, s), with its scale, centre (2) and shape (2)."""
    rows[i, 0], rows[i, 1], rows[i, 2] = radius, c, s
    rows[i, 3], rows[i, 4] = radius * (c * c - s * s), radius * 2.0 * c * s


@inner_kernel
def _weighted_fit(rows: Any, values: Any, weights: Any, answer: Any, inverse: Any) -> bool:
    """Weighted least squares: ``rows`` (N, 5) times ``answer`` (5,) is nearest to ``values`` (N,). False = singular."""
    answer[:] = 0.0
    inverse[:] = 0.0
    for i in range(weights.shape[0]):
        if weights[i] > 0.0:
            for a in range(5):
                share = weights[i] * rows[i, a]
                answer[a] += share * values[i]
                for b in range(5):
                    inverse[a, b] += share * rows[i, b]
    return solve_normal(inverse, answer)


@inner_kernel
def _median(values: Any) -> float:
    """The median of what is known; NaN where too few rays are."""
    known, count = np.empty(values.shape[0]), 0
    for value in values:
        if not math.isnan(value):
            known[count] = value
            count += 1
    if count < _MINIMUM_SHARE * RAYS:
        return math.nan
    return np.median(known[:count])


@inner_kernel
def _level(values: Any, contrast: float, fitted: Any) -> float:
    """Fit a + harmonics 1 and 2 over the rays to plateau brightness; far-off rays become NaN. Returns the middle level."""
    rows, weights, answer, inverse = np.empty((RAYS, 5)), np.empty(RAYS), np.empty(5), np.empty((5, 5))
    middle = _median(values)
    for j in range(RAYS):
        _set_row(rows, j, 1.0, _COS[j], _SIN[j])
        fitted[j] = middle
    for turn in range(2):
        limit = (0.45 if turn == 0 else 0.3) * contrast
        for j in range(RAYS):
            weights[j] = 1.0 if abs(values[j] - fitted[j]) <= limit else 0.0
        if not _weighted_fit(rows, values, weights, answer, inverse):
            return math.nan
        for j in range(RAYS):
            c, s = rows[j, 1], rows[j, 2]
            fitted[j] = answer[0] + answer[1] * c + answer[2] * s + answer[3] * rows[j, 3] + answer[4] * 2.0 * c * s
    return middle


@inner_kernel
def _edges(image: Any, ellipse: Any, radii: Any, edges: Any, contrasts: Any) -> None:
    """Fill ``edges`` (RINGS RAYS,) with edge radii over the outer radius; NaN where there is none."""
    scale = math.sqrt(abs(ellipse[2] * ellipse[5] - ellipse[3] * ellipse[4]))
    inside, outside, means = np.empty(RAYS), np.empty(RAYS), np.empty(RAYS)
    fitted_in, fitted_out = np.empty(RAYS), np.empty(RAYS)
    edges[:] = math.nan
    contrasts[:] = 0.0
    for k in range(RINGS):
        outer_gap = 0.5 if k == 0 else 0.5 * (radii[k - 1] - radii[k])
        inner_gap = 0.8 * radii[k] if k == RINGS - 1 else 0.5 * (radii[k] - radii[k + 1])
        half = min(min(outer_gap, inner_gap), _LARGEST_WINDOW / scale)
        if k == 0:
            half = min(half, 0.25)
        if radii[k] * scale < _MINIMUM_RADIUS:
            continue
        start, stop = radii[k] - half, radii[k] + half
        count = math.ceil(min(32.0, max(6.0, 4.0 * half * scale)))
        step = (stop - start) / count
        for j in range(RAYS):
            dx = ellipse[2] * _COS[j] + ellipse[3] * _SIN[j]
            dy = ellipse[4] * _COS[j] + ellipse[5] * _SIN[j]
            total = 0.0
            for i in range(count + 1):
                rho = start + step * i
                value = brightness(image, ellipse[0] + rho * dx, ellipse[1] + rho * dy)
                if i == 0:
                    inside[j] = value
                    value *= 0.5
                elif i == count:
                    outside[j] = value
                    value *= 0.5
                total += value
            means[j] = total / count
        sign = -1.0 if k == 1 else 1.0
        contrast = sign * (_median(outside) - _median(inside))
        if not contrast > _MINIMUM_CONTRAST:
            continue
        if math.isnan(_level(inside, contrast, fitted_in)) or math.isnan(_level(outside, contrast, fitted_out)):
            continue
        contrasts[k] = contrast
        for j in range(RAYS):
            if not (abs(inside[j] - fitted_in[j]) < 0.35 * contrast and abs(outside[j] - fitted_out[j]) < 0.35 * contrast):
                continue
            share = (means[j] - fitted_out[j]) / (fitted_in[j] - fitted_out[j])
            if 0.06 < share < 0.94:
                edges[k * RAYS + j] = start + share * (stop - start)


@inner_kernel
def _fit(rho: Any, cosine: Any, sine: Any, radius: Any, answer: Any, inverse: Any) -> tuple[float, int, float]:
    """Fit radial residuals rho - radius, where rho is not NaN: scale, centre (2), shape (2), with Huber weights.

    Returns:
        Rms, infinite where the fit is no good; number of points used; the largest change.
    """
    count = rho.shape[0]
    rows, offsets, weights = np.empty((count, 5)), rho - radius, np.empty(count)
    residuals, sizes = np.empty(count), np.empty(count)
    for i in range(count):
        _set_row(rows, i, radius[i], cosine[i], sine[i])
        weights[i] = 0.0 if math.isnan(rho[i]) else 1.0
    if weights.sum() < _MINIMUM_SHARE * RAYS:
        return math.inf, 0, math.inf
    spread, used = math.inf, 0
    for _ in range(3):
        if not _weighted_fit(rows, offsets, weights, answer, inverse):
            return math.inf, 0, math.inf
        for i in range(count):
            c, s = cosine[i], sine[i]
            shape = radius[i] * (answer[0] + answer[3] * (c * c - s * s) + answer[4] * 2.0 * c * s)
            residuals[i] = offsets[i] - shape - answer[1] * c - answer[2] * s
            sizes[i] = abs(residuals[i])
        limit = 1.5 * 1.4826 * _median(sizes) + 1e-12
        total, used = 0.0, 0
        for i in range(count):
            weights[i] = 0.0
            if sizes[i] < 3.0 * limit:
                weights[i] = 1.0 if sizes[i] < limit else limit / sizes[i]
                total += weights[i] * residuals[i] * residuals[i]
                used += 1
        spread = math.sqrt(total / max(1, used - 5))
    largest = np.abs(answer).max()
    return (spread if spread < 0.2 and largest <= 0.5 else math.inf), used, largest


@inner_kernel
def _change(ellipse: Any, answer: Any) -> None:
    """Move an ellipse by the result of a fit."""
    xx, xy, yy = 1.0 + answer[0] + answer[3], answer[4], 1.0 + answer[0] - answer[3]
    for axis in range(2):
        k = 2 + 2 * axis
        a, b = ellipse[k], ellipse[k + 1]
        ellipse[axis] += a * answer[1] + b * answer[2]
        ellipse[k], ellipse[k + 1] = a * xx + b * xy, a * xy + b * yy


@compiled
def fit_marker(
    image: Any, camera: Any, ellipse: Any, radii: Any, centres: Any, covariances: Any, shape: Any, quality: Any
) -> bool:
    """Refine one marker.

    Args:
        image: (H, W) grey.
        camera: (9,) of :attr:`wlr_gym.perception.markers.camera.Camera.values`.
        ellipse: (6,) guess of the outer circle's image, px; refined in place.
        radii: (3,) of the marker's circles over the outer radius.
        centres, covariances: (3, 2) and (3, 2, 2) output: centre of each circle's ellipse, undistorted coordinates; NaN for
            circles not used.
        shape: (6,) output: the outer circle's ellipse, undistorted.
        quality: (4,) output, see :data:`CONTRAST` and the names beside it.

    Returns:
        Whether it is a marker: edges of the right polarity at the right radii around most of it.
    """
    points = RINGS * RAYS
    edges, cosine, sine, radius = np.empty(points), np.empty(points), np.empty(points), np.empty(points)
    contrasts, answer, inverse = np.empty(RINGS), np.empty(5), np.empty((5, 5))
    for i in range(points):
        cosine[i], sine[i], radius[i] = _COS[i % RAYS], _SIN[i % RAYS], radii[i // RAYS]
    centres[:] = math.nan
    quality[:] = 0.0
    for turn in range(4):
        scale = math.sqrt(abs(ellipse[2] * ellipse[5] - ellipse[3] * ellipse[4]))
        if not 2.0 < scale < 2000.0:
            return False
        _edges(image, ellipse, radii, edges, contrasts)
        spread, _, largest = _fit(edges, cosine, sine, radius, answer, inverse)
        if math.isinf(spread):
            return False
        if turn == 3 or largest * scale < 0.02:
            break  # the edges below belong to this ellipse
        _change(ellipse, answer)
    x, y = undistort(camera, ellipse[0], ellipse[1])
    rx, ry = undistort(camera, ellipse[0] + 1.0, ellipse[1])
    dx, dy = undistort(camera, ellipse[0], ellipse[1] + 1.0)
    shape[0], shape[1] = x, y
    for k in range(2, 4):  # to first order
        shape[k] = (rx - x) * ellipse[k] + (dx - x) * ellipse[k + 2]
        shape[k + 2] = (ry - y) * ellipse[k] + (dy - y) * ellipse[k + 2]
    return _fit_circles(camera, ellipse, radii, edges, contrasts, centres, covariances, shape, quality)


@inner_kernel
def _fit_circles(
    camera: Any, ellipse: Any, radii: Any, edges: Any, contrasts: Any, centres: Any, covariances: Any, shape: Any, quality: Any
) -> bool:
    """One ellipse per circle, from edge points in undistorted coordinates."""
    pixels = math.sqrt(abs(ellipse[2] * ellipse[5] - ellipse[3] * ellipse[4]))
    x, y = np.empty(RAYS), np.empty(RAYS)
    rho, cosine, sine, radius = np.empty(RAYS), np.empty(RAYS), np.empty(RAYS), np.empty(RAYS)
    answer, inverse = np.empty(5), np.empty((5, 5))
    contrast, worst, squares, points, rings = math.inf, 0.0, 0.0, 0, 0
    for k in range(RINGS):
        for j in range(RAYS):
            radius[j], x[j], y[j] = radii[k], math.nan, math.nan
            edge = edges[k * RAYS + j]
            if not math.isnan(edge):
                u = ellipse[0] + edge * (ellipse[2] * _COS[j] + ellipse[3] * _SIN[j])
                v = ellipse[1] + edge * (ellipse[4] * _COS[j] + ellipse[5] * _SIN[j])
                x[j], y[j] = undistort(camera, u, v)
        ring = shape.copy()
        spread, used, growth = math.inf, 0, 1.0
        for _ in range(2):
            determinant = ring[2] * ring[5] - ring[3] * ring[4]
            for i in range(RAYS):
                dx, dy = x[i] - ring[0], y[i] - ring[1]
                p, q = (ring[5] * dx - ring[3] * dy) / determinant, (ring[2] * dy - ring[4] * dx) / determinant
                rho[i] = math.hypot(p, q)
                cosine[i], sine[i] = p / rho[i], q / rho[i]
            spread, used, _ = _fit(rho, cosine, sine, radius, answer, inverse)
            if math.isinf(spread):
                break
            growth *= 1.0 + answer[0]
            _change(ring, answer)
        off = abs(growth - 1.0) * radii[k]
        if math.isinf(spread) or used < 0.3 * RAYS or off > 0.12:
            continue
        alike = max(1.0, RAYS * _GRAIN / (2.0 * math.pi * radii[k] * pixels))
        sigma = math.sqrt(alike) * max(spread, _EDGE_FLOOR / pixels)
        floor, variance = (_CENTRE_FLOOR / pixels) * (_CENTRE_FLOOR / pixels), sigma * sigma
        xx, xy, yy = variance * inverse[1, 1] + floor, variance * inverse[1, 2], variance * inverse[2, 2] + floor
        for i in range(2):
            a, b = ring[2 + 2 * i], ring[3 + 2 * i]
            for j in range(2):
                c, d = ring[2 + 2 * j], ring[3 + 2 * j]
                covariances[k, i, j] = a * c * xx + (a * d + b * c) * xy + b * d * yy
            centres[k, i] = ring[i]
        contrast, worst = min(contrast, contrasts[k]), max(worst, off)
        squares += used * (spread * pixels * (spread * pixels))
        points += used
        rings += 1
        if k == 0:
            for i in range(6):
                shape[i] = ring[i]
    if rings < 2:  # one circle alone could be anything
        return False
    quality[0], quality[1] = contrast, math.sqrt(squares / points)
    quality[2], quality[3] = points / (RINGS * RAYS), worst
    return True


# --- the whole image --------------------------------------------------------------------------------------------------


Array = NDArray[np.float64]
Image = NDArray[np.uint8]

SMALLEST_RADIUS = 5.0  # px, of a marker's outer circle
#: Shrinking of the image and block (px) of the adaptive threshold: large markers, usual ones, ones beside a shadow's edge.
_PASSES = ((1, 51), (2, 51), (1, 21))
_OFFSET = 6  # grey levels below the mean of the block from which on a pixel is dark
_LARGEST_AXIS_RATIO = 4.0
_ELLIPSE_TOLERANCE = 0.15  # of the area
_LEAST_MATCH = 0.78  # correlation of a brightness profile with a code
#: Shares of the outer radius at which a brightness profile is taken.
_GRID = (np.arange(26) + 0.5) / 20


@cache
def _codes() -> tuple[Array, Array]:
    """Return radii (codes, 3) and profiles (codes, 26) of every code: +1 white, -1 black."""
    radii = np.array([ring_radii(code) for code in range(len(CODE_NAMES))])
    return radii, np.array([[1.0 if rho > 1 or r3 < rho < r2 else -1.0 for rho in _GRID] for _, r2, r3 in radii])


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
    if not fit_marker(image, camera, guess, _codes()[0][code], centres, covariances, shape, quality):
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
    kept: list[Detection] = []
    for candidate in sorted(found, key=lambda d: -d.contrast * d.share):  # the better of two at one place
        if not any(_same_place(candidate.ellipse, other) for other in kept):
            kept.append(candidate)
    return kept


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
    radii, profiles = _codes()
    scores = np.empty((len(radii), RINGS))
    _match(image, ellipse, radii, profiles, _GRID, scores)
    for index in np.argsort(-scores, axis=None)[:2]:
        code, edge = divmod(int(index), RINGS)
        if not scores[code, edge] > _LEAST_MATCH:
            return None
        guess = ellipse.copy()
        guess[2:] /= radii[code, edge]
        found = refine(image, camera, guess, code)
        if found is not None and found.radius > SMALLEST_RADIUS:
            return found
    return None


@compiled
def _match(image: Any, ellipse: Any, radii: Any, profiles: Any, grid: Any, scores: Any) -> None:
    """Correlate the mean profile around an ellipse with every code, taking the ellipse for each of its edges."""
    profile = np.empty(grid.shape[0])
    for edge in range(RINGS):
        for code in range(radii.shape[0]):
            if edge > 0 or code == 0:  # taken for the outer edge, the profile is the same for every code
                _profile(image, ellipse, grid, radii[code, edge], profile)
            x, y = profile - profile.mean(), profiles[code] - profiles[code].mean()
            spread = (x * x).sum() * (y * y).sum()
            scores[code, edge] = (x * y).sum() / math.sqrt(spread) if spread > 0.0 else -1.0


@inner_kernel
def _profile(image: Any, ellipse: Any, grid: Any, radius: float, profile: Any) -> None:
    """Mean brightness along ellipses scaled by ``grid`` / ``radius``; NaN where half of one lies outside the image."""
    for i in range(grid.shape[0]):
        rho, total, known = grid[i] / radius, 0.0, 0
        for j in range(16):
            c, s = math.cos(2.0 * math.pi * j / 16), math.sin(2.0 * math.pi * j / 16)
            x = ellipse[0] + rho * (ellipse[2] * c + ellipse[3] * s)
            y = ellipse[1] + rho * (ellipse[4] * c + ellipse[5] * s)
            value = brightness(image, x, y)
            if not math.isnan(value):
                total += value
                known += 1
        profile[i] = total / known if known >= 8 else math.nan
