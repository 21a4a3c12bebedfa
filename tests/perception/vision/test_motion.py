"""One smoother over camera and IMU: a motion made of sines, whose IMU readings come from differences of its rotations."""

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from vision_studio import OFFSET, measured, samples_of, with_table

from studies.bench.vision import pose_at, true_slip
from wlr_gym.perception.vision import slip
from wlr_gym.perception.vision.motion import ImuReadings, smooth_motion
from wlr_gym.perception.vision.slip import imu_findings, wrong_axes
from wlr_gym.perception.vision.tracking import OK, Sample, angles

GRAVITY, SECONDS = 9.80665, 5.0
SIZE = np.array([0.2, 0.1, 0.01, 0.9, 0.03, 0.02])
PACE = np.array([2.1, 2.9, 4.3, 1.7, 3.7, 5.3])
STD = np.array([8e-5, 8e-5, 2e-4, 2e-4, 1e-3, 1e-3])
GYRO, FORCE = 1e-3, 0.03  # rad/s, m/s2, 1 sigma
ROWS = np.arange(0.1, SECONDS - 0.1, 0.02)
NONE = {f"{kind}_{axis}": math.nan for kind in ("gyro", "acc") for axis in "xyz"}


def truth(at):
    return SIZE * np.sin(PACE * np.atleast_1d(at)[:, None])


def rates(at):
    return SIZE * PACE * np.cos(PACE * at[:, None])


def frames(rng):
    """Samples whose x errs with the pitch."""
    root = np.diag(STD)
    root[0, 4] = 1e-4
    for index in range(int(30 * SECONDS)):
        time = index / 30
        pose = truth(time)[0] + root @ rng.standard_normal(6)
        yield Sample(index, time, OK, pose, root @ root.T, 4, 0.02, np.zeros((4, 2)))


def imu(rng, mount=(0.0, 0.0, 0.0)):
    """Readings with a bias, of an IMU turned by ``mount`` (rad) on the body, over a floor with a slope."""
    at, step = np.arange(0.0, SECONDS, 0.02), 1e-4
    turned = Rotation.from_rotvec(mount).as_matrix()
    readings = []
    for t in at:
        before, now, after = (Rotation.from_euler("ZYX", truth(t + d)[0, 3:]).as_matrix() for d in (-step, 0.0, step))
        spin = now.T @ (after - before) / (2 * step)
        force = (-(PACE**2) * truth(t)[0])[:3] + GRAVITY * np.array([0.004, -0.006, 1.0])
        readings.append([*(turned.T @ [spin[2, 1], spin[0, 2], spin[1, 0]]), *(turned.T @ now.T @ force)])
    noise = np.repeat([GYRO, FORCE], 3)
    bias = np.array([0.002, 0.0, -0.003, 0.05, -0.04, 0.02])
    values = np.array(readings) + bias + noise * rng.standard_normal((len(at), 6))
    values[:, 1] = np.nan
    return ImuReadings(at, values, np.tile(noise**2, (len(at), 1)), np.zeros(len(at)), GRAVITY)


def slipping(value, rate):
    """What would slip of wheels that do not turn: the body's speed, to the side further by the turn."""
    ahead, aside = rate[:, 0], rate[:, 1] + 0.1 * rate[:, 3]
    return np.stack([np.stack([ahead, aside], axis=1)] * 4, axis=1)


def smoothed(seed, with_imu=True, **settings):
    rng = np.random.default_rng(seed)
    samples = list(frames(rng))
    readings = imu(rng, **settings) if with_imu else None
    return smooth_motion(samples, np.array([s.time for s in samples]), ROWS, slipping, readings)


def rms(values):
    return np.sqrt(np.mean(np.square(values), axis=0))


