"""What is wrong with the frames of a film as such: noise that compression adds, times that jitter, pictures shown twice.

Of five frames, neighbours or every other one, what a cubic in time does not explain is noise; it is held against the sigmas
that the edges of the markers state. An error of a frame's time moves its pose along the velocity, other noise does not.

A codec copies markers that stand still from picture to picture, with their error: such frames say little about noise, and
together no more than one of them.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from wlr_gym.perception.vision.tracking import REPEATED, Sample, without_pose

Array = NDArray[np.float64]

_LEAST_NOISE, _LEAST_FRAMES = 0.7, 30
_ONE_SIGMA = 0.683  # share of normal errors below 1 sigma; compression errs unevenly, which a median does not show
#: Errors of a frame's time (s, 1 sigma) and factors of the noise that are tried.
_JITTERS = np.array([0.0, 0.25, 0.5, 0.75, 1, 1.5, 2, 3, 4, 6, 8, 12]) * 1e-3
_FACTORS = 0.6 * 1.15 ** np.arange(15)
#: Twice the gain in log likelihood that an error of the times must bring.
_WORTH = 12.0
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
    time, poses, variance, rates = _signals(seen)
    differences = [_fourth_difference(time, poses, variance, rates**2, stride) for stride in (1, 2)]
    jitter = _jitter(*differences[0])
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
    _, poses, _, rates = _signals(kept)
    copies = np.ones(len(kept))
    for run in _standing(kept):
        if _scatter(poses[run], np.stack([kept[k].covariance for k in run])) < _COPIED * noise.scale:
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


def _scatter(poses: Array, covariances: Array) -> float:
    """How far poses (F, 6) lie from one to the next (median), over what their covariances state."""
    steps = np.diff(poses, axis=0)
    squares = np.einsum("fi,fij,fj->f", steps, np.linalg.inv(covariances[1:] + covariances[:-1]), steps)
    return math.sqrt(float(np.median(squares)) / poses.shape[1])


def _signals(seen: Sequence[Sample]) -> tuple[Array, Array, Array, Array]:
    """Times (F,), poses, their variances and their rates (F, 6)."""
    time, poses = np.array([sample.time for sample in seen]), np.stack([sample.pose for sample in seen])
    poses[:, 3] = np.unwrap(poses[:, 3])
    variance = np.stack([np.diag(sample.covariance) for sample in seen])
    return time, poses, variance, np.gradient(poses, time, axis=0)


def _fourth_difference(time: Array, poses: Array, variance: Array, late: Array, stride: int) -> tuple[Array, Array, Array]:
    """Fourth divided differences (., 6), their variance by the edges, and by one s2 of error of the times."""
    rows = np.arange(len(time) - 4 * stride)[:, None] + stride * np.arange(5)
    at = (time[rows] - time[rows[:, [2]]]) / np.ptp(time[rows], axis=1)[:, None]
    weights = 1 / np.prod(at[:, :, None] - at[:, None, :] + np.eye(5), axis=2)
    weights /= np.linalg.norm(weights, axis=1)[:, None]
    rest, *variances = (np.einsum("fk,fkc->fc", w, values[rows]) for w, values in
                        ((weights, poses), (weights**2, variance), (weights**2, late)))  # fmt: skip
    return rest, variances[0], variances[1]


def _jitter(rest: Array, edges: Array, late: Array) -> float:
    """Error of the frames' times (s) that makes the differences most likely, robustly; 0 unless it is plain."""
    total = _FACTORS[:, None, None, None] ** 2 * edges + _JITTERS[:, None, None] ** 2 * late
    cost = np.sum(np.log(total) + 5 * np.log1p(rest**2 / total / 4), axis=(2, 3)) / 5  # five differences share a frame
    best = cost.min(axis=0)
    least = int(np.argmin(best))
    return float(_JITTERS[least]) if best[0] - best[least] > _WORTH else 0.0


def _length(step: Array) -> float:
    """Largest coordinate (px) of the markers' moves between two frames; NaN when no marker is seen in both."""
    moved = np.abs(step[np.isfinite(step)])
    return float(moved.max()) if moved.size else math.nan
