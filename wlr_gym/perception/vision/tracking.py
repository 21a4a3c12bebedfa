"""Follow the robot's markers through a film or through frames as they come: one sample per frame, with its covariance.

The floor's markers carry the floor frame. They are located first, over some frames, and watched from then on: a camera that
moves is noticed, and live the floor is then located anew. The body's markers are searched in the whole image until they are
found, then only where a constant velocity puts them; one of four may be hidden. A frame without a pose that passes every check
gives a sample without a pose, and live also why.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from itertools import chain, islice

import numpy as np
from numpy.typing import NDArray

from wlr_gym.base.errors import InputError
from wlr_gym.perception.markers.camera import Camera
from wlr_gym.perception.markers.detection import Detection, Image, detect, refine
from wlr_gym.perception.markers.pose import (
    LARGEST_RESIDUAL,
    MINIMUM_MARKERS,
    TargetPose,
    expected_ellipse,
    find_laid_target,
    find_target,
    sheet_fault,
    solve_pose,
    solved_again,
    solved_floor,
)
from wlr_gym.perception.markers.targets import Target
from wlr_gym.perception.vision.adjustment import LONGEST_STEP, TargetView, at_frame_time, velocity_between

Array = NDArray[np.float64]

# Status of a sample.
OK = "ok"  # pose from all markers
PARTIAL = "partial"  # pose from fewer than all markers
LOST = "lost"  # no markers found
MOVED = "moved"  # the camera moved
IMPOSSIBLE = "impossible"  # a pose that cannot be: in the floor, or upside down
REPEATED = "repeated"  # the picture before once more
FLOOR_FRAMES = 20
_MOVED_BY = 0.4  # px, median over the floor's markers: 1 mm at 2 m with a focal length of 800 px
_FILM_SLACK = 0.001  # m; 1 sigma of what a rolling shutter displaces a marker by
_LEAST_COSINE = 0.7  # of the tilt of the body against the floor
_HEIGHTS = (0.0, 0.6)  # m, of the body's origin


@dataclass(frozen=True, eq=False)
class VideoFrame:
    """One image (H, W) grey with its number and its time on the camera's clock, s."""

    index: int
    time: float
    image: Image


@dataclass(frozen=True, eq=False)
class Sample:
    """The body in the floor frame at one frame.

    Attributes:
        index, time: of the frame. status: see :data:`OK`.
        pose: (6,) x, y, z (m) of the body's origin, yaw, pitch, roll (rad): Rz Ry Rx; NaN without a pose.
        covariance: (6, 6) of it.
        markers: number used. residual: px rms.
        centres: (M, 2) px of the body's markers; NaN where not seen.
        seen: the markers used. in_camera, floor: body and floor in the camera frame; None without a pose.
        floor_seen: the floor's markers; films only.
    """

    index: int
    time: float
    status: str
    pose: Array
    covariance: Array
    markers: int
    residual: float
    centres: Array
    seen: dict[int, Detection] = field(default_factory=dict)
    in_camera: TargetPose | None = None
    floor: TargetPose | None = None
    floor_seen: dict[int, Detection] = field(default_factory=dict)


