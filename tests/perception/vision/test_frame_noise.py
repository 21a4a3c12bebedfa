"""Noise, jitter, repeated pictures and lost time of a film, from samples made of a simulated drive; no pictures."""

import math
from dataclasses import replace

import numpy as np
import pytest
from vision_studio import OFFSET, STD, samples_of

from wlr_gym.perception.vision.motion import body_rates
from wlr_gym.perception.vision.self_calibration import frame_noise, widened, without_repeats
from wlr_gym.perception.vision.slip import _angle_rates, imu_differences
from wlr_gym.perception.vision.tracking import REPEATED, without_pose


def jittered(drive, std):
    """Samples whose times are not those at which their poses were taken."""
    rng = np.random.default_rng(4)
    return [replace(sample, time=sample.time + std * rng.standard_normal()) for sample in samples_of(drive)]


def test_a_film_without_poses_is_left_as_it_is(drive):
    blind = [without_pose(sample, REPEATED) for sample in samples_of(drive)]
    assert widened(blind, frame_noise(blind)) == tuple(blind)


def test_the_frames_noise_is_found_from_one_to_the_next(drive):
    honest = samples_of(drive)
    assert frame_noise(honest).scale == pytest.approx(1.0, abs=0.15)
    assert frame_noise(honest).jitter == 0.0
    bold = [replace(sample, covariance=sample.covariance / 2.5**2) for sample in honest]
    assert frame_noise(bold).scale == pytest.approx(2.5, rel=0.15)


STILL, NOISE = 100, 2.5


def standing_first(drive, scatter):
    """Samples noisier than they state; before, the markers stand, and poses scatter by ``scatter`` sigmas about the first."""
    rng, samples = np.random.default_rng(8), samples_of(drive)
    bold = [replace(s, covariance=s.covariance / NOISE**2, centres=np.full((4, 2), 3.0 * k)) for k, s in enumerate(samples)]
    poses = bold[0].pose + scatter * STD * rng.standard_normal((STILL, 6))
    return [replace(bold[0], time=bold[0].time - (STILL - k) / 30, pose=pose) for k, pose in enumerate(poses)] + bold


@pytest.mark.parametrize(("scatter", "worth"), [(0.1, 1.0), (1.0, STILL)], ids=["copied", "taken anew"])
def test_pictures_of_standing_markers_that_a_codec_copies_count_as_one(scatter, worth, drive):
    samples = standing_first(drive, scatter)
    noise = frame_noise(samples)
    assert noise.scale == pytest.approx(NOISE, rel=0.15)
    information = sum(np.linalg.inv(sample.covariance) for sample in widened(samples, noise)[:STILL])
    assert np.diag(information) * STD**2 == pytest.approx(np.full(6, worth), rel=0.3)
    assert widened(samples, noise)[-1].covariance == pytest.approx(np.diag(STD**2), rel=0.3)


def test_jitter_of_the_times_is_told_from_noise_and_widens_along_the_motion(drive):
    samples = jittered(drive, 0.003)
    noise = frame_noise(samples)
    assert noise.jitter == pytest.approx(0.003, rel=0.4)
    assert noise.scale == pytest.approx(1.0, abs=0.2)
    middle = len(samples) // 2  # in the turn on the spot
    before, after = samples[middle].covariance, widened(samples, noise)[middle].covariance
    assert after[3, 3] > 100 * before[3, 3]
    assert after[2, 2] < 4 * before[2, 2]


@pytest.mark.parametrize(
    ("steps", "repeated"),
    [
        ([3, 3, 0, 6, 3, 0, 0, 0], [3]),
        ([0.3, 0.3, 0.002, 0.6, 0.3], [3]),  # hardly moving
        ([3, 3, 0.25, 6, 3], [3]),  # compression changes a picture that it repeats
        ([3, 3, 0, 0, 9, 3, 0, 6, 0, 6], [3, 4, 7, 9]),  # twice in a row, and every other one
        ([3, 0, 0, 0, 0, 3, 3], []),  # standing for a while
        ([0.02, 0.01, -0.001, 0.03, -0.02], []),  # standing, with noise
        ([0.6, 0.3, 0.01, -0.3, -0.6], []),  # turning back
        ([0.3, 0.2, 0.08, 0.2, 0.3], []),  # slower for a moment
    ],
    ids=["fast", "slow", "compressed", "in a row", "a while", "standing", "turning back", "slower"],
)
def test_a_repeated_picture_has_no_pose_unless_the_robot_stands(steps, repeated, drive):
    places = np.cumsum([0, *steps])
    samples = [replace(s, centres=np.full((4, 2), float(p))) for s, p in zip(samples_of(drive), places, strict=False)]
    assert [k for k, sample in enumerate(without_repeats(samples)) if sample.status == REPEATED] == repeated


def test_time_that_is_lost_without_a_trace_shows_against_the_gyroscope(drive):
    samples = samples_of(drive)
    assert not list(imu_differences(samples, OFFSET, drive.run, drive.robot))
    middle = len(samples) // 2
    late = [*samples[:middle], *(replace(sample, time=sample.time - 0.1) for sample in samples[middle + 3 :])]
    found = next(imu_differences(late, OFFSET, drive.run, drive.robot))
    assert found.axis == "yaw"
    assert found.time == pytest.approx(samples[middle].time + OFFSET, abs=1.5)
    assert found.size > 0.01


def tilted(samples, tilt, start=-math.inf, stop=math.inf):
    """With another tilt (yaw, pitch, roll; rad) between two times."""
    poses = [s.pose + np.concatenate([np.zeros(3), tilt if start < s.time < stop else np.zeros(3)]) for s in samples]
    return [replace(sample, pose=pose) for sample, pose in zip(samples, poses, strict=True)]


@pytest.mark.parametrize(("axis", "tilt"), [("pitch", (0, 0.05, 0)), ("roll", (0, 0, -0.05))])
def test_a_tilt_that_the_imu_does_not_know_is_found(axis, tilt, drive):
    """For a second in the drive by the gyroscope, all the time by the accelerometer."""
    samples = samples_of(drive)
    middle = samples[len(samples) // 2].time
    found = list(imu_differences(tilted(samples, np.array(tilt), middle, middle + 1.0), OFFSET, drive.run, drive.robot))
    assert axis in {difference.axis for difference in found if not difference.level}
    found = list(imu_differences(tilted(samples, np.array(tilt)), OFFSET, drive.run, drive.robot))
    assert [(difference.axis, difference.level) for difference in found] == [(axis, True)]
    assert found[0].size == pytest.approx(0.05, abs=0.01)


def test_rates_of_the_angles_are_those_of_a_turning_body():
    pitch, roll, rates = np.array([0.2, -0.4]), np.array([-0.3, 0.1]), np.array([[0.7, -0.4, 0.5], [-0.2, 0.3, 0.9]])
    assert pytest.approx(rates) == _angle_rates(body_rates(pitch, roll, rates), pitch, roll).T
