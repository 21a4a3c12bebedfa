"""Measure a film's poses anew with what the film itself tells: noise of its frames, place of the camera, markers and shutter.

Noise: of five frames, neighbours or every other one, what a cubic in time does not explain; it is held against the sigmas that
the edges of the markers state. An error of a frame's time moves its pose along the velocity, other noise does not. A codec
copies markers that stand still from picture to picture, with their error: such frames say little about noise, and together no
more than one of them.

Camera: it stands while the floor's markers stay where they are in the image, averaged over half a second. Once it moves, the
places of the floor's markers are adjusted over the film first (the target file's tolerance as prior), so that it does not
matter which of them a frame shows. A sheet that changes its place against the others was kicked: it is left out, and named.

Markers: where the film says they are, each at its own row's time (:mod:`wlr_gym.perception.vision.adjustment`).
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wlr_gym.perception.markers.camera import Camera
from wlr_gym.perception.markers.detection import Detection
from wlr_gym.perception.markers.pose import MINIMUM_MARKERS, TargetPose, solve_pose, solved_again, solved_floor
from wlr_gym.perception.markers.targets import Target
from wlr_gym.perception.vision.adjustment import LONGEST_STEP, Adjustment, TargetView, adjust, at_frame_time, velocity_between
from wlr_gym.perception.vision.tracking import (
    MOVED,
    OK,
    PARTIAL,
    REPEATED,
    Sample,
    centres_of,
    mean_detection,
    pose_in_floor,
    without_pose,
)

Array = NDArray[np.float64]

_LEAST_NOISE, _LEAST_FRAMES = 0.7, 30
_ONE_SIGMA = 0.683  # share of normal errors below 1 sigma; compression errs unevenly, which a median does not show
#: Errors of a frame's time (s, 1 sigma) and factors of the noise that are tried.
_JITTERS = np.array([0.0, 0.25, 0.5, 0.75, 1, 1.5, 2, 3, 4, 6, 8, 12]) * 1e-3
_FACTORS = 0.6 * 1.15 ** np.arange(15)
_WORTH = 12.0  # twice the gain in log likelihood that an error of the times must bring
#: Share of the steps before and after that markers move by at most in a picture shown once more, which compression may still
#: change; px, of those steps.
_SAME_SHARE, _MOVING = 0.2, 0.1
_MOST_REPEATS = 3  # in a row; then the robot stands
#: Standing frames whose poses scatter by less than this share of the noise are copies of each other.
_COPIED = 0.5
_LEAST_STANDING = 3  # frames in a row


@dataclass(frozen=True)
class FrameNoise:
    """Noise of the frames' poses over what the edges of their markers state, and of the frames' times (s, 1 sigma)."""

    scale: float = 1.0
    jitter: float = 0.0


def frame_noise(samples: Sequence[Sample]) -> FrameNoise:
    """Find the noise of a film's poses and times."""
    seen = [sample for sample in samples if math.isfinite(sample.pose[0])]
    if len(seen) < _LEAST_FRAMES:
        return FrameNoise()
    standing = {k for run in _standing(seen) for k in run}
    if len(seen) - len(standing) >= _LEAST_FRAMES:
        seen = [sample for k, sample in enumerate(seen) if k not in standing]
    time, poses, rates = _signals(seen)
    variance = np.stack([np.diag(sample.covariance) for sample in seen])
    differences = [_fourth_difference(time, poses, variance, rates**2, stride) for stride in (1, 2)]
    # the error of the frames' times that makes the differences most likely, robustly; 0 unless it is plain
    rest, edges, late = differences[0]
    total = _FACTORS[:, None, None, None] ** 2 * edges + _JITTERS[:, None, None] ** 2 * late
    cost = np.sum(np.log(total) + 5 * np.log1p(rest**2 / total / 4), axis=(2, 3)) / 5  # five differences share a frame
    best = cost.min(axis=0)
    least = int(np.argmin(best))
    jitter = float(_JITTERS[least]) if best[0] - best[least] > _WORTH else 0.0
    scales = [
        float(np.median(np.quantile(np.abs(rest) / np.sqrt(edges + jitter**2 * late), _ONE_SIGMA, axis=0)))
        for rest, edges, late in differences
    ]
    return FrameNoise(max(_LEAST_NOISE, *scales), jitter)


