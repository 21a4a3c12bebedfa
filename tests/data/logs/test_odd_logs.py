"""Logs with lost frames, repeated times and holes: what is odd is left out and said, the rest comes in right."""

import copy

import numpy as np
import pandas
import pytest
from foreign_logs import NAMES, joint_state, lab_frame, lab_map, lab_messages, made_up, rows_of, write_lerobot, write_mcap

from wlr_gym.base.errors import InputError
from wlr_gym.data import read_run, write_run
from wlr_gym.data.logs import export_run, import_log, read_logs, suggest_map
from wlr_gym.data.logs.messages import make
from wlr_gym.robot import JOINTS, LEGS, WHEELS


@pytest.fixture(scope="module")
def table():
    return made_up(12.0)


@pytest.fixture(scope="module")
def messages(table):
    return lab_messages(table)


def of_topic(messages, topic):
    return [one for one in messages if one[1] == topic]


def since_start(messages, one):
    return (one[0] - messages[0][0]) * 1e-9


@pytest.mark.parametrize("lost", [np.nan, 0.0])
def test_a_frame_without_a_rotation_is_lost(messages, table, tmp_path, lost):
    changed = copy.deepcopy(messages)
    for _, _, _, message in of_topic(changed, "/mocap/base")[100:102]:
        message.pose.position = make("geometry_msgs/msg/Point", x=lost, y=lost, z=lost)
        message.pose.orientation = make("geometry_msgs/msg/Quaternion", **dict.fromkeys("xyzw", lost))
    log = write_mcap(tmp_path / "a.mcap", changed)
    (imported,) = import_log(log, tmp_path / "runs", lab_map(log))
    assert "topic '/mocap/base': 2 lost frames are left out" in imported.notes
    run, seen = read_run(imported.path), np.isfinite(table["cam_yaw"])
    known = np.isfinite(run["cam_yaw"])
    start = imported.origin * 1e-9 - 1_760_000_000
    for column in ("cam_x", "cam_yaw"):
        right = np.interp(run["t"][known] + start, table["t"][seen], table[column][seen])
        assert np.abs(run[column][known] - right).max() < 0.03


def test_times_that_repeat_are_said(messages, tmp_path):
    changed, stamp = copy.deepcopy(messages), None
    for k, (_, _, _, message) in enumerate(of_topic(changed, "/chassis/joints")):
        stamp = message.header.stamp if k % 2 == 0 else stamp
        message.header.stamp = stamp
    log = write_mcap(tmp_path / "a.mcap", changed)
    assert lab_map(log).clocks["/chassis/joints"].use == "log"
    (whole,) = import_log(log, tmp_path / "whole", lab_map(log))
    assert len(read_run(whole.path)["t"]) > 590
    (imported,) = import_log(log, tmp_path / "runs", lab_map(write_mcap(tmp_path / "b.mcap", messages)))
    note = "topic '/chassis/joints': 300 of 600 messages repeat a time and are left out: in the map, clocks: {/chassis/joints"
    assert any(one.startswith(note) for one in imported.notes)


@pytest.fixture(scope="module")
def known(messages, tmp_path_factory):
    return lab_map(write_mcap(tmp_path_factory.mktemp("whole") / "a.mcap", messages))


