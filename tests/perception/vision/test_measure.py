"""From poses to clocks, slip and run columns: simulated drives, camera samples made from the truth, no pictures."""

import math
from dataclasses import replace

import numpy as np
import pytest
from vision_studio import OFFSET, measured, samples_of, with_table

from studies.bench.vision import paper_test, pose_at, true_slip
from wlr_gym.base.errors import InputError
from wlr_gym.data import Run, read_run
from wlr_gym.perception.vision.alignment import align
from wlr_gym.perception.vision.analysis import VideoAnalysis, _findings, camera_columns, save_video_analysis
from wlr_gym.perception.vision.motion import smooth
from wlr_gym.perception.vision.tracking import angles
from wlr_gym.robot import load_robot
from wlr_gym.robot.parameters import Parameters


def aligned(drive, samples, around=0.0):
    time, poses = np.array([s.time for s in samples]), np.stack([s.pose for s in samples])
    return align(time, poses, drive.run, drive.robot, Parameters.nominal(drive.robot), around)


@pytest.mark.parametrize("seed", range(2))
def test_clocks_are_aligned_within_2_ms(drive, seed):
    found = aligned(drive, samples_of(drive, seed=seed))
    assert found.offset == pytest.approx(OFFSET, abs=0.002)
    assert found.std < 0.002
    assert "yaw" in found.parts


@pytest.mark.parametrize(("missing", "used"), [(slice(50, 52), True), (slice(50, 60), False)])
def test_clocks_are_aligned_by_a_gyroscope_that_misses_readings(drive, missing, used):
    table = drive.run.table.copy()
    table.loc[table.index[missing], "gyro_z"] = np.nan
    found = aligned(replace(drive, run=with_table(drive.run, table)), samples_of(drive))
    assert found.offset == pytest.approx(OFFSET, abs=0.002)
    assert ("yaw" in found.parts) == used


def test_a_pause_of_the_log_is_told(drive):
    samples = samples_of(drive)
    for count, told in ((4, False), (15, True)):
        paused = with_table(drive.run, drive.run.table.drop(index=range(100, 100 + count)))
        said = [
            finding for finding in _findings(samples, measured(drive, samples, run=paused), 0.0) if "no rows for" in finding
        ]
        assert bool(said) == told
    assert "no rows for 0.32 s after 1.98 s" in said[0]


@pytest.mark.slow
def test_the_wheels_errors_are_correlated_as_the_covariance_says(drive):
    """Against the errors of other draws of the frames' noise; its diagonal is that of the sigmas."""
    draws = [measured(drive, samples_of(drive, seed=seed)) for seed in range(8)]
    truth = true_slip(drive, draws[0].time)[-1].ravel()
    errors = np.stack([found.slip[-1].ravel() - truth for found in draws])
    root = np.linalg.cholesky(draws[0].covariance)
    whitened = np.linalg.solve(root, (errors - errors.mean(axis=0)).T)
    assert 0.5 < np.sqrt(np.mean(whitened**2)) < 1.5
    whole = np.linalg.solve(root, errors.T)  # with what all draws share: the counts of legs and wheels
    assert 0.5 < np.sqrt(np.mean(whole**2)) < 1.5
    lateral = draws[0].covariance[1::2, 1::2]
    assert np.all(lateral > 0.8 * lateral[0, 0])  # all wheels are off alike
    with_layout = measured(drive, None, 0.0, (0.002, 0.003))
    std = np.hypot(with_layout.slip_std, with_layout.slip_layout_std)[-1].ravel()
    assert np.sqrt(np.diag(with_layout.covariance)) == pytest.approx(std, rel=1e-6)


def test_slow_motion_is_refused(drive):
    """A film whose times run slower than the camera's clock did."""
    samples = samples_of(drive)
    samples = [replace(sample, time=samples[0].time + 2.0 * (sample.time - samples[0].time)) for sample in samples]
    with pytest.raises(InputError, match=r"do not see the same turns.*slow motion.*--rate"):
        aligned(drive, samples)


