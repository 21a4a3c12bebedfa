"""Runs written as MCAP and rosbag2 come back: channels to the bit, times to 1 ns."""

import math
import shutil
import threading
from pathlib import Path

import numpy as np
import pandas
import pytest
from foreign_logs import made_up, rows_of
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st

from wlr_gym.base.errors import InputError
from wlr_gym.cli import main
from wlr_gym.data import Run, convert, read_run, write_run
from wlr_gym.data.format import COLUMNS, COMMANDS, REQUIRED, Profile, RunMeta
from wlr_gym.data.logs import export_run, import_log, read_exported
from wlr_gym.data.logs.messages import McapStream, nanoseconds, seconds
from wlr_gym.data.runs import robot_of
from wlr_gym.robot import load_robot, robot_content, robot_hash

OPTIONAL = [name for name in COLUMNS if name not in REQUIRED]
NUMBERS = st.one_of(st.floats(allow_nan=False, allow_infinity=False, width=64), st.just(math.nan), st.sampled_from([0.0, -0.0]))


@st.composite
def runs(draw):
    """Any table of run columns: any values, missing columns, clocks since boot, since 1970 and before 0."""
    rows = draw(st.integers(2, 5))
    begin = draw(st.sampled_from([0.0, 12.3456789, 1_760_000_000.25, -5.5]))
    steps = draw(st.lists(st.floats(1e-6, 0.1), min_size=rows, max_size=rows))
    columns = [*REQUIRED[1:], *draw(st.lists(st.sampled_from(OPTIONAL), unique=True))]
    values = {name: draw(st.lists(NUMBERS, min_size=rows, max_size=rows)) for name in columns}
    table = pandas.DataFrame({"t": begin + np.cumsum(steps)} | {name: values[name] for name in COLUMNS if name in values})
    return Run(table, RunMeta(profile=Profile(leg_velocity=1.5), ground="ice"), Path("run_01.csv"))


def with_a_live_camera():
    """Every row says how old the last pose is, also without a new one."""
    columns = {name: [0.0, 0.1] for name in REQUIRED} | {"cam_x": [0.2, math.nan], "cam_age": [0.03, 0.05]}
    table = pandas.DataFrame({name: columns[name] for name in COLUMNS if name in columns})
    return Run(table, RunMeta(profile=Profile(leg_velocity=1.5), ground="ice"), Path("run_01.csv"))


@pytest.mark.parametrize(("form", "name"), [("mcap", "a.mcap"), ("rosbag2", "a")])
@settings(max_examples=8, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow])
@given(run=runs())
@example(run=with_a_live_camera())
def test_any_run_comes_back(form, name, tmp_path_factory, run):
    if (np.diff([nanoseconds(t, 10) for t in run["t"]]) <= 0).any():
        return
    path = export_run(run, tmp_path_factory.mktemp("bag") / name, form)
    back = read_exported(path)
    assert list(back.table) == list(run.table.columns)
    for column in run.table.columns:
        if column == "t":
            np.testing.assert_allclose(back.table["t"], run["t"], rtol=0, atol=max(1e-9, np.spacing(run["t"].max())))
        else:
            expected = run[column]
            known = np.isfinite(expected)
            assert np.array_equal(back.table[column].view(np.int64)[known], expected.view(np.int64)[known]), column
            assert np.isnan(back.table[column][~known]).all()
    assert back.meta == run.meta
    assert back.notes == ()


@given(t=st.one_of(st.floats(0, 1e6), st.floats(1.7e9, 1.8e9)))
def test_times_to_one_nanosecond(t):
    assert abs(seconds(nanoseconds(t)) - t) <= max(1e-9, np.spacing(t))


def test_rows_less_than_a_nanosecond_apart_are_refused(tmp_path):
    table = {name: np.zeros(3) for name in REQUIRED} | {"t": np.array([1.0, 1.0 + 3e-10, 2.0])}
    run = Run(pandas.DataFrame(table), RunMeta(), tmp_path / "run_01.csv")
    with pytest.raises(InputError, match=r"run_01.csv: row 1 \(line 3\), column 't': less than 1 ns"):
        export_run(run, tmp_path / "a.mcap")
    assert not list(tmp_path.iterdir())


def test_a_bag_that_is_there_is_kept(tmp_path):
    run = read_run(write_run(tmp_path / "run_01.csv", rows_of(made_up(3.0))))
    export_run(run, tmp_path / "bag", "rosbag2")
    with pytest.raises(InputError, match="is there already"):
        export_run(run, tmp_path / "bag", "rosbag2")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["bag", "run_01.csv"]


