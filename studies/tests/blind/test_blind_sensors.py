"""The blind tests' sensors against what their specification says."""

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest

from studies.bench.blind import drive
from studies.bench.blind.cases import hide
from studies.bench.blind.copies import JOINTS, nominal, read_robot
from studies.bench.blind.drive import WIDTH
from wlr_gym.base.paths import data_directory

ROBOT = read_robot(data_directory("configs") / "robot" / "nominal.yaml")


def moving(seconds: float = 20.0, yaw_rate: float = 0.2) -> np.ndarray:
    """Records of a robot on a straight line at 0.1 m/s along the floor's x, turning on the spot as it goes."""
    time = np.arange(int(seconds * 1000) + 1) / 1000
    records = np.zeros((len(time), WIDTH))
    records[:, 0], records[:, 2] = 0.3 + 0.1 * time, 0.17
    yaw = yaw_rate * time
    records[:, 3], records[:, 6] = np.cos(yaw / 2), np.sin(yaw / 2)
    records[:, 33], records[:, 36], records[:, 37] = yaw_rate, 9.81, 12.0
    records[:, 11:15] = 5.0 + 3.0 * time[:, None]
    records[:, 19:23] = 3.0
    return records


def log(records, effects=(), seed=0, **copy_numbers) -> pd.DataFrame:
    copy, rng = replace(nominal(ROBOT), **copy_numbers), np.random.default_rng(seed)
    times = drive.ticks((len(records) - 1) / 1000 - 0.1, 50.0, rng)
    setpoints = np.zeros((len(times), 8))
    return drive.log(records, times, setpoints, copy, hide(effects), ROBOT, rng)


def effect(name, **parameters):
    return {"name": name, "where": ["sensor"], "parameters": parameters}


def test_clock_jitters_by_a_millisecond_and_loses_one_tick_in_three_hundred():
    times = drive.ticks(2000.0, 50.0, np.random.default_rng(1))
    steps = np.diff(times)
    assert (steps > 0).all()
    assert np.std(steps[steps < 0.03]) == pytest.approx(np.sqrt(2) * 1e-3, rel=0.03)
    assert 1 - len(times) / 100_000 == pytest.approx(1 / 300, rel=0.2)


def test_noise_and_counts_are_those_of_the_robot_file():
    table = log(moving())
    t = table["t"]
    assert np.std(table["gyro_x"]) == pytest.approx(0.0009, rel=0.1)
    assert np.std(table["acc_y"]) == pytest.approx(0.03, rel=0.1)
    assert np.std(table["cam_x"] - 0.1 * t) == pytest.approx(0.001, rel=0.1)
    assert np.std(table["cam_yaw"] - 0.2 * t) == pytest.approx(0.005, rel=0.1)
    for joint, count in ((JOINTS[0], 0.010), (JOINTS[4], 0.005)):
        assert np.std(table[f"eff_{joint}"]) == pytest.approx(count, rel=0.1)
    position = table["pos_wheel_lf"] / 0.0015339807878856412
    assert np.abs(position - np.rint(position)).max() < 1e-6
    assert np.abs(table["pos_wheel_lf"] - 3.0 * t).max() <= 0.00077 + 1e-9, "zero at the start, then the rate"
    assert set(np.rint(10 * table["volt"])) <= {118, 119, 120, 121, 122}


def test_camera_delivers_thirty_frames_a_second_as_old_as_it_is():
    table = log(moving(), camera_age=0.008)
    assert np.mean(np.isfinite(table["cam_x"])) == pytest.approx(0.6, abs=0.01)
    frames = table.dropna()
    late = np.mean(0.1 * frames["t"] - frames["cam_x"]) / 0.1
    assert late == pytest.approx(0.008, abs=0.0015)
    older = log(moving(), [effect("camera_delay", delay=0.1)], camera_age=0.008).dropna()
    assert np.mean(0.2 * older["t"] - older["cam_yaw"]) / 0.2 == pytest.approx(0.108, abs=0.004)


def test_camera_misalignment_turns_positions_back_and_scales_them():
    plain, turned = log(moving()), log(moving(), [effect("camera_misalignment", yaw=0.1, scale=1.1)])
    last = turned.dropna().iloc[-1].to_dict()
    assert last["cam_x"] == pytest.approx(1.1 * np.cos(0.1) * 0.1 * last["t"], abs=0.006)
    assert last["cam_y"] == pytest.approx(-1.1 * np.sin(0.1) * 0.1 * last["t"], abs=0.006)
    assert turned["cam_yaw"].dropna().to_numpy() == pytest.approx(plain["cam_yaw"].dropna().to_numpy(), abs=1e-12)


def test_inertial_sensors_read_in_their_own_frame():
    pitched = log(moving(), [effect("imu_misalignment", pitch=0.1)]).mean().to_dict()
    assert pitched["acc_x"] == pytest.approx(-9.81 * np.sin(0.1), abs=0.01)
    assert pitched["gyro_x"] == pytest.approx(-0.2 * np.sin(0.1), abs=0.001)
    assert pitched["acc_z"] == pytest.approx(9.81 * np.cos(0.1), abs=0.01)
    biased = log(moving(), [effect("gyro_bias", x=0.02, z=-0.01)], gyro_bias=np.array([0.001, 0.0, 0.0])).mean().to_dict()
    assert biased["gyro_x"] == pytest.approx(0.021, abs=3e-4)
    assert biased["gyro_z"] == pytest.approx(0.19, abs=3e-4)


def test_leg_readings_have_their_zero():
    records = moving()
    records[:, 7:11] = 1.5
    table = log(records, [{"name": "joint_zero_offset", "where": ["leg_lr"], "parameters": {"angle": 0.05}}])
    assert float(np.mean(table["pos_leg_lr"])) == pytest.approx(1.55, abs=0.001)
    assert float(np.mean(table["pos_leg_lf"])) == pytest.approx(1.5, abs=0.001)


def test_effort_is_current_times_nominal_constant():
    records = moving()
    records[:, 23:31] = 0.1
    table = log(records, no_load_speed=np.full(8, 9.0))
    assert float(np.mean(table["eff_leg_lf"])) == pytest.approx(0.1 * 12 / 5.550, abs=0.002)
    assert float(np.mean(table["eff_wheel_rr"])) == pytest.approx(0.1 * 12 / 6.388, abs=0.002)
