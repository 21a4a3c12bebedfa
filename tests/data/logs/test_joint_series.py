"""What a log leaves open about joints: motors that were off, wheel angles that start anew after a turn."""

import numpy as np
import pandas
import pytest
from foreign_logs import made_up, rows_of

from wlr_gym.data import read_run, write_run
from wlr_gym.data.logs import export_run, import_log
from wlr_gym.robot import JOINTS, LEGS, WHEELS

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
