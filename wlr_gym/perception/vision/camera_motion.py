"""Where the floor is in the camera frame over a film: one place for a camera that stands, one per frame for one that moves.

A camera stands while the floor's markers stay where they are in the image, averaged over half a second. Once it moves, the
places of the floor's markers are adjusted over the film first (the target file's tolerance as prior), so that it does not
matter which of them a frame shows. A sheet that changes its place against the others was kicked: it is left out, and named.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from wlr_gym.perception.markers.camera import Camera
from wlr_gym.perception.markers.detection import Detection
from wlr_gym.perception.markers.pose import MINIMUM_MARKERS, TargetPose, solve_pose, solved_floor
from wlr_gym.perception.markers.targets import Target
from wlr_gym.perception.vision.adjustment import LONGEST_STEP, TargetView, adjust, at_frame_time, velocity_between
from wlr_gym.perception.vision.tracking import Sample, centres_of, mean_detection

Array = NDArray[np.float64]

#: px, and sigmas of the mean over a block, by which the floor's markers leave their places once the camera moves.
MOVED_BY, MOVED_SIGMAS = 0.03, 4.0
#: px, and times the usual (median), of a step against the others that makes a marker a kicked one.
KICKED_BY, KICKED_TIMES = 0.5, 4.0
_BLOCK = 15  # frames that are averaged
_AROUND = 2  # frames before and after a step


@dataclass(frozen=True, eq=False)
class Kick:
    """A floor sheet that changed its place: index of the marker, time (camera clock, s) and distance (m)."""

    marker: int
    time: float
    distance: float


@dataclass(frozen=True, eq=False)
class CameraMotion:
    """The floor in the camera frame.

    Attributes:
        floors: per frame; None where it is not known. moves: whether the camera moves.
        kicks: sheets that were left out. enough: whether the others carry a pose. names: of the floor's markers.
    """

    floors: tuple[TargetPose | None, ...]
    moves: bool
    kicks: tuple[Kick, ...] = ()
    enough: bool = True
    names: tuple[str, ...] = ()


def camera_motion(samples: Sequence[Sample], camera: Camera, floor: Target, readout: float) -> CameraMotion:
    """Find out whether the camera moves, and where the floor is in every frame.

    Args:
        samples: with the floor's markers. camera: its lens. floor: target. readout: s, of the shutter.
    """
    first = next((sample.floor for sample in samples if sample.floor is not None), None)
    if first is None or not any(sample.floor_seen for sample in samples):  # samples without pictures
        return CameraMotion(tuple(sample.floor for sample in samples), moves=False)
    centres = np.stack([centres_of(floor, sample.floor_seen) for sample in samples])
    scale = first.position[2] / camera.focal[0]
    kicks = tuple(_kicks(centres, np.array([sample.time for sample in samples]), scale))
    names = tuple(marker.name for marker in floor.markers)
    standing = [m for m in range(len(floor.markers)) if m not in {kick.marker for kick in kicks}]
    enough = len(standing) >= MINIMUM_MARKERS
    if not enough:
        standing = list(range(len(floor.markers)))
    usable = [{m: d for m, d in sample.floor_seen.items() if m in standing} for sample in samples]
    if not _moves(centres[:, standing]):
        means = {m: mean_detection(found) for m in standing if (found := [seen[m] for seen in usable if m in seen])}
        found = solved_floor(means, floor, camera, first) or first
        return CameraMotion((found,) * len(samples), False, kicks, enough, names)
    return CameraMotion(tuple(_followed(samples, usable, camera, floor, readout)), True, kicks, enough, names)


def velocities(times: Sequence[float], poses: Sequence[TargetPose | None]) -> Array:
    """Turn rate and speed (F, 6) of a target in the camera frame, from the frames before and after; 0 where not known."""
    result = np.zeros((len(poses), 6))
    known = [(k, pose) for k, pose in enumerate(poses) if pose is not None]
    for place, (k, _) in enumerate(known):
        (i, before), (j, after) = known[max(0, place - 1)], known[min(len(known) - 1, place + 1)]
        step = times[j] - times[i]
        if 0 < step < LONGEST_STEP:
            result[k] = velocity_between(before, after, step)
    return result


def _followed(
    samples: Sequence[Sample], usable: Sequence[dict[int, Detection]], camera: Camera, floor: Target, readout: float
) -> Iterator[TargetPose | None]:
    """The floor in every frame, its markers where the film puts them, each at its own row's time."""
    guesses = [s.floor if len(seen) >= MINIMUM_MARKERS else None for s, seen in zip(samples, usable, strict=True)]
    speeds = velocities([sample.time for sample in samples], guesses)
    views = [
        None if guess is None else TargetView(seen, guess.rotation, guess.position, speed)
        for seen, guess, speed in zip(usable, guesses, speeds, strict=True)
    ]
    known = [view for view in views if view is not None]
    target = adjust(floor, known, camera.height, readout).target.model_copy(update={"tolerance": 0.0})
    for view in views:
        if view is None:
            yield None
            continue
        seen = at_frame_time(view, target, camera.height, readout) if readout else view.seen
        yield solve_pose(seen, target, camera, view.rotation, view.position)


