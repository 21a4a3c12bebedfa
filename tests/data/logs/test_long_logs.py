"""Logs that are longer than memory come in part by part: the rows of all parts are those of the log as a whole."""

import copy
import tracemalloc
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
from foreign_logs import joint_state, lab_frame, lab_map, lab_messages, made_up, ns, write_mcap

from wlr_gym.base.errors import InputError
from wlr_gym.data import read_run
from wlr_gym.data.logs import LogMap, import_log, read_logs
from wlr_gym.data.logs.map import resolve
from wlr_gym.data.logs.messages import header, make
from wlr_gym.data.logs.rows import runs_of, wanted_fields
from wlr_gym.data.logs.topics import Collector, Message, Topic, TopicStore
from wlr_gym.robot import WHEELS, load_robot


@pytest.fixture(scope="module")
def messages():
    return lab_messages(made_up(16.0))


@pytest.fixture(scope="module")
def known(messages, tmp_path_factory):
    return lab_map(write_mcap(tmp_path_factory.mktemp("whole") / "a.mcap", messages))


@pytest.fixture
def small(monkeypatch):
    """As if memory were small: parts of about 4 s, blocks of some messages, all of them on disk."""
    monkeypatch.setattr("wlr_gym.data.logs.rows.NUMBERS", 12_000)
    monkeypatch.setattr("wlr_gym.data.logs.open.BLOCK", 40)
    monkeypatch.setattr("wlr_gym.data.logs.topics.IN_MEMORY", 10_000)


def rows_of_all(imported):
    """Return the rows of runs one after the other, on the log's clock; wheels and heading count from where the first began."""
    table = {}
    for one in imported:
        run = read_run(one.path)
        for name in map(str, run.table.columns):
            values = run[name] + (one.origin - imported[0].origin) * 1e-9 if name == "t" else run[name]
            table.setdefault(name, []).append(values)
    return {name: np.concatenate(parts) for name, parts in table.items()}


def test_parts_are_the_whole(messages, known, tmp_path, request):
    (whole,) = import_log(write_mcap(tmp_path / "a.mcap", messages), tmp_path / "whole", known)
    request.getfixturevalue("small")
    shares = []
    parts = import_log(write_mcap(tmp_path / "b.mcap", messages), tmp_path / "parts", known, tell=shares.append)
    assert len(parts) == 4
    assert parts[0].notes[0] == "cut into 4 parts, where the robot is quietest"
    assert shares == sorted(shares)
    assert shares[-1] == 1.0
    expected, found = rows_of_all([whole]), rows_of_all(parts)
    assert set(found) == set(expected)
    for name, values in expected.items():
        one = found[name]
        assert len(one) == len(values)
        if name.partition("_")[2] in WHEELS and name.startswith("pos_"):  # each part counts from its start
            np.testing.assert_allclose(np.diff(one)[np.abs(np.diff(one) - np.diff(values)) < 1.0].sum(), values[-1], atol=2.0)
            continue
        turns = np.round((one - values) / (2 * np.pi)) * 2 * np.pi if name == "cam_yaw" else 0.0
        np.testing.assert_allclose(one - np.nan_to_num(turns), values, atol=1e-9, err_msg=name)
    assert {len(np.unique(np.round(fact.rate))) for fact in parts[1].facts} == {1}
    assert {fact.column: round(fact.rate) for fact in parts[2].facts} == {fact.column: round(fact.rate) for fact in whole.facts}


def test_messages_in_any_order_are_the_same_runs(messages, known, tmp_path, small):
    """As in files that were merged: topic after topic."""
    sorted_by_topic = sorted(messages, key=lambda one: one[1])
    first, second = (
        rows_of_all(import_log(write_mcap(tmp_path / f"{name}.mcap", some), tmp_path / name, known))
        for name, some in (("a", messages), ("b", sorted_by_topic))
    )
    assert all(np.array_equal(first[name], second[name], equal_nan=True) for name in first)


def test_a_setpoint_of_long_ago_still_holds(messages, known, tmp_path, small):
    start = messages[0][0]
    kept = [one for one in messages if one[1] != "/chassis/target" or (one[0] - start) * 1e-9 < 3.0]
    parts = import_log(write_mcap(tmp_path / "a.mcap", kept), tmp_path / "runs", known)
    table = rows_of_all(parts)
    late = table["cmd_wheel_lf"][table["t"] > 3.1]
    assert len(late) > 600
    assert (late == late[0]).all()
    assert any("s on: topic '/chassis/target': silent for up to" in note for one in parts for note in one.notes)


