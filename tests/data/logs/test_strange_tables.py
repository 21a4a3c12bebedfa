"""Tables as other programs write them: encodings, comments, repeated names, cut rows. They work, or what is wrong is said."""

import numpy as np
import pandas
import pytest
from foreign_logs import lab_frame, lab_map, made_up

from wlr_gym.base.errors import InputError
from wlr_gym.data import read_run
from wlr_gym.data.logs import import_log, read_logs, suggest_map


@pytest.fixture(scope="module")
def frame():
    return lab_frame(made_up(4.0)).drop(columns="comment")


@pytest.fixture(scope="module")
def text(frame):
    return frame.to_csv(index=False)


def written(path, content, encoding="utf-8"):
    path.write_bytes(content.encode(encoding))
    return path


def read(path):
    (log,) = read_logs(path)
    return log


def check_same(log, frame, rows=slice(None)):
    topic = log.topics["table"]
    expected = frame[rows]
    assert topic.received.tolist() == (expected["time_ms"] * 1e6).round().astype(int).tolist()
    for name in expected.columns.drop("time_ms"):
        assert np.array_equal(topic.fields[name][1], expected[name]), name


@pytest.mark.parametrize("encoding", ["utf-8-sig", "utf-16", "utf-16-le", "utf-16-be", "utf-32", "cp1252"])
def test_any_encoding(tmp_path, frame, text, encoding):
    named = frame.rename(columns={"ax": "ax ü"}) if encoding == "cp1252" else frame
    log = read(written(tmp_path / "a.csv", named.to_csv(index=False), encoding))
    check_same(log, named)
    assert log.notes == ()


@pytest.mark.parametrize(
    "before",
    ["# a logger\n# of 2026, at 50 Hz\n", "sep=,\n", "\n\n", "% MATLAB\n", "// C, with, many, commas\n#\n"],
    ids=["comments", "excel", "blank", "percent", "slashes"],
)
def test_lines_before_the_names(tmp_path, frame, text, before):
    check_same(read(written(tmp_path / "a.csv", before + text)), frame)


@pytest.mark.parametrize("separator", [",", " ", "\t", ";"])
def test_names_in_a_comment_as_numpy_writes_them(tmp_path, frame, separator):
    np.savetxt(tmp_path / "a.csv", frame, delimiter=separator, header=separator.join(frame.columns), fmt="%.17g")
    check_same(read(tmp_path / "a.csv"), frame)


def test_names_that_are_repeated_and_comments_between_rows_are_left_out_and_said(tmp_path, frame, text):
    lines = text.splitlines()
    lines[51:51] = [lines[0]]
    lines[30:30] = ["# the operator pushed it"]
    lines[1:1] = [",".join(["ms"] + ["deg"] * (len(frame.columns) - 1))]
    log = read(written(tmp_path / "a.csv", "\n".join(lines) + "\n"))
    check_same(log, frame)
    assert log.notes[0] == "3 rows without a time are left out (first row 0: 'time_ms' is 'ms')"


def test_decimal_commas_survive_rows_that_are_no_numbers(tmp_path, frame):
    lines = frame.to_csv(index=False, sep=";", decimal=",").splitlines()
    lines[20:20] = [lines[0]]
    check_same(read(written(tmp_path / "a.csv", "\n".join(lines))), frame)


def test_the_decimal_sign_is_that_of_all_rows(tmp_path, frame):
    whole = frame.copy()
    whole.loc[0, frame.columns.drop("time_ms")] = 0.0
    lines = whole.to_csv(index=False, sep=";", decimal=",").replace(",0;", ";").replace(",0\n", "\n").splitlines()
    assert "," not in lines[1]
    check_same(read(written(tmp_path / "a.csv", "\n".join(lines))), whole)
    remarks = frame.assign(remark="").astype({"remark": object})
    remarks.loc[3, "remark"] = "moved by 1,5 m"
    check_same(read(written(tmp_path / "b.csv", remarks.to_csv(index=False, sep=";"))), frame)


