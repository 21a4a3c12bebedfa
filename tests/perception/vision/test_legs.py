"""What the legs say about the tilt of the body: poses of a simulated drive, seen in frames that err."""

import math
from dataclasses import replace

import numpy as np
import pytest
from test_frame_noise import tilted
from vision_studio import OFFSET, measured, samples_of, with_table

from studies.bench.vision import paper_test, pose_at, true_slip
from wlr_gym.perception.vision import slip
from wlr_gym.perception.vision.motion import STANDING, leg_readings
from wlr_gym.perception.vision.tracking import angles
from wlr_gym.robot import load_robot
from wlr_gym.robot.parameter_table import read_tolerances
from wlr_gym.robot.parameters import Parameters


@pytest.fixture(scope="module")
def paper():
    return paper_test(1, load_robot())


def drifting(samples, pitch, roll):
    """With tilts that drift to and fro, as compression lets them, and sigmas by which a second of frames errs that much."""
    size = np.array([0, 0, 0, 0, pitch, roll])
    wide = 30 * np.diag(size**2)
    return [replace(s, pose=s.pose + size * math.cos(0.7 * s.time), covariance=s.covariance + wide) for s in samples]


def shaken(samples, tilt):
    """With tilts that err in each frame, and state that they do."""
    rng, size = np.random.default_rng(0), tilt * np.array([0, 0, 0, 0, 1, 1])
    wide = np.diag(size**2)
    return [replace(s, pose=s.pose + size * rng.standard_normal(6), covariance=s.covariance + wide) for s in samples]


def raised(samples, height, start, stop):
    """As if the robot were lifted, level, within half a second."""
    share = [min(1.0, max(0.0, 2 * (s.time - start))) * min(1.0, max(0.0, 2 * (stop - s.time))) for s in samples]
    return [replace(s, pose=s.pose + height * part * np.eye(6)[2]) for s, part in zip(samples, share, strict=True)]


def normalised(drive, found):
    """rms of the poses' errors in sigmas: height, pitch and roll."""
    true = [pose_at(drive, time) for time in found.time]
    values = np.array([[pose.position[2], *angles(pose.rotation)[1:]] for pose in true])
    return np.sqrt(np.mean(((found.pose[:, STANDING] - values) / found.pose_std[:, STANDING]) ** 2, axis=0))


@pytest.fixture
def alone(monkeypatch):
    """Measures without the legs."""

    def without(drive, samples, run=None):
        with monkeypatch.context() as patch:
            patch.setattr(slip, "leg_findings", lambda *_: ["not used"])
            return measured(drive, samples, run=run)

    return without


def test_tilts_that_frames_tell_badly_come_from_the_legs(paper, alone):
    samples = shaken(samples_of(paper), 0.008)
    found, film = measured(paper, samples), alone(paper, samples)
    error, before = (one.slip - true_slip(paper, one.time) for one in (found, film))
    assert np.abs(error).max() < 0.6 * np.abs(before).max()
    assert np.median(found.slip_std) < 0.9 * np.median(film.slip_std)
    assert not found.contradictions


@pytest.mark.slow
@pytest.mark.parametrize("tilt", [0.0, 0.008])
def test_a_straight_drive_finds_no_slope_of_the_floor(paper, alone, tilt):
    """Paper test 1: loads shift as the legs sweep, so heights that tyres cause go with the way driven."""
    samples = shaken(samples_of(paper), tilt)
    found, film = measured(paper, samples), alone(paper, samples)
    assert not found.contradictions
    assert np.all(normalised(paper, found) < np.maximum(1.4, 1.1 * normalised(paper, film)))
    assert normalised(paper, found)[1] < 1.4
    assert np.median(found.pose_std[:, 2]) < 0.9 * np.median(film.pose_std[:, 2])


def test_a_short_straight_drive_is_no_worse_with_the_legs(drive, alone):
    samples = [s for s in drifting(samples_of(drive), 0.004, 0.004) if s.time + OFFSET < 3.1]
    found, film = measured(drive, samples), alone(drive, samples)
    assert not found.contradictions
    assert np.all(normalised(drive, found) < np.maximum(1.5, 1.1 * normalised(drive, film)))