class Tracker:
    """Turn frames into samples.

    Args:
        camera: its lens. body, floor: targets.
        floor_pose, homes: where the floor is, and its markers in px (:func:`locate_floor`).
        follow: locate the floor in every frame (films); else frames from the first on in which the camera moved have no pose.
    """

    def __init__(
        self, camera: Camera, body: Target, floor: Target, floor_pose: TargetPose, homes: Array, follow: bool = False
    ) -> None:
        self.camera, self.body, self.floor, self.floor_pose = camera, body, floor, floor_pose
        self._values, self._homes, self._watched = camera.values, homes, 0
        self._track: list[tuple[float, TargetPose]] = []  # the last two poses
        self._follow_camera, self._stated = follow, body
        if follow or camera.readout:  # what is off is found out, and taken off, so no marker may be left out for it
            self.body = body.model_copy(update={"tolerance": math.hypot(body.tolerance, _FILM_SLACK)})

    def __call__(self, frame: VideoFrame) -> Sample:
        """Process one frame. Frames must come in order of time."""
        check_size(frame.image, self.camera, f"frame {frame.index}")
        floor_seen = self._locate_anew(frame.image) if self._follow_camera else {}
        shift = 0.0 if self._follow_camera else self._floor_shift(frame.image)
        found, seen = self._follow(frame) if self._track else (None, {})
        if found is None:
            found, seen = self._search(frame.image)
        if found is None or shift > _MOVED_BY:
            self._track = []
            dark = found is None and math.isinf(shift)  # nothing at all is seen
            status = MOVED if shift > _MOVED_BY and not dark else LOST
            return replace(no_pose(frame, status, self.body), floor=self.floor_pose, floor_seen=floor_seen)
        self._track = [*self._track[-1:], (frame.time, found)]
        if self.camera.readout and not self._follow_camera:
            found = self._at_frame_time(found, seen)
        used = {index: detection for index, detection in seen.items() if found.used[index]}
        centres = centres_of(self.body, used)
        pose, covariance = pose_in_floor(found, self.floor_pose)
        if not (_HEIGHTS[0] < pose[2] < _HEIGHTS[1] and math.cos(pose[4]) * math.cos(pose[5]) > _LEAST_COSINE):
            self._track = []
            nothing = no_pose(frame, IMPOSSIBLE, self.body)
            return replace(nothing, centres=centres, floor=self.floor_pose, floor_seen=floor_seen)
        status, count = OK if found.used.all() else PARTIAL, int(found.used.sum())
        return Sample(
            frame.index, frame.time, status, pose, covariance, count, found.residual, centres, used, found, self.floor_pose,
            floor_seen,
        )  # fmt: skip

    def _follow(self, frame: VideoFrame) -> tuple[TargetPose | None, dict[int, Detection]]:
        """Look where the markers should be."""
        found, seen = self._solved_at(frame.image, *self._predicted(frame.time))
        if found is None or found.used.all():
            return found, seen
        # the prediction may have been off, or three markers seen from the wrong side of their plane's two likely tilts
        starts = (found.rotation, found.position), _mirrored(found)
        tries = [(found, seen), *(self._solved_at(frame.image, *start) for start in starts)]
        return max(tries, key=lambda t: (-1, 0.0) if t[0] is None else (int(t[0].used.sum()), -t[0].residual))

    def _solved_at(self, image: Image, rotation: Array, position: Array) -> tuple[TargetPose | None, dict[int, Detection]]:
        """The pose from the markers near where this one puts them."""
        seen = seen_at(image, self.body, self._values, rotation, position)
        found = solve_pose(seen, self.body, self.camera, rotation, position)
        return (found, seen) if found is not None and found.residual < LARGEST_RESIDUAL else (None, seen)

    def _at_frame_time(self, found: TargetPose, seen: dict[int, Detection]) -> TargetPose:
        """The pose with each marker at its own row's time, by the speed since the frame before."""
        (before, first), (now, last) = self._track[0], self._track[-1]
        if not before < now < before + LONGEST_STEP:
            return found
        view = TargetView(seen, found.rotation, found.position, velocity_between(first, last, now - before))
        moved = at_frame_time(view, self._stated, self.camera.height, self.camera.readout or 0.0)
        return solved_again(moved, self._stated, self.camera, found)

    def _search(self, image: Image) -> tuple[TargetPose | None, dict[int, Detection]]:
        """Look around where the body was, then everywhere."""
        up = self.floor_pose.rotation[:, 2]
        for box in [self._neighbourhood(), None] if self._track else [None]:
            detections = detect(image, self.camera, box)
            found = find_target(detections, self.body, self.camera, up)
            if found is None:
                continue
            seen = {}
            for index in range(len(self.body.markers)):
                ellipse = expected_ellipse(self.body, index, self._values, found.rotation, found.position)
                if ellipse is not None:
                    away = [math.hypot(*(detection.ellipse[:2] - ellipse[:2])) for detection in detections]
                    seen[index] = detections[int(np.argmin(away))]
            return found, seen
        return None, {}

    def _predicted(self, time: float) -> tuple[Array, Array]:
        import cv2

        last_time, last = self._track[-1]
        if len(self._track) < 2:
            return last.rotation, last.position
        before_time, before = self._track[0]
        share = min(3.0, (time - last_time) / max(1e-6, last_time - before_time))
        turn = cv2.Rodrigues(last.rotation @ before.rotation.T)[0]
        return cv2.Rodrigues(share * turn)[0] @ last.rotation, last.position + share * (last.position - before.position)

    def _neighbourhood(self) -> tuple[int, int, int, int]:
        _, last = self._track[-1]
        count = range(len(self.body.markers))
        ellipses = [expected_ellipse(self.body, index, self._values, last.rotation, last.position) for index in count]
        points = np.array([ellipse[:2] for ellipse in ellipses if ellipse is not None])
        low, high = points.min(axis=0), points.max(axis=0)
        margin = 0.5 * (high - low).max() + 20
        (x0, y0), (x1, y1) = np.floor(low - margin).astype(int), np.ceil(high + margin).astype(int)
        return max(0, x0), max(0, y0), min(self.camera.width, x1), min(self.camera.height, y1)

    def _floor_shift(self, image: Image) -> float:
        """How far (px) the floor's markers are from their places; inf when none of them is to be seen there.

        One marker is looked at per frame, in turn; when it is not in its place, all of them: it may just be hidden.
        """
        pose = self.floor_pose

        def shift_of(index: int) -> float:
            seen = _marker_at(image, self.floor, index, self._values, pose.rotation, pose.position)
            return math.nan if seen is None else math.hypot(*(seen.ellipse[:2] - self._homes[index]))

        self._watched = (self._watched + 1) % len(self._homes)
        shift = shift_of(self._watched)
        if shift < _MOVED_BY:
            return shift
        shifts = np.array([shift_of(index) for index in range(len(self._homes))])
        known = shifts[np.isfinite(shifts)]
        return float(np.median(known)) if len(known) else math.inf

    def _locate_anew(self, image: Image) -> dict[int, Detection]:
        """Locate the floor in this frame alone; returns its markers. It stays where it was when too few are seen."""
        last = self.floor_pose
        seen = seen_at(image, self.floor, self._values, last.rotation, last.position)
        if len(seen) < MINIMUM_MARKERS:
            if (anew := find_laid_target(detect(image, self.camera), self.floor, self.camera)) is None:
                return {}
            last, seen = anew, seen_at(image, self.floor, self._values, anew.rotation, anew.position)
        found = solved_floor(seen, self.floor, self.camera, last)
        if found is None:
            return {}
        self.floor_pose = found
        return {index: detection for index, detection in seen.items() if found.used[index]}