@pytest.mark.parametrize(("form", "name"), [("mcap", "run_01.mcap"), ("rosbag2", "run_01.bag2")])
def test_a_run_that_cannot_be_read_costs_no_older_export(form, name, tmp_path):
    run = write_run(tmp_path / "run_01.csv", rows_of(made_up(3.0)))
    assert main(["export", str(run), "--to", form]) == 0
    run.write_text("broken")
    assert main(["export", str(run), "--to", form, "--force"]) == 2
    assert (tmp_path / name).exists()


# ---- while it goes on ------------------------------------------------------------------------------------------------


def stream(path, rows, close):
    columns = [name for name in rows if name != "t"]
    writing = McapStream(path, columns, RunMeta(robot="wlr-nominal"))
    writing.__enter__()
    for k, t in enumerate(rows["t"]):
        writing.add(float(t), [rows[name][k] for name in columns])
    if close:
        writing.__exit__(None, None, None)
    return writing


def test_a_stream_is_the_run(tmp_path):
    rows = rows_of(made_up(4.0))
    writing = stream(tmp_path / "live.mcap", rows, close=True)
    assert (writing.left_out, writing.trouble) == (0, "")
    back = read_exported(tmp_path / "live.mcap")
    assert back.meta.robot == "wlr-nominal"
    assert all(np.array_equal(back.table[name], rows[name], equal_nan=True) for name in rows if name != "t")


def test_a_stream_that_was_killed_can_be_read_up_to_its_last_flush(tmp_path, monkeypatch):
    monkeypatch.setattr("wlr_gym.data.logs.messages.FLUSH", 0.0)
    rows = rows_of(made_up(4.0))
    writing = stream(tmp_path / "live.mcap", rows, close=False)
    while not writing._rows.empty():
        pass
    content = (tmp_path / "live.mcap").read_bytes()
    (tmp_path / "killed.mcap").write_bytes(content[: len(content) * 2 // 3])
    writing.__exit__(None, None, None)
    back = read_exported(tmp_path / "killed.mcap")
    count = len(back.table["t"])
    assert 0.5 * len(rows["t"]) < count < 0.8 * len(rows["t"])
    assert np.array_equal(back.table["cmd_wheel_lf"][:-1], rows["cmd_wheel_lf"][: count - 1])
    assert "cut off" in back.notes[0]


def test_a_stream_without_a_row_leaves_no_file(tmp_path):
    with McapStream(tmp_path / "live.mcap", COMMANDS, RunMeta()):
        assert (tmp_path / "live.mcap").is_file()
    assert not list(tmp_path.iterdir())


def test_a_stream_never_waits_and_never_overwrites(tmp_path, monkeypatch):
    monkeypatch.setattr("wlr_gym.data.logs.messages.WAITING", 5)
    writing = McapStream(tmp_path / "live.mcap", COMMANDS, RunMeta())  # its thread has not begun
    for k in range(8):
        writing.add(0.02 * k, [0.0] * len(COMMANDS))
    assert writing.left_out == 3
    with pytest.raises(InputError, match="is there already"):
        McapStream(tmp_path / "live.mcap", COMMANDS, RunMeta())


@pytest.mark.parametrize("error", [OSError(28, "No space left on device"), RuntimeError("broken")])
def test_a_stream_that_failed_ends_at_once_though_its_queue_is_full(tmp_path, monkeypatch, error):
    monkeypatch.setattr("wlr_gym.data.logs.messages.WAITING", 5)

    def fail(message):
        raise error

    writing = McapStream(tmp_path / "live.mcap", COMMANDS, RunMeta())
    monkeypatch.setattr(writing._sink, "add", fail)
    writing.__enter__()
    writing.add(0.0, [0.0] * len(COMMANDS))
    writing._thread.join(5.0)
    for k in range(1, 10):
        writing.add(0.02 * k, [0.0] * len(COMMANDS))
    ending = threading.Thread(target=writing.__exit__, args=(None, None, None), daemon=True)
    ending.start()
    ending.join(5.0)
    assert not ending.is_alive()
    assert str(error) in writing.trouble
    assert writing.left_out == 4


@pytest.mark.parametrize(("form", "name"), [("mcap", "a.mcap"), ("rosbag2", "a")])
def test_a_robot_of_ones_own_travels_with_its_run(form, name, tmp_path):
    heavy = load_robot(robot_content("nominal") | {"name": "heavy", "gravity": 9.0})
    run = read_run(write_run(tmp_path / "here" / "run_01.csv", rows_of(made_up(3.0)), RunMeta(), robot=heavy))
    assert run.meta.robot_hash == robot_hash(heavy)
    log = export_run(run, tmp_path / name, form)
    shutil.rmtree(tmp_path / "here")
    (imported,) = import_log(log, tmp_path / "there")
    assert robot_of(read_run(imported.path)) == heavy
    convert(imported.path, tmp_path / "elsewhere" / "run_01.parquet")
    assert robot_of(read_run(tmp_path / "elsewhere" / "run_01.parquet")) == heavy