def standing(robot, front, rear, period=0.02):
    """What legs say that rest at these angles."""
    angles = np.tile([front, front, rear, rear, 0.0, 0.0, 0.0, 0.0], (20, 1))
    return leg_readings(np.linspace(0.0, 19 * period, 20), (angles, 0 * angles), robot, Parameters.nominal(robot))


def test_a_short_wheelbase_tells_the_pitch_worse(drive):
    out, back = math.radians(30), math.radians(150)
    long, short = standing(drive.robot, out, back), standing(drive.robot, back, out)
    hip, reach = drive.robot.hip_position.x, drive.robot.leg.length * math.cos(out)
    assert short.noise[0, 1, 1] / long.noise[0, 1, 1] == pytest.approx(((hip + reach) / (hip - reach)) ** 2, rel=0.02)
    assert short.noise[0, 0, 0] == pytest.approx(long.noise[0, 0, 0], rel=0.02)


def test_rows_that_come_more_often_tell_no_more(drive):
    rows, half = standing(drive.robot, 1.0, 2.0), standing(drive.robot, 1.0, 2.0, 0.01)
    assert half.noise == pytest.approx(2 * rows.noise)


def test_a_floor_that_is_not_flat_does_not_falsify_slip(drive, alone):
    """A wave of 1 mm under the front wheels that the legs do not know, and the film sees."""
    rough = [replace(s, pose=s.pose + 0.003 * math.sin(9 * s.pose[0]) * np.eye(6)[4]) for s in samples_of(drive)]
    assert np.abs(measured(drive, rough).slip - alone(drive, rough).slip).max() < 1e-4


def test_a_wheel_on_a_step_is_said_and_the_legs_are_not_used(drive, alone):
    samples = samples_of(drive)
    middle = samples[len(samples) // 2].time
    stepped = tilted(samples, np.array([0.0, 0.0, 0.03]), middle, middle + 1.0)
    found = measured(drive, stepped)
    assert any("roll differs from what the legs say" in text for text in found.contradictions)
    assert np.array_equal(found.pose, alone(drive, stepped).pose)


@pytest.mark.slow
@pytest.mark.parametrize("tilt", [0.0, 0.003, 0.008])
def test_front_wheels_on_a_kerb_of_3_mm_are_said(paper, tilt):
    """Also where each frame shows no more than its own noise."""
    change = np.array([0, 0, 0.0015, 0, -0.0086, 0])
    stepped = [replace(s, pose=s.pose + change * np.interp(s.time, [3, 3.2, 4.8, 5], [0, 1, 1, 0])) for s in samples_of(paper)]
    assert any("pitch differs from what the legs say" in text for text in measured(paper, shaken(stepped, tilt)).contradictions)


@pytest.mark.parametrize("height", [0.01, 0.1, 0.3])
def test_a_robot_that_is_lifted_is_said(drive, height):
    found = measured(drive, raised(samples_of(drive), height, 3.5, 5.5))
    assert any("height differs from what the legs say" in text for text in found.contradictions)


def test_what_happens_after_the_log_does_not_count(drive, alone):
    """The robot is picked up: film and legs are compared, and the legs used, within the log."""
    samples, run = raised(samples_of(drive), 0.1, 7.1, 9.0), with_table(drive.run, drive.run.table[drive.run["t"] < 7.0])
    found, film = measured(drive, samples, run=run), alone(drive, samples, run)
    assert not found.contradictions
    assert np.all(normalised(drive, found) < 1.1 * normalised(drive, film))


def test_single_frames_that_err_do_not_count(drive):
    """An outlier, and frames that state that they err."""
    samples = samples_of(drive)
    samples[100] = replace(samples[100], pose=samples[100].pose + 0.1 * np.eye(6)[4])
    samples[120:138] = shaken(samples[120:138], 0.04)
    assert not measured(drive, samples).contradictions


def test_zeros_of_legs_may_be_certain(drive):
    certain = drive.robot.model_copy(update={"tolerances": read_tolerances({"joint_zero": "0 rad"})})
    assert np.isfinite(measured(drive, robot=certain).pose).all()
