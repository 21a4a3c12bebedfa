"""A log with other names, units, axes and clocks comes in right by a proposed map."""

import numpy as np
import pandas
import pytest
from foreign_logs import (
    NAMES,
    lab_frame,
    lab_messages,
    made_up,
    rows_of,
    write_lerobot,
    write_mcap,
    write_rosbag1,
    write_rosbag2,
)

from wlr_gym.data import read_dataset, read_run
from wlr_gym.data.logs import import_log, suggest_map
from wlr_gym.data.logs.map import GROUPS
from wlr_gym.robot import JOINTS


@pytest.fixture(scope="module")
def table():
    return made_up(24.0)


@pytest.fixture(scope="module")
def bag(table, tmp_path_factory):
    return write_rosbag2(tmp_path_factory.mktemp("bag") / "lab", lab_messages(table), "mcap")


@pytest.fixture(scope="module")
def proposal(bag):
    return suggest_map(bag)


def check_joints(run, rows, exact=1e-9):
    first = round(rows["t"].searchsorted(0.0))
    n = min(len(run["t"]), len(rows["t"]) - first)
    for joint in JOINTS:
        start = rows[f"pos_{joint}"][0] if joint.startswith("wheel") else 0.0
        np.testing.assert_allclose(run[f"pos_{joint}"][:n], rows[f"pos_{joint}"][:n] - start, atol=exact)
        np.testing.assert_allclose(run[f"cmd_{joint}"][:n], rows[f"cmd_{joint}"][:n], atol=exact)


def test_a_bag_comes_in_right_without_a_line_of_map(bag, table, tmp_path):
    (imported,) = import_log(bag, tmp_path / "runs")
    run, rows = read_run(imported.path), rows_of(table)
    cut = {name: values[round(run_start(imported, table) * 50) :] for name, values in rows.items()}
    n = min(len(run["t"]), len(cut["t"]))
    assert n > 0.98 * len(rows["t"])
    np.testing.assert_allclose(run["t"][:n], cut["t"][:n] - cut["t"][0], atol=1e-9)
    check_joints(run, cut)
    assert np.std(run["gyro_z"][:n] - cut["gyro_z"][:n]) < 0.012  # 0.4 rad/s, whose clock would be 37 ms off: 0.04
    seen = np.isfinite(run["cam_x"])
    assert 0.55 < seen.mean() < 0.65
    way = np.interp(
        run["t"][seen], table["t"][np.isfinite(table["cam_x"])] - cut["t"][0], table["cam_x"][np.isfinite(table["cam_x"])]
    )
    assert np.std(run["cam_x"][seen] - way) < 2e-3
    assert not [finding for finding in run.findings if finding.kind in ("gap", "missing", "rate")]


def run_start(imported, table):
    return imported.origin * 1e-9 - 1_760_000_000


def test_the_clock_of_the_imu_is_found(proposal):
    assert proposal.map.clocks["/xsens/data"].offset == pytest.approx(-0.037 + 1 / (2 * np.pi * 44.0), abs=0.006)
    assert "/mocap/base" not in proposal.map.clocks


def test_how_sure_it_is_is_said(proposal):
    said = {reason.what: reason for reason in proposal.reasons}
    assert said["pos_leg"].sure == "sure"
    assert "deg" in said["pos_leg"].why
    assert said["eff_leg"].sure == "likely"  # N m by magnitude only
    assert "ms" in said["clocks./xsens/data"].why


def test_units_of_the_map(proposal):
    units = {column: source.unit for key, source in proposal.map.channels.items() for column in GROUPS.get(key, (key,))}
    assert {units[f"pos_{joint}"] for joint in JOINTS} == {"deg"}
    assert {units[f"vel_{joint}"] for joint in JOINTS} == {"deg/s"}
    assert units["gyro_x"] == "deg/s"
    assert units["acc_x"] is None
    assert proposal.map.joints["leg_lr"].name == "RL_hip"


def test_a_turned_imu_is_found(table, tmp_path):
    """Its x is our left, its y is our back: ours are its -y, x, z."""
    bag = write_rosbag2(tmp_path / "turned", lab_messages(table, imu_axes=((1, 1), (0, -1), (2, 1))))
    assert suggest_map(bag).map.frames["imu"] == ("-y", "x", "z")
    (imported,) = import_log(bag, tmp_path / "runs")
    run = read_run(imported.path)
    speed_up = np.interp(run["t"], table["t"] - run_start(imported, table), table["acc_x"])
    assert np.corrcoef(run["acc_x"], speed_up)[0, 1] > 0.9


def test_mirrored_wheels_are_found(table, tmp_path):
    mirrored = dict(table)
    for wheel in ("wheel_rf", "wheel_rr"):
        for kind in ("pos", "vel", "cmd"):
            mirrored[f"{kind}_{wheel}"] = -table[f"{kind}_{wheel}"]
    bag = write_rosbag2(tmp_path / "mirrored", lab_messages(mirrored))
    (imported,) = import_log(bag, tmp_path / "runs")
    run = read_run(imported.path)
    assert np.corrcoef(run["vel_wheel_rf"], np.interp(run["t"], table["t"], table["vel_wheel_rf"]))[0, 1] > 0.99
    assert np.corrcoef(run["cmd_wheel_rr"], np.interp(run["t"], table["t"], table["cmd_wheel_rr"]))[0, 1] > 0.99


