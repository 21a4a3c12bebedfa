"""Measure a film's poses anew, with the markers where the film itself says they are, and every marker at its own row's time."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from wlr_gym.perception.markers.camera import Camera
from wlr_gym.perception.markers.pose import LARGEST_RESIDUAL, solve_pose
from wlr_gym.perception.markers.targets import Target
from wlr_gym.perception.vision.adjustment import Adjustment, TargetView, adjust, at_frame_time
from wlr_gym.perception.vision.tracking import Sample, pose_in_floor

Array = NDArray[np.float64]

#: s; a readout that the film alone tells counts from here on, and from so many sigmas on: global shutters stay exact.
LEAST_READOUT, SURE_READOUT = 0.001, 4.0
#: m; a layout that is right to this leaves the film's poses as they are.
LEAST_LAYOUT = 0.00005
#: m; marker places that the film moves by more are worth saying.
TOLD_LAYOUT = 0.0005
#: Sigmas (of the stated tolerance) by which a marker may lie off before the target file is held to be wrong.
WRONG_LAYOUT = 4.0
#: s; frames further apart do not tell a speed.
_LONGEST_STEP = 0.3


@dataclass(frozen=True, eq=False)
class SelfCalibration:
    """What a film's poses were corrected by.

    Attributes:
        adjustment: of the body's target and the shutter. readout: s that was used. drawn: the target as its file has it.
        stated: the readout came with the camera file.
    """

    adjustment: Adjustment
    readout: float
    drawn: Target
    stated: bool

    @property
    def moved(self) -> Array:
        """(M,) m, how far the film puts each marker from its stated place."""
        return np.linalg.norm(self.adjustment.target.positions - self.drawn.positions, axis=1)


def self_calibrated(samples: tuple[Sample, ...], camera: Camera, body: Target) -> tuple[tuple[Sample, ...], SelfCalibration]:
    """Adjust target and shutter over the film, and solve every frame anew with them."""
    first, _ = _once(samples, camera, body)
    return _once(first, camera, body)  # with speeds that the shutter no longer falsifies


def _once(samples: tuple[Sample, ...], camera: Camera, body: Target) -> tuple[tuple[Sample, ...], SelfCalibration]:
    speeds = _velocities(samples)
    found, readout = _adjusted(samples, speeds, camera, body)
    calibration = SelfCalibration(found, readout, body, camera.readout is not None)
    if readout == 0.0 and calibration.moved.max() < LEAST_LAYOUT:
        return samples, calibration
    target = found.target.model_copy(update={"tolerance": 0.0})
    solved = tuple(_solved(s, v, camera, target, readout) for s, v in zip(samples, speeds, strict=True))
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
    found, drawn = calibration.adjustment, calibration.drawn
    moved = calibration.moved
    if moved.max() > TOLD_LAYOUT:
        places = ", ".join(f"{m.name} {1e3 * d:.1f}" for m, d in zip(drawn.markers, moved, strict=True))
        yield f"markers lie off their stated places, and were measured anew from the film (mm): {places}"
    allowed = WRONG_LAYOUT * math.hypot(drawn.tolerance, drawn.stretch * float(np.abs(drawn.positions).max()))
    if moved.max() > allowed:
        name = drawn.markers[int(np.argmax(moved))].name
        yield (
            f"marker '{name}' lies {1e3 * moved.max():.1f} mm off: more than the tolerance in the target file allows "
            f"({1e3 * drawn.tolerance:g} mm, 1 sigma); the right file and sheet? The slip may be off by more than its sigma"
        )
    if calibration.readout and not calibration.stated:
        std = 1e3 * found.readout_std
        yield (
            f"rolling shutter: {1e3 * calibration.readout:.1f} ± {std:.1f} ms from the first row to the last, estimated from "
            "the film and taken off; write it into the camera file (readout, in s)"
        )
    if drawn.stretch and drawn.caliper is None:
        first, second = (drawn.markers[k].name for k in drawn.long_side)
        yield (
            f"no caliper reading of the sheet (distance of the centres of {first} and {second}): a film cannot tell the "
            f"print's scale, which costs {1e3 * found.scale_std:.1f} mm of slip per metre driven (1 sigma)"
        )


def _solved(sample: Sample, speed: Array, camera: Camera, target: Target, readout: float) -> Sample:
    """One frame with corrected markers; as it was where it has no pose."""
    first = sample.in_camera
    if first is None or sample.floor is None:
        return sample
    seen = sample.seen
    if readout:
        seen = at_frame_time(TargetView(seen, first.rotation, first.position, speed), target, camera.height, readout)
    found = solve_pose(seen, target, camera, first.rotation, first.position)
    if found is None or found.residual > LARGEST_RESIDUAL:
        return sample
    pose, covariance = pose_in_floor(found, sample.floor)
    count = int(found.used.sum())
    return replace(sample, pose=pose, covariance=covariance, residual=found.residual, markers=count, in_camera=found)


def _velocities(samples: Sequence[Sample]) -> Array:
    """Turn rate and speed (F, 6) of the body in the camera frame, from the frames before and after; 0 where not known."""
    from scipy.spatial.transform import Rotation

    result = np.zeros((len(samples), 6))
    known = [k for k, sample in enumerate(samples) if sample.in_camera is not None]
    for place, k in enumerate(known):
        before, after = samples[known[max(0, place - 1)]], samples[known[min(len(known) - 1, place + 1)]]
        step = after.time - before.time
        if not 0 < step < _LONGEST_STEP or before.in_camera is None or after.in_camera is None:
            continue
        turn = Rotation.from_matrix(after.in_camera.rotation @ before.in_camera.rotation.T).as_rotvec()
        result[k] = np.concatenate([turn, after.in_camera.position - before.in_camera.position]) / step
    return result
