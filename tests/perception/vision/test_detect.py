"""Markers in rendered frames: found, precise, told apart; and nothing else taken for one."""

import math

import numpy as np
import pytest
from vision_studio import pose_of

from studies.bench.vision import _centre_error, clutter
from wlr_gym.perception.markers.camera import Camera, distort, undistort
from wlr_gym.perception.markers.detection import detect
from wlr_gym.perception.markers.pose import circle_centres, find_target
from wlr_gym.perception.markers.targets import CODE_NAMES, load_target
from wlr_gym.perception.scene import Look, ScenePose, project

CAMERA = Camera(width=1280, height=720, focal=(800.0, 800.0), centre=(639.5, 359.5))


@pytest.mark.parametrize(
    ("lens", "look", "bar"),
    [
        ((0.0, 0.0, 0.0, 0.0, 0.0), Look(noise=4.0), 0.05),
        ((0.0, 0.0, 0.0, 0.0, 0.0), Look(blur=3.0, noise=4.0), 0.20),
        ((-0.3, 0.1, 0.0, 0.0, 0.0), Look(noise=4.0), 0.08),
        ((0.3, -0.05, 0.0, 0.0, 0.0), Look(noise=4.0), 0.08),
    ],
)
def test_centres_are_sub_pixel(lens, look, bar):
    camera = CAMERA.model_copy(update={"distortion": lens})
    errors = np.array([_centre_error(camera, look, seed) for seed in range(16)])
    assert np.isfinite(errors).mean() > 0.9
    assert np.sqrt(np.nanmean(errors**2)) < bar


def test_all_markers_of_a_frame_are_found_with_their_codes(studio):
    pose = pose_of(yaw=2.0, pitch=0.08)
    detections = detect(studio.frame(pose).image, studio.camera)
    eye = studio.renderer.floor_in_camera
    for target, shift in ((studio.body, pose), (studio.floor, ScenePose(np.zeros(3), np.eye(3)))):
        points = (target.positions @ shift.rotation.T + shift.position) @ eye.rotation.T + eye.position
        for place, code in zip(project(studio.camera, points), target.codes, strict=True):
            near = [d for d in detections if math.hypot(*(d.ellipse[:2] - place)) < 1]
            assert [d.code for d in near] == [code], CODE_NAMES[code]
    assert len(detections) == len(studio.body.markers) + len(studio.floor.markers)


@pytest.mark.parametrize(
    "look",
    [
        Look(noise=15.0),
        Look(gain=0.35, gradient=(0.8, -0.5)),
        Look(shadow=0.6, shadow_line=(0.0, 0.0)),
        Look(gamma=2.0),
        Look(blur=1.8),
    ],
    ids=["noise", "dark and uneven", "shadow", "gamma", "defocus"],
)
def test_light_and_noise_do_not_hide_the_robot(studio, look):
    pose = pose_of(yaw=0.3)
    detections = detect(studio.frame(pose, look=look).image, studio.camera)
    found = find_target(detections, studio.body, studio.camera)
    assert found is not None
    assert found.used.all()
    eye = studio.renderer.floor_in_camera
    assert np.linalg.norm(found.position - (eye.rotation @ pose.position + eye.position)) < 0.004


def test_no_pose_in_clutter():
    for seed in range(6):
        detections = detect(clutter(seed, CAMERA), CAMERA)
        for name in ("body", "floor"):
            assert find_target(detections, load_target(name), CAMERA) is None


def test_half_a_turn_is_told_by_the_key_marker(studio):
    for yaw in (0.3, 0.3 + math.pi):
        found = find_target(detect(studio.frame(pose_of(yaw=yaw)).image, studio.camera), studio.body, studio.camera)
        assert found is not None
        eye = studio.renderer.floor_in_camera
        heading = eye.rotation.T @ found.rotation[:, 0]
        assert heading @ [math.cos(yaw), math.sin(yaw), 0] > 0.999


def test_mirrored_target_is_refused(studio):
    image = np.ascontiguousarray(studio.frame(pose_of()).image[:, ::-1])
    assert find_target(detect(image, studio.camera), studio.body, studio.camera) is None


def test_ellipse_centre_of_a_projected_circle():
    """The closed form against an ellipse fitted to projected points, and against the projected centre, which is not it."""
    import cv2

    rotation = cv2.Rodrigues(np.array([2.6, 0.5, 0.2]))[0]
    position, radius = np.array([0.1, -0.2, 0.5]), 0.08
    angle = np.linspace(0, 2 * np.pi, 400, endpoint=False)
    points = position + radius * (np.cos(angle)[:, None] * rotation[:, 0] + np.sin(angle)[:, None] * rotation[:, 1])
    image = points[:, :2] / points[:, 2:]
    conic = np.linalg.svd(np.column_stack([image**2, image[:, :1] * image[:, 1:], image, np.ones(400)]))[2][-1]
    a, c, b, d, e, _ = conic
    fitted = np.linalg.solve([[2 * a, b], [b, 2 * c]], [-d, -e])
    predicted = np.empty((1, 2))
    circle_centres(np.zeros((1, 3)), np.array([radius]), rotation, position, predicted)
    assert predicted[0] == pytest.approx(fitted, abs=1e-9)
    assert np.linalg.norm(predicted[0] - position[:2] / position[2]) > 1e-3


def test_lens_model_agrees_with_opencv_and_with_its_inverse():
    import cv2

    camera = CAMERA.model_copy(update={"distortion": (-0.25, 0.08, 0.002, -0.003, 0.01)})
    points = np.random.default_rng(0).uniform(-0.6, 0.6, (50, 2))
    mine = np.array([distort(camera.values, x, y) for x, y in points])
    theirs = cv2.projectPoints(np.column_stack([points, np.ones(50)]), np.zeros(3), np.zeros(3), camera.matrix,
                               np.array(camera.distortion))[0].reshape(-1, 2)  # fmt: skip
    assert mine == pytest.approx(theirs, abs=1e-9)
    assert np.array([undistort(camera.values, u, v) for u, v in mine]) == pytest.approx(points, abs=1e-10)
