"""Films of a lab that is not perfect, drawn by a second renderer: hand-laid markers, rolling shutter, a camera that drifts."""

import numpy as np
import pytest
from vision_studio import OFFSET, wrapped

from studies.bench.lab_renderer import Lab, frames, lens, true_places
from studies.bench.vision import pose_at, true_slip
from wlr_gym.perception.markers.targets import load_target
from wlr_gym.perception.vision.analysis import analyse
from wlr_gym.perception.vision.tracking import OK, PoseFinder, Tracker, angles, locate_floor

SECONDS, RATE = 4.6, 15.0


def analysed(drive, lab, **body):
    target = load_target("body").model_copy(update=body)
    return analyse(list(frames(drive, lab, SECONDS, RATE)), drive.run, lens(), target, load_target("floor"), drive.robot)


def test_poses_are_right_in_the_pictures_of_another_renderer(drive):
    shots, body, floor = list(frames(drive, Lab(), 6.0, 0.7)), load_target("body"), load_target("floor")
    tracker = Tracker(lens(), body, floor, *locate_floor(shots, lens(), floor))
    for shot in shots:
        sample, pose = tracker(shot), pose_at(drive, shot.time + OFFSET)
        assert sample.status == OK
        assert np.hypot(*(sample.pose[:2] - pose.position[:2])) < 0.5e-3
        assert abs(wrapped(sample.pose[3] - angles(pose.rotation)[0])) < 1e-3


def checked(drive, analysis):
    """Every frame has a pose; the slip is right to 1 mm and to 2.5 sigma at the end."""
    assert all(np.isfinite(sample.pose[0]) for sample in analysis.samples)
    slip = analysis.slip
    error = (slip.slip - true_slip(drive, slip.time))[-1]
    assert np.abs(slip.slip[-1]).max() > 0.05  # there is slip to be found
    assert np.abs(error).max() < 1e-3
    assert np.all(np.abs(error) < 2.5 * np.hypot(slip.slip_std[-1], slip.slip_layout_std[-1]))


@pytest.mark.slow
def test_a_rolling_shutter_over_a_floor_laid_by_hand(drive):
    found = analysed(drive, Lab(floor_error=0.003, readout=0.025, seed=3))
    checked(drive, found)
    assert found.calibration is not None
    assert found.calibration.readout == pytest.approx(0.025, abs=0.0015)
    assert any("rolling shutter" in finding for finding in found.findings)


@pytest.mark.slow
def test_a_print_that_is_stretched_both_ways_with_a_caliper_reading(drive):
    lab = Lab(stretch=(0.002, 0.005), floor_error=0.001, seed=5)
    places = true_places(lab)[1]
    reading = float(np.linalg.norm(places[0] - places[2]))
    found = analysed(drive, lab, tolerance=1e-4, stretch=0.005, caliper=reading)
    checked(drive, found)
    assert found.calibration is not None
    assert np.ptp(found.calibration.adjustment.target.positions, axis=0)[:2] == pytest.approx(
        np.ptp(places, axis=0)[:2], rel=1e-3
    )
    assert any("caliper" in finding for finding in analysed(drive, lab, tolerance=1e-4, stretch=0.005).findings)


@pytest.mark.slow
def test_a_camera_that_drifts(drive):
    found = analysed(drive, Lab(drift=0.002))
    checked(drive, found)
    assert any("the camera moved" in finding for finding in found.findings)


@pytest.mark.slow
def test_a_camera_in_the_hands_a_kicked_sheet_and_times_that_jitter(drive):
    found = analysed(drive, Lab(hand=0.7, floor_error=0.002, kick=(3.9, 0.012), stamp_error=0.002, seed=7))
    checked(drive, found)
    assert any("floor sheet 'b' changed its place" in finding for finding in found.findings)
    assert found.calibration is not None
    assert found.calibration.noise.jitter == pytest.approx(0.002, rel=0.5)


@pytest.mark.slow
def test_the_live_tracker_gives_the_poses_of_the_film(drive):
    """With a rolling shutter whose readout the camera file states."""
    shots = [frame for frame in frames(drive, Lab(readout=0.025), 4.6, 30.0) if frame.time > 1.5]
    film = analyse(shots, drive.run, lens(0.025), load_target("body"), load_target("floor"), drive.robot)
    finder = PoseFinder(lens(0.025), load_target("body"), load_target("floor"))
    apart = np.array([finder(shot).pose - sample.pose for shot, sample in zip(shots, film.samples, strict=True)])
    apart = apart[np.isfinite(apart[:, 0])]
    assert len(apart) > 60
    assert np.all(np.sqrt(np.mean(apart**2, axis=0)) < [1e-4, 1e-4, 2e-4, 1e-4, 2e-3, 2e-3])
