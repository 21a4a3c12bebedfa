"""Reading, checking, writing and converting runs: every refusal and warning of the format, with broken files."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from wlr_gym.base.errors import InputError
from wlr_gym.data import COLUMNS, Profile, RunMeta, check_table, convert, read_dataset, read_meta, read_run, write_run
from wlr_gym.data.format import CAMERA, FLOW, REQUIRED
from wlr_gym.data.logs import export_run
from wlr_gym.data.logs.messages import read_exported
from wlr_gym.data.sensors import SENSED, channels
from wlr_gym.physics.plants.base import SENSOR_LAYOUT, Sensors
from wlr_gym.robot import JOINTS, LEGS, WHEELS

DATA = Path(__file__).parent / "data"
DEGREES = 180 / np.pi


@pytest.fixture
def table() -> dict[str, np.ndarray]:
    """A real measured run of 6 s, columns by name."""
    run = read_run(DATA / "run_01.parquet")
    return {name: run[name].copy() for name in run.table}


def write_raw(path: Path, table: dict[str, np.ndarray]) -> Path:
    """Write a table as CSV or Parquet without any check, as a careless user would."""
    import pandas

    frame = pandas.DataFrame(table)
    frame.to_csv(path, index=False) if path.suffix == ".csv" else frame.to_parquet(path)
    return path


def refused(path: Path, *words: str) -> None:
    with pytest.raises(InputError) as error:
        read_run(path)
    for word in (path.name, *words):
        assert word in str(error.value)


def findings_of(table: dict[str, np.ndarray], kind: str) -> dict[str, tuple[int, ...]]:
    return {finding.column: finding.rows for finding in check_table(table, "run.csv") if finding.kind == kind}


# --- a row of the sensors ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize("is_new", [False, True])
def test_a_row_has_no_flow_and_no_pose_without_a_new_reading_but_their_age(is_new):
    """The plant's readings keep the last ones; in a run each stands where it was new."""
    sensors = Sensors(np.arange(1.0, SENSOR_LAYOUT.width + 1.0)[None])
    for name in ("flow_is_new", "camera_is_new"):
        sensors[name][:] = is_new
    columns = (*SENSED, *FLOW)
    row = dict(zip(columns, channels(sensors, 0, columns), strict=True))
    expected = {"flow_x": sensors.flow[0, 0], "flow_y": sensors.flow[0, 1], "flow_quality": sensors.flow_quality[0]}
    expected |= dict(zip(("cam_x", "cam_y", "cam_yaw"), sensors.camera_pose[0], strict=True))
    for name, value in expected.items():
        assert row[name] == value if is_new else np.isnan(row[name]), name
    assert row["flow_age"] == sensors.flow_age[0]
    assert row["volt"] == sensors.supply_voltage[0]
    assert np.array_equal(channels(sensors, 0), [row[name] for name in SENSED], equal_nan=True)


# --- honest data ------------------------------------------------------------------------------------------------------


def test_a_real_run_is_read_and_only_its_gaps_are_reported():
    run = read_run(DATA / "run_01.parquet")
    assert list(run.table.columns) == [name for name in COLUMNS if name not in ("cam_age", *FLOW)]
    assert len(run.table) == 300
    assert run.meta.profile.leg_velocity == pytest.approx(1.438849)
    assert {finding.kind for finding in run.findings} <= {"gap"}


def test_minimal_run_has_only_the_required_columns(tmp_path, table):
    path = write_run(tmp_path / "run_01.csv", {name: table[name] for name in REQUIRED})
    assert set(read_run(path).table.columns) == set(REQUIRED)


def test_torque_off_is_no_error(tmp_path, table):
    table["cmd_wheel_lr"][:] = np.nan
    assert np.isnan(read_run(write_run(tmp_path / "run_01.csv", table))["cmd_wheel_lr"]).all()


