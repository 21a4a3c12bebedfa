"""Bundle adjustment: where the markers of a target really are, and the shutter's readout, from all frames of a film together.

Unknown are the marker places (M, 3), shared by all frames, the readout time of the shutter, and one pose per frame. The target
file gives the places with its tolerances as a prior (``tolerance`` of every marker on its own, ``stretch`` of the print along
x and y, ``caliper`` reading of the long side). Gauss-Newton with an analytic Jacobian; each frame's pose is eliminated (Schur
complement), so the shared unknowns keep a small dense matrix whose inverse is their covariance. What no film can tell (scale
and heading of the whole target) keeps the prior's sigma there.

With a rolling shutter, row v is exposed at the frame's time + readout (v / height - 1/2): every marker has a time of its own.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from wlr_gym.perception.markers.detection import Detection
from wlr_gym.perception.markers.pose import TargetPose, move
from wlr_gym.perception.markers.targets import Target, ring_radii

Array = NDArray[np.float64]

CALIPER_STD = 0.0002  # m, 1 sigma of a caliper reading
#: s, 1 sigma of an unknown readout before the film is looked at; of a readout that the camera file states.
UNKNOWN_READOUT, STATED_READOUT = 0.015, 0.0002
MOST_VIEWS = 150  # frames that are adjusted together at most
LONGEST_STEP = 0.3  # s; frames further apart do not give a speed
_TURNS = 8
_HUBER = 3.0  # sigmas from which on a circle counts less
_FLATNESS = 0.1  # tolerance of a marker's height over the tolerance in the plane: markers lie on a flat plate
_READOUT = -1  # column of the readout among the shared unknowns


@dataclass(frozen=True, eq=False)
class TargetView:
    """One frame's markers and a first guess of where the target is.

    Attributes:
        seen: detection of each marker. rotation: (3, 3) target to camera. position: (3,) m.
        velocity: (6,) turn rate about the camera's axes (rad/s), then speed (m/s).
    """

    seen: dict[int, Detection]
    rotation: Array
    position: Array
    velocity: Array


@dataclass(frozen=True, eq=False)
class Adjustment:
    """What the film says about target and shutter.

    Attributes:
        target: with the marker places found. covariance: (3 M, 3 M) m2 of them.
        readout, readout_std: s from the first row to the last.
        noise: of the circles' centres over what the detector states for them (rms).
    """

    target: Target
    covariance: Array
    readout: float
    readout_std: float
    noise: float

    @property
    def scale_std(self) -> float:
        """1 sigma of the target's scale as a whole, in its plane."""
        return self._std((1, 1, 0), [0, 1, 2])

    @property
    def heading_std(self) -> float:
        """1 sigma of the target's heading as a whole, rad."""
        return self._std((-1, 1, 0), [1, 0, 2])

    def _std(self, signs: tuple[int, int, int], axes: list[int]) -> float:
        """1 sigma of a motion in the plane that is linear in the markers' places about their middle."""
        places = (self.target.positions - self.target.positions.mean(axis=0)) * (1, 1, 0)
        row = (places[:, axes] * signs / np.sum(places**2)).ravel()
        return math.sqrt(float(row @ self.covariance @ row))


@dataclass(frozen=True, eq=False)
class Circles:
    """All circles of all views as arrays, F views, M markers, 3 circles each; weight 0 where one was not seen.

    Attributes:
        measured: (F, M, 3, 2). roots: (F, M, 3, 2, 2) inverse roots of the covariances. row: (F, M) v / height - 1/2.
        squares: (M, 3) radius squared, m2. velocity: (F, 6).
    """

    measured: Array
    roots: Array
    row: Array
    squares: Array
    velocity: Array


def adjust(target: Target, views: Sequence[TargetView], height: int, readout: float | None) -> Adjustment:
    """Adjust target and readout to views of one film.

    Args:
        target: with its tolerances. views: of it; thinned out evenly to :data:`MOST_VIEWS`.
        height: of the image, px. readout: s, as the camera file states it; None = not known.
    """
    views = [views[k] for k in np.unique(np.linspace(0, len(views) - 1, min(len(views), MOST_VIEWS)).astype(int))]
    circles = _circles(target, views, height)
    rotations, positions = np.stack([view.rotation for view in views]), np.stack([view.position for view in views])
    shared = np.append(target.positions.ravel(), readout or 0.0)
    noise, covariance = 1.0, np.eye(len(shared))
    for _ in range(_TURNS):
        residual, by_pose, by_shared = whitened(circles, rotations, positions, shared)
        lengths = np.linalg.norm(residual, axis=-1)
        seen = circles.roots[..., 0, 0] > 0
        noise = max(1.0, float(np.median(lengths[seen])) / 1.1774)  # median length of two unit normals
        weight = np.minimum(1.0, _HUBER * noise / np.maximum(lengths, 1e-12)) / noise**2
        information, right = _prior(target, shared, readout)
        steps, change, covariance = _step(residual, by_pose, by_shared, weight, information, right)
        shared = shared + change
        for k, step in enumerate(steps):
            move(rotations[k], positions[k], step, rotations[k], positions[k])
        if np.abs(change).max() < 1e-7:
            break
    places = shared[:_READOUT].reshape(-1, 3)
    markers = tuple(m.model_copy(update={"position": tuple(p)}) for m, p in zip(target.markers, places.tolist(), strict=True))
    found = target.model_copy(update={"markers": markers})
    std = math.sqrt(covariance[_READOUT, _READOUT])
    return Adjustment(found, covariance[:_READOUT, :_READOUT], float(shared[_READOUT]), std, noise)