def _mirrored(pose: TargetPose) -> tuple[Array, Array]:
    """The other pose in which a small plane target looks nearly the same: its normal mirrored at the line of sight."""
    normal, sight = pose.rotation[:, 2], pose.position / np.linalg.norm(pose.position)
    turn = np.eye(3)
    for axis in (normal, sight):  # half a turn about each
        turn = (2 * np.outer(axis, axis) - np.eye(3)) @ turn
    return turn @ pose.rotation, pose.position


def track(frames: Iterable[VideoFrame], camera: Camera, body: Target, floor: Target) -> Iterator[Sample]:
    """Locate the floor in the first frames, then yield one sample per frame.

    Raises:
        InputError: frames of another size than the camera was calibrated for, or no floor to be found.
    """
    stream = iter(frames)
    first = list(islice(stream, FLOOR_FRAMES))
    tracker = Tracker(camera, body, floor, *locate_floor(first, camera, floor), follow=True)
    return (tracker(frame) for frame in chain(first, stream))


def locate_floor(frames: Sequence[VideoFrame], camera: Camera, floor: Target) -> tuple[TargetPose, Array]:
    """Locate the floor over several frames of a camera that stands still; also the markers' places (M, 2) in px.

    Raises:
        InputError: wrong image size, or too few floor markers; the message says what was seen.
    """
    if not frames:
        raise InputError("the video has no frames")
    start: TargetPose | None = None
    sums: dict[int, list[Detection]] = {index: [] for index in range(len(floor.markers))}
    most: list[Detection] = []
    for frame in frames:
        check_size(frame.image, camera, f"frame {frame.index}")
        if start is None:
            detections = detect(frame.image, camera)
            most = max(most, detections, key=lambda found: sum(d.code in floor.codes for d in found))
            start = find_laid_target(detections, floor, camera)
        if start is not None:
            for index, detection in seen_at(frame.image, floor, camera.values, start.rotation, start.position).items():
                sums[index].append(detection)
    if start is None:
        raise InputError(f"no floor frame in the first {len(frames)} frames: {sheet_fault(most, floor, camera)}")
    means = {index: mean_detection(found) for index, found in sums.items() if len(found) >= max(1, len(frames) // 2)}
    found = solved_floor(means, floor, camera, start) or start
    return found, centres_of(floor, means)


def check_size(image: Image, camera: Camera, where: str) -> None:
    """Refuse an image that the calibration is not for."""
    height, width = image.shape[:2]
    if (width, height) != (camera.width, camera.height):
        raise InputError(
            f"{where}: {width} x {height} px, but the camera was calibrated for {camera.width} x {camera.height}; film and "
            "calibrate in the same mode"
        )


def pose_in_floor(body: TargetPose, floor: TargetPose, moving: bool = False) -> tuple[Array, Array]:
    """Pose (6,) of the body in the floor frame and its covariance (6, 6).

    That of the floor's own place is part of it only where every frame has its own (``moving``).
    """
    to_floor, apart = floor.rotation.T, body.position - floor.position
    pose = np.concatenate([to_floor @ apart, angles(to_floor @ body.rotation)])
    yaw, pitch = pose[3], pose[4]
    c, s = math.cos(yaw), math.sin(yaw)
    cosine = max(0.1, math.cos(pitch))
    # a small turn w about the floor's axes changes yaw, pitch and roll by this matrix times w
    rates = np.array([[c * math.tan(pitch), s * math.tan(pitch), 1.0], [-s, c, 0.0], [c / cosine, s / cosine, 0.0]])
    jacobian = np.zeros((6, 6))
    jacobian[:3, 3:], jacobian[3:, :3] = to_floor, rates @ to_floor
    covariance = jacobian @ body.covariance @ jacobian.T
    if moving:
        jacobian[:3, :3] = -to_floor @ np.cross(np.eye(3), apart)
        covariance = covariance + jacobian @ floor.covariance @ jacobian.T
    return pose, covariance


def angles(rotation: Array) -> Array:
    """Yaw, pitch, roll (rad) of Rz(yaw) Ry(pitch) Rx(roll)."""
    yaw = math.atan2(rotation[1, 0], rotation[0, 0])
    pitch = math.asin(max(-1.0, min(1.0, -rotation[2, 0])))
    return np.array([yaw, pitch, math.atan2(rotation[2, 1], rotation[2, 2])])


def no_pose(frame: VideoFrame, status: str, body: Target) -> Sample:
    """The sample of a frame that shows nothing."""
    nothing = np.full(6, np.nan), np.full((6, 6), np.nan)
    return Sample(frame.index, frame.time, status, *nothing, 0, math.nan, centres_of(body, {}))


def without_pose(sample: Sample, status: str) -> Sample:
    """The sample with its pose taken off."""
    nothing = np.full(6, np.nan), np.full((6, 6), np.nan)
    return replace(sample, status=status, pose=nothing[0], covariance=nothing[1], markers=0, residual=math.nan, in_camera=None)


def centres_of(target: Target, seen: Mapping[int, Detection]) -> Array:
    """Centres (M, 2) px of a target's markers; NaN where not seen."""
    centres = np.full((len(target.markers), 2), np.nan)
    for index, detection in seen.items():
        centres[index] = detection.ellipse[:2]
    return centres


def seen_at(image: Image, target: Target, camera: Array, rotation: Array, position: Array) -> dict[int, Detection]:
    """The markers of a target where a pose puts them."""
    found = {k: _marker_at(image, target, k, camera, rotation, position) for k in range(len(target.markers))}
    return {k: detection for k, detection in found.items() if detection is not None}


def _marker_at(image: Image, target: Target, index: int, camera: Array, rotation: Array, position: Array) -> Detection | None:
    ellipse = expected_ellipse(target, index, camera, rotation, position)
    return None if ellipse is None else refine(image, camera, ellipse, int(target.codes[index]))


def mean_detection(found: Sequence[Detection]) -> Detection:
    """The mean of several detections of one marker that stands still."""
    centres = np.stack([d.centres for d in found])
    covariances = np.stack([d.covariances for d in found])
    known = np.asarray(np.isfinite(centres[:, :, 0]).all(axis=0))
    mean = np.where(known[:, None], centres.mean(axis=0), np.nan)
    spread = np.where(known[:, None, None], covariances.mean(axis=0) / len(found), np.nan)
    shape, ellipse = np.mean([d.shape for d in found], axis=0), np.mean([d.ellipse for d in found], axis=0)
    return replace(found[0], centres=mean, covariances=spread, shape=shape, ellipse=ellipse)


# --- live frames ------------------------------------------------------------------------------------------------------


# Status of a sample without a pose, besides those of :mod:`wlr_gym.perception.vision.tracking`.
NO_FLOOR = "no floor"  # the floor markers are not found (yet)
DARK = "dark"  # too dark, or nothing to be seen: a covered lens, no light
GLARE = "glare"  # overexposed
FROZEN = "frozen"  # exactly the picture before: the camera repeats itself
#: What a status means, for people.
MEANINGS = {
    NO_FLOOR: "the floor markers are not found",
    LOST: "the robot's markers are not found",
    MOVED: "the camera was moved",
    IMPOSSIBLE: "the pose is in the floor or upside down",
    DARK: "the picture is dark or blank: lens covered?",
    GLARE: "the picture is overexposed",
    FROZEN: "the camera repeats the same picture",
}
LIVE_FLOOR_FRAMES = 10  # frames with floor markers that the floor is located from
_EVERY = 5  # frames between two tries to find the floor where it was not found
_SPARSE = 8  # every so many pixels are looked at, along both axes, to judge a picture as a whole
#: Grey levels: spread (1 sigma) below which nothing is to be seen, and mean above which a picture is overexposed.
_BLANK, _BRIGHT = 12.0, 240.0


class PoseFinder:
    """Turn frames of a live camera into samples, in the order in which they come.

    ``camera``: its lens. ``body``, ``floor``: targets.
    """

    def __init__(self, camera: Camera, body: Target, floor: Target) -> None:
        self.camera, self.body, self.floor = camera, body, floor
        self._tracker: Tracker | None = None
        self._floor_frames: list[VideoFrame] = []
        self._waited = 0
        self._last: Image | None = None

    def __call__(self, frame: VideoFrame) -> Sample:
        """Process one frame."""
        check_size(frame.image, self.camera, "camera")
        last, self._last = self._last, frame.image
        if last is not None and np.array_equal(last, frame.image):
            return no_pose(frame, FROZEN, self.body)
        if self._tracker is None:
            self._look_for_floor(frame)
            if self._tracker is None:
                return no_pose(frame, _judged(frame.image) or NO_FLOOR, self.body)
        sample = self._tracker(frame)
        if sample.status == MOVED:
            self._tracker = None  # located anew, from the frames that follow
        if sample.status == LOST and (judged := _judged(frame.image)):
            return no_pose(frame, judged, self.body)
        return sample

    def _look_for_floor(self, frame: VideoFrame) -> None:
        """Collect frames that show floor markers, and locate the floor from them."""
        self._waited += 1
        if not self._floor_frames and 1 < self._waited < _EVERY:
            return
        if sum(detection.code in self.floor.codes for detection in detect(frame.image, self.camera)) < 4:
            self._floor_frames, self._waited = [], 1
            return
        self._floor_frames.append(frame)
        if len(self._floor_frames) == LIVE_FLOOR_FRAMES:
            with suppress(InputError):  # markers that do not fit together
                located = locate_floor(self._floor_frames, self.camera, self.floor)
                self._tracker = Tracker(self.camera, self.body, self.floor, *located)
            self._floor_frames, self._waited = [], 0


def _judged(image: Image) -> str:
    """What is wrong with a picture as a whole; empty = nothing."""
    sparse = image[::_SPARSE, ::_SPARSE]
    if sparse.mean() > _BRIGHT:
        return GLARE
    return DARK if sparse.std() < _BLANK else ""
