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

from wlr_gym.base.compiled import inner_kernel
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
    """The median of what is known (Hoare's selection; numpy's takes a second to compile); NaN where too few rays are."""
    known, count = np.empty(values.shape[0]), 0
    for i in range(values.shape[0]):
        if not math.isnan(values[i]):
            known[count] = values[i]
            count += 1
    if count < _MINIMUM_SHARE * RAYS:
        return math.nan
    middle, low, high = count // 2, 0, count - 1
    while low < high:
        pivot, i, j = known[middle], low, high
        while i <= j:
            while known[i] < pivot:
                i += 1
            while known[j] > pivot:
                j -= 1
            if i <= j:
                known[i], known[j] = known[j], known[i]
                i += 1
                j -= 1
        if j < middle:
            low = i
        if i > middle:
            high = j
    if count % 2 == 1:
        return known[middle]
    below = known[0]
    for i in range(1, middle):
        below = max(below, known[i])
    return 0.5 * (below + known[middle])


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
    for k in range(RINGS):
        for j in range(RAYS):
            edges[k * RAYS + j] = math.nan
        contrasts[k] = 0.0
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
    rows, offsets, weights = np.empty((count, 5)), np.empty(count), np.empty(count)
    residuals, sizes = np.empty(count), np.empty(count)
    known = 0
    for i in range(count):
        _set_row(rows, i, radius[i], cosine[i], sine[i])
        offsets[i] = rho[i] - radius[i]
        weights[i] = 0.0 if math.isnan(rho[i]) else 1.0
        known += weights[i] > 0.0
    if known < _MINIMUM_SHARE * RAYS:
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
    largest = 0.0
    for a in range(5):
        largest = max(largest, abs(answer[a]))
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


@inner_kernel
def _to_directions(camera: Any, ellipse: Any, result: Any) -> None:
    """Write the ellipse in undistorted coordinates, to first order."""
    x, y = undistort(camera, ellipse[0], ellipse[1])
    rx, ry = undistort(camera, ellipse[0] + 1.0, ellipse[1])
    dx, dy = undistort(camera, ellipse[0], ellipse[1] + 1.0)
    result[0], result[1] = x, y
    for k in range(2, 4):
        result[k] = (rx - x) * ellipse[k] + (dx - x) * ellipse[k + 2]
        result[k + 2] = (ry - y) * ellipse[k] + (dy - y) * ellipse[k + 2]


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
    _to_directions(camera, ellipse, shape)
    return _fit_circles(camera, ellipse, radii, edges, contrasts, centres, covariances, shape, quality)


@inner_kernel
def _fit_circles(
    camera: Any, ellipse: Any, radii: Any, edges: Any, contrasts: Any, centres: Any, covariances: Any, shape: Any, quality: Any
) -> bool:
    """One ellipse per circle, from edge points in undistorted coordinates."""
    pixels = math.sqrt(abs(ellipse[2] * ellipse[5] - ellipse[3] * ellipse[4]))
    x, y, ring = np.empty(RAYS), np.empty(RAYS), np.empty(6)
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
        for i in range(6):
            ring[i] = shape[i]
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
        contrast = min(contrast, contrasts[k])
        worst = max(worst, off)
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