def test_the_imu_makes_poses_and_rates_sharper_and_the_sigmas_hold():
    value, rate = truth(ROWS), rates(ROWS)
    alone, both = ([smoothed(seed, with_imu) for seed in range(4)] for with_imu in (False, True))
    for found in (alone, both):
        normalised = np.concatenate([(one.value - value) / one.value_std for one in found])
        assert np.all((rms(normalised) > 0.75) & (rms(normalised) < 1.3))
    gain = [rms(np.concatenate([m.rate - rate for m in found])) for found in (both, alone)]
    assert np.all((gain[0] / gain[1])[[0, 1, 3, 5]] < 0.75)
    assert np.all(rms(both[0].value_std)[[0, 1, 3, 5]] < 0.9 * rms(alone[0].value_std)[[0, 1, 3, 5]])


@pytest.mark.slow
@pytest.mark.parametrize("with_imu", [False, True])
def test_the_covariance_of_slip_is_that_of_its_errors(with_imu):
    """Slip is the change of x, and of y and yaw, since the first row; wheels that slip alike err alike."""
    errors, stds = [], []
    for seed in range(12):
        found = smoothed(seed, with_imu)
        off = found.value - truth(ROWS)
        moved = np.stack([off[:, 0], off[:, 1] + 0.1 * off[:, 3]], axis=1)
        errors.append(moved[[120, -1]] - moved[0])
        stds.append(np.sqrt(np.diagonal(found.slip_covariance, axis1=1, axis2=2)[[120, -1], :2]))
        assert found.slip_covariance[-1, 0, 2] == pytest.approx(found.slip_covariance[-1, 0, 0])
    spread = rms((np.array(errors) / stds).reshape(-1, 2))
    assert np.all((spread > 0.55) & (spread < 1.4))


def test_mounting_of_the_imu_and_missing_readings_do_not_matter():
    value = truth(ROWS)
    turned = smoothed(1, mount=(0.02, -0.03, 0.025))
    assert np.all(rms((turned.value - value) / turned.value_std) < 1.5)
    rng = np.random.default_rng(2)
    samples, readings = list(frames(rng)), imu(rng)
    readings.values[:, 3:] = np.nan
    readings.values[60:90] = np.nan
    readings.values[200] = 5.0  # a blow
    found = smooth_motion(samples, np.array([s.time for s in samples]), ROWS, slipping, readings)
    assert np.all(rms((found.value - value) / found.value_std) < 1.4)


def measured_with(drive, samples=None, **columns):
    """Slip with other columns of the log."""
    return measured(drive, samples, run=with_table(drive.run, drive.run.table.assign(**columns)))


@pytest.mark.slow
@pytest.mark.parametrize(("legs", "share"), [(True, 0.9), (False, 0.8)])
def test_slip_to_the_side_is_sharper_with_the_imu(drive, monkeypatch, legs, share):
    if not legs:
        monkeypatch.setattr(slip, "leg_findings", lambda *_: ["not used"])
    alone, both = measured_with(drive, **NONE), measured_with(drive)
    true = true_slip(drive, both.time)
    assert np.median(both.slip_std[:, :, 1]) < share * np.median(alone.slip_std[:, :, 1])
    assert np.median(both.slip_velocity_std[:, :, 1]) < 0.95 * np.median(alone.slip_velocity_std[:, :, 1])
    for found in (alone, both):
        assert np.abs(found.slip - true).max() < 1e-3
        assert np.sqrt(np.mean(np.square((found.slip - true)[-1] / found.slip_std[-1]))) < 2.0


def test_an_imu_that_the_film_contradicts_pulls_nothing(drive):
    """A gyroscope that loses counts for a second; and a film whose tilt jumps."""
    lost = np.where(np.abs(drive.run["t"] - 4.5) < 0.5, 0.0, drive.run["gyro_z"])
    assert np.array_equal(measured_with(drive, gyro_z=lost).pose, measured_with(drive, **NONE).pose)
    tilt = np.array([0, 0, 0, 0, 0.05, 0])
    jumped = [replace(s, pose=s.pose + tilt * (4 < s.time < 5)) for s in samples_of(drive)]
    assert np.array_equal(measured_with(drive, jumped).pose, measured_with(drive, jumped, **NONE).pose)
    assert not np.array_equal(measured_with(drive).pose, measured_with(drive, **NONE).pose)