def test_a_robot_at_rest_gives_no_findings(table):
    rest = {name: np.full(100, values[0]) for name, values in table.items()}
    noise = np.random.default_rng(0)
    rest["t"] = 0.02 * np.arange(100)
    for name in ("gyro_x", "gyro_y", "gyro_z", "acc_x", "acc_y", "acc_z", "volt", *[f"eff_{joint}" for joint in JOINTS]):
        rest[name] = rest[name] + noise.normal(0, 0.01, 100)
    for name in CAMERA:
        rest[name] = np.where(np.arange(100) % 2, np.nan, noise.normal(0, 0.001, 100))
    assert check_table(rest, "run.csv") == []


# --- refusals ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("suffix", [".csv", ".parquet"])
@pytest.mark.parametrize("column", ["t", "cmd_leg_lf", "pos_wheel_rr"])
def test_missing_required_column(tmp_path, table, column, suffix):
    del table[column]
    refused(write_raw(tmp_path / f"run_01{suffix}", table), "missing required column", f"'{column}'")


@pytest.mark.parametrize("suffix", [".csv", ".parquet"])
def test_unknown_column_names_the_nearest(tmp_path, table, suffix):
    table["gyro_zz"] = table.pop("gyro_z")
    refused(write_raw(tmp_path / f"run_01{suffix}", table), "unknown column 'gyro_zz'", "did you mean 'gyro_z'")


@pytest.mark.parametrize("step", [0.0, -1.0])
def test_clock_that_does_not_increase(tmp_path, table, step):
    table["t"][17] = table["t"][16] + step
    refused(write_raw(tmp_path / "run_01.csv", table), "row 17", "'t'", "does not come after")


@pytest.mark.parametrize("suffix", [".csv", ".parquet"])
@pytest.mark.parametrize(("column", "row"), [("pos_leg_rf", 5), ("t", 7), ("cmd_wheel_lf", 0), ("cam_x", 0), ("volt", 299)])
def test_infinity(tmp_path, table, column, row, suffix):
    table[column][row] = np.inf
    refused(write_raw(tmp_path / f"run_01{suffix}", table), f"row {row}", f"'{column}'", "inf")


@pytest.mark.parametrize("column", ["t", "pos_leg_lf", "pos_wheel_rr"])
def test_missing_value_in_a_required_column(tmp_path, table, column):
    table[column][9] = np.nan
    refused(write_raw(tmp_path / "run_01.csv", table), "row 9", f"'{column}'", "no value")


def test_broken_lines_of_a_csv_file(tmp_path, table):
    path = write_raw(tmp_path / "run_01.csv", table)
    lines = path.read_text().splitlines()
    path.write_text("\n".join([lines[0] + ",volt", *[line + ",12.0" for line in lines[1:]]]))
    refused(path, "'volt' occurs twice")
    path.write_text("\n".join([*lines[:4], lines[4].rpartition(",")[0], *lines[5:]]))
    refused(path, "row 3", "44 values", "45 columns")
    cells = lines[6].split(",")
    path.write_text("\n".join([*lines[:6], ",".join([*cells[:3], "n/a", *cells[4:]]), *lines[7:]]))
    refused(path, "row 5 (line 7)", "'cmd_leg_lr'", "'n/a' is not a number")
    path.write_text(lines[0])
    refused(path, "0 rows")


def test_unequal_columns(tmp_path, table):
    table["volt"] = table["volt"][:-1]
    with pytest.raises(InputError, match=r"'volt' has shape \(299,\), 't' has 300 rows"):
        write_run(tmp_path / "run_01.csv", table)


def test_text_column_in_parquet(tmp_path, table):
    table["volt"] = np.array(["twelve"] * 300)
    refused(write_raw(tmp_path / "run_01.parquet", table), "'volt'", "string")


@pytest.mark.parametrize("name", ["run_01.csv", "run_01.parquet"])
@pytest.mark.parametrize("content", [b"", b"\xff\xfe\x00junk"])
def test_not_a_table_at_all(tmp_path, content, name):
    (tmp_path / name).write_bytes(content)
    refused(tmp_path / name)
    refused(tmp_path / "nothing_here.csv")
    refused(tmp_path / "run_01.txt")


