"""A proposed map has what names and types decide, and asks the rest with what the log shows; answered, logs come in right."""

import copy
import re

import numpy as np
import pandas
import pytest
import yaml
from foreign_logs import (
    EPOCH,
    NAMES,
    lab_frame,
    lab_map,
    lab_messages,
    made_up,
    rows_of,
    write_lerobot,
    write_mcap,
    write_rosbag1,
    write_rosbag2,
)
from json_logs import EPOCH as JSON_EPOCH
from json_logs import IMU, UPTIME, name_of, sign_of, write_json_mcap

from wlr_gym.base.errors import InputError
from wlr_gym.data import read_dataset, read_run
from wlr_gym.data.logs import import_log, suggest_map
from wlr_gym.data.logs.map import OPEN
from wlr_gym.data.logs.suggest import stated_unit
from wlr_gym.robot import JOINTS, LEGS, WHEELS, load_robot

NO_PROFILE = {"meta": {"profile": {}}}


@pytest.fixture(scope="module")
def table():
    return made_up(24.0)


@pytest.fixture(scope="module")
def bag(table, tmp_path_factory):
    return write_rosbag2(tmp_path_factory.mktemp("bag") / "lab", lab_messages(table), "mcap")


@pytest.fixture(scope="module")
def proposal(bag):
    return suggest_map(bag)


def said(proposal, place):
    (line,) = [line for line in proposal.lines if line.place == place]
    return line.why


def start_of(imported, epoch: float = EPOCH):
    return imported.origin * 1e-9 - epoch


def check_right(run, table, start, largest, exact=1e-5):
    """Compare a run with the table that it was made of, channel by channel; ``start`` is where its t is 0."""
    for column in (str(name) for name in run.table.columns if name != "t"):
        known, seen = np.isfinite(table[column]), np.isfinite(run[column])
        expected = np.interp(run["t"][seen] + start, table["t"][known], table[column][known])
        expected -= expected[0] if column.partition("_")[2] in WHEELS and column.startswith("pos_") else 0.0
        assert np.abs(run[column][seen] - expected).max() < largest.get(column.partition("_")[0], exact), column


# ---- what is decided, and what is asked ------------------------------------------------------------------------------


def test_what_names_do_not_decide_is_asked(proposal):
    """Standard messages define units, but loggers write others: no message's type decides one."""
    kinds = [f"{kind}_{part}" for kind in ("cmd", "pos", "vel", "eff") for part in ("leg", "wheel")]
    assert set(proposal.open) == {
        *(f"joints.{joint}.sign" for joint in JOINTS), *(f"joints.{leg}.zero" for leg in LEGS),
        *(f"channels.{kind}.unit" for kind in (*kinds, "gyro", "acc", "cam", "volt")),
        "frames.imu", "frames.cam", "clocks./xsens/data", "meta.profile",
    }  # fmt: skip
    assert proposal.content["joints"]["leg_lr"]["name"] == "RL_hip"
    assert proposal.content["channels"]["cam"] == {"topic": "/mocap/base", "field": "pose.position.{axis}", "unit": OPEN}
    assert "(geometry_msgs/msg/PoseStamped), 'pose.position.{axis}'; x -0.008002 to" in said(proposal, "channels.cam")


def test_each_question_says_what_the_log_shows(proposal):
    shown = {
        "joints.leg_rf": ["pos 72.", "(89.43 at the start); cmd 72.", "; correlation with its command 1.00"],
        "channels.pos_leg": ["rad, deg, turn, count?", "'position[{joint}]'", "leg_lf 72."],
        "channels.vel_wheel": ["rpm"],
        "channels.eff_wheel": ["mA", "the motor stalls at 1.5 N m"],
        "frames.imu": ["9.81 in the median (up is", "gyro varies by 0.05"],
        "clocks./xsens/data": [
            "messages arrive -35.0 ms after their header's time, the joints' 1.",
            "adds S (-0.036 would",
        ],
        "meta.profile": ["{} = none"],
        "rows": ["50 messages a second; each makes a row"],
    }
    for place, parts in shown.items():
        assert all(part in said(proposal, place) for part in parts), (place, said(proposal, place))
    text = proposal.text
    assert yaml.safe_load(text) == proposal.content
    assert re.search(r"# sign: of a leg 1 where .*\n(#.*\n)+joints:\n(  #.*\n)+  leg_lf: {name: FL_hip, sign: open", text)


