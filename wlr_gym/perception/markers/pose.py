"""Pose of a target from the ring centres of its markers: assignment, least squares, covariance.

The centre of a circle's image is not the image of its centre: the ellipse's centre lies off by an amount that grows with
radius and tilt. The measurement model here is the ellipse's centre itself: the circle of radius r about C with normal n (camera
frame) is seen as an ellipse with its centre, in undistorted coordinates, at

    (C_x C_z + r2 n_x n_z, C_y C_z + r2 n_y n_z) / (C_z2 - r2 (1 - n_z2)),  r2 = r^2,

which follows from its dual conic M diag(1, 1, -1) M^T, M = [r e1, r e2, C], so nothing is left to correct. Height is free.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations, permutations
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wlr_gym.base.compiled import compiled, inner_kernel
from wlr_gym.perception.markers.camera import Camera, distort
from wlr_gym.perception.markers.detection import Detection, solve_normal
from wlr_gym.perception.markers.targets import CODE_NAMES, Target, ring_radii

Array = NDArray[np.float64]

MINIMUM_MARKERS = 3  # at least this many markers make a pose; a target found anew needs four
LARGEST_RESIDUAL = 1.5  # px; a pose whose circle centres miss by more (rms) is none
FLOOR_TOLERANCE = 0.01  # m; markers that were laid and measured by hand may be off by this much
_SHAPE_TOLERANCE = 0.25  # of a marker's seen size and shape against what the pose says
_OUTLIER = 16.0  # chi square per degree of freedom that makes the worst marker suspicious
_MODEL_ERROR = 0.15  # px; beyond its noise, but too small for an outlier
_TOLERATED = 2.0  # rms over the markers of a target in its tolerance: what 98 % of hand-laid ones stay below
_MOST_CANDIDATES = 8  # markers of one code tried for a target


@dataclass(frozen=True, eq=False)
class TargetPose:
    """Where a target is in the camera frame.

    Attributes:
        rotation: (3, 3) target to camera. position: (3,) of the target's origin, m.
        covariance: (6, 6) of a small turn about the camera's axes (rad), then of the position (m).
        used: (M,) markers the pose rests on.
        residual: px, rms of the circles' centres.
        chi_square: per degree of freedom, before the covariance was widened by it.
    """

    rotation: Array
    position: Array
    covariance: Array
    used: NDArray[np.bool_]
    residual: float
    chi_square: float


def find_target(
    detections: Sequence[Detection],
    target: Target,
    camera: Camera,
    up: Array | None = None,
    tolerance: float = LARGEST_RESIDUAL,
) -> TargetPose | None:
    """Find a target among detections: the assignment of markers that fits best, or None.

    Args:
        detections: of the whole image. target: what to look for. camera: its lens.
        up: (3,) direction in the camera frame the target's z axis is near to; decides between the two poses a plane has.
        tolerance: px, largest rms residual.
    """
    codes, key = target.codes, target.key
    keys = [d for d in detections if d.code == codes[key]][:_MOST_CANDIDATES]
    others = [d for d in detections if d.code == codes[key - 1]][:_MOST_CANDIDATES]
    plain = [index for index in range(len(codes)) if index != key]
    best: TargetPose | None = None
    for first in keys:
        for chosen in permutations(others, 3):
            for places in combinations(plain, 3):
                seen = dict(zip((key, *places), (first, *chosen), strict=True))
                for rotation, position in _plane_poses(seen, target, tolerance / camera.focal[0]):
                    found = solve_pose(_completed(seen, others, target, rotation, position), target, camera, rotation, position)
                    if found is None or found.residual > tolerance or found.used.sum() < 4:
                        continue
                    if up is not None and found.rotation[:, 2] @ up < 0.5:
                        continue
                    if best is None or _better(found, best, up):
                        best = found
    return best


def find_laid_target(detections: Sequence[Detection], target: Target, camera: Camera) -> TargetPose | None:
    """Find a target that was laid by hand: it may miss by what a marker off by :data:`FLOOR_TOLERANCE` looks like."""
    sizes = [d.radius for d in detections if d.code in target.codes]
    scale = max(sizes) / target.radii.min() if sizes else camera.focal[0]
    return find_target(detections, target, camera, tolerance=LARGEST_RESIDUAL + FLOOR_TOLERANCE * scale)


def solve_pose(
    seen: dict[int, Detection], target: Target, camera: Camera, rotation: Array, position: Array
) -> TargetPose | None:
    """Least-squares pose from markers with known identity, near a first guess; None when too few agree.

    A marker that is off on its own is left out, unless all are off by no more than the target's tolerance explains. Three
    markers are enough; fewer are not.
    """
    indices = sorted(seen)
    while len(indices) >= MINIMUM_MARKERS:
        measured, roots, places, radii, owners = _measurements([(index, seen[index]) for index in indices], target)
        turn, place = rotation.copy(), position.copy()
        covariance, errors = np.empty((6, 6)), np.empty((len(owners), 2))
        if not _least_squares(measured, roots, places, radii, turn, place, covariance, errors.reshape(-1)):
            return None
        squares = np.sum(errors**2, axis=1)
        per_marker = np.array([squares[owners == index].sum() / (2 * (owners == index).sum()) for index in indices])
        chi_square = float(squares.sum() / max(1, 2 * len(squares) - 6))
        wrong = [i for i in indices if not _looks_right(seen[i], target, i, turn, place)]
        suspicious = wrong or ([indices[int(np.argmax(per_marker))]] if chi_square > _OUTLIER and len(indices) > 3 else [])
        centres = np.empty_like(measured)
        circle_centres(places, radii, turn, place, centres)
        residual = float(np.sqrt(np.mean(np.sum(((measured - centres) * np.array(camera.focal)) ** 2, axis=1))))
        explained = max(_MODEL_ERROR, _TOLERATED * target.slack * camera.focal[0] / place[2])
        if not suspicious or (not wrong and residual < explained):
            used = np.zeros(len(target.markers), bool)
            used[indices] = True
            return TargetPose(turn, place, covariance * max(1.0, chi_square), used, residual, chi_square)
        indices.remove(suspicious[0])
    return None


def solved_again(seen: dict[int, Detection], target: Target, camera: Camera, found: TargetPose) -> TargetPose:
    """The pose from other markers than those of ``found``, which stays where they do not fit."""
    again = solve_pose(seen, target, camera, found.rotation, found.position)
    return again if again is not None and again.residual < LARGEST_RESIDUAL else found


def solved_floor(seen: Mapping[int, Detection], floor: Target, camera: Camera, start: TargetPose) -> TargetPose | None:
    """The floor's pose, with the tolerance of its markers' places in the weights and in the covariance."""
    std = floor.tolerance / start.position[2]  # in undistorted coordinates; a marker's circles share it
    tolerated = {
        k: replace(one, covariances=one.covariances + len(one.covariances) * std**2 * np.eye(2)) for k, one in seen.items()
    }
    return solve_pose(tolerated, floor, camera, start.rotation, start.position)


def expected_ellipse(target: Target, index: int, camera: Array, rotation: Array, position: Array) -> Array | None:
    """Image (6,) of a marker's outer circle at a pose, px, to first order; None behind the camera."""
    marker = target.markers[index]
    ellipse = _expected(rotation @ np.asarray(marker.position) + position, rotation, marker.radius, camera)
    return None if math.isnan(ellipse[0]) else ellipse


