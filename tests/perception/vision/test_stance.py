"""What the legs say about the tilt of the body: poses of a simulated drive, seen in frames that err."""

import math
from dataclasses import replace

import numpy as np
import pytest
from test_frame_noise import tilted
from test_measure import OFFSET, samples_of

from wlr_gym.perception.vision import slip
from wlr_gym.perception.vision.slip import measure_slip
from wlr_gym.perception.vision.stance import levelled
from wlr_gym.robot import load_robot
from wlr_gym.robot.parameters import Parameters
from wlr_gym.studies.bench.vision_drives import skid_turn, true_slip


@pytest.fixture(scope="module")
def drive():
    return skid_turn(load_robot())


def measured(drive, samples):
    return measure_slip(samples, OFFSET, drive.run, drive.robot, Parameters.nominal(drive.robot))


def drifting(samples, pitch, roll):
    """With tilts that drift to and fro, as compression lets them, and sigmas of that size."""
    size = np.array([0, 0, 0, 0, pitch, roll])
    wide = np.diag(size**2)
    return [replace(s, pose=s.pose + size * math.cos(0.7 * s.time), covariance=s.covariance + wide) for s in samples]


@pytest.fixture
def alone(drive, monkeypatch):
    """Measures without the legs."""

    def without(samples):
        with monkeypatch.context() as patch:
            patch.setattr(slip, "floor_slope", lambda *_: (np.zeros(2), ["not used"]))
            return measured(drive, samples)

    return without


def test_tilts_that_frames_tell_badly_come_from_the_legs(drive, alone):
    samples = drifting(samples_of(drive), 0.008, 0.008)
    found, film = measured(drive, samples), alone(samples)
    error, before = (one.slip - true_slip(drive, one.time) for one in (found, film))
    assert np.abs(error).max() < 0.6 * np.abs(before).max()
    assert np.median(found.slip_std) < 0.8 * np.median(film.slip_std)
    assert not found.contradictions


def test_a_floor_that_slopes_against_its_markers_is_levelled(drive):
    samples = samples_of(drive)
    plain, sloping = measured(drive, samples), measured(drive, levelled(samples, np.array([0.012, -0.009])))
    assert np.abs(sloping.slip - plain.slip).max() < 1e-4
    assert sloping.pose[:, [2, 4, 5]] == pytest.approx(plain.pose[:, [2, 4, 5]], abs=1e-3)


def test_a_floor_that_is_not_flat_does_not_falsify_slip(drive, alone):
    """A wave of 1 mm under the front wheels that the legs do not know, and the film sees."""
    rough = [replace(s, pose=s.pose + 0.003 * math.sin(9 * s.pose[0]) * np.eye(6)[4]) for s in samples_of(drive)]
    assert np.abs(measured(drive, rough).slip - alone(rough).slip).max() < 1e-4


def test_a_wheel_on_a_step_is_said_and_the_legs_are_not_used(drive):
    samples = samples_of(drive)
    middle = samples[len(samples) // 2].time
    found = measured(drive, tilted(samples, np.array([0.0, 0.0, 0.03]), middle, middle + 1.0))
    assert any("roll differs from what the legs say" in text for text in found.contradictions)
    assert np.abs(found.pose[:, 5]).max() > 0.02