def velocity_between(before: TargetPose, after: TargetPose, step: float) -> Array:
    """Turn rate about the camera's axes (rad/s) and speed (m/s) of a target from one pose to another, ``step`` s later."""
    from scipy.spatial.transform import Rotation

    turn = Rotation.from_matrix(after.rotation @ before.rotation.T).as_rotvec()
    return np.concatenate([turn, after.position - before.position]) / step


def at_frame_time(view: TargetView, target: Target, height: int, readout: float) -> dict[int, Detection]:
    """The detections as a shutter that is open for all rows at the frame's time would show them."""
    circles, centres = _circles(target, [view], height), []
    for late in (readout, 0.0):
        shared = np.append(target.positions.ravel(), late)
        _, points, normals, _ = _points(circles, view.rotation[None], view.position[None], shared)
        centres.append(_projected(points, normals, circles.squares)[0][0])
    shift = centres[0] - centres[1]
    return {index: replace(seen, centres=seen.centres - shift[index]) for index, seen in view.seen.items()}


def whitened(circles: Circles, rotations: Array, positions: Array, shared: Array) -> tuple[Array, Array, Array]:
    """Residuals (F, M, 3, 2) over their sigma, derivatives by turn and shift (., 6), by places and readout (., S)."""
    count = len(shared)
    arms, points, normals, drift = _points(circles, rotations, positions, shared)
    predicted, by_point, by_normal = _projected(points, normals, circles.squares)
    frames, markers = arms.shape[:2]
    by_pose = np.empty((frames, markers, 3, 2, 6))
    by_pose[..., :3] = np.einsum("fmrij,fmjk->fmrik", by_point, -_cross(arms)) + np.einsum(
        "fmrij,fjk->fmrik", by_normal, -_cross(normals)
    )
    by_pose[..., 3:] = by_point
    # the drift of a marker turns with its place on the target, so both derivatives carry it
    lag = (shared[_READOUT] * circles.row)[..., None, None] * _cross(circles.velocity[:, :3])[:, None]
    moved = np.eye(3) + lag
    by_pose[..., :3] += np.einsum("fmrij,fmjk,fmkl->fmril", by_point, lag, -_cross(arms))
    by_shared = np.zeros((frames, markers, 3, 2, count))
    by_place = np.einsum("fmrij,fmjk,fkl->fmril", by_point, moved, rotations)
    for index in range(markers):
        by_shared[:, index, ..., 3 * index : 3 * index + 3] = by_place[:, index]
    by_shared[..., _READOUT] = np.einsum("fmrij,fmj->fmri", by_point, circles.row[..., None] * drift)
    residual = np.einsum("fmrij,fmrj->fmri", circles.roots, predicted - circles.measured)
    by_pose, by_shared = (np.einsum("fmrij,fmrjk->fmrik", circles.roots, part) for part in (by_pose, by_shared))
    return residual, by_pose, by_shared


def _points(circles: Circles, rotations: Array, positions: Array, shared: Array) -> tuple[Array, Array, Array, Array]:
    """Arms and centres of the markers (F, M, 3) in the camera frame at their rows' times; normals (F, 3); their velocity."""
    arms = np.einsum("fij,mj->fmi", rotations, shared[:_READOUT].reshape(-1, 3))
    turning = np.einsum("fij,fmj->fmi", _cross(circles.velocity[:, :3]), arms)
    drift = circles.velocity[:, None, 3:] + turning
    points = arms + positions[:, None] + (shared[_READOUT] * circles.row)[..., None] * drift
    return arms, points, rotations[:, :, 2], drift