def _measurements(seen: Sequence[tuple[int, Detection]], target: Target) -> tuple[Array, ...]:
    """Rows of all usable circles: measured centre, inverse root of its covariance, marker centre, radius, marker index."""
    rows = []
    for index, detection in seen:
        marker = target.markers[index]
        for ring, share in enumerate(ring_radii(detection.code)):
            if math.isfinite(detection.centres[ring, 0]):
                root = np.linalg.inv(np.linalg.cholesky(detection.covariances[ring]))
                rows.append((detection.centres[ring], root, marker.position, share * marker.radius, index))
    return tuple(np.array(column, float) for column in zip(*rows, strict=True))


def _plane_poses(seen: dict[int, Detection], target: Target, tolerance: float) -> list[tuple[Array, Array]]:
    """Both poses a plane can have, from the outer circles' centres."""
    import cv2

    height = target.positions[0, 2]
    places = np.array([(*target.positions[index, :2], 0.0) for index in seen])
    centres = np.array([detection.shape[:2] for detection in seen.values()])
    if _cycle(places[:, :2]) != _cycle(centres * (1, -1)):  # image y is down: a target seen from its front goes round as it is
        return []
    count, turns, shifts, errors = cv2.solvePnPGeneric(places, centres, np.eye(3), np.zeros(5), flags=cv2.SOLVEPNP_IPPE)
    result = []
    for k in range(count):
        rotation, position = cv2.Rodrigues(turns[k])[0], np.asarray(shifts[k]).reshape(3)
        if float(np.asarray(errors).reshape(-1)[k]) < 4 * tolerance + 0.01 and position[2] > 0:
            result.append((rotation, position - rotation[:, 2] * height))
    return result


def _cycle(points: Array) -> tuple[int, ...]:
    """Order of the points by their angle about the middle, from point 0 on."""
    offset = points - points.mean(axis=0)
    order = np.argsort(np.arctan2(offset[:, 1], offset[:, 0])).tolist()
    start = order.index(0)
    return tuple(order[start:] + order[:start])