def widened(samples: Sequence[Sample], noise: FrameNoise) -> tuple[Sample, ...]:
    """The samples with that noise in their covariances; of copied pictures, so that together they count as one."""
    seen = [k for k, sample in enumerate(samples) if math.isfinite(sample.pose[0])]
    if len(seen) < 2:  # no rates: :func:`wlr_gym.perception.vision.slip.measure_slip` refuses so few
        return tuple(samples)
    result, kept = list(samples), [samples[k] for k in seen]
    _, poses, rates = _signals(kept)
    copies = np.ones(len(kept))
    for run in _standing(kept):  # how far poses lie from one to the next, over what their covariances state
        steps, spread = np.diff(poses[run], axis=0), np.stack([kept[k].covariance for k in run])
        squares = np.einsum("fi,fij,fj->f", steps, np.linalg.inv(spread[1:] + spread[:-1]), steps)
        if math.sqrt(float(np.median(squares)) / poses.shape[1]) < _COPIED * noise.scale:
            copies[run] = len(run)
    for k, rate, count in zip(seen, rates, copies, strict=True):
        covariance = count * noise.scale**2 * samples[k].covariance + noise.jitter**2 * np.outer(rate, rate)
        result[k] = replace(samples[k], covariance=covariance)
    return tuple(result)


def without_repeats(samples: Sequence[Sample]) -> Iterator[Sample]:
    """Take the pose off frames that show the picture before once more, while robot or camera move.

    The markers then stay for a step, or a few, between two steps the same way; where a motion turns back, these are opposite.
    """
    steps = [b.centres - a.centres for a, b in pairwise(samples)]
    repeats = {k for first in range(1, len(steps)) for k in _repeats(steps, first)}
    for k, sample in enumerate(samples):
        yield without_pose(sample, REPEATED) if k in repeats else sample


def _repeats(steps: Sequence[Array], first: int) -> range:
    """Frames that show the picture before once more, where the markers stay from step ``first`` on."""
    before, last = steps[first - 1], first
    while last < len(steps) and _length(steps[last]) < _SAME_SHARE * _length(before):
        last += 1
    if not 0 < last - first <= _MOST_REPEATS or last == len(steps):
        return range(0)
    after = steps[last]
    least = float(np.minimum(_length(before), _length(after)))
    if not least > _MOVING or max(_length(step) for step in steps[first:last]) > _SAME_SHARE * least:
        return range(0)
    return range(first + 1, last + 1) if float(np.nansum(before * after)) > 0 else range(0)


def _standing(seen: Sequence[Sample]) -> list[range]:
    """Runs of frames in which the markers stay where they are in the picture."""
    moved = [k for k, (a, b) in enumerate(pairwise(seen), 1) if not _length(b.centres - a.centres) < _MOVING]
    return [range(first, stop) for first, stop in pairwise([0, *moved, len(seen)]) if stop - first >= _LEAST_STANDING]


def _signals(seen: Sequence[Sample]) -> tuple[Array, Array, Array]:
    """Times (F,), poses and their rates (F, 6)."""
    time, poses = np.array([sample.time for sample in seen]), np.stack([sample.pose for sample in seen])
    poses[:, 3] = np.unwrap(poses[:, 3])
    return time, poses, np.gradient(poses, time, axis=0)


def _fourth_difference(time: Array, poses: Array, variance: Array, late: Array, stride: int) -> tuple[Array, Array, Array]:
    """Fourth divided differences (., 6), their variance by the edges, and by one s2 of error of the times."""
    rows = np.arange(len(time) - 4 * stride)[:, None] + stride * np.arange(5)
    at = (time[rows] - time[rows[:, [2]]]) / np.ptp(time[rows], axis=1)[:, None]
    weights = 1 / np.prod(at[:, :, None] - at[:, None, :] + np.eye(5), axis=2)
    weights /= np.linalg.norm(weights, axis=1)[:, None]
    rest, edges, by_time = (
        np.einsum("fk,fkc->fc", w, values[rows]) for w, values in ((weights, poses), (weights**2, variance), (weights**2, late))
    )
    return rest, edges, by_time


def _length(step: Array) -> float:
    """Largest coordinate (px) of the markers' moves between two frames; NaN when no marker is seen in both."""
    moved = np.abs(step[np.isfinite(step)])
    return float(moved.max()) if moved.size else math.nan