# --- unit mistakes ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("suffix", [".csv", ".parquet"])
@pytest.mark.parametrize(
    ("column", "factor", "looks_like"),
    [
        ("pos_leg_lf", DEGREES, "degrees"),
        ("cmd_leg_rr", DEGREES, "degrees"),
        ("pos_wheel_lf", DEGREES, "degrees"),
        ("cmd_wheel_rf", DEGREES, "degrees"),
        ("vel_leg_lr", DEGREES, "degrees"),
        ("vel_wheel_rr", DEGREES, "degrees"),
        ("gyro_z", DEGREES, "degrees"),
        ("cam_yaw", DEGREES, "degrees"),
        ("cam_pitch", DEGREES, "degrees"),
        ("cam_x", 1000, "millimetres"),
        ("cam_y", 1000, "millimetres"),
        ("cam_z", 1000, "millimetres"),
        ("eff_leg_lf", 1000, "mA or mN m"),
        ("eff_wheel_lf", 1000, "mA or mN m"),
        ("volt", 1000, "millivolts"),
        ("t", 1000, "milliseconds"),
    ],
)
def test_wrong_unit_in_one_column(tmp_path, table, column, factor, looks_like, suffix):
    table[column] = table[column] * factor
    refused(write_raw(tmp_path / f"run_01{suffix}", table), f"'{column}'", "row ", looks_like)


@pytest.mark.parametrize("kind", ["pos_", "vel_", "cmd_", ""])
def test_wrong_unit_in_a_whole_kind(tmp_path, table, kind):
    for name in (name for name in table if name.startswith(kind) and COLUMNS[name].unit.startswith("rad")):
        table[name] = table[name] * DEGREES
    refused(write_raw(tmp_path / "run_01.csv", table), f"'{kind}", "degrees")


@pytest.mark.parametrize("column", ["cmd_wheel_lf", "vel_wheel_lf", "vel_leg_rr"])
def test_one_value_of_a_rate_does_not_tell_degrees_from_rpm(tmp_path, table, column):
    table[column] = np.full(len(table["t"]), 30.0)
    refused(write_raw(tmp_path / "run_01.csv", table), f"'{column}': 30", "degrees per second (57.3 times) or rpm (9.55 times)")


def test_acceleration_in_g(tmp_path, table):
    for axis in "xyz":
        table[f"acc_{axis}"] = table[f"acc_{axis}"] / 9.81
    refused(write_raw(tmp_path / "run_01.csv", table), "'acc_z'", "multiples of g")


def test_outliers_are_no_unit_mistake(table):
    table["cam_x"][np.flatnonzero(np.isfinite(table["cam_x"]))[::15]] += 3.0  # misdetections
    table["vel_wheel_lf"][::30] = 40.0  # broken packets
    table["gyro_z"][::40] = 34.0
    check_table(table, "run.csv")


def test_fast_driving_is_no_unit_mistake(table):
    for wheel in WHEELS:
        table[f"cmd_{wheel}"] = np.full(300, 6.4)
        table[f"pos_{wheel}"] = 6.4 * table["t"]
        table[f"vel_{wheel}"] = np.full(300, 6.4)
    check_table(table, "run.csv")


# --- findings ---------------------------------------------------------------------------------------------------------


def test_gaps_are_reported_with_their_rows(table):
    keep = np.ones(300, dtype=bool)
    keep[40:50] = keep[200] = False
    before = findings_of(table, "gap").get("t", ())
    rows = findings_of({name: values[keep] for name, values in table.items()}, "gap")["t"]
    assert {39, 189} <= set(rows)
    assert len(rows) == len(before) + 2


def test_another_rate_is_reported(table):
    table["t"] = table["t"] / 2
    assert "t" in findings_of(table, "rate")


def test_duplicate_camera_frames(table):
    frames = np.flatnonzero(np.isfinite(table["cam_x"]))
    for name in CAMERA:
        table[name][frames[[20, 40]]] = table[name][frames[[19, 39]]]
    assert findings_of(table, "duplicate") == {"cam_x": (frames[20], frames[40])}


