"""Tracking: precise poses with honest covariances, occlusion, loss, a camera that moves; never a silent wrong pose."""

import math
from dataclasses import replace

import numpy as np
import pytest
from vision_studio import Studio, hand, pose_of, wrapped

from wlr_gym.base.errors import InputError
from wlr_gym.perception.markers.camera import Camera
from wlr_gym.perception.scene import ScenePose
from wlr_gym.perception.vision.tracking import LOST, MOVED, OK, PARTIAL, Tracker, VideoFrame, locate_floor, track


@pytest.fixture(scope="module")
def located(studio):
    return locate_floor([studio.frame(None, index) for index in range(4)], studio.camera, studio.floor)


@pytest.fixture
def tracker(studio, located):
    return Tracker(studio.camera, studio.body, studio.floor, *located)


def moving(index: int) -> ScenePose:
    t = index / 30
    return pose_of(-0.1 + 0.2 * t, 0.05 * math.sin(t), 0.3 + 0.8 * t, 0.05 * math.sin(2 * t), 0.169 - 0.03 * t)


def test_poses_are_within_the_bars_and_their_covariance_is_honest(studio, tracker):
    errors, deviations = [], []
    for index in range(15):
        sample, pose = tracker(studio.frame(moving(index), index)), moving(index)
        assert sample.status == OK
        yaw = math.atan2(pose.rotation[1, 0], pose.rotation[0, 0])
        errors.append([*(sample.pose[:3] - pose.position), wrapped(sample.pose[3] - yaw)])
        deviations.append(np.sqrt(np.diag(sample.covariance))[:4])
    errors, deviations = np.array(errors), np.array(deviations)
    assert np.sqrt(np.mean(np.sum(errors[:, :2] ** 2, axis=1))) < 0.1e-3
    assert np.degrees(np.sqrt(np.mean(errors[:, 3] ** 2))) < 0.01
    normalised = np.sqrt(np.mean((errors / deviations) ** 2, axis=0))
    assert np.all((normalised > 0.3) & (normalised < 2.5))


def test_45_degrees():
    studio = Studio(Camera(width=1280, height=720, focal=(800.0, 800.0), centre=(639.5, 359.5)), math.pi / 4)
    frames = [studio.frame(moving(index), index) for index in range(6)]
    tracker = Tracker(studio.camera, studio.body, studio.floor, *locate_floor(frames, studio.camera, studio.floor))
    for index, frame in enumerate(frames):
        sample = tracker(frame)
        assert np.hypot(*(sample.pose[:2] - moving(index).position[:2])) < 0.6e-3
        yaw = math.atan2(moving(index).rotation[1, 0], moving(index).rotation[0, 0])
        assert abs(math.degrees(wrapped(sample.pose[3] - yaw))) < 0.03


def test_after_a_jump_the_markers_are_not_taken_for_their_mirror_image(studio, tracker):
    """A frame comes twice, so the next is predicted wrongly; every later one still has the right tilt."""
    for index in range(12):
        shown = index - (index == 4)
        pose = moving(4 * shown)
        sample = tracker(replace(studio.frame(pose, 4 * shown), index=index, time=index / 30))
        assert abs(wrapped(sample.pose[5])) < 0.03
        assert np.abs(sample.pose[:3] - pose.position).max() < 1e-3


def test_a_hidden_marker_gives_a_flagged_pose(studio, tracker):
    tracker(studio.frame(moving(0), 0))
    tracker(studio.frame(moving(1), 1))
    pose = moving(2)
    corner = (pose.rotation @ studio.body.positions[2] + pose.position)[:2]
    sample = tracker(studio.frame(pose, 2, extra=(hand(*corner * 0.84),)))  # nearer to the camera, hence nearer to its axis
    assert sample.status == PARTIAL
    assert sample.markers == 3
    assert np.hypot(*(sample.pose[:2] - pose.position[:2])) < 0.5e-3


def test_a_half_hidden_marker_does_not_pull_the_pose(studio, located):
    pose, rng = pose_of(), np.random.default_rng(3)
    first = [studio.frame(pose, index) for index in range(2)]
    for k in range(8):
        tracker = Tracker(studio.camera, studio.body, studio.floor, *located)
        for frame in first:
            tracker(frame)
        marker = (pose.rotation @ studio.body.positions[k % 4] + pose.position)[:2]
        cover = hand(*(0.97 * marker + rng.uniform(-0.05, 0.05, 2)), size=rng.uniform(0.015, 0.04), height=0.26)
        sample = tracker(studio.frame(pose, 2 + k, extra=(replace(cover, shade=float(rng.choice([30, 90, 230]))),)))
        assert sample.status in (OK, PARTIAL)
        assert np.hypot(*(sample.pose[:2] - pose.position[:2])) < 0.6e-3


def test_a_hidden_robot_is_lost_and_found_again(studio, tracker):
    statuses = []
    for index in range(6):
        gone = index in (2, 3)
        sample = tracker(studio.frame(moving(index), index, blind=gone))
        statuses.append(sample.status)
        assert np.isfinite(sample.pose[0]) != gone
    assert statuses == [OK, OK, LOST, LOST, OK, OK]


def test_a_jump_is_followed_without_a_wrong_pose(studio, tracker):
    tracker(studio.frame(moving(0), 0))
    tracker(studio.frame(moving(1), 1))
    far = pose_of(0.35, 0.15, -1.0)
    sample = tracker(studio.frame(far, 2))
    assert sample.status == LOST or np.hypot(*(sample.pose[:2] - far.position[:2])) < 1e-3


@pytest.mark.parametrize("shift", [(0.5, 0), (5, 0), (40, 40), (100, 0), (0, 150)])
def test_a_camera_that_moved_is_noticed_at_once(studio, tracker, shift):
    """Also when it moved so far that no floor marker is near its place."""
    import cv2

    frames = [studio.frame(moving(index), index) for index in range(3)]
    assert tracker(frames[0]).status == OK
    matrix = np.array([[1, 0, shift[0]], [0, 1, shift[1]]], np.float32)
    for frame in frames[1:]:
        image = cv2.warpAffine(frame.image, matrix, (1280, 720), borderMode=cv2.BORDER_REPLICATE)
        sample = tracker(replace(frame, image=image))
        assert sample.status == MOVED
        assert not np.isfinite(sample.pose[0])


def test_a_hidden_floor_marker_is_not_a_moved_camera(studio, tracker):
    cover = tuple(hand(*(0.84 * place[:2]), size=0.12) for place in studio.floor.positions[1:])
    assert [tracker(studio.frame(moving(index), index, extra=cover)).status for index in range(4)] == [OK] * 4


def test_a_dark_image_is_lost(studio, tracker):
    assert tracker(VideoFrame(0, 0.0, np.zeros((720, 1280), np.uint8))).status == LOST


@pytest.mark.parametrize(
    ("shown", "message"),
    [
        (None, "no frames"),
        ((480, 640), "frame 0: 640 x 480 px, but the camera was calibrated for 1280 x 720"),
        ((720, 1280), "no floor frame in the first 1 frames: 3 of the 4 markers of 'floor' seen"),
    ],
)
def test_films_without_a_floor_are_refused(studio, shown, message):
    frames = [] if shown is None else [VideoFrame(0, 0.0, np.zeros(shown, np.uint8))]
    if shown == (720, 1280):
        frames = [studio.frame(moving(0), 0)]
        frames[0].image[:360, :640] = 128
    with pytest.raises(InputError, match=message):
        track(frames, studio.camera, studio.body, studio.floor)