def test_a_line_of_map_wins(bag):
    found = suggest_map(bag, {"channels": {"eff": {"topic": "/chassis/joints", "field": "effort[{joint}]", "unit": "mA"}}})
    assert found.map.channels["eff"].unit == "mA"
    assert found.map.channels["pos"].unit == "deg"
    assert suggest_map(bag, {"clocks": {"/xsens/data": {"offset": -0.01}}}).map.clocks["/xsens/data"].offset == -0.01


def test_one_recording_in_every_format_is_one_run(table, tmp_path):
    messages = lab_messages(made_up(8.0))
    found = {}
    for name, write in (("a.mcap", write_mcap), ("b", write_rosbag2), ("c.bag", write_rosbag1)):
        log = write(tmp_path / name, messages if name != "c.bag" else lab_messages(made_up(8.0)))
        found[name] = import_log(log, tmp_path / f"runs_{name[0]}")[0]
    first = read_run(found["a.mcap"].path)
    for other in found.values():
        run = read_run(other.path)
        assert all(np.array_equal(run[name], first[name], equal_nan=True) for name in first.table.columns)


def test_a_table_of_a_logger(table, tmp_path):
    lab_frame(table).to_csv(tmp_path / "log.csv", index=False)
    (imported,) = import_log(tmp_path / "log.csv", tmp_path / "runs")
    run, rows = read_run(imported.path), rows_of(table)
    check_joints(run, rows, 1e-6)
    np.testing.assert_allclose(run["acc_z"], rows["acc_z"], rtol=1e-3)
    np.testing.assert_allclose(run["volt"], rows["volt"], atol=1e-9)
    assert any("comment" in note for note in imported.notes)
    lab_frame(table).drop(columns="comment").to_parquet(tmp_path / "log.parquet")
    (again,) = import_log(tmp_path / "log.parquet", tmp_path / "more")
    assert np.array_equal(read_run(again.path)["t"], run["t"])


def test_episodes_of_lerobot(table, tmp_path):
    folder = write_lerobot(tmp_path / "set", table)
    imported = import_log(folder, tmp_path / "runs")
    runs = read_dataset(tmp_path / "runs").runs
    assert len(runs) == len(imported) == 2
    rows = rows_of(table)
    np.testing.assert_allclose(runs[0]["pos_leg_lf"], rows["pos_leg_lf"][: len(runs[0]["t"])], atol=1e-6)
    np.testing.assert_allclose(
        runs[1]["cmd_wheel_rf"], rows["cmd_wheel_rf"][len(runs[0]["t"]) :][: len(runs[1]["t"])], atol=1e-5
    )
    assert any("observation.images.top" in note for note in imported[0].notes)


def test_every_sample_is_kept_at_its_own_time(bag, tmp_path):
    import pandas

    (imported,) = import_log(bag, tmp_path / "runs")
    samples = pandas.read_parquet(imported.path.with_name("run_01.samples.parquet"))
    gyro = samples[samples["channel"] == "gyro_z"]
    assert len(gyro) == 4800
    assert np.median(np.diff(gyro["t"])) == pytest.approx(0.005, abs=1e-6)
    assert [run.name for run in read_dataset(tmp_path / "runs").runs] == ["run_01"]


def test_a_long_recording_becomes_several_runs(bag, tmp_path):
    imported = import_log(bag, tmp_path / "runs", split=8.0)
    runs = read_dataset(tmp_path / "runs").runs
    assert len(imported) == len(runs) == 3
    assert all(run["t"][0] == 0.0 and run["pos_wheel_lf"][0] == 0.0 for run in runs)
    ends = [one.origin * 1e-9 + run["t"][-1] for one, run in zip(imported, runs, strict=True)]
    assert all(later.origin * 1e-9 > end for later, end in zip(imported[1:], ends, strict=False))


def test_names_that_are_servo_numbers(table, tmp_path):
    from wlr_gym.robot import load_robot

    names = {joint: f"dxl_{number}" for joint, number in load_robot().dynamixel_ids.items()}
    bag = write_rosbag2(tmp_path / "ids", lab_messages(made_up(6.0), names=names))
    assert suggest_map(bag).map.joints["wheel_rr"].name == "dxl_8"


def test_unknown_names_need_a_line_each(tmp_path):
    names = {joint: f"part{chr(97 + k)}" for k, joint in enumerate(JOINTS)}
    bag = write_rosbag2(tmp_path / "odd", lab_messages(made_up(6.0), names=names))
    assert "pos" not in suggest_map(bag).map.channels
    given = {"joints": names}
    found = suggest_map(bag, given).map
    assert found.channels["pos"].unit == "deg"
    assert found.joints["leg_rf"].name == "partb"
    assert set(NAMES) == set(found.joints)


def test_a_name_unlike_those_beside_it_is_a_guess(table, tmp_path):
    frame = pandas.DataFrame(rows_of(table)).rename(columns={"pos_leg_lf": "pos_leg_fl"})
    frame.to_csv(tmp_path / "log.csv", index=False)
    guessed = {one.what: one.sure for one in suggest_map(tmp_path / "log.csv").reasons if "is taken for it" in one.why}
    assert guessed == {"pos_leg_lf": "guess"}
