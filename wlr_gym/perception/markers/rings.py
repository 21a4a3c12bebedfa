"""Sub-pixel edges of a ring marker, and the ellipses of its three circles in undistorted coordinates.

Along 64 rays from the centre of a guessed ellipse every edge is located by area: the mean brightness between the middles of
two neighbouring rings tells where between them the edge lies, and symmetric blur cancels. The edge points, not the image, are
undistorted, and one ellipse per circle is fitted to them (least squares over radial residuals, Huber weights). Its centre is
not the image of the circle's centre: :mod:`wlr_gym.perception.markers.pose` predicts the centre of the projected circle
instead.

Ellipses are affine maps of the unit circle, as (6,) arrays: centre (2), shape (2 x 2, row by row).
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba import njit

from wlr_gym.perception.markers.camera import undistort

RAYS = 64
RINGS = 3
# Columns of the quality row.
#: Least contrast of the used edges, grey levels.
CONTRAST = 0
#: Rms of the edges about the ellipses, px.
RESIDUAL = 1
#: Share of the edge points that are used.
SHARE = 2
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


@njit(cache=True, nogil=True, inline="always")
def brightness(image: Any, x: float, y: float) -> float:
    """Bilinear brightness; NaN outside the image."""
    height, width = image.shape
    if not (0.0 <= x < width - 1.0 and 0.0 <= y < height - 1.0):
        return math.nan
    i, j = int(x), int(y)
    a, b = x - i, y - j
    top = (1.0 - a) * image[j, i] + a * image[j, i + 1]
    return (1.0 - b) * top + b * ((1.0 - a) * image[j + 1, i] + a * image[j + 1, i + 1])


@njit(cache=True, nogil=True)
def solve5(normal: Any, right: Any) -> bool:
    """Solve ``normal`` x = ``right`` in place (Cholesky; (5, 5) and (5,)); the inverse goes to ``normal``. False = singular."""
    size = right.shape[0]
    lower = np.zeros((size, size))
    for i in range(size):
        for j in range(i + 1):
            rest = normal[i, j]
            for k in range(j):
                rest -= lower[i, k] * lower[j, k]
            if i == j:
                if rest <= 1e-12 * (1.0 + normal[i, i]):
                    return False
                lower[i, i] = math.sqrt(rest)
            else:
                lower[i, j] = rest / lower[j, j]
    inverse = np.zeros((size, size))
    for column in range(size):
        for i in range(column, size):
            rest = 1.0 if i == column else 0.0
            for k in range(column, i):
                rest -= lower[i, k] * inverse[k, column]
            inverse[i, column] = rest / lower[i, i]
    answer = np.zeros(size)
    for i in range(size):
        for j in range(size):
            total = 0.0
            for k in range(max(i, j), size):
                total += inverse[k, i] * inverse[k, j]
            normal[i, j] = total
            answer[i] += total * right[j]
    for i in range(size):  # assigning to a slice takes seconds to compile
        right[i] = answer[i]
    return True


@njit(cache=True, nogil=True)
def _middle(values: Any) -> float:
    """The median of what is known; NaN where too few rays are."""
    known = values[~np.isnan(values)]
    return np.median(known) if known.shape[0] >= _MINIMUM_SHARE * RAYS else math.nan


@njit(cache=True, nogil=True)
def _level(values: Any, contrast: float, fitted: Any) -> float:
    """Fit a + harmonics 1 and 2 over the rays to plateau brightness; far-off rays become NaN. Returns the middle level."""
    middle = _middle(values)
    for turn in range(2):
        normal, right = np.zeros((5, 5)), np.zeros(5)
        row = np.ones(5)
        for j in range(RAYS):
            if math.isnan(values[j]):
                continue
            expected = middle if turn == 0 else fitted[j]
            if abs(values[j] - expected) > (0.45 if turn == 0 else 0.3) * contrast:
                continue
            row[1], row[2] = _COS[j], _SIN[j]
            row[3], row[4] = row[1] * row[1] - row[2] * row[2], 2.0 * row[1] * row[2]
            for a in range(5):
                right[a] += row[a] * values[j]
                for b in range(5):
                    normal[a, b] += row[a] * row[b]
        if not solve5(normal, right):
            return math.nan
        for j in range(RAYS):
            c, s = _COS[j], _SIN[j]
            fitted[j] = right[0] + right[1] * c + right[2] * s + right[3] * (c * c - s * s) + right[4] * 2.0 * c * s
    return middle


@njit(cache=True, nogil=True)
def _edges(image: Any, ellipse: Any, radii: Any, edges: Any, contrasts: Any) -> None:
    """Fill ``edges`` (RINGS, RAYS) with edge radii over the outer radius; NaN where there is none."""
    scale = math.sqrt(abs(ellipse[2] * ellipse[5] - ellipse[3] * ellipse[4]))
    inside, outside, means = np.empty(RAYS), np.empty(RAYS), np.empty(RAYS)
    fitted_in, fitted_out = np.empty(RAYS), np.empty(RAYS)
    for k in range(RINGS):
        edges[k, :] = math.nan
        contrasts[k] = 0.0
        outer_gap = 0.5 if k == 0 else 0.5 * (radii[k - 1] - radii[k])
        inner_gap = 0.8 * radii[k] if k == RINGS - 1 else 0.5 * (radii[k] - radii[k + 1])
        half = min(outer_gap, inner_gap, _LARGEST_WINDOW / scale)
        if k == 0:
            half = min(half, 0.25)
        if radii[k] * scale < _MINIMUM_RADIUS:
            continue
        start, stop = radii[k] - half, radii[k] + half
        count = min(32, max(6, math.ceil(4.0 * half * scale)))
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
        contrast = sign * (_middle(outside) - _middle(inside))
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
                edges[k, j] = start + share * (stop - start)


@njit(cache=True, nogil=True)
def _fit(rho: Any, cosine: Any, sine: Any, radius: Any, answer: Any, inverse: Any) -> tuple[float, int]:
    """Fit radial residuals rho - radius: scale, centre (2), shape (2), with Huber weights; rms and number of points used."""
    count = rho.shape[0]
    weights = np.ones(count)
    residuals = np.empty(count)
    row = np.empty(5)
    spread, used = math.inf, 0
    for _ in range(3):
        inverse[:] = 0.0
        answer[:] = 0.0
        for i in range(count):
            c, s = cosine[i], sine[i]
            row[0], row[1], row[2] = radius[i], c, s
            row[3], row[4] = radius[i] * (c * c - s * s), radius[i] * 2.0 * c * s
            for a in range(5):
                answer[a] += weights[i] * row[a] * (rho[i] - radius[i])
                for b in range(5):
                    inverse[a, b] += weights[i] * row[a] * row[b]
        if not solve5(inverse, answer):
            return math.inf, 0
        for i in range(count):
            c, s = cosine[i], sine[i]
            shape = radius[i] * (answer[0] + answer[3] * (c * c - s * s) + answer[4] * 2.0 * c * s)
            residuals[i] = rho[i] - radius[i] - shape - answer[1] * c - answer[2] * s
        limit = 1.5 * 1.4826 * np.median(np.abs(residuals)) + 1e-12
        total, used = 0.0, 0
        for i in range(count):
            size = abs(residuals[i])
            weights[i] = 1.0 if size < limit else (limit / size if size < 3.0 * limit else 0.0)
            if size < 3.0 * limit:
                total += weights[i] * residuals[i] * residuals[i]
                used += 1
        spread = math.sqrt(total / max(1, used - 5))
    return spread, used


@njit(cache=True, nogil=True)
def _change(ellipse: Any, answer: Any) -> None:
    """Move an ellipse by the result of a fit."""
    a, b, c, d = ellipse[2], ellipse[3], ellipse[4], ellipse[5]
    ellipse[0] += a * answer[1] + b * answer[2]
    ellipse[1] += c * answer[1] + d * answer[2]
    xx, xy, yy = 1.0 + answer[0] + answer[3], answer[4], 1.0 + answer[0] - answer[3]
    ellipse[2], ellipse[3] = a * xx + b * xy, a * xy + b * yy
    ellipse[4], ellipse[5] = c * xx + d * xy, c * xy + d * yy


@njit(cache=True, nogil=True)
def _to_directions(camera: Any, ellipse: Any, result: Any) -> None:
    """Write the ellipse in undistorted coordinates, to first order."""
    x, y = undistort(camera, ellipse[0], ellipse[1])
    result[0], result[1] = x, y
    rx, ry = undistort(camera, ellipse[0] + 1.0, ellipse[1])
    dx, dy = undistort(camera, ellipse[0], ellipse[1] + 1.0)
    a, b, c, d = rx - x, dx - x, ry - y, dy - y
    result[2], result[3] = a * ellipse[2] + b * ellipse[4], a * ellipse[3] + b * ellipse[5]
    result[4], result[5] = c * ellipse[2] + d * ellipse[4], c * ellipse[3] + d * ellipse[5]


@njit(cache=True, nogil=True)
def fit_marker(
    image: Any, camera: Any, ellipse: Any, radii: Any, centres: Any, covariances: Any, shape: Any, quality: Any
) -> bool:
    """Refine one marker.

    Args:
        image: (H, W) grey.
        camera: (9,) of :attr:`wlr_gym.perception.markers.camera.Camera.values`.
        ellipse: (6,) guess of the outer circle's image, px; refined in place.
        radii: (3,) of the marker's circles over the outer radius.
        centres: (3, 2) output: centre of each circle's ellipse, undistorted coordinates; NaN for circles not used.
        covariances: (3, 2, 2) output.
        shape: (6,) output: the outer circle's ellipse, undistorted.
        quality: (4,) output, see :data:`CONTRAST` and the names beside it.

    Returns:
        Whether it is a marker: edges of the right polarity at the right radii around most of it.
    """
    edges, contrasts = np.empty((RINGS, RAYS)), np.empty(RINGS)
    answer, inverse = np.empty(5), np.empty((5, 5))
    centres[:] = math.nan
    quality[:] = 0.0
    for turn in range(4):
        scale = math.sqrt(abs(ellipse[2] * ellipse[5] - ellipse[3] * ellipse[4]))
        if not 2.0 < scale < 2000.0:
            return False
        _edges(image, ellipse, radii, edges, contrasts)
        total = 0
        for k in range(RINGS):
            for j in range(RAYS):
                total += not math.isnan(edges[k, j])
        if total < _MINIMUM_SHARE * RAYS:
            return False
        rho, cosine, sine, radius = np.empty(total), np.empty(total), np.empty(total), np.empty(total)
        i = 0
        for k in range(RINGS):
            for j in range(RAYS):
                if not math.isnan(edges[k, j]):
                    rho[i], cosine[i], sine[i], radius[i] = edges[k, j], _COS[j], _SIN[j], radii[k]
                    i += 1
        spread, _ = _fit(rho, cosine, sine, radius, answer, inverse)
        if not spread < 0.2 or np.abs(answer).max() > 0.5:
            return False
        if turn == 3 or np.abs(answer).max() * scale < 0.02:
            break  # the edges below belong to this ellipse
        _change(ellipse, answer)
    _to_directions(camera, ellipse, shape)
    return _fit_circles(camera, ellipse, radii, edges, contrasts, centres, covariances, shape, quality)


@njit(cache=True, nogil=True)
def _fit_circles(
    camera: Any, ellipse: Any, radii: Any, edges: Any, contrasts: Any, centres: Any, covariances: Any, shape: Any, quality: Any
) -> bool:
    """One ellipse per circle, from edge points in undistorted coordinates."""
    pixels = math.sqrt(abs(ellipse[2] * ellipse[5] - ellipse[3] * ellipse[4]))
    answer, inverse = np.empty(5), np.empty((5, 5))
    contrast, worst, squares, points, rings = math.inf, 0.0, 0.0, 0, 0
    for k in range(RINGS):
        found = 0
        for j in range(RAYS):
            found += not math.isnan(edges[k, j])
        if found < _MINIMUM_SHARE * RAYS:
            continue
        x, y = np.empty(found), np.empty(found)
        i = 0
        for j in range(RAYS):
            if not math.isnan(edges[k, j]):
                u = ellipse[0] + edges[k, j] * (ellipse[2] * _COS[j] + ellipse[3] * _SIN[j])
                v = ellipse[1] + edges[k, j] * (ellipse[4] * _COS[j] + ellipse[5] * _SIN[j])
                x[i], y[i] = undistort(camera, u, v)
                i += 1
        ring = shape.copy()
        spread, used = math.inf, 0
        rho, cosine, sine, radius = np.empty(found), np.empty(found), np.empty(found), np.full(found, radii[k])
        growth = 1.0
        for _ in range(2):
            determinant = ring[2] * ring[5] - ring[3] * ring[4]
            for i in range(found):
                dx, dy = x[i] - ring[0], y[i] - ring[1]
                p, q = (ring[5] * dx - ring[3] * dy) / determinant, (ring[2] * dy - ring[4] * dx) / determinant
                rho[i] = math.hypot(p, q)
                cosine[i], sine[i] = p / rho[i], q / rho[i]
            spread, used = _fit(rho, cosine, sine, radius, answer, inverse)
            if not spread < 0.2 or np.abs(answer).max() > 0.5:
                break
            growth *= 1.0 + answer[0]
            _change(ring, answer)
        if not spread < 0.2 or used < 0.3 * RAYS or abs(growth - 1.0) * radii[k] > 0.12:
            continue
        centres[k, 0], centres[k, 1] = ring[0], ring[1]
        alike = max(1.0, RAYS * _GRAIN / (2.0 * math.pi * radii[k] * pixels))
        sigma = math.sqrt(alike) * max(spread, _EDGE_FLOOR / pixels)
        floor = (_CENTRE_FLOOR / pixels) ** 2
        xx, xy, yy = sigma**2 * inverse[1, 1] + floor, sigma**2 * inverse[1, 2], sigma**2 * inverse[2, 2] + floor
        a, b, c, d = ring[2], ring[3], ring[4], ring[5]
        covariances[k, 0, 0] = a * a * xx + 2.0 * a * b * xy + b * b * yy
        covariances[k, 0, 1] = a * c * xx + (a * d + b * c) * xy + b * d * yy
        covariances[k, 1, 0] = covariances[k, 0, 1]
        covariances[k, 1, 1] = c * c * xx + 2.0 * c * d * xy + d * d * yy
        contrast = min(contrast, contrasts[k])
        worst = max(worst, abs(growth - 1.0) * radii[k])
        squares += used * (spread * pixels) ** 2
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