def test_every_message_or_every_fourth_makes_a_row(table, tmp_path):
    """Of joints at 200 Hz, by their times in seconds."""
    quick = {"t": table["t"][:800]} | {name: table[name][:800] for name in table if name[:3] in ("pos", "cmd")}
    pandas.DataFrame(quick).to_csv(tmp_path / "a.csv", index=False)
    found = suggest_map(tmp_path / "a.csv", NO_PROFILE)
    assert said(found, "rows") == "topic 'table', 200 messages a second; every 4th makes a row"
    assert found.map.every == 4


def test_names_state_units_and_what_joints_differ_in_is_their_name(table, tmp_path):
    lab_frame(table).to_csv(tmp_path / "log.csv", index=False)
    found = suggest_map(tmp_path / "log.csv")
    fields = {key: (one["field"], one.get("unit")) for key, one in found.content["channels"].items()}
    assert fields == {
        "cmd_leg": ("{joint}_hip_goal_deg", "deg"), "cmd_wheel": ("{joint}_wheel_goal_rpm", "rpm"),
        "pos_leg": ("{joint}_hip_pos_deg", "deg"), "pos_wheel": ("{joint}_wheel_pos_deg", "deg"),
        "vel_leg": ("{joint}_hip_speed_rpm", "rpm"), "vel_wheel": ("{joint}_wheel_speed_rpm", "rpm"),
        "gyro": ("g{axis}", OPEN), "acc": ("a{axis}", OPEN), "volt": ("vbat_mv", "mV"),
    }  # fmt: skip
    assert {joint: one["name"] for joint, one in found.content["joints"].items()} == {
        joint: NAMES[joint][:2].lower() for joint in JOINTS
    }


@pytest.mark.parametrize(
    ("name", "column", "unit"),
    [
        ("Bein VL Winkel [°]", "pos_leg_lf", "deg"), ("Rad VL Drehzahl [1/min]", "vel_wheel_lf", "rpm"),
        ("Rad VL Winkel", "pos_wheel_lf", None), ("gyro_x_deg_s", "gyro_x", "deg/s"), ("gz (°/s)", "gyro_z", "deg/s"),
        ("current_mA", "eff_leg_lf", "mA"), ("acc_x_m_s2", "acc_x", "m/s2"), ("angleDeg", "pos_leg_lf", "deg"),
        ("speed_deg", "vel_leg_lf", None), ("deg_of_leg", "pos_leg_lf", None),
    ],
)  # fmt: skip
def test_a_unit_is_stated_by_the_end_of_a_name(name, column, unit):
    assert stated_unit(name, column) == unit


def test_columns_with_our_names_are_our_channels_as_they_are(table, tmp_path):
    """Also where legs stand as they seldom do: nothing is mirrored, turned or scaled by how it looks."""
    rows = pandas.DataFrame({name: values for name, values in rows_of(table).items() if not name.startswith("cam")})
    rows[[f"{kind}_{leg}" for kind in ("pos", "cmd") for leg in ("leg_lf", "leg_lr")]] += 1.5
    rows.to_csv(tmp_path / "log.csv", index=False)
    assert suggest_map(tmp_path / "log.csv").open == ["meta.profile"]
    found = suggest_map(tmp_path / "log.csv", NO_PROFILE)
    (imported,) = import_log(tmp_path / "log.csv", tmp_path / "runs", found.map)
    run = read_run(imported.path)
    for name in rows.columns:
        start = rows[name][0] if name.startswith("pos_wheel") else 0.0
        np.testing.assert_allclose(run[name], rows[name] - start, atol=1e-9, err_msg=name)


def test_a_name_unlike_those_beside_it_is_asked(table, tmp_path):
    pandas.DataFrame(rows_of(table)).rename(columns={"pos_leg_lf": "pos_leg_fl"}).to_csv(tmp_path / "log.csv", index=False)
    asked = set(suggest_map(tmp_path / "log.csv", NO_PROFILE).open)
    assert asked == {"joints.leg_lf.sign", "joints.leg_lf.zero", "channels.pos_leg_lf.unit"}


def test_names_that_are_servo_numbers(tmp_path):
    names = {joint: f"dxl_{number}" for joint, number in load_robot().dynamixel_ids.items()}
    bag = write_rosbag2(tmp_path / "ids", lab_messages(made_up(6.0), names=names))
    assert suggest_map(bag).content["joints"]["wheel_rr"]["name"] == "dxl_8"


