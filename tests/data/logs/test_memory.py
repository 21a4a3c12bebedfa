"""Memory of reading: what the map does not ask for costs nothing, however long; test_long_logs.py has what it asks for."""

import tracemalloc

import numpy as np
from foreign_logs import joint_state, ns, write_mcap

from wlr_gym.data.logs import read_logs
from wlr_gym.data.logs.messages import header, make
from wlr_gym.data.logs.topics import Collector, Message

IMAGE = "sensor_msgs/msg/CompressedImage"
STATE = "sensor_msgs/msg/JointState"
WANTED = {"/joints": {"position[a]", "position[b]"}}


def messages(count, pictures):
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
        peak(write_mcap(tmp_path / f"{name}.mcap", messages(100, count), chunk=100_000))
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
    (log,) = read_logs(write_mcap(tmp_path / "a.mcap", messages(50, 0)), WANTED)
    at, values = log.topics["/joints"].series("position[b]", "header", "a")
    assert at.tolist() == [ns(0.01 * k) for k in range(50)]
    assert values.tolist() == [0.2 * k for k in range(50)]