@pytest.mark.parametrize("offset", [1.2, 2.0, 3.0, -2.5])
def test_clocks_far_apart_are_refused_and_found_around_a_guess(drive, offset):
    samples = samples_of(drive, offset=offset)
    with pytest.raises(InputError, match="--around"):
        aligned(drive, samples)
    assert aligned(drive, samples, around=round(offset)).offset == pytest.approx(offset, abs=0.003)


def test_slip_is_within_a_millimetre_and_its_sigma_is_honest(drive):
    """Six draws of the frames' noise, clocks aligned anew each time, all errors over their own sigma.

    Lateral errors are alike for all wheels, so six independent ones are left: if sigma is right, their rms is below 0.25 or
    above 1.93 once in 500 times (chi square).
    """
    assert np.abs(drive.slip[-1]).max() > 0.1  # there is slip to be found
    normalised = []
    for seed in range(6):
        samples = samples_of(drive, seed=seed)
        clocks = aligned(drive, samples)
        found = measured(drive, samples, clocks.std, offset=clocks.offset)
        error = found.slip - true_slip(drive, found.time)
        assert np.abs(error).max() < 1e-3
        normalised.append(error[-1] / found.slip_std[-1])
    spread = np.sqrt(np.mean(np.square(normalised), axis=(0, 1)))
    assert np.all((spread > 0.25) & (spread < 1.93))


@pytest.mark.slow
def test_sigma_of_slip_grows_with_what_is_known_less(drive):
    """Clocks count while it moves, tilts of the body and the layout of its markers always."""
    samples = samples_of(drive)
    tilted = [replace(s, covariance=s.covariance * np.diag([1, 1, 1, 1, 9, 9])) for s in samples]
    plain = measured(drive, samples)
    late = measured(drive, samples, 0.004)
    rough = measured(drive, tilted, 0.0, (0.001, 0.001))
    fast, end = np.abs(plain.rate[:, 0]) > 0.1, -1
    assert np.median(late.slip_std[fast, :, 0]) > 2 * np.median(plain.slip_std[fast, :, 0])
    assert np.all(late.slip_std[end] < 1.6 * plain.slip_std[end])
    assert np.all(rough.slip_std[end] > 1.2 * plain.slip_std[end])
    scaled = [replace(s, pose=s.pose * [1.001, 1.001, 1, 1, 1, 1]) for s in samples]
    turned = [replace(s, pose=s.pose + np.array([0, 0, 0, 0.001, 0, 0])) for s in samples]
    errors = [measured(drive, s).slip[end] - plain.slip[end] for s in (scaled, turned)]
    assert np.linalg.norm(errors, axis=0) == pytest.approx(rough.slip_layout_std[end], rel=0.15)
    assert not plain.slip_layout_std.any()


@pytest.mark.slow
@pytest.mark.parametrize("number", [1, 2])
def test_paper_tests_from_poses(number):
    drive = paper_test(number, load_robot())
    samples = samples_of(drive)
    found = aligned(drive, samples)
    assert found.offset == pytest.approx(OFFSET, abs=0.004)
    slip = measured(drive, samples, offset=found.offset)
    assert np.abs(slip.slip - true_slip(drive, slip.time)).max() < 1e-3


def test_a_robot_that_stands_still_cannot_be_aligned(drive):
    still = 3 * [s for s in samples_of(drive) if s.time + OFFSET < 0.95]
    still = [replace(sample, time=k / 30) for k, sample in enumerate(still)]
    rows = drive.run.table[drive.run.table["t"] < 0.95]
    table = rows.iloc[np.tile(np.arange(len(rows)), 3)].assign(t=np.arange(3 * len(rows)) * 0.02)
    with pytest.raises(InputError, match="clocks cannot be aligned"):
        aligned(replace(drive, run=with_table(drive.run, table)), still)


def test_a_video_of_something_else_is_refused(drive):
    late = samples_of(drive, offset=-500.0)
    with pytest.raises(InputError, match="does the video belong"):
        aligned(drive, late)
    with pytest.raises(InputError, match="does it belong to this run"):
        measured(drive, late, offset=0.0)