def test_duplicate_rows(table):
    for name in table:
        if name != "t" and not name.startswith("cam"):
            table[name][50] = table[name][49]
    assert 50 in next(iter(findings_of(table, "duplicate").values()))


@pytest.mark.parametrize(
    "column", ["gyro_x", "acc_z", "eff_leg_lf", "cam_y", "volt", "pos_leg_lf", "vel_leg_lf", "vel_wheel_lf"]
)
def test_dead_channel(table, column):
    table[column] = np.where(np.isnan(table[column]), np.nan, table[column][0])
    assert column in findings_of(table, "constant")


def test_channel_that_dies_half_way(table):
    table["gyro_y"][150:] = table["gyro_y"][150]
    assert findings_of(table, "constant") == {"gyro_y": (150,)}


@pytest.mark.parametrize(("column", "share"), [("gyro_z", 0.5), ("gyro_y", 0.5), ("acc_x", 0.5), ("eff_leg_lf", 0.7)])
def test_clipped_channel(table, column, share):
    limit = share * np.abs(table[column]).max()
    table[column] = np.clip(table[column], -limit, limit)
    assert column in findings_of(table, "clipped")


def test_missing_values(table):
    table["eff_leg_rf"][[3, 8]] = np.nan
    table["volt"][:] = np.nan
    assert findings_of(table, "missing") == {"eff_leg_rf": (3, 8), "volt": (0,)}


# --- meta and data sets -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("profil: {}", ["unknown key 'profil'", "did you mean 'profile'"]),
        ("profile: {leg_velocty: 1.0}", ["profile.leg_velocty", "did you mean 'leg_velocity'"]),
        ("profile: {leg_velocity: -1}", ["profile.leg_velocity", "-1"]),
        ("marker_offset: [0, 0]", ["marker_offset"]),
        ("marker_offset: [0, 0, 85]", ["marker_offset", "millimetres"]),
        ("robot: [", ["broken YAML", "line 1"]),
        ("just text", ["expected keys and values"]),
    ],
)
def test_bad_meta_is_refused(tmp_path, text, words):
    (tmp_path / "meta.yaml").write_text(text)
    with pytest.raises(InputError) as error:
        read_meta(tmp_path)
    for word in ("meta.yaml", *words):
        assert word in str(error.value)


@pytest.mark.parametrize("text", [None, "", "{}"])
def test_meta_is_optional(tmp_path, text):
    if text is not None:
        (tmp_path / "meta.yaml").write_text(text)
    assert read_meta(tmp_path) == RunMeta(profile=Profile(wheel_acceleration=0, leg_velocity=0, leg_acceleration=0))


def test_dataset_is_read_in_the_order_of_the_numbers(tmp_path, table):
    for number in (10, 2, 1):
        write_run(tmp_path / f"run_{number}.parquet", table, RunMeta(ground="mat"))
    data = read_dataset(tmp_path)
    assert [run.name for run in data.runs] == ["run_1", "run_2", "run_10"]
    assert data.meta.ground == "mat"


def test_a_policys_log_beside_a_run_is_no_run(tmp_path, table):
    write_run(tmp_path / "run_01.csv", table)
    (tmp_path / "run_01.policy.csv").write_text("command_yaw_rate,action_leg_lf\n0.1,0.2\n")
    assert [run.name for run in read_dataset(tmp_path).runs] == ["run_01"]


def test_dataset_refuses_what_is_no_data_set(tmp_path, table):
    with pytest.raises(InputError, match="no such folder"):
        read_dataset(tmp_path / "nowhere")
    write_run(tmp_path / "inside" / "run_01.csv", table)
    with pytest.raises(InputError, match="its folders inside have some"):
        read_dataset(tmp_path)
    write_run(tmp_path / "inside" / "run_01.parquet", table)
    with pytest.raises(InputError, match="same run"):
        read_dataset(tmp_path / "inside")


# --- writing ----------------------------------------------------------------------------------------------------------


def test_writing_refuses_what_reading_refuses(tmp_path, table):
    table["gyro_x"][4] = np.inf
    with pytest.raises(InputError, match=r"row 4 \(line 6\), column 'gyro_x'"):
        write_run(tmp_path / "run_01.csv", table)
    assert list(tmp_path.iterdir()) == []