def _completed(
    seen: dict[int, Detection], others: Sequence[Detection], target: Target, rotation: Array, position: Array
) -> dict[int, Detection]:
    """Add the target's further markers, where there is a detection at the place the pose expects."""
    result = dict(seen)
    for index in range(len(target.markers)):
        if index in result:
            continue
        point = rotation @ target.positions[index] + position
        expected, reach = point[:2] / point[2], target.markers[index].radius / point[2]
        near = [d for d in others if np.hypot(*(d.shape[:2] - expected)) < reach]
        if near:
            result[index] = near[0]
    return result


def _better(found: TargetPose, best: TargetPose, up: Array | None) -> bool:
    if found.used.sum() != best.used.sum():
        return bool(found.used.sum() > best.used.sum())
    if up is not None and max(found.chi_square, best.chi_square) < 2 * min(found.chi_square, best.chi_square):
        return bool(found.rotation[:, 2] @ up > best.rotation[:, 2] @ up)
    return found.chi_square < best.chi_square


def _looks_right(detection: Detection, target: Target, index: int, rotation: Array, position: Array) -> bool:
    """Whether a marker is seen as large and as tilted as the pose says."""
    expected = expected_ellipse(target, index, _IDENTITY, rotation, position)
    if expected is None:
        return False
    ratio = np.linalg.svd(np.linalg.solve(expected[2:].reshape(2, 2), detection.shape[2:].reshape(2, 2)), compute_uv=False)
    return bool(np.all(np.abs(np.log(ratio)) < _SHAPE_TOLERANCE))


_IDENTITY = np.array([1.0, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0])


# --- kernels ----------------------------------------------------------------------------------------------------------


@compiled
def circle_centres(places: Any, radii: Any, rotation: Any, position: Any, centres: Any) -> None:
    """Fill ``centres`` (K, 2) with the centres of the ellipses that circles at ``places`` (K, 3) with ``radii`` (K,) show."""
    nx, ny, nz = rotation[0, 2], rotation[1, 2], rotation[2, 2]
    for k in range(places.shape[0]):
        a, b, c = places[k, 0], places[k, 1], places[k, 2]
        x = rotation[0, 0] * a + rotation[0, 1] * b + rotation[0, 2] * c + position[0]
        y = rotation[1, 0] * a + rotation[1, 1] * b + rotation[1, 2] * c + position[1]
        z = rotation[2, 0] * a + rotation[2, 1] * b + rotation[2, 2] * c + position[2]
        square = radii[k] * radii[k]
        below = z * z - square * (1.0 - nz * nz)
        centres[k, 0], centres[k, 1] = (x * z + square * nx * nz) / below, (y * z + square * ny * nz) / below


@compiled
def move(rotation: Any, position: Any, step: Any, new_rotation: Any, new_position: Any) -> None:
    """Move a pose by ``step`` (6,), a rotation vector, then a shift; the new pose may be in the same arrays as the old one."""
    x, y, z = step[0], step[1], step[2]
    angle = math.sqrt(x * x + y * y + z * z)
    a, b = 1.0, 0.5
    if angle >= 1e-12:
        a, b = math.sin(angle) / angle, (1.0 - math.cos(angle)) / (angle * angle)
    for k in range(3):
        p, q, r = rotation[0, k], rotation[1, k], rotation[2, k]
        u, v, w = y * r - z * q, z * p - x * r, x * q - y * p
        new_rotation[0, k] = p + (a * u + b * (y * w - z * v))
        new_rotation[1, k] = q + (a * v + b * (z * u - x * w))
        new_rotation[2, k] = r + (a * w + b * (x * v - y * u))
        new_position[k] = position[k] + step[3 + k]


@inner_kernel
def _residuals(measured: Any, roots: Any, places: Any, radii: Any, rotation: Any, position: Any, out: Any) -> float:
    centres = np.empty(measured.shape)
    circle_centres(places, radii, rotation, position, centres)
    total = 0.0
    for k in range(measured.shape[0]):
        dx, dy = measured[k, 0] - centres[k, 0], measured[k, 1] - centres[k, 1]
        p, q = roots[k, 0, 0] * dx + roots[k, 0, 1] * dy, roots[k, 1, 0] * dx + roots[k, 1, 1] * dy
        out[2 * k], out[2 * k + 1] = p, q
        total += p * p + q * q
    return total