# --- camera -----------------------------------------------------------------------------------------------------------


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
    standing = standing if enough else list(range(len(floor.markers)))
    usable = [{m: d for m, d in sample.floor_seen.items() if m in standing} for sample in samples]
    if _moves(centres[:, standing]):
        return CameraMotion(tuple(_followed(samples, usable, camera, floor, readout)), True, kicks, enough, names)
    means = {m: mean_detection(found) for m in standing if (found := [seen[m] for seen in usable if m in seen])}
    found = solved_floor(means, floor, camera, first) or first
    return CameraMotion((found,) * len(samples), False, kicks, enough, names)


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
        else:
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
            odd, step = _odd_one(before[seen] @ (1, 1j), after[seen] @ (1, 1j))
            away[min(k, count - 1), seen[odd]] = step
    steps = away[away > 0]
    limit = max(KICKED_BY, KICKED_TIMES * float(np.median(steps))) if len(steps) else math.inf
    for marker, k in enumerate(np.argmax(away, axis=0)):
        if away[k, marker] > limit:
            yield Kick(marker, float(times[k]), scale * float(away[k, marker]))


def _odd_one(before: NDArray[Any], after: NDArray[Any]) -> tuple[int, float]:
    """The marker, of complex places, without which the others only shift, turn and grow; and how far (px) it leaves them."""
    best, odd, step = math.inf, 0, 0.0
    for marker in range(len(before)):
        others = np.arange(len(before)) != marker
        start, end = before[others].mean(), after[others].mean()
        a, b = before[others] - start, after[others] - end
        factor = np.vdot(a, b) / np.vdot(a, a)  # turn and growth, by least squares
        missed = after - end - factor * (before - start)
        rest = float(np.linalg.norm(missed[others]))
        if rest < best:
            best, odd, step = rest, marker, float(abs(missed[marker]))
    return odd, step


# --- markers and shutter ----------------------------------------------------------------------------------------------


#: s; a readout that the film alone tells counts from here on, and from so many sigmas on: global shutters stay exact.
LEAST_READOUT, SURE_READOUT = 0.001, 4.0
LEAST_LAYOUT = 0.00005  # m; a layout that is right to this leaves the film's poses as they are
TOLD_LAYOUT = 0.0005  # m; marker places that the film moves by more are worth saying
#: Sigmas (of the stated tolerance) by which a marker may lie off before the target file is held to be wrong.
WRONG_LAYOUT = 4.0
#: Films are said to be noisy from here on: noise of the poses over what the edges of their markers state; s, of the times.
TOLD_NOISE, TOLD_JITTER = 1.6, 0.001
UNSURE = "the slip may be off by more than its sigma"  # in findings that doubt the result


@dataclass(frozen=True, eq=False)
class SelfCalibration:
    """What a film's poses were corrected by.

    Attributes:
        adjustment: of the body's target and the shutter. readout: s that was used. drawn: the target as its file has it.
        stated: the readout came with the camera file. motion: of the camera.
        noise: of the frames, found from one to the next.
    """

    adjustment: Adjustment
    readout: float
    drawn: Target
    stated: bool
    motion: CameraMotion
    noise: FrameNoise

    @property
    def moved(self) -> Array:
        """(M,) m, how far the film puts each marker from its stated place."""
        return np.linalg.norm(self.adjustment.target.positions - self.drawn.positions, axis=1)


def self_calibrated(
    samples: tuple[Sample, ...], camera: Camera, body: Target, floor: Target
) -> tuple[tuple[Sample, ...], SelfCalibration]:
    """Adjust target and shutter over the film, find out where the camera is, and solve every frame anew with them."""
    first, _ = _once(samples, camera, body, floor)
    second, found = _once(first, camera, body, floor)  # with speeds that the shutter no longer falsifies
    noise = frame_noise(second)
    return widened(second, noise), replace(found, noise=noise)


def _once(
    samples: tuple[Sample, ...], camera: Camera, body: Target, floor: Target
) -> tuple[tuple[Sample, ...], SelfCalibration]:
    speeds = velocities([sample.time for sample in samples], [sample.in_camera for sample in samples])
    found, readout = _adjusted(samples, speeds, camera, body)
    motion = camera_motion(samples, camera, floor, readout)
    calibration = SelfCalibration(found, readout, body, camera.readout is not None, motion, FrameNoise())
    as_drawn = readout == 0.0 and calibration.moved.max() < LEAST_LAYOUT
    target = None if as_drawn else found.target.model_copy(update={"tolerance": 0.0})
    solved = tuple(
        _solved(s, v, camera, target, readout, f, motion.moves) for s, v, f in zip(samples, speeds, motion.floors, strict=True)
    )
    return solved, calibration


