"""Poses from frames as they come: find the floor, follow the robot, and say why a frame shows no pose.

The floor's markers carry the floor frame. They are located over some frames in which they are seen, watched from then on, and
located anew after the camera was moved.
"""

from __future__ import annotations

import numpy as np

from wlr_gym.base.errors import InputError
from wlr_gym.perception.markers.camera import Camera
from wlr_gym.perception.markers.detection import Image, detect
from wlr_gym.perception.markers.targets import Target
from wlr_gym.perception.vision.tracking import (
    IMPOSSIBLE,
    LOST,
    MOVED,
    Sample,
    Tracker,
    VideoFrame,
    check_size,
    locate_floor,
    no_pose,
)

# Status of a sample without a pose, besides those of :mod:`wlr_gym.perception.vision.tracking`.
#: The floor markers are not found (yet).
NO_FLOOR = "no floor"
#: Too dark, or nothing to be seen: a covered lens, no light.
DARK = "dark"
#: Overexposed.
GLARE = "glare"
#: Exactly the picture before: the camera repeats itself.
FROZEN = "frozen"
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
#: Frames with floor markers that the floor is located from.
FLOOR_FRAMES = 10
#: Frames between two tries to find the floor where it was not found.
_EVERY = 5
#: Every so many pixels are looked at, along both axes, to judge a picture as a whole.
_SPARSE = 8
#: Grey levels: spread (1 sigma) below which nothing is to be seen, and mean above which a picture is overexposed.
_BLANK, _BRIGHT = 12.0, 240.0


class PoseFinder:
    """Turn frames of a live camera into samples, in the order in which they come.

    Args:
        camera: its lens. body, floor: targets.
    """

    def __init__(self, camera: Camera, body: Target, floor: Target) -> None:
        self.camera, self.body, self.floor = camera, body, floor
        self._tracker: Tracker | None = None
        self._floor_frames: list[VideoFrame] = []
        self._waited = 0
        self._last: Image | None = None

    def __call__(self, frame: VideoFrame) -> Sample:
        """Process one frame.

        Raises:
            InputError: another size than the camera was calibrated for.
        """
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
        if not self._floor_frames and self._waited < _EVERY and self._waited > 1:
            return
        found = sum(detection.code in self.floor.codes for detection in detect(frame.image, self.camera))
        if found < 4:
            self._floor_frames = []
            self._waited = 1
            return
        self._floor_frames.append(frame)
        if len(self._floor_frames) < FLOOR_FRAMES:
            return
        try:
            located = locate_floor(self._floor_frames, self.camera, self.floor)
        except InputError:  # markers that do not fit together
            located = None
        self._floor_frames, self._waited = [], 0
        if located is not None:
            self._tracker = Tracker(self.camera, self.body, self.floor, *located)


def _judged(image: Image) -> str:
    """What is wrong with a picture as a whole; empty = nothing."""
    sparse = image[::_SPARSE, ::_SPARSE]
    if sparse.mean() > _BRIGHT:
        return GLARE
    return DARK if sparse.std() < _BLANK else ""
