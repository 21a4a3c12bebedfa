"""A camera that stands, drifts or is held in the hands, and sheets that were kicked, from circles' centres; no pictures."""

import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from wlr_gym.perception.markers.camera import Camera
from wlr_gym.perception.markers.detection import Detection
from wlr_gym.perception.markers.pose import TargetPose, circle_centres
from wlr_gym.perception.markers.targets import load_target, ring_radii
from wlr_gym.perception.vision.self_calibration import camera_motion
from wlr_gym.perception.vision.tracking import LOST, Sample

CAMERA = Camera(width=1280, height=720, focal=(800.0, 800.0), centre=(639.5, 359.5))
NOISE = 0.02  # px
DOWN = np.diag([1.0, -1.0, -1.0])


def film(floor, places, drift=0.0, hand=0.0, kick=None, count=60, hidden=()):
    """Samples of an empty floor (true ``places``) with the floor where the tracker would guess it, and the truth."""
    rng, samples, truths = np.random.default_rng(1), [], []
    for k in range(count):
        t = k / 30
        sway = hand * np.array([math.sin(5 * t), math.cos(7 * t), math.sin(9 * t)])
        turn = Rotation.from_rotvec(0.01 * sway / 0.005 if hand else np.zeros(3)).as_matrix() @ DOWN
        position = np.array([drift * t, 0.0, 1.8]) + sway
        shown = places + (0 if kick is None or t < kick[0] else np.eye(4)[kick[1]][:, None] * np.array([0.012, 0.0, 0.0]))
        seen = {}
        for m, marker in enumerate(floor.markers):
            if m in hidden and k > 20:
                continue
            radii = marker.radius * np.array(ring_radii(int(floor.codes[m])))
            centres = np.empty((3, 2))
            circle_centres(np.repeat(shown[m : m + 1], 3, axis=0), radii, turn, position, centres)
            centres += NOISE / CAMERA.focal[0] * rng.standard_normal((3, 2))
            scale = marker.radius / position[2]
            shape = np.array([*centres[0], *(scale * turn[:2, :2]).ravel()])
            ellipse = shape * CAMERA.focal[0]
            ellipse[:2] += CAMERA.centre
            spread = np.tile((NOISE / CAMERA.focal[0]) ** 2 * np.eye(2), (3, 1, 1))
            seen[m] = Detection(int(floor.codes[m]), ellipse, centres, spread, shape, 200.0, 0.1, 1.0)
        guess = TargetPose(turn, position + 1e-3 * rng.standard_normal(3), np.eye(6), np.ones(4, bool), 0.0, 1.0)
        nothing = np.full(6, np.nan), np.full((6, 6), np.nan)
        samples.append(Sample(k, t, LOST, *nothing, 0, math.nan, np.full((4, 2), np.nan), floor=guess, floor_seen=seen))
        truths.append((turn, position))
    return samples, truths


@pytest.fixture(scope="module")
def floor():
    return load_target("floor")


@pytest.fixture(scope="module")
def laid(floor):
    """Where the sheets really are: off by 3 mm."""
    return floor.positions + np.array([0.003, 0.003, 0.0]) * np.random.default_rng(8).standard_normal((4, 3))


def steadiness(motion, truths):
    """Spread (m) of the floor's origin in the camera frame, and of its tilt (rad), against the truth over the film."""
    pairs = list(zip(motion.floors, truths, strict=True))
    places = np.array([pose.position - position for pose, (_, position) in pairs])
    tilts = np.array([Rotation.from_matrix(pose.rotation @ turn.T).as_rotvec() for pose, (turn, _) in pairs])
    return places.std(axis=0), tilts.std(axis=0)


def test_a_camera_that_stands_has_one_floor(floor, laid):
    motion = camera_motion(film(floor, laid)[0], CAMERA, floor, 0.0)
    assert not motion.moves
    assert len({id(pose) for pose in motion.floors}) == 1


@pytest.mark.parametrize("motions", [{"drift": 0.004}, {"hand": 0.005}, {"hand": 0.005, "hidden": (2,)}])
def test_a_camera_that_moves_has_one_floor_per_frame_in_one_frame_of_reference(floor, laid, motions):
    """Also when a marker is hidden from some frame on: its place was learned before."""
    samples, truths = film(floor, laid, **motions)
    motion = camera_motion(samples, CAMERA, floor, 0.0)
    assert motion.moves
    place, tilt = steadiness(motion, truths)
    assert np.all(place < [0.1e-3, 0.1e-3, 0.3e-3])
    assert np.all(tilt < 0.5e-3)


@pytest.mark.parametrize("hand", [0.0, 0.005])
def test_a_kicked_sheet_is_named_and_left_out(floor, laid, hand):
    samples, truths = film(floor, laid, hand=hand, kick=(1.0, 1))
    motion = camera_motion(samples, CAMERA, floor, 0.0)
    assert [motion.names[kick.marker] for kick in motion.kicks] == ["b"]
    assert motion.kicks[0].time == pytest.approx(1.0, abs=0.1)
    assert motion.kicks[0].distance == pytest.approx(0.012, rel=0.2)
    assert motion.enough
    assert motion.moves == (hand > 0)
    assert np.all(steadiness(motion, truths)[0] < [0.2e-3, 0.2e-3, 0.5e-3])