WRONG = {
    "degrees per second": lambda run: {f"gyro_{axis}": np.rad2deg(run[f"gyro_{axis}"]) for axis in "xyz"},
    "inverted": lambda run: {f"gyro_{axis}": -run[f"gyro_{axis}"] for axis in "xyz"},
    "in g": lambda run: {f"acc_{axis}": run[f"acc_{axis}"] / 9.81 for axis in "xyz"},
    "silent": lambda run: {f"acc_{axis}": 0.0 for axis in "xyz"},
    "upside down": lambda run: {"acc_z": -run["acc_z"]},
    "x against the motion": lambda run: {"acc_x": -run["acc_x"]},
    "x and y swapped": lambda run: {"acc_x": run["acc_y"], "acc_y": run["acc_x"]},
}


@pytest.mark.slow
@pytest.mark.parametrize("wrong", WRONG)
def test_a_wrong_imu_changes_nothing_and_is_a_finding(drive, wrong):
    columns = WRONG[wrong](drive.run)
    run = with_table(drive.run, drive.run.table.assign(**columns))
    assert np.array_equal(measured_with(drive, **columns).pose, measured_with(drive, **NONE).pose)
    assert list(imu_findings(samples_of(drive), OFFSET, run, drive.robot))


def test_an_axis_of_the_accelerometer_that_is_wrong_is_named(drive):
    """With what the film shows instead and when: the start at 1 s; of a right one nothing is said."""

    def found(**columns):
        run = with_table(drive.run, drive.run.table.assign(**columns))
        return {(channel, shown): time for channel, shown, time in wrong_axes(samples_of(drive), OFFSET, run, drive.robot)}

    assert not found()
    assert found(acc_x=-drive.run["acc_x"]) == pytest.approx({("acc_x", "-acc_x"): 1.0}, abs=0.1)
    swapped = found(acc_x=drive.run["acc_y"], acc_y=-drive.run["acc_x"])
    assert swapped == pytest.approx({("acc_x", "-acc_y"): 1.0, ("acc_y", "acc_x"): 1.0}, abs=0.1)


def test_one_missing_reading_does_not_matter(drive):
    missing = drive.run["gyro_z"].copy()
    missing[100] = math.nan
    found, whole, alone = measured_with(drive, gyro_z=missing), measured_with(drive), measured_with(drive, **NONE)
    assert np.abs(found.pose - whole.pose).max() < 0.05 * np.abs(alone.pose - whole.pose).max()


@pytest.mark.slow
@pytest.mark.parametrize("with_imu", [False, True])
def test_sigmas_hold_in_gaps_of_the_film(drive, with_imu):
    """Of half a second to 4 s, at starts, turns and stops; with the gyroscope the yaw stays known to milliradians."""
    rng, normalised, stds, ends = np.random.default_rng(1), [], [], []
    for seed in range(6):
        width = rng.uniform(0.5, 4.0)
        start = rng.uniform(0.8, 8.0 - width)
        found = measured_with(drive, samples_of(drive, seed=seed, gap=((start, start + width),)), **({} if with_imu else NONE))
        gap = (found.time > start) & (found.time < start + width)
        true = [pose_at(drive, t) for t in found.time[gap]]
        true = np.unwrap(np.stack([np.concatenate([pose.position, angles(pose.rotation)]) for pose in true]), axis=0)
        normalised.append(rms((found.pose[gap] - true) / found.pose_std[gap]))
        stds.append(found.pose_std[gap, 3].max())
        ends.append((found.slip[-1] - true_slip(drive, found.time)[-1]) / found.slip_std[-1])
    assert np.all(rms(normalised) < 1.6)
    assert rms(np.ravel(normalised)) > 0.5
    assert rms(np.ravel(ends)) < 1.5
    if with_imu:
        assert max(stds) < 0.003


def test_the_sigma_of_slip_velocity_is_that_of_its_error():
    z = []
    for seed in range(6):
        found = smoothed(seed)
        error = (slipping(found.value, found.rate) - slipping(truth(ROWS), rates(ROWS))).reshape(-1, 8)
        z.append(error / np.sqrt(found.velocity_variance))
    assert 0.75 < rms(np.concatenate(z).ravel()) < 1.3