@compiled
def _least_squares(
    measured: Any, roots: Any, places: Any, radii: Any, rotation: Any, position: Any, covariance: Any, residual: Any
) -> bool:
    """Levenberg-Marquardt over a turn and a shift in the camera frame; pose in place, covariance of it, residuals (2 K,)."""
    rows = residual.shape[0]
    moved, jacobian, step, gradient = np.empty(rows), np.empty((6, rows)), np.empty(6), np.empty(6)
    normal, damped, turn, place = np.empty((6, 6)), np.empty((6, 6)), np.empty((3, 3)), np.empty(3)
    damping, attempt = 1e-4, 0.0
    cost = _residuals(measured, roots, places, radii, rotation, position, residual)
    for _ in range(30):
        for k in range(6):
            step[:] = 0.0
            step[k] = 1e-6
            move(rotation, position, step, turn, place)
            _residuals(measured, roots, places, radii, turn, place, moved)
            for i in range(rows):
                jacobian[k, i] = (moved[i] - residual[i]) / 1e-6
        for a in range(6):
            gradient[a] = 0.0
            for i in range(rows):
                gradient[a] += jacobian[a, i] * residual[i]
            for b in range(6):
                normal[a, b] = 0.0
                for i in range(rows):
                    normal[a, b] += jacobian[a, i] * jacobian[b, i]
        improved = False
        for _ in range(8):
            for a in range(6):
                step[a] = -gradient[a]
                for b in range(6):
                    damped[a, b] = normal[a, b]
                damped[a, a] *= 1.0 + damping
            if solve_normal(damped, step):
                move(rotation, position, step, turn, place)
                attempt = _residuals(measured, roots, places, radii, turn, place, moved)
                if attempt <= cost:
                    improved = True
                    break
            damping *= 10.0
        if not improved:
            break
        move(rotation, position, step, rotation, position)
        for i in range(rows):
            residual[i] = moved[i]
        gain = cost - attempt
        cost = attempt
        damping = max(1e-9, damping / 10.0)
        if gain < 1e-6 * (1.0 + cost):
            break
    for a in range(6):
        for b in range(6):
            covariance[a, b] = normal[a, b]
    return math.isfinite(cost) and position[2] > 0.0 and solve_normal(covariance, gradient)


@compiled
def _expected(centre: Any, rotation: Any, radius: float, camera: Any) -> Any:
    """Image (6,) of a circle with that centre in the camera frame; NaN too near or behind the camera."""
    ellipse = np.full(6, math.nan)
    x, y, z = centre[0], centre[1], centre[2]
    if z >= 2.0 * radius:
        u, v = distort(camera, x / z, y / z)
        ru, rv = distort(camera, x / z + 1e-5, y / z)
        du, dv = distort(camera, x / z, y / z + 1e-5)
        ellipse[0], ellipse[1] = u, v
        for axis in range(2):
            a = radius * (rotation[0, axis] - x / z * rotation[2, axis]) / z
            b = radius * (rotation[1, axis] - y / z * rotation[2, axis]) / z
            ellipse[2 + axis] = ((ru - u) * a + (du - u) * b) / 1e-5
            ellipse[4 + axis] = ((rv - v) * a + (dv - v) * b) / 1e-5
    return ellipse


# --- why a target is not found ----------------------------------------------------------------------------------------


def sheet_fault(detections: Sequence[Detection], target: Target, camera: Camera) -> str:
    """Why ``target`` is not found, in words that end a sentence; what was seen is named."""
    count = len(target.markers)
    seen = Counter(CODE_NAMES[detection.code] for detection in detections)
    own = Counter(marker.code for marker in target.markers)
    found = ", ".join(f"{number} {name}" for name, number in sorted(seen.items())) or "no marker"
    if not any(seen[code] for code in own):
        others = f"; {found} seen: are the sheets or the files of floor and robot swapped?" if seen else ""
        return f"0 of the {count} markers of '{target.name}' seen{others}"
    key = target.markers[target.key].code
    if seen[key] > 1:
        return f"{found} seen, but '{target.name}' has one {key}: is a sheet of it there twice?"
    swaps = []  # markers that, with the key's sheet in their place and theirs in its, fit what is seen
    for other, marker in enumerate(target.markers):
        markers = list(target.markers)
        markers[target.key] = markers[target.key].model_copy(update={"code": marker.code})
        markers[other] = marker.model_copy(update={"code": key})
        swapped = target.model_copy(update={"markers": tuple(markers)})
        if other != target.key and find_laid_target(detections, swapped, camera):
            swaps.append(marker.name)
    if swaps:
        names = " or ".join(f"'{target.markers[target.key].name}' and '{name}'" for name in swaps)
        return f"the sheets {names} of '{target.name}' lie in each other's places"
    together = sum(seen[code] for code in own)
    return (
        f"{together} of the {count} markers of '{target.name}' seen, and at least 4 must fit together (check their positions "
        "in the target file, and the light)"
    )
