"""Recordings that cannot be true are refused with row, channel and reason; with keep-going what comes before is imported."""

import numpy as np
import pandas
import pytest
from foreign_logs import made_up, rows_of

from wlr_gym.base.errors import InputError
from wlr_gym.cli import BAD_INPUT, OK, main
from wlr_gym.data import read_run
from wlr_gym.data.logs import import_log
from wlr_gym.data.logs.map import map_text
from wlr_gym.robot import JOINTS, LEGS, WHEELS

MAP = {
    "joints": dict(zip(JOINTS, JOINTS, strict=True)),
    "channels": {
        **{kind: {"topic": "table", "field": f"{kind}_{{joint}}"} for kind in ("cmd", "pos", "vel")},
        **{kind: {"topic": "table", "field": f"{kind}_{{axis}}"} for kind in ("gyro", "acc")},
        "cam": {"topic": "table", "field": "cam_{axis}"},
        "cam_yaw": {"topic": "table", "field": "cam_yaw"},
    },
}
#: Row of 1200 from which on something else is recorded.
LATER = 700


@pytest.fixture(scope="module")
def table():
    return pandas.DataFrame(rows_of(made_up(24.0)))


def later(columns, change):
    def spoil(table):
        kept = table.index < LATER
        return table.assign(**{name: table[name].where(kept, change(table[name])) for name in columns})

    return spoil


def interleaved(table):
    """Two recordings row by row; the second robot stood elsewhere, and its clock is 5 ms behind."""
    other = table.assign(t=table["t"] + 0.005, **{f"pos_{leg}": table[f"pos_{leg}"] + 0.6 for leg in LEGS})
    return pandas.concat([table, other[LATER:]]).sort_values("t")


def of_legs(kind):
    return [f"{kind}_{leg}" for leg in LEGS]


GYRO = [f"gyro_{axis}" for axis in "xyz"]
#: What is done to the later part -> words of the refusal; the row where it begins to show.
FAULTS = {
    "two recordings": (interleaved, r"column 'pos_leg_lf': jumps by 0.6 rad, .* two recordings in one", 701),
    "legs in degrees": (later(of_legs("pos"), np.rad2deg), r"'pos_leg_lf': \d+\S*; expected rad, looks like degrees", 700),
    "legs in turns": (
        later([*of_legs("pos"), *of_legs("vel")], lambda one: one / 6.283), r"column 'pos_leg_lf': jumps by 1.\d+ rad", 700
    ),
    "setpoints in degrees": (later(of_legs("cmd"), np.rad2deg), r"column 'cmd_leg_lf': .* looks like degrees", 700),
    "rates in turns": (
        later([f"vel_{wheel}" for wheel in WHEELS], lambda one: one / 6.283),
        r"column 'vel_\w+': from here on 0.1\d+ times the rate of 'pos_\w+'",
        None,
    ),
    "gyroscope in degrees": (later(GYRO, np.rad2deg), "column 'gyro_z': from here on 5\\d\\S* times", None),
    "gyroscope in turns": (later(GYRO, lambda one: one / 6.283), "column 'gyro_z': from here on 0.1", None),
    "infinite value": (later(["gyro_x"], lambda one: one.where(one.index != 900, np.inf)), "'gyro_x': inf; expected", 900),
}  # fmt: skip


@pytest.mark.parametrize("fault", FAULTS)
def test_what_cannot_be_true_is_refused_or_cut(fault, table, tmp_path):
    spoil, message, row = FAULTS[fault]
    spoil(table).to_csv(tmp_path / "a.csv", index=False)
    with pytest.raises(InputError, match=message) as error:
        import_log(tmp_path / "a.csv", tmp_path / "runs", MAP)
    assert row is None or f"row {row} " in str(error.value)
    assert "--keep-going imports" in str(error.value)
    assert not (tmp_path / "runs").exists()
    (imported,) = import_log(tmp_path / "a.csv", tmp_path / "runs", MAP, keep_going=True)
    run = read_run(imported.path)
    assert 0.7 * LATER < len(run["t"]) <= (row or LATER)
    assert np.allclose(run["pos_leg_lf"], table["pos_leg_lf"][: len(run["t"])])
    assert np.allclose(run["gyro_z"], table["gyro_z"][: len(run["t"])])
    (note,) = [note for note in imported.notes if note.startswith(f"rows from {len(run['t'])} on (")]
    assert "are cut" in note


def test_a_cut_comes_before_the_split(table, tmp_path):
    """Runs after the change would each be in one unit, and pass."""
    later([*of_legs("pos"), *of_legs("vel")], lambda one: one / 6.283)(table).to_csv(tmp_path / "a.csv", index=False)
    with pytest.raises(InputError, match=f"row {LATER} "):
        import_log(tmp_path / "a.csv", tmp_path / "runs", MAP, split=7.0)
    made = import_log(tmp_path / "a.csv", tmp_path / "runs", MAP, split=7.0, keep_going=True)
    assert sum(len(read_run(one.path)["t"]) for one in made) == LATER


def test_nothing_good_is_left_where_it_is_wrong_from_the_start(table, tmp_path, capsys):
    table.assign(**{name: np.rad2deg(table[name]) for name in of_legs("pos")}).to_csv(tmp_path / "a.csv", index=False)
    (tmp_path / "map.yaml").write_text(map_text(MAP))
    words = ["import", str(tmp_path / "a.csv"), "--map", str(tmp_path / "map.yaml"), "--out", str(tmp_path / "runs")]
    assert main([*words, "--keep-going"]) == BAD_INPUT
    assert "looks like degrees" in capsys.readouterr().err
    assert not (tmp_path / "runs").exists()
    later(of_legs("pos"), np.rad2deg)(table).to_csv(tmp_path / "a.csv", index=False)
    assert main([*words, "--keep-going"]) == OK
    assert "rows from 600 on (12.0 of 24.0 s) are cut" in " ".join(capsys.readouterr().out.split())


def test_one_late_row_is_no_jump(table, tmp_path):
    """A row read 15 ms late moves further than its clock says, and less than any motor could."""
    times = table["t"].to_numpy().copy()
    times[500] += 0.015
    table.assign(t=times).to_csv(tmp_path / "a.csv", index=False)
    assert import_log(tmp_path / "a.csv", tmp_path / "runs", MAP)


def test_old_readings_and_the_bias_of_a_gyroscope_are_no_fault(table, tmp_path):
    """Joints are read at 12.5 Hz and logged at 50 Hz: a step between two rows is that of four."""
    old = [f"{kind}_{joint}" for kind in ("pos", "vel") for joint in JOINTS]
    fast = {f"pos_{wheel}": table[f"pos_{wheel}"] + 6.0 * table["t"] for wheel in WHEELS}
    fast |= {f"vel_{wheel}": table[f"vel_{wheel}"] + 6.0 for wheel in WHEELS}
    odd = table.assign(**fast, gyro_z=table["gyro_z"] + 0.3)
    odd[old] = odd[old].iloc[np.arange(len(odd)) // 4 * 4].to_numpy()
    odd.to_csv(tmp_path / "a.csv", index=False)
    assert import_log(tmp_path / "a.csv", tmp_path / "runs", MAP)
