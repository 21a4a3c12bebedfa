"""A log of another writer (JSON, mirrored, IMU on its side, y up, mm) comes in right by a proposed map and two lines more."""

import numpy as np
import pytest
from foreign_logs import made_up
from json_logs import EPOCH, IMU, UPTIME, name_of, sign_of, write_json_mcap

from wlr_gym.data import read_run
from wlr_gym.data.logs import import_log, suggest_map
from wlr_gym.robot import JOINTS, WHEELS


@pytest.fixture(scope="module")
def table():
    return made_up(16.0)


@pytest.fixture(scope="module")
def log(table, tmp_path_factory):
    return write_json_mcap(tmp_path_factory.mktemp("json") / "lab.mcap", table)


@pytest.fixture(scope="module")
def proposal(log):
    return suggest_map(log)


def test_units_axes_signs_and_clocks_are_found(proposal):
    found = proposal.map
    units = {
        "pos": "deg", "vel": "rpm", "eff": "mA", "cmd_leg": "deg", "cmd_wheel": "rpm", "gyro": "deg/s", "acc": "mg",
        "cam_x": "mm", "volt": "mV",
    }  # fmt: skip
    assert {key: found.channels[key].unit for key in units} == units
    assert found.frames["imu"] == IMU
    assert found.frames["cam"] == ("x", "-z", "y")
    assert {joint: found.joints[joint].sign for joint in WHEELS} == {joint: sign_of(joint) for joint in WHEELS}
    assert found.clocks["imu"].offset == pytest.approx(EPOCH - UPTIME + 0.002, abs=0.01)  # it is received 2 ms after joints
    assert found.clocks["optitrack"].offset == pytest.approx(0.08, abs=0.01)
    assert {reason.what for reason in proposal.reasons if reason.sure == "guess"} == {
        "meta.profile",
        *(f"joints.{joint}" for joint in JOINTS if joint not in WHEELS),
    }


def test_it_comes_in_right(log, table, tmp_path):
    mirrored = {leg: {"name": name_of(leg), "sign": -1} for leg in ("leg_rf", "leg_rr")}
    (imported,) = import_log(log, tmp_path / "runs", suggest_map(log, {"joints": mirrored}).map)
    run, start = read_run(imported.path), imported.origin * 1e-9 - EPOCH
    largest = {"gyro": 0.02, "acc": 0.15, "cam": 3e-3, "volt": 0.2}
    for column in (str(name) for name in run.table.columns if name != "t"):
        known, seen = np.isfinite(table[column]), np.isfinite(run[column])
        expected = np.interp(run["t"][seen] + start, table["t"][known], table[column][known])
        expected -= expected[0] if column.partition("_")[2] in WHEELS and column.startswith("pos_") else 0.0
        assert np.abs(run[column][seen] - expected).max() < largest.get(column.partition("_")[0], 1e-5), column