def _projected(points: Array, normals: Array, squares: Array) -> tuple[Array, Array, Array]:
    """Centre of each circle's ellipse (F, M, 3, 2), with derivatives by the circle's centre and by its normal (., 3)."""
    x, y, z = (points[:, :, None, axis] for axis in range(3))
    nx, ny, nz = (normals[:, None, None, axis] for axis in range(3))
    below = z * z - squares * (1 - nz * nz)
    centres = np.stack([x * z + squares * nx * nz, y * z + squares * ny * nz], axis=-1) / below[..., None]
    by_point, by_normal = np.zeros((*centres.shape, 3)), np.zeros((*centres.shape, 3))
    for axis, (along, normal) in enumerate(((x, nx), (y, ny))):
        by_point[..., axis, axis] = z / below
        by_point[..., axis, 2] = (along - 2 * z * centres[..., axis]) / below
        by_normal[..., axis, axis] = squares * nz / below
        by_normal[..., axis, 2] = squares * (normal - 2 * nz * centres[..., axis]) / below
    return centres, by_point, by_normal


def _cross(vectors: Array) -> Array:
    """Matrices (., 3, 3) of the cross product with ``vectors`` (., 3) from the left."""
    return np.cross(np.eye(3), vectors[..., None, :])


def _step(
    residual: Array, by_pose: Array, by_shared: Array, weight: Array, information: Array, right: Array
) -> tuple[Array, Array, Array]:
    """Gauss-Newton step of poses (F, 6) and shared unknowns (S,), and covariance of the latter."""
    frames, count = len(residual), by_shared.shape[-1]
    root = np.sqrt(weight)[..., None]
    r = (root * residual).reshape(frames, -1)
    a, b = (root[..., None] * by_pose).reshape(frames, -1, 6), (root[..., None] * by_shared).reshape(frames, -1, count)
    inner = np.linalg.inv(np.einsum("fri,frj->fij", a, a))
    mixed = np.einsum("fri,frj->fij", a, b)
    pose_right = np.einsum("fri,fr->fi", a, r)
    known = np.einsum("fij,fjs->fis", inner, mixed)
    reduced = information + np.einsum("fri,frj->ij", b, b) - np.einsum("fis,fit->st", mixed, known)
    rest = right - np.einsum("fri,fr->i", b, r) + np.einsum("fis,fi->s", known, pose_right)
    size = np.outer(*2 * (1 / np.sqrt(np.diag(reduced)),))  # places and seconds: scaled before the inverse
    covariance: Array = size * np.linalg.inv(size * reduced)
    change = covariance @ rest
    steps = -np.einsum("fij,fj->fi", inner, pose_right) - known @ change
    return steps, change, covariance


def _prior(target: Target, shared: Array, readout: float | None) -> tuple[Array, Array]:
    """Information (S, S) of the prior about the shared unknowns, and its pull (S,) at their present values."""
    count, drawn = len(shared), target.positions
    tolerances = max(target.tolerance, 1e-6) * np.tile([1.0, 1.0, _FLATNESS], len(drawn))
    covariance = np.diag(np.append(tolerances**2, 1.0))
    for axis in range(2):
        along = np.zeros_like(drawn)
        along[:, axis] = drawn[:, axis] - drawn[:, axis].mean()
        stretched = np.append(target.stretch * along.ravel(), 0.0)
        covariance += np.outer(stretched, stretched)
    known = UNKNOWN_READOUT if readout is None else STATED_READOUT if readout else 1e-9
    covariance[_READOUT, _READOUT] = known**2
    size = np.sqrt(np.diag(covariance))
    information = np.linalg.inv(covariance / np.outer(size, size)) / np.outer(size, size)
    right = information @ (np.append(drawn.ravel(), readout or 0.0) - shared)
    if target.caliper is not None:
        first, second = target.long_side
        places = shared[:_READOUT].reshape(-1, 3)
        apart = places[second] - places[first]
        length, row = float(np.linalg.norm(apart)), np.zeros(count)
        row[3 * first : 3 * first + 3], row[3 * second : 3 * second + 3] = -apart / length, apart / length
        information = information + np.outer(row, row) / CALIPER_STD**2
        right = right + row * (target.caliper - length) / CALIPER_STD**2
    return information, right


def _circles(target: Target, views: Sequence[TargetView], height: int) -> Circles:
    markers = len(target.markers)
    measured, roots = np.zeros((len(views), markers, 3, 2)), np.zeros((len(views), markers, 3, 2, 2))
    row = np.zeros((len(views), markers))
    for f, view in enumerate(views):
        for m, seen in view.seen.items():
            known = np.isfinite(seen.centres[:, 0])
            measured[f, m, known] = seen.centres[known]
            roots[f, m, known] = np.linalg.inv(np.linalg.cholesky(seen.covariances[known]))
            row[f, m] = seen.ellipse[1] / height - 0.5
    squares = np.square([np.multiply(r, ring_radii(c)) for r, c in zip(target.radii, target.codes.tolist(), strict=True)])
    return Circles(measured, roots, row, squares, np.stack([view.velocity for view in views]))