def test_unknown_names_need_a_line_each(tmp_path):
    names = {joint: f"part{chr(97 + k)}" for k, joint in enumerate(JOINTS)}
    bag = write_rosbag2(tmp_path / "odd", lab_messages(made_up(6.0), names=names))
    assert suggest_map(bag).content["channels"]["pos_leg"] == {"topic": OPEN, "field": OPEN}
    found = lab_map(bag, {"joints": names})
    assert {joint: one.name for joint, one in found.joints.items()} == names
    assert found.channels["pos_leg"].unit == "deg"


# ---- answers ---------------------------------------------------------------------------------------------------------


def test_a_run_is_made_from_a_complete_map_only(bag, proposal, tmp_path):
    with pytest.raises(InputError, match=r"lab: needs a map: its names leave open joints.leg_lf.sign, .*--suggest writes the"):
        import_log(bag, tmp_path / "runs")
    with pytest.raises(InputError, match=r"^map: still open: joints.leg_lf.sign, .*; decide them"):
        import_log(bag, tmp_path / "runs", proposal.content)
    (tmp_path / "map.yaml").write_text(proposal.text)
    with pytest.raises(InputError, match=r"map.yaml: still open: joints.leg_lf.sign"):
        import_log(bag, tmp_path / "runs", tmp_path / "map.yaml")
    assert not (tmp_path / "runs").exists()


def test_answers_stay_and_what_is_open_is_asked_again(bag, proposal):
    answered = copy.deepcopy(proposal.content)
    answered["channels"]["eff_leg"]["unit"] = "mA"
    answered["joints"]["leg_lf"] = {"name": "FL_hip", "sign": -1, "zero": OPEN}
    answered["clocks"]["/xsens/data"] = {"offset": -0.01}
    answered["frames"]["imu"] = ["-y", "x", "z"]
    found = suggest_map(bag, answered)
    gone = {"channels.eff_leg.unit", "joints.leg_lf.sign", "clocks./xsens/data", "frames.imu"}
    assert set(proposal.open) - set(found.open) == gone
    assert found.content["joints"]["leg_lf"] == {"name": "FL_hip", "sign": -1, "zero": OPEN}
    assert found.content["channels"]["eff_leg"]["unit"] == "mA"
    one = {"channels": {"eff": {"topic": "/chassis/joints", "field": "effort[{joint}]", "unit": "mA"}}}
    assert not [place for place in suggest_map(bag, one).open if "eff" in place]


def test_a_bag_with_answers_comes_in_right(bag, table, tmp_path):
    (imported,) = import_log(bag, tmp_path / "runs", lab_map(bag))
    run = read_run(imported.path)
    assert len(run["t"]) > 0.98 * len(rows_of(table)["t"])
    assert 0.55 < np.isfinite(run["cam_x"]).mean() < 0.65
    check_right(run, table, start_of(imported), {"gyro": 0.02, "acc": 0.2, "cam": 5e-3, "volt": 0.2}, 1e-6)
    assert not [finding for finding in run.findings if finding.kind in ("gap", "missing", "rate")]


def test_a_log_of_other_words_units_axes_and_clocks_with_answers_comes_in_right(tmp_path):
    """JSON, the right side mirrored, legs 0 where they hang, IMU on its side and on its own clock, y up, mm."""
    table = made_up(16.0)
    log = write_json_mcap(tmp_path / "lab.mcap", table)
    zero = {"leg": {"zero": -np.pi / 2}, "wheel": {}}
    answers = {
        "joints": {
            joint: {"name": name_of(joint), "sign": (sign := int(sign_of(joint)))}
            | {key: sign * value for key, value in zero[joint.partition("_")[0]].items()}
            for joint in JOINTS
        },
        "frames": {"imu": list(IMU), "cam": ["x", "-z", "y"]},
        "clocks": {"imu": {"offset": JSON_EPOCH - UPTIME}, "optitrack": {"offset": 0.08}},
        **NO_PROFILE,
    }
    assert {"frames.cam", "frames.imu", "clocks.imu", "clocks.optitrack", "joints.leg_rf.zero"} <= set(suggest_map(log).open)
    found = suggest_map(log, answers)
    assert found.open == ["channels.gyro.unit", "channels.acc.unit", "channels.cam.unit"]
    channels = copy.deepcopy(found.content["channels"])
    for key, unit in (("gyro", "deg/s"), ("acc", "mg"), ("cam", "mm")):
        channels[key]["unit"] = unit
    (imported,) = import_log(log, tmp_path / "runs", found.content | {"channels": channels})
    largest = {"gyro": 0.02, "acc": 0.15, "cam": 3e-3, "volt": 0.2}
    check_right(read_run(imported.path), table, start_of(imported, JSON_EPOCH), largest)