def test_a_table_of_rostopic(tmp_path, frame):
    """Its line of names begins like a comment; headers hold a text."""
    nanoseconds = 1_700_000_000_000_000_000 + (frame["time_ms"] * 1e6).round().astype("int64")
    table = frame.drop(columns="time_ms").add_prefix("field.")
    table.insert(0, "field.header.frame_id", "base")
    table.insert(0, "%time", nanoseconds)
    topic = read(written(tmp_path / "a.csv", table.to_csv(index=False))).topics["table"]
    assert topic.received.tolist() == nanoseconds.tolist()
    assert np.array_equal(topic.fields["field.ax"][1], frame["ax"])


@pytest.mark.parametrize("encoding", ["utf-8", "utf-16"])
def test_a_row_that_was_cut_off_is_left_out_and_said(tmp_path, frame, text, encoding):
    lines = text.splitlines(keepends=True)
    log = read(written(tmp_path / "a.csv", "".join(lines[:-1]) + lines[-1][:40], encoding))
    check_same(log, frame, slice(0, -1))
    assert log.notes == (f"the last row was cut off: left out (row {len(frame) - 1})",)


def test_a_cut_table_is_proposed_and_imported(tmp_path, text):
    path = written(tmp_path / "a.csv", text[:-70])
    (imported,) = import_log(path, tmp_path / "runs", lab_map(path))
    assert any("cut off" in note for note in imported.notes)


def test_a_value_that_is_no_number_is_left_out_and_said(tmp_path, frame):
    changed = frame.astype({"ax": object})
    changed.loc[7, "ax"] = "ERR"
    changed.to_csv(tmp_path / "a.csv", index=False)
    log = read(tmp_path / "a.csv")
    rows, values = log.topics["table"].fields["ax"]
    assert 7 not in rows
    assert np.array_equal(values, frame["ax"].drop(7))
    assert log.notes == ("columns that hold texts beside numbers: ax; the texts are left out",)


def test_times_that_go_back_are_refused_with_their_row(tmp_path, frame):
    lines = frame.assign(time_ms=np.where(frame.index == 111, 0.0, frame["time_ms"])).to_csv(index=False).splitlines()
    lines[90:90] = [lines[0]]
    with pytest.raises(InputError, match="row 112, column 'time_ms': times must increase"):
        read(written(tmp_path / "b.csv", "\n".join(lines)))


def test_whole_nanoseconds_are_kept_beside_rows_without_a_time(tmp_path, frame):
    times = 1_760_000_000_123_456_789 + np.arange(len(frame)) * 20_000_001
    lines = frame.drop(columns="time_ms").assign(t_ns=times).to_csv(index=False).splitlines()
    lines[9:9] = [lines[0]]
    assert read(written(tmp_path / "a.csv", "\n".join(lines))).topics["table"].received.tolist() == times.tolist()


def test_dates_and_an_index_of_dates(tmp_path, frame):
    dates = pandas.to_datetime("2026-01-02T03:04:05Z") + pandas.to_timedelta(frame["time_ms"], unit="ms")
    dated = frame.assign(time_ms=dates).rename(columns={"time_ms": "stamp"})
    dated.to_csv(tmp_path / "a.csv", index=False)
    dated.set_index("stamp").to_parquet(tmp_path / "a.parquet")
    expected = dates.dt.tz_localize(None).astype("datetime64[ns]").astype("int64").tolist()
    for name in ("a.csv", "a.parquet"):
        assert read(tmp_path / name).topics["table"].received.tolist() == expected


def test_a_time_of_plotjuggler(tmp_path, frame):
    frame.assign(time_ms=frame["time_ms"] * 1e-3).rename(columns={"time_ms": "__time"}).to_csv(tmp_path / "a.csv", index=False)
    assert np.median(np.diff(read(tmp_path / "a.csv").topics["table"].received)) == pytest.approx(2e7)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("0.0,1.0\n0.1,2.0\n", "its first line holds numbers, not the names of columns: '0.0,1.0'"),
        ("# only\n# comments\n", "no row in it"),
        ("t,a\n", "0 rows; a recording has at least 2"),
        ("t,a\nx,1\ny,2\n", "row 0, column 't': 'x' is neither a number nor a date"),
        ("t,a,a\n0,1,2\n1,2,3\n", "column 'a' occurs twice"),
        ("t,a\n0,1\n1,2,3,4\n2,3\n", "cannot be read as csv: .*line 3"),
        ("\0\1\2\3", "holds bytes that are no text"),
    ],
)
def test_what_is_no_table_is_said(tmp_path, content, message):
    with pytest.raises(InputError, match=rf"a.csv: {message}"):
        read(written(tmp_path / "a.csv", content))


