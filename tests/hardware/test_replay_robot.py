"""``wlr replay --backend dynamixel``: a run's commands on the emulated robot, compared with the run."""

import json

import numpy as np
import pandas
import pytest

from wlr_gym.base.errors import InputError
from wlr_gym.cli import record, replay
from wlr_gym.cli.options import RobotOption
from wlr_gym.data import read_run
from wlr_gym.data.excitations import excite
from wlr_gym.data.format import COMMANDS
from wlr_gym.data.record import record_simulation
from wlr_gym.data.replay import compare_repeat
from wlr_gym.robot import load_robot

pytest.importorskip("dynamixel_sdk")
pytest.importorskip("serial")

from wlr_gym.hardware.emulator import Machine, MachineOptions
from wlr_gym.hardware.emulator.line import NO_TIME
from wlr_gym.hardware.emulator.link import emulated_link

ROBOT = load_robot("emanual")


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A run of the emulated robot: 4 s of spins and arcs."""
    out = tmp_path_factory.mktemp("measured")
    assert record.run(record.RecordOptions(excitation=("turns",), out=out, emulated=True, noise_seed=0, seconds=4.0)) == 0
    return read_run(out / "run_01.csv")


def again(run, out, **options):
    code = replay.run(replay.ReplayOptions(run.path, out, backend="dynamixel", plots=False, **{"emulated": True, **options}))
    return code, json.loads((out / "errors.json").read_text())["run_01"]


@pytest.mark.slow
def test_the_same_robot_does_the_same(run, tmp_path, capsys):
    """In emulated time the same robot, driven by the same setpoints from the same pose, gives the same bits."""
    code, errors = again(run, tmp_path)
    assert code == 0
    assert max(error["full_run_in_noise_units"] for error in errors.values()) < 1.0  # it starts half a count beside the run
    assert {"pos_leg_lf", "vel_wheel_rr", "gyro_z", "volt"} <= set(errors)
    assert not any(name.startswith("cam") for name in errors)
    repeated = read_run(tmp_path / "robot/run_01/run_01.csv")
    assert repeated.meta.profile == run.meta.profile
    for name in COMMANDS:
        np.testing.assert_array_equal(repeated[name][: len(run.table)], run[name], err_msg=name)
    assert again(repeated, tmp_path / "twice")[0] == 0
    twice = read_run(tmp_path / "twice/robot/run_01/run_01.csv")
    pandas.testing.assert_frame_equal(twice.table.iloc[: len(repeated.table)], repeated.table, check_exact=True)
    text = capsys.readouterr().out
    assert "Measured minus repeated" in text
    assert f"run_01: {len(run.table)} of {len(run.table)} steps driven; command limiter: " in text


def test_another_robot_shows(run, tmp_path):
    code, errors = again(run, tmp_path, effects=("tired_battery",))
    assert code == 0
    assert errors["volt"]["full_run_in_noise_units"] > 5
    assert errors["pos_wheel_lf"]["segment_in_noise_units"] > 2
    assert errors["pos_wheel_lf"]["segment_rms"] < errors["pos_wheel_lf"]["full_run_rms"]


def test_a_robot_that_stops_ends_it(run, tmp_path, monkeypatch, capsys):
    machine = Machine(ROBOT, RobotOption().load_hardware(), MachineOptions(timing=NO_TIME))
    machine.inject("dead wheel_lf after=2.5")
    monkeypatch.setattr("wlr_gym.hardware.plant.link_of", lambda *args: emulated_link(machine))
    options = replay.ReplayOptions(run.path, tmp_path, backend="dynamixel", plots=False, emulated=True)
    assert replay.run(options) == 1
    assert "stopped: " in capsys.readouterr().out
    assert len(read_run(tmp_path / "robot/run_01/run_01.csv").table) > 10
    assert not (tmp_path / "errors.json").exists()


def test_segments_forgive_what_wheels_drifted_and_nothing_else(tmp_path):
    measured = read_run(record_simulation(tmp_path / "run_01.parquet", excite("turns", 1, seconds=4.0), ROBOT, "gibbs_appell"))
    table = measured.table.copy()
    table["t"] += 17.0
    table["pos_wheel_rr"] += np.linspace(0.0, 0.4, len(table))
    table["pos_leg_rr"] += 0.01
    repeated = type(measured)(table.iloc[:-30], measured.meta, measured.path)
    result = compare_repeat(measured, repeated)
    assert result.errors["pos_wheel_lf"].full_run_rms < 1e-12
    assert result.errors["pos_wheel_rr"].full_run_rms == pytest.approx(0.4 * 0.85 / np.sqrt(3), rel=0.02)
    assert result.errors["pos_wheel_rr"].segment_rms == pytest.approx(0.1 / np.sqrt(3), rel=0.1)  # the last one is shorter
    assert result.errors["pos_leg_rr"].segment_rms == pytest.approx(0.01)
    assert np.isnan(result.full["gyro_z"][-29:]).all()
    assert result.starts == (0, 50, 100, 150)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"backend": "mujoco"}, "--emulated: it is about the robot: add --backend dynamixel"),
        ({"backend": "mujoco", "emulated": False, "hardware": "no.yaml"}, "--hardware: it is about the robot: add --backend"),
        ({"backend": "mujoco", "emulated": False, "yes": True}, "--yes: it is about the robot: add --backend dynamixel"),
        ({"video": "a.webp"}, "--video: a film needs a simulator"),
        ({"emulated": False, "port": ("leg=/dev/x",), "yes": True}, "unknown port 'leg'"),
    ],
)
def test_refusals(run, tmp_path, options, words):
    with pytest.raises(InputError, match=words):
        replay.run(replay.ReplayOptions(run.path, tmp_path / "out", **{"backend": "dynamixel", "emulated": True, **options}))