def _adjusted(samples: Sequence[Sample], speeds: Array, camera: Camera, body: Target) -> tuple[Adjustment, float]:
    """Target and readout that the film tells; a readout that is not sure is 0."""
    views = [
        TargetView(sample.seen, sample.in_camera.rotation, sample.in_camera.position, speed)
        for sample, speed in zip(samples, speeds, strict=True)
        if sample.in_camera is not None
    ]
    found = adjust(body, views, camera.height, camera.readout)
    if camera.readout == 0.0:
        return found, 0.0
    if camera.readout is None and not abs(found.readout) > max(LEAST_READOUT, SURE_READOUT * found.readout_std):
        return adjust(body, views, camera.height, 0.0), 0.0
    return found, found.readout


def calibration_findings(calibration: SelfCalibration) -> Iterator[str]:
    """What was estimated away, and what the film cannot tell, in words."""
    found, drawn, moved, noise = calibration.adjustment, calibration.drawn, calibration.moved, calibration.noise
    if noise.scale > TOLD_NOISE:
        yield f"poses scatter {noise.scale:.1f} times as much as their edges state (compression?); their sigmas were widened"
    if noise.jitter > TOLD_JITTER:
        yield f"frame times are off by {1e3 * noise.jitter:.1f} ms (1 sigma) from frame to frame; sigmas were widened"
    for kick in calibration.motion.kicks:
        name, place = calibration.motion.names[kick.marker], f"about {1e3 * kick.distance:.0f} mm at {kick.time:.2f} s"
        rest = "it was left out" if calibration.motion.enough else f"too few others are left: {UNSURE}"
        yield f"floor sheet '{name}' changed its place by {place} (kicked?); {rest}"
    if calibration.motion.moves:
        yield "the camera moved: the floor was located in every frame; the poses are less precise"
    if moved.max() > TOLD_LAYOUT:
        places = ", ".join(f"{m.name} {1e3 * d:.1f}" for m, d in zip(drawn.markers, moved, strict=True))
        yield f"markers lie off their stated places, and were measured anew from the film (mm): {places}"
    if moved.max() > WRONG_LAYOUT * drawn.slack:
        name = drawn.markers[int(np.argmax(moved))].name
        yield (
            f"marker '{name}' lies {1e3 * moved.max():.1f} mm off: more than the tolerance in the target file allows "
            f"({1e3 * drawn.tolerance:g} mm, 1 sigma); the right file and sheet? {UNSURE}"
        )
    if calibration.readout and not calibration.stated:
        readout = f"{1e3 * calibration.readout:.1f} ± {1e3 * found.readout_std:.1f} ms"
        yield (
            f"rolling shutter: {readout} from the first row to the last, estimated from "
            "the film and taken off; write it into the camera file (readout, in s)"
        )
    if drawn.stretch and drawn.caliper is None:
        first, second = (drawn.markers[k].name for k in drawn.long_side)
        yield (
            f"no caliper reading of the sheet (distance of the centres of {first} and {second}): a film cannot tell the "
            f"print's scale, which costs {1e3 * found.scale_std:.1f} mm of slip per metre driven (1 sigma)"
        )


def _solved(
    sample: Sample, speed: Array, camera: Camera, target: Target | None, readout: float, floor: TargetPose | None, moving: bool
) -> Sample:
    """One frame with corrected markers (``target`` None = they are right) and floor; as it was where it has no pose."""
    found = sample.in_camera
    if found is None or sample.floor is None:
        return sample
    if floor is None:
        return without_pose(sample, MOVED)
    if target is not None:
        seen = sample.seen
        if readout:
            seen = at_frame_time(TargetView(seen, found.rotation, found.position, speed), target, camera.height, readout)
        found = solved_again(seen, target, camera, found)
    pose, covariance = pose_in_floor(found, floor, moving)
    return replace(
        sample, status=OK if found.used.all() else PARTIAL, pose=pose, covariance=covariance, residual=found.residual,
        markers=int(found.used.sum()), in_camera=found, floor=floor,
    )  # fmt: skip