def test_a_channel_that_is_silent_all_the_while_has_no_values_there(messages, known, tmp_path, small):
    start = messages[0][0]
    kept = [one for one in messages if one[1] not in ("/mocap/base", "/xsens/data") or (one[0] - start) * 1e-9 < 3.5]
    parts = import_log(write_mcap(tmp_path / "a.mcap", kept), tmp_path / "runs", known)
    last = read_run(parts[-1].path)
    assert not any(np.isfinite(last[name]).any() for name in ("cam_x", "gyro_z") if name in last)
    assert np.isfinite(read_run(parts[0].path)["gyro_z"]).any()


def test_a_part_without_rows_is_left_out_and_said(messages, known, tmp_path, small):
    start = messages[0][0]
    kept = [one for one in messages if one[1] != "/chassis/target" or (one[0] - start) * 1e-9 > 13.0]
    parts = import_log(write_mcap(tmp_path / "a.mcap", kept), tmp_path / "runs", known)
    assert len(parts) == 1
    assert any("s on: no run: setpoints and positions are never known together" in note for note in parts[0].notes)
    assert read_run(parts[0].path)["t"][-1] == pytest.approx(3.0, abs=0.1)


def test_a_hole_and_a_stray_header_leave_the_parts_as_they_are(messages, known, tmp_path, small):
    start = messages[0][0]
    kept = copy.deepcopy([one for one in messages if not 3.5 < (one[0] - start) * 1e-9 < 9.0])
    stray = next(message for _, topic, _, message in kept[200:] if topic == "/chassis/joints")
    stray.header.stamp = make("builtin_interfaces/msg/Time", sec=0, nanosec=0)
    parts = import_log(write_mcap(tmp_path / "a.mcap", kept), tmp_path / "runs", known)
    assert len(parts) in (3, 4)
    runs = [read_run(one.path) for one in parts]
    assert sum(len(run["t"]) for run in runs) == pytest.approx(525, abs=5)
    assert max(len(run["t"]) for run in runs) < 300
    assert any("its times go back 1 times" in note for one in parts for note in one.notes)


def test_split_cuts_parts_further_and_may_ask_for_longer_ones(messages, known, tmp_path, small):
    log = write_mcap(tmp_path / "a.mcap", messages)
    short = [read_run(one.path)["t"][-1] for one in import_log(log, tmp_path / "short", known, split=2.0)]
    assert len(short) == pytest.approx(8, abs=1)
    assert max(short) < 3.5
    assert len(import_log(log, tmp_path / "long", known, split=60.0)) == 1


def test_what_is_refused_in_the_last_part_leaves_nothing(messages, known, tmp_path, small):
    wrong = known.model_dump(exclude_defaults=True)
    wrong["channels"]["volt"] = {"topic": "/power", "field": "volts"}
    with pytest.raises(InputError, match="unknown field 'volts'"):
        import_log(write_mcap(tmp_path / "a.mcap", messages), tmp_path / "runs", wrong)
    assert not (tmp_path / "runs").exists()


def test_a_table_comes_in_parts_too(tmp_path, monkeypatch, small):
    monkeypatch.setattr("wlr_gym.data.logs.tables.ROWS", 100)
    path = tmp_path / "a.csv"
    lab_frame(made_up(12.0)).to_csv(path, index=False)
    found = lab_map(path)
    parts = import_log(path, tmp_path / "runs", found)
    assert len(parts) == 2
    assert len(rows_of_all(parts)["t"]) == 600


def test_memory_does_not_grow_with_length(small, known, monkeypatch):
    monkeypatch.setattr("wlr_gym.data.logs.rows.NUMBERS", 60_000)
    content = known.model_dump(exclude_defaults=True)
    content["channels"] = {key: one for key, one in content["channels"].items() if one["topic"].startswith("/chassis")}
    found = LogMap.model_validate(content)
    resolved = resolve(found, load_robot(), "map")
    rows = np.arange(500)
    fields = {topic: sorted(names) for topic, names in wanted_fields(resolved).items()}

    def peak(blocks):
        tracemalloc.start()
        try:
            with closing(TopicStore(Path("a"))) as recording:
                for k in range(blocks):
                    times = np.array([ns(0.02 * (500 * k + row)) for row in range(500)])
                    for name, names in fields.items():
                        values = {field: (rows, np.sin(0.01 * rows + place)) for place, field in enumerate(names)}
                        recording.add(Topic(name, "", times, times, values))
                count = sum(len(made.table["t"]) for made in runs_of(recording, found, resolved, None, lambda share: None))
            return count, tracemalloc.get_traced_memory()[1]
        finally:
            tracemalloc.stop()

    (few, short), (many, long) = peak(12), peak(36)
    assert (few, many) == (6000, 18000)
    assert long < 1.4 * short


