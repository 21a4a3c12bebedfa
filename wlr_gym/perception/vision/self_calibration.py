"""Measure a film's poses anew, with the markers where the film itself says they are, and every marker at its own row's time."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from wlr_gym.perception.markers.camera import Camera
from wlr_gym.perception.markers.pose import LARGEST_RESIDUAL, TargetPose, solve_pose
from wlr_gym.perception.markers.targets import Target
from wlr_gym.perception.vision.adjustment import Adjustment, TargetView, adjust, at_frame_time
from wlr_gym.perception.vision.camera_motion import CameraMotion, camera_motion, velocities
from wlr_gym.perception.vision.frame_noise import FrameNoise, frame_noise, widened
from wlr_gym.perception.vision.tracking import MOVED, OK, PARTIAL, Sample, pose_in_floor, without_pose

Array = NDArray[np.float64]

#: s; a readout that the film alone tells counts from here on, and from so many sigmas on: global shutters stay exact.
LEAST_READOUT, SURE_READOUT = 0.001, 4.0
#: m; a layout that is right to this leaves the film's poses as they are.
LEAST_LAYOUT = 0.00005
#: m; marker places that the film moves by more are worth saying.
TOLD_LAYOUT = 0.0005
#: Sigmas (of the stated tolerance) by which a marker may lie off before the target file is held to be wrong.
WRONG_LAYOUT = 4.0
#: Films are said to be noisy from here on: noise of the poses over what the edges of their markers state; s, of the times.
TOLD_NOISE, TOLD_JITTER = 1.6, 0.001
#: In findings that doubt the result.
UNSURE = "the slip may be off by more than its sigma"


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
    found, drawn = calibration.adjustment, calibration.drawn
    moved = calibration.moved
    noise = calibration.noise
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
    allowed = WRONG_LAYOUT * drawn.slack
    if moved.max() > allowed:
        name = drawn.markers[int(np.argmax(moved))].name
        yield (
            f"marker '{name}' lies {1e3 * moved.max():.1f} mm off: more than the tolerance in the target file allows "
            f"({1e3 * drawn.tolerance:g} mm, 1 sigma); the right file and sheet? {UNSURE}"
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
        again = solve_pose(seen, target, camera, found.rotation, found.position)
        found = again if again is not None and again.residual < LARGEST_RESIDUAL else found
    pose, covariance = pose_in_floor(found, floor, moving)
    count = int(found.used.sum())
    status = OK if count == len(found.used) else PARTIAL
    return replace(
        sample, status=status, pose=pose, covariance=covariance, residual=found.residual, markers=count, in_camera=found,
        floor=floor,
    )  # fmt: skip