def test_writing_does_not_overwrite_other_meta_data(tmp_path, table):
    write_run(tmp_path / "run_01.csv", table, RunMeta(ground="mat"))
    write_run(tmp_path / "run_02.csv", table, RunMeta(ground="mat"))
    told = "says something else .*: ground is 'mat' there, 'tiles' for the new run; notes is not stated there, 'wet' for the"
    with pytest.raises(InputError, match=told):
        write_run(tmp_path / "run_03.csv", table, RunMeta(ground="tiles", notes="wet"))


def test_a_broken_write_leaves_the_old_file(tmp_path, table, monkeypatch):
    path = write_run(tmp_path / "run_01.csv", table)
    before = path.read_bytes()
    monkeypatch.setattr("wlr_gym.data.runs.write_csv", lambda path, columns: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        write_run(path, table)
    assert path.read_bytes() == before
    assert list(tmp_path.iterdir()) == [path]


def bits(values: np.ndarray) -> np.ndarray:
    """The bits of floats, with every NaN alike."""
    return np.where(np.isnan(values), np.nan, values).view(np.int64)


@settings(max_examples=40, deadline=None)
@given(data=st.data(), suffix=st.sampled_from([".csv", ".parquet"]))
def test_round_trip_keeps_every_bit(tmp_path_factory, data, suffix):
    rows = data.draw(st.integers(2, 12))
    finite = hnp.arrays(np.float64, rows, elements=st.floats(-3, 3, allow_nan=False))
    with_nan = hnp.arrays(np.float64, rows, elements=st.floats(-3, 3) | st.just(np.nan))
    steps = data.draw(hnp.arrays(np.float64, rows, elements=st.floats(1e-3, 0.9)))
    table = {name: data.draw(with_nan if column.may_be_nan else finite) for name, column in COLUMNS.items() if column.required}
    table["t"] = np.cumsum(steps)
    table["volt"] = data.draw(finite)
    path = write_run(tmp_path_factory.mktemp("runs") / f"run_01{suffix}", table)
    run = read_run(path)
    assert set(run.table.columns) == set(table)
    for name, values in table.items():
        np.testing.assert_array_equal(bits(run[name]), bits(values))


def test_convert_there_and_back(tmp_path):
    shutil.copytree(DATA, tmp_path / "a")
    written = convert(tmp_path / "a", tmp_path / "b", ".csv")
    assert [path.name for path in written] == ["run_01.csv"]
    convert(written[0], tmp_path / "c" / "run_01.parquet")
    first, last = read_run(tmp_path / "a" / "run_01.parquet"), read_run(tmp_path / "c" / "run_01.parquet")
    np.testing.assert_array_equal(first.table.to_numpy().view(np.int64), last.table.to_numpy().view(np.int64))
    assert first.meta == last.meta
    with pytest.raises(InputError, match="format of a data set"):
        convert(tmp_path / "a", tmp_path / "d", ".mat")


def test_a_profile_that_is_not_stated_is_not_stated_in_a_copy(tmp_path, table):
    """Where nobody knows the servo profile, a converted or exported run does not claim that there was none."""
    run = write_run(tmp_path / "a" / "run_01.csv", table, RunMeta(ground="mat"))
    convert(run.parent, tmp_path / "b", ".parquet")
    assert not read_meta(tmp_path / "b").states_profile
    assert read_exported(export_run(read_run(run), tmp_path / "run_01.mcap")).meta.content() == {
        "ground": "mat",
        "marker_offset": [0.0, 0.0, 0.0],
    }
    write_run(tmp_path / "c" / "run_01.csv", table, RunMeta(profile=Profile()))
    assert read_meta(tmp_path / "c").states_profile


def test_every_joint_has_its_columns():
    for joint in JOINTS:
        assert {f"cmd_{joint}", f"pos_{joint}"} <= set(REQUIRED)
        assert COLUMNS[f"cmd_{joint}"].unit == ("rad" if joint in LEGS else "rad/s")