def test_an_import_that_fails_leaves_nothing(table, tmp_path):
    folder = write_lerobot(tmp_path / "set", made_up(8.0))
    file = folder / "data" / "chunk-000" / "file-000.parquet"
    frame = pandas.read_parquet(file)
    whole = lab_map(folder)
    frame[frame["index"] <= frame["index"].max() // 2 + 1].to_parquet(file)  # of the second episode one row is left
    with pytest.raises(InputError):
        import_log(folder, tmp_path / "runs", whole)
    assert not (tmp_path / "runs").exists()


def test_a_recording_with_a_hole_is_cut_there(messages, known, tmp_path):
    log = write_mcap(tmp_path / "a.mcap", [one for one in messages if not 4.0 < since_start(messages, one) < 9.0])
    imported = import_log(log, tmp_path / "runs", known, split=2.0)
    runs = [read_run(one.path) for one in imported]
    assert sum(len(run["t"]) for run in runs) > 340
    assert all(np.diff(run["t"]).max() < 0.1 for run in runs)
    assert [round(run["t"][-1]) for run in runs] == [2, 2, 3]


def test_setpoints_that_end_early_are_held_and_said(messages, known, tmp_path):
    """As of robots that are sent a setpoint only when it changes."""
    log = write_mcap(
        tmp_path / "a.mcap", [one for one in messages if one[1] != "/chassis/target" or since_start(messages, one) < 5.0]
    )
    (imported,) = import_log(log, tmp_path / "runs", known)
    run = read_run(imported.path)
    assert len(run["t"]) > 590
    late = run["t"] > 5.1
    assert (run["cmd_wheel_lf"][late] == run["cmd_wheel_lf"][-1]).all()
    (note,) = [one for one in imported.notes if "silent" in one]
    assert note.startswith("topic '/chassis/target': silent for up to 7.0 s: its last message is held over 34")


def split_joints(messages):
    """Return the log with legs and wheels in topics of their own, wheels 3 ms later and silent from 4.0 to 4.6 s."""
    wheels = [name for joint, name in NAMES.items() if joint in WHEELS]
    for time, topic, kind, message in messages:
        if topic != "/chassis/joints":
            yield time, topic, kind, message
            continue
        stamp = message.header.stamp.sec * 10**9 + message.header.stamp.nanosec
        for name, joints, late in (("/legs", set(NAMES.values()) - set(wheels), 0), ("/wheels", wheels, 3_000_000)):
            places = [message.name.index(one) for one in joints]
            values = (message.position[places], message.velocity[places], message.effort[places])
            if name == "/legs" or not 4.0 < (time - messages[0][0]) * 1e-9 < 4.6:
                yield time + late, name, kind, joint_state(stamp + late, joints, *values)


def test_rows_in_a_hole_of_another_topic_are_left_out(messages, tmp_path):
    log = write_mcap(tmp_path / "a.mcap", sorted(split_joints(messages), key=lambda one: one[0]))
    (imported,) = import_log(log, tmp_path / "runs", lab_map(log))
    run = read_run(imported.path)
    assert len(run["t"]) == pytest.approx(600 - 35, abs=4)
    assert np.diff(run["t"]).max() == pytest.approx(0.6, abs=0.05)
    (note,) = [one for one in imported.notes if "hole" in one]
    assert "'pos_wheel_lf' (topic '/wheels') has a hole there" in note
    assert "(0.6 s) are left out" in note


def test_a_channel_that_begins_late_is_named(messages, known, tmp_path):
    log = write_mcap(
        tmp_path / "a.mcap", [one for one in messages if one[1] != "/chassis/target" or since_start(messages, one) > 2.0]
    )
    (imported,) = import_log(log, tmp_path / "runs", known)
    (note,) = [one for one in imported.notes if "at the beginning" in one]
    assert "rows (2.0 s) at the beginning are left out: 'cmd_leg_lf' (topic '/chassis/target') is not known there" in note


def table_of(tmp_path, times, name="timestamp"):
    frame = lab_frame(made_up(3.0)).drop(columns="comment").rename(columns={"time_ms": name})
    frame[name] = times(frame[name])
    frame.to_csv(tmp_path / "a.csv", index=False)
    return tmp_path / "a.csv"


@pytest.mark.parametrize(
    ("unit", "since"),
    [(1e-3, 0), (1, 0), (1e3, 0), (1e6, 0), (1e6, 1_760_000_000 * 10**9)],
    ids=["s", "ms", "us", "ns", "epoch"],
)
def test_the_unit_of_times_shows_by_their_size(tmp_path, unit, since):
    whole = np.int64 if unit > 1 else np.float64
    (log,) = read_logs(table_of(tmp_path, lambda ms: (ms * unit).round(3).astype(whole) + since))
    assert np.median(np.diff(log.topics["table"].received)) == pytest.approx(2e7)


@pytest.mark.parametrize(
    ("name", "message"), [("time", "in no unit of time"), ("time_ms", "read as ms"), ("time_s", "read as s")]
)
def test_times_of_no_unit_are_refused(tmp_path, name, message):
    log = table_of(tmp_path, lambda ms: ms * 1e9, name)
    with pytest.raises(InputError, match=rf"column '{name}': rows are 2e\+10 apart, {message}"):
        list(read_logs(log))


@pytest.mark.parametrize("seconds", [0.004, 0.05, 0.9])
def test_a_log_that_is_too_short_to_show_much_is_asked_about_all_the_same(messages, tmp_path, seconds):
    log = write_mcap(tmp_path / "a.mcap", [one for one in messages if since_start(messages, one) < seconds])
    assert {"joints.leg_lf.sign", "channels.pos_leg.unit", "channels.gyro.unit", "meta.profile"} <= set(suggest_map(log).open)


@pytest.mark.parametrize(("separator", "decimal"), [(";", ","), (";", "."), ("\t", "."), ("\t", ",")])
def test_tables_of_spreadsheets_are_read_as_those_with_commas(tmp_path, separator, decimal):
    frame = lab_frame(made_up(2.0))
    for name, options in (("plain", {}), ("other", {"sep": separator, "decimal": decimal})):
        frame.to_csv(tmp_path / f"{name}.csv", index=False, **options)
    (plain,), (other,) = (read_logs(tmp_path / f"{name}.csv") for name in ("plain", "other"))
    assert set(plain.topics["table"].fields) == set(other.topics["table"].fields)
    for name, (_, values) in plain.topics["table"].fields.items():
        assert np.array_equal(values, other.topics["table"].fields[name][1])


# ---- motors that were off, and wheel angles that start anew after a turn -------------------------------------------------


TABLE = {kind: {"topic": "table", "field": f"{kind}_{{joint}}"} for kind in ("cmd", "pos")}
BAG = {
    "cmd_leg": {"topic": "/joint_commands", "field": "position[{joint}]"},
    "cmd_wheel": {"topic": "/joint_commands", "field": "velocity[{joint}]"},
    "pos": {"topic": "/joint_states", "field": "position[{joint}]"},
}


def imported(log, channels, out):
    (one,) = import_log(log, out, {"channels": channels, "joints": {joint: joint for joint in JOINTS}})
    return read_run(one.path), one.notes


@pytest.mark.parametrize("off", [slice(100, 149), slice(None)], ids=["a while", "throughout"])
def test_motors_that_are_off_are_so_in_every_kind_of_log(tmp_path, off):
    table = pandas.DataFrame(rows_of(made_up(6.0)))
    table.loc[off, [f"cmd_{joint}" for joint in JOINTS]] = np.nan
    table.to_csv(tmp_path / "a.csv", index=False)
    table.to_parquet(tmp_path / "a.parquet")
    run = read_run(write_run(tmp_path / "own" / "run_01.csv", table))
    logs = {"a.csv": TABLE, "a.parquet": TABLE, export_run(run, tmp_path / "a.mcap").name: BAG}
    for name, channels in logs.items():
        found, notes = imported(tmp_path / name, channels, tmp_path / f"runs_{name}")
        assert np.array_equal(np.isnan(found["cmd_wheel_lf"]), np.isnan(table["cmd_wheel_lf"])), name
        count = table["cmd_wheel_lf"].isna().sum()
        assert f"{count} rows have no setpoint, 'cmd_leg_lf' among them: torque off" in notes
        assert not [note for note in notes if "silent" in note]


@pytest.mark.parametrize("alone", [False, True])
def test_setpoints_of_another_rate_hold(tmp_path, alone):
    """Between them cells are empty, be it in rows of their own or in rows with angles."""
    table = pandas.DataFrame(rows_of(made_up(6.0)))
    commands = [f"cmd_{joint}" for joint in JOINTS]
    sparse = table.assign(**{name: table[name].where(table.index % 5 == 0) for name in commands})
    if alone:
        late = table.loc[::5, ["t", *commands]]
        late["t"] += 0.003
        sparse = pandas.concat([table.drop(columns=commands), late]).sort_values("t")
    sparse.to_csv(tmp_path / "a.csv", index=False)
    found, _ = imported(tmp_path / "a.csv", TABLE, tmp_path / "runs")
    assert np.isfinite(found["cmd_wheel_lf"]).all()


def turning(path, every, rate):
    """Write a table of wheels that turn at one rate, their angles within a turn."""
    t = np.round(np.arange(0.0, 30.0, every), 3)
    columns = {"t": t}
    columns |= {f"{kind}_{leg}": np.full(len(t), 1.57) for leg in LEGS for kind in ("cmd", "pos")}
    columns |= {f"cmd_{wheel}": np.full(len(t), rate) for wheel in WHEELS}
    columns |= {f"pos_{wheel}": np.rad2deg(rate * t) % 360 for wheel in WHEELS}
    pandas.DataFrame(columns).to_csv(path, index=False)
    return {**TABLE, "pos_leg": TABLE["pos"], "pos_wheel": {**TABLE["pos"], "unit": "deg"}}


@pytest.mark.parametrize("every", [0.02, 0.05, 0.1, 0.2, 0.4])
def test_wheels_that_start_anew_go_on_at_any_rate_of_rows(tmp_path, every):
    run, notes = imported(tmp_path / "a.csv", turning(tmp_path / "a.csv", every, 3.0), tmp_path / "runs")
    assert np.allclose(run["pos_wheel_lf"], 3.0 * run["t"])
    assert not [note for note in notes if "pos_wheel" in note]


def test_turns_that_no_sample_shows_are_a_guess_and_said(tmp_path):
    channels = turning(tmp_path / "slow.csv", 0.4, 12.0)
    _, notes = imported(tmp_path / "slow.csv", channels, tmp_path / "slow")
    text = "'pos_wheel_lf': turns are a guess between {}: at {} rad/s that may be more than half a turn"
    assert text.format("74 pairs of samples, up to 0.4 s apart", 12) in notes
    turning(tmp_path / "hole.csv", 0.02, 3.0)
    table = pandas.read_csv(tmp_path / "hole.csv")
    table[(table["t"] < 10.0) | (table["t"] > 12.0)].to_csv(tmp_path / "hole.csv", index=False)
    _, notes = imported(tmp_path / "hole.csv", channels, tmp_path / "hole")
    assert text.format("1 pairs of samples, up to 2 s apart", 3) in notes


def test_jumps_that_may_be_none_of_a_turn_are_left_in_and_said(tmp_path):
    run, notes = imported(tmp_path / "a.csv", turning(tmp_path / "a.csv", 0.4, 5.5), tmp_path / "runs")
    assert np.abs(run["pos_wheel_lf"]).max() < 2 * np.pi
    assert any(
        note.startswith("'pos_wheel_lf': ") and note.endswith("jumps of more than half a turn are left in") for note in notes
    )