def test_axes_and_signs_of_the_map_are_taken(table, tmp_path):
    """An IMU whose x is our left and whose y is our back, and wheels of the right side that count backwards."""
    mirrored = dict(table)
    for wheel in ("wheel_rf", "wheel_rr"):
        mirrored |= {f"{kind}_{wheel}": -table[f"{kind}_{wheel}"] for kind in ("pos", "vel", "cmd", "eff")}
    bag = write_rosbag2(tmp_path / "turned", lab_messages(mirrored, imu_axes=((1, 1), (0, -1), (2, 1))))
    wheels = {wheel: {"name": NAMES[wheel], "sign": -1} for wheel in ("wheel_rf", "wheel_rr")}
    (imported,) = import_log(bag, tmp_path / "runs", lab_map(bag, {"joints": wheels, "frames": {"imu": ["-y", "x", "z"]}}))
    largest = {"gyro": 0.02, "acc": 0.2, "cam": 5e-3, "volt": 0.2}
    check_right(read_run(imported.path), table, start_of(imported), largest, 1e-6)


# ---- kinds of logs ---------------------------------------------------------------------------------------------------


def test_one_recording_in_every_format_is_one_run(tmp_path):
    messages = lab_messages(made_up(8.0))
    found = {}
    for name, write in (("a.mcap", write_mcap), ("b", write_rosbag2), ("c.bag", write_rosbag1)):
        log = write(tmp_path / name, messages if name != "c.bag" else lab_messages(made_up(8.0)))
        found[name] = import_log(log, tmp_path / f"runs_{name[0]}", lab_map(log))[0]
    first = read_run(found["a.mcap"].path)
    for other in found.values():
        run = read_run(other.path)
        assert all(np.array_equal(run[name], first[name], equal_nan=True) for name in first.table.columns)


def test_a_table_of_a_logger(table, tmp_path):
    lab_frame(table).to_csv(tmp_path / "log.csv", index=False)
    (imported,) = import_log(tmp_path / "log.csv", tmp_path / "runs", lab_map(tmp_path / "log.csv"))
    run = read_run(imported.path)
    check_right(run, rows_of(table), 0.0, {}, 1e-6)
    assert any("comment" in note for note in imported.notes)
    lab_frame(table).drop(columns="comment").to_parquet(tmp_path / "log.parquet")
    (again,) = import_log(tmp_path / "log.parquet", tmp_path / "more", lab_map(tmp_path / "log.parquet"))
    assert np.array_equal(read_run(again.path)["t"], run["t"])


def test_episodes_of_lerobot(table, tmp_path):
    folder = write_lerobot(tmp_path / "set", table)
    imported = import_log(folder, tmp_path / "runs", lab_map(folder))
    runs = read_dataset(tmp_path / "runs").runs
    assert len(runs) == len(imported) == 2
    rows = rows_of(table)
    np.testing.assert_allclose(runs[0]["pos_leg_lf"], rows["pos_leg_lf"][: len(runs[0]["t"])], atol=1e-6)
    np.testing.assert_allclose(
        runs[1]["cmd_wheel_rf"], rows["cmd_wheel_rf"][len(runs[0]["t"]) :][: len(runs[1]["t"])], atol=1e-5
    )
    assert any("observation.images.top" in note for note in imported[0].notes)


def test_a_long_recording_becomes_several_runs(bag, tmp_path):
    imported = import_log(bag, tmp_path / "runs", lab_map(bag), split=8.0)
    runs = read_dataset(tmp_path / "runs").runs
    assert len(imported) == len(runs) == 3
    assert all(run["t"][0] == 0.0 and run["pos_wheel_lf"][0] == 0.0 for run in runs)
    ends = [one.origin * 1e-9 + run["t"][-1] for one, run in zip(imported, runs, strict=True)]
    assert all(later.origin * 1e-9 > end for later, end in zip(imported[1:], ends, strict=False))