def test_read_logs_is_the_same_from_memory_and_from_disk(messages, tmp_path, request):
    log = write_mcap(tmp_path / "a.mcap", messages)
    (one,) = read_logs(log)
    request.getfixturevalue("small")
    (other,) = read_logs(log)
    assert set(one.topics) == set(other.topics)
    for name, topic in one.topics.items():
        assert np.array_equal(topic.clock("header"), other.topics[name].clock("header"))
        for field, (rows, values) in topic.fields.items():
            assert np.array_equal(rows, other.topics[name].fields[field][0])
            assert np.array_equal(values, other.topics[name].fields[field][1], equal_nan=True)


# ---- memory of reading: what the map does not ask for costs nothing, however long ------------------------------------------


IMAGE = "sensor_msgs/msg/CompressedImage"
STATE = "sensor_msgs/msg/JointState"
WANTED = {"/joints": {"position[a]", "position[b]"}}


def pictured(count, pictures):
    picture = np.random.default_rng(0).integers(0, 255, 20_000, dtype=np.uint8)
    for k in range(count):
        yield ns(0.01 * k), "/joints", STATE, joint_state(ns(0.01 * k), "ab", [0.1 * k, 0.2 * k])
        for _ in range(pictures):
            yield ns(0.01 * k), "/camera", IMAGE, make(IMAGE, header=header(ns(0.01 * k), ""), format="jpeg", data=picture)


def peak(path):
    """Return the most memory (bytes) that reading takes, and the log."""
    shares = []
    tracemalloc.start()
    try:
        (log,) = read_logs(path, WANTED, tell=shares.append)
        return tracemalloc.get_traced_memory()[1], log, shares
    finally:
        tracemalloc.stop()


def test_pictures_cost_no_memory_however_many_and_progress_is_told(tmp_path):
    (warm, _, _), (short, log, _), (long, _, shares) = (
        peak(write_mcap(tmp_path / f"{name}.mcap", pictured(100, count), chunk=100_000))
        for name, count in (("warm", 1), ("short", 2), ("long", 8))
    )
    assert (tmp_path / "long.mcap").stat().st_size > 3 * (tmp_path / "short.mcap").stat().st_size > 1_000_000
    assert long < 1.1 * short + 50_000
    assert warm > 0
    assert len(log.topics["/joints"].received) == 100
    assert shares == sorted(shares)
    assert len(set(shares)) > 50


def test_a_number_that_is_asked_for_costs_eight_bytes():
    def kept(count):
        tracemalloc.start()
        try:
            collector = Collector("", {"a", "b"})
            for k in range(count):
                collector.add(Message("", "", k, {"a": 1.0 * k, "b": 2.0 * k, "c": 3.0 * k}))
            return tracemalloc.get_traced_memory()[0]
        finally:
            tracemalloc.stop()

    per_message = (kept(9000) - kept(3000)) / 6000
    assert 3 * 8 <= per_message < 1.3 * 3 * 8  # a, b and when it was received; arrays grow by an eighth


def test_a_field_that_some_messages_lack_keeps_its_places():
    collector = Collector("")
    for k, content in enumerate(({"a": 0.0}, {"a": 1.0, "b": 1.0}, {"b": 2.0}, {"a": 3.0, "b": 3.0})):
        collector.add(Message("", "", 10 * k, content))
    fields = collector.topic("t").fields
    assert {name: (rows.tolist(), values.tolist()) for name, (rows, values) in fields.items()} == {
        "a": ([0, 1, 3], [0.0, 1.0, 3.0]),
        "b": ([1, 2, 3], [1.0, 2.0, 3.0]),
    }


def test_values_and_times_come_as_they_are_written(tmp_path):
    (log,) = read_logs(write_mcap(tmp_path / "a.mcap", pictured(50, 0)), WANTED)
    at, values = log.topics["/joints"].series("position[b]", "header", "a")
    assert at.tolist() == [ns(0.01 * k) for k in range(50)]
    assert values.tolist() == [0.2 * k for k in range(50)]