def test_quaternions_of_tables(tmp_path):
    """Columns and lists, in either order: the map says which."""
    table = made_up(4.0)
    rows = {name: values[::4] for name, values in table.items()}
    yaw = np.interp(rows["t"], table["t"][np.isfinite(table["cam_yaw"])], table["cam_yaw"][np.isfinite(table["cam_yaw"])])
    frame = lab_frame(table).drop(columns="comment").assign(qw=np.cos(yaw / 2), qx=0.0, qy=0.0, qz=np.sin(yaw / 2))
    for k, part in enumerate("wxyz"):
        frame[f"att[{k}]"] = frame[f"q{part}"]
    path = written(tmp_path / "a.csv", frame.to_csv(index=False))
    known = lab_map(path)
    for field, right in (("q.yaw", True), ("att[wxyz].yaw", True), ("att[xyzw].yaw", False)):
        channels = {**known.model_dump()["channels"], "cam_yaw": {"topic": "table", "field": field}}
        (imported,) = import_log(path, tmp_path / field, {**known.model_dump(), "channels": channels})
        found = pandas.read_parquet(imported.path)["cam_yaw"].to_numpy()
        assert (np.nanmax(np.abs(found - yaw[: len(found)])) < 1e-9) == right, field


@pytest.mark.parametrize("missing", [{"qw": [9]}, {"qw": [20], "qx": [30], "qy": [40], "qz": [50]}], ids=["one", "each"])
def test_a_quaternion_with_empty_cells_is_a_lost_frame(tmp_path, frame, missing):
    yaw = 0.01 * np.arange(len(frame))
    posed = frame.assign(qw=np.cos(yaw / 2), qx=0.0, qy=0.0, qz=np.sin(yaw / 2), px=yaw, py=0.0)
    known = lab_map(written(tmp_path / "whole.csv", posed.to_csv(index=False))).model_dump()
    pose = {name: {"topic": "table", "field": field} for name, field in
        (("cam_x", "px"), ("cam_y", "py"), ("cam_yaw", "q.yaw"))}  # fmt: skip
    for part, rows in missing.items():
        posed.loc[rows, part] = np.nan
    path = written(tmp_path / "a.csv", posed.to_csv(index=False))
    (imported,) = import_log(path, tmp_path / "runs", {**known, "channels": {**known["channels"], **pose}})
    found = pandas.read_parquet(imported.path)
    lost = sorted(row for rows in missing.values() for row in rows)
    assert np.flatnonzero(found["cam_yaw"].isna()).tolist() == np.flatnonzero(found["cam_x"].isna()).tolist() == lost
    right = np.delete(np.arange(len(found)), lost)
    assert np.allclose(found["cam_yaw"][right], yaw[right])
    assert any(f"{len(lost)} lost frame" in note for note in imported.notes)


def test_an_axis_stands_apart_from_the_letters_of_a_word(tmp_path, frame):
    """The y of angular_velocity_x is no axis."""
    long = {
        f"{short}{axis}": f"{name}_{axis}"
        for short, name in (("g", "angular_velocity"), ("a", "acceleration"))
        for axis in "xyz"
    }
    path = written(tmp_path / "a.csv", frame.rename(columns=long).to_csv(index=False))
    assert {"gyro", "acc"} <= set(lab_map(path).channels)


def test_a_map_names_the_column_of_times(tmp_path):
    frame = lab_frame(made_up(6.0)).rename(columns={"time_ms": "Zeit [ms]"})
    frame.to_csv(tmp_path / "a.csv", index=False)
    with pytest.raises(InputError, match=r"no column of times: .* its name in the map \(--map\), such as: time: 'Zeit \[ms\]'"):
        suggest_map(tmp_path / "a.csv")
    known = lab_map(tmp_path / "a.csv", {"time": "Zeit [ms]"})
    assert known.time == "Zeit [ms]"
    (imported,) = import_log(tmp_path / "a.csv", tmp_path / "runs", known)
    assert read_run(imported.path)["t"][-1] == pytest.approx(5.98)
    with pytest.raises(InputError, match=r"time: unknown column 'Zeit' \(did you mean 'Zeit \[ms\]'\?\)"):
        suggest_map(tmp_path / "a.csv", {"time": "Zeit"})