def test_gaps_are_flagged(drive):
    found = measured(drive, samples_of(drive, gap=[(4.0, 4.6)]))
    gap = (found.time > 4.2) & (found.time < 4.4)
    assert not found.covered[gap].any()
    assert found.covered[found.time < 3.8].all()
    assert found.pose_std[gap, 0].min() > 5 * np.median(found.pose_std[:, 0])


def test_a_wild_sample_is_left_out(drive):
    samples = samples_of(drive)
    samples[100] = replace(samples[100], pose=samples[100].pose + np.array([0.05, 0, 0, 0, 0, 0]))
    found = measured(drive, samples)
    assert np.flatnonzero(found.outliers).tolist() == [100]
    assert np.abs(found.slip - true_slip(drive, found.time)).max() < 1e-3


def test_a_video_that_starts_in_mid_drive_is_told(drive):
    samples = samples_of(drive)
    for first, told in ((0, False), (60, True)):
        said = _findings(samples[first:], measured(drive, samples[first:]), 0.0)
        assert any("already moves" in finding for finding in said) == told


def test_a_video_that_is_cut_off_is_told(drive):
    samples = samples_of(drive)[:30]
    slip = measured(drive, samples)
    told = list(_findings(samples, slip, 0.0, 12))
    assert any("announces 42 frames, of which 30 could be decoded" in finding for finding in told)
    assert not any("announces" in finding for finding in _findings(samples, slip, 0.0))


@pytest.mark.parametrize("origin", ["start", "floor"])
def test_columns_are_the_pose_at_the_row(drive, origin):
    table = camera_columns(samples_of(drive), OFFSET, drive.run, origin, np.zeros(len(samples_of(drive)), bool))
    rows = np.flatnonzero(np.isfinite(table["cam_x"]))
    assert len(rows) == len(samples_of(drive))
    truth = np.array([[*pose_at(drive, t).position[:2], angles(pose_at(drive, t).rotation)[0]] for t in table["t"][rows]])
    if origin == "start":
        truth -= truth[0]  # it starts with heading 0
    found = table.loc[rows, ["cam_x", "cam_y", "cam_yaw"]].to_numpy()
    assert np.abs(found - truth).max() < 6e-4


def test_results_are_written_and_the_run_reads_back(drive, tmp_path):
    samples = samples_of(drive)
    slip = measured(drive, samples)
    table = camera_columns(samples, OFFSET, drive.run, "start", slip.outliers)
    run = Run(table, drive.run.meta, tmp_path / "run_01.parquet")
    analysis = VideoAnalysis(run, tuple(samples), None, OFFSET, slip, drive.robot, "start", 0.0, 3, ())
    names = {path.name for path in save_video_analysis(analysis, tmp_path)}
    assert names == {"run_01.parquet", "slip.csv", "frames.csv", "summary.json", "pose.png", "slip.png"}
    again = read_run(tmp_path / "run_01.parquet")
    assert np.isfinite(again["cam_x"]).sum() == len(samples)
    assert analysis.summary()["missing_frames"] == 3
    assert analysis.summary()["body_lateral_slip_m"] == pytest.approx(float(slip.slip[-1, :, 1].mean()))


def test_smoother_gives_value_and_rate():
    rng, t = np.random.default_rng(1), np.arange(0, 8, 1 / 30)
    values = 0.1 * np.sin(1.5 * t) + 1e-3 * rng.standard_normal(len(t))
    values[60:70] = np.nan
    at = np.linspace(0.5, 7.5, 200)
    found = smooth(t, values, 1e-3, at)
    error, slope = found.value - 0.1 * np.sin(1.5 * at), found.rate - 0.15 * np.cos(1.5 * at)
    assert np.sqrt(np.mean(error**2)) < 0.6e-3
    assert np.sqrt(np.mean(slope**2)) < 3e-3
    assert math.isfinite(found.value[70])
