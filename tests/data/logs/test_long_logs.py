"""Long logs: only numbers that the map asks for are kept, and a long recording becomes several runs."""

import tracemalloc

import numpy as np
import pytest
from foreign_logs import joint_state, lab_frame, lab_map, made_up, ns, write_mcap

from wlr_gym.data import read_run
from wlr_gym.data.logs import import_log, read_logs
from wlr_gym.data.logs.messages import header, make
from wlr_gym.data.logs.topics import Collector, Message

IMAGE = "sensor_msgs/msg/CompressedImage"
STATE = "sensor_msgs/msg/JointState"
WANTED = {"/joints": {"position[a]", "position[b]"}}


def test_a_recording_of_more_than_ten_minutes_becomes_several_runs(tmp_path, monkeypatch):
    monkeypatch.setattr("wlr_gym.data.logs.rows.LONGEST", 5.0)
    path = tmp_path / "a.csv"
    lab_frame(made_up(12.0)).to_csv(path, index=False)
    known = lab_map(path)
    parts = import_log(path, tmp_path / "runs", known)
    runs = [read_run(one.path) for one in parts]
    assert [round(run["t"][-1]) for run in runs] == pytest.approx([6, 6], abs=2)
    assert sum(len(run["t"]) for run in runs) == 600
    assert len(import_log(path, tmp_path / "whole", known, split=60.0)) == 1


def pictured(count, pictures):
    picture = np.random.default_rng(0).integers(0, 255, 20_000, dtype=np.uint8)
    for k in range(count):
        yield ns(0.01 * k), "/joints", STATE, joint_state(ns(0.01 * k), "ab", [0.1 * k, 0.2 * k])
        for _ in range(pictures):
            yield ns(0.01 * k), "/camera", IMAGE, make(IMAGE, header=header(ns(0.01 * k), ""), format="jpeg", data=picture)


def peak(path):
    """Return the most memory (bytes) that reading takes, the log, and the shares that were told."""
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
    at, values = log.topics["/joints"].series("position[b]", "header", "a")
    assert at.tolist() == [ns(0.01 * k) for k in range(100)]
    assert values.tolist() == [0.2 * k for k in range(100)]
    assert shares == sorted(shares)
    assert len(set(shares)) > 50


def test_a_field_that_some_messages_lack_keeps_its_places():
    collector = Collector("t", "")
    for k, content in enumerate(({"a": 0.0}, {"a": 1.0, "b": 1.0}, {"b": 2.0}, {"a": 3.0, "b": 3.0})):
        collector.add(Message("", "", 10 * k, content))
    fields = collector.topic().fields
    assert {name: (rows.tolist(), values.tolist()) for name, (rows, values) in fields.items()} == {
        "a": ([0, 1, 3], [0.0, 1.0, 3.0]),
        "b": ([1, 2, 3], [1.0, 2.0, 3.0]),
    }