def _moves(centres: Array) -> bool:
    """Whether markers seen at ``centres`` (F, M, 2) px leave their places together."""
    count = max(1, len(centres) // _BLOCK)
    with np.errstate(invalid="ignore"):
        blocks = np.stack([_mean(block) for block in np.array_split(centres, count)])
    noise = 1.4826 * np.nanmedian(np.abs(np.diff(centres, axis=0))) / math.sqrt(2 * _BLOCK)
    away = np.linalg.norm(blocks - np.nanmedian(blocks, axis=0), axis=2)
    known = np.isfinite(away).any(axis=1)
    moved = np.nanmedian(away[known], axis=1)
    return bool(len(moved) and moved.max() > MOVED_BY + MOVED_SIGMAS * noise)


def _mean(block: Array) -> Array:
    """Mean (M, 2) over the frames in which a marker is seen; NaN where it never is."""
    seen = np.isfinite(block)
    total = np.where(seen, block, 0.0).sum(axis=0)
    return np.where(seen.any(axis=0), total / np.maximum(1, seen.sum(axis=0)), np.nan)


def _kicks(centres: Array, times: Array, scale: float) -> Iterator[Kick]:
    """Markers that make a step against the others: the largest step of each; ``scale`` is m per px."""
    count, markers = centres.shape[:2]
    away = np.zeros((count, markers))
    for k in range(_AROUND, count - _AROUND + 1):
        before, after = _mean(centres[k - _AROUND : k]), _mean(centres[k : k + _AROUND])
        seen = np.flatnonzero(np.isfinite(before[:, 0]) & np.isfinite(after[:, 0]))
        if len(seen) > MINIMUM_MARKERS:
            marker, step = _odd_one(before, after, seen)
            away[min(k, count - 1), marker] = step
    steps = away[away > 0]
    limit = max(KICKED_BY, KICKED_TIMES * float(np.median(steps))) if len(steps) else math.inf
    for marker in range(markers):
        k = int(np.argmax(away[:, marker]))
        if away[k, marker] > limit:
            yield Kick(marker, float(times[k]), scale * float(away[k, marker]))


def _odd_one(before: Array, after: Array, seen: NDArray[np.int64]) -> tuple[int, float]:
    """The marker without which the others only shift, turn and grow together, and how far (px) it leaves them."""
    best, odd, step = math.inf, 0, 0.0
    for marker in seen:
        others = seen[seen != marker]
        moved = _similarity(before[others], after[others])
        rest = float(np.linalg.norm(moved(before[others]) - after[others]))
        if rest < best:
            best, odd, step = rest, int(marker), float(np.linalg.norm(moved(before[[marker]]) - after[marker]))
    return odd, step


def _similarity(before: Array, after: Array) -> Callable[[Array], Array]:
    """The shift, turn and growth that takes points ``before`` (K, 2) to ``after`` with least squares."""
    start, end = before.mean(axis=0), after.mean(axis=0)
    # as complex numbers, turn and growth are one factor
    a, b = (before - start) @ (1, 1j), (after - end) @ (1, 1j)
    factor = np.vdot(a, b) / np.vdot(a, a)
    matrix = np.array([[factor.real, factor.imag], [-factor.imag, factor.real]])
    return lambda points: (points - start) @ matrix + end
