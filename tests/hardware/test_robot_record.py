"""``wlr record``: runs from the emulated robot and from simulators, motions as files, what is refused."""

import io
import json
import signal
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

from wlr_gym.base.errors import InputError
from wlr_gym.base.paths import data_directory
from wlr_gym.cli import record, replay, run_command
from wlr_gym.cli.options import RobotOption
from wlr_gym.data import read_dataset, read_run, simulate_again
from wlr_gym.data.excitations import EXCITATIONS, GENTLE, Motion, excite
from wlr_gym.data.format import COMMANDS, Profile
from wlr_gym.data.record import motion_of, read_commands, record_simulation
from wlr_gym.data.runs import next_run
from wlr_gym.data.sensors import SENSED
from wlr_gym.physics.effects import load_patch
from wlr_gym.robot import JOINTS, load_robot

pytest.importorskip("dynamixel_sdk")
pytest.importorskip("serial")

from wlr_gym.hardware import plant
from wlr_gym.hardware.deployment import DriveResult
from wlr_gym.hardware.emulator import Machine, MachineOptions
from wlr_gym.hardware.emulator.line import NO_TIME
from wlr_gym.hardware.emulator.link import emulated_link
from wlr_gym.hardware.log import read_events
from wlr_gym.hardware.plant import link_of

ROBOT = load_robot("emanual")


def recorded(out, **options):
    return record.run(record.RecordOptions(out=out, **{"emulated": True, "seconds": 2.0, **options}))


@pytest.fixture
def machine(monkeypatch):
    """The emulated robot that the command is connected to."""
    machine = Machine(ROBOT, RobotOption().load_hardware(), MachineOptions(timing=NO_TIME))
    monkeypatch.setattr("wlr_gym.hardware.plant.link_of", lambda *args: emulated_link(machine))
    return machine


def test_a_robot_that_waits_for_an_operator_is_not_recorded(tmp_path):
    text = (data_directory("configs") / "hardware/nominal.yaml").read_text()
    (tmp_path / "mine.yaml").write_text(text.replace("deadman: null", "deadman: 0.5"))
    with pytest.raises(InputError, match=r"safety\.deadman = 0\.5 s: there is no key"):
        recorded(tmp_path / "runs", hardware=str(tmp_path / "mine.yaml"), excitation=("posture",))


def test_the_emulated_robot_is_driven_and_logged(tmp_path, capsys):
    assert recorded(tmp_path, excitation=("straight", "rear_legs"), ground="cork", seed=3) == 0
    data = read_dataset(tmp_path)
    assert [run.path.name for run in data.runs] == ["run_01.csv", "run_02.csv"]
    assert (data.meta.robot, data.meta.profile, data.meta.ground) == (ROBOT.name, GENTLE, "cork")
    for run, name in zip(data.runs, ("straight", "rear_legs"), strict=True):
        motion = excite(name, 3, ROBOT, seconds=2.0)
        logged = np.stack([run[name] for name in COMMANDS], axis=1)
        near = motion.setpoints[: len(logged)]
        assert len(near) == 100
        np.testing.assert_array_equal(np.isnan(logged[:100]), np.isnan(near))
        half_count = np.pi / 4096  # the command limiter leaves them as they are; the registers round them
        np.testing.assert_allclose(logged[:100, :4], near[:, :4], rtol=0.0, atol=1.001 * half_count)
        assert np.diff(run["t"]) == pytest.approx(0.02, abs=1e-9)
        assert {finding.kind for finding in run.findings} <= {"constant"}
        assert read_events(run.path)[-1]["event"] == "end"
    straight = data.runs[0]
    assert np.ptp(straight["pos_wheel_lf"]) > 0.5
    assert straight["pos_wheel_lf"][0] == 0.0
    text = capsys.readouterr().out
    assert "straight: 100 of 100 steps driven; to its end" in text


def noise_of(folder, run="run_01", **options):
    """Record a motion; return the accelerometer's rows of a run, and the seed that its events tell."""
    assert recorded(folder, excitation=("straight",), seconds=0.4, **options) == 0
    (event,) = [event for event in read_events(folder / f"{run}.csv") if event["event"] == "emulated"]
    return read_run(folder / f"{run}.csv")["acc_x"].tolist(), event["noise_seed"]


def test_every_emulated_run_has_other_noise_and_tells_how_to_repeat_it(tmp_path):
    first, seed = noise_of(tmp_path / "first")
    assert noise_of(tmp_path / "second")[0] != first
    assert noise_of(tmp_path / "again", noise_seed=seed) == (first, seed)


def test_the_seed_of_the_motions_decides_the_noise_too(tmp_path):
    first = noise_of(tmp_path / "first", seed=3)
    assert noise_of(tmp_path / "second", seed=3) == first
    assert noise_of(tmp_path / "second", "run_02", seed=3)[0] != first[0]


def test_the_profile_reaches_the_servos(machine, tmp_path, monkeypatch):
    seen = []
    step = machine.step

    def watched_step():
        seen.append([servo["profile_acceleration"] for servo in machine.servos.values()])
        step()

    monkeypatch.setattr(machine, "step", watched_step)
    recorded(tmp_path, excitation=("straight",), seconds=0.2)
    assert seen[-1] == [40] * 4 + [30] * 4
    assert machine.servos["leg_lf"]["profile_velocity"] == 60
    assert not any(servo["torque_enable"] for servo in machine.servos.values())


def test_a_robot_that_stops_leaves_its_log_and_code_1(machine, tmp_path, capsys):
    machine.inject("dead leg_rf after=2.5")
    assert recorded(tmp_path, excitation=("straight", "turns"), seconds=6.0) == 1
    (run,) = read_dataset(tmp_path).runs
    assert 20 < len(run.table) < 300
    text = capsys.readouterr().out
    assert "of 300 steps driven" in text
    assert "turns: " not in text
    assert "not driven: turns" in text
    assert not any(servo["torque_enable"] for servo in machine.servos.values() if not servo.dead)


@pytest.mark.parametrize("name", ["SIGINT", "SIGTERM"])
def test_an_interrupted_record_says_what_it_did_not_drive(machine, tmp_path, monkeypatch, capsys, name):
    step, signals = machine.step, [getattr(signal, name)]

    def interrupted_step():
        step()
        if machine.time > 5.0 and signals:
            signal.raise_signal(signals.pop())

    monkeypatch.setattr(machine, "step", interrupted_step)
    assert recorded(tmp_path, excitation=("straight", "turns", "s_curve"), seconds=9.0, json=True) == 130
    text = capsys.readouterr().out
    assert "not driven: turns, s_curve" in text
    first, *others = json.loads(text[text.index("[\n") :])
    assert name in first["reason"]
    assert [(other["motion"], other["reason"], other["well"]) for other in others] == [
        ("turns", "not driven", False),
        ("s_curve", "not driven", False),
    ]


def test_effects_make_an_emulated_robot_another_one(tmp_path):
    plain, other = tmp_path / "plain", tmp_path / "other"
    for out, effects in ((plain, ()), (other, ("tired_battery",))):
        recorded(out, excitation=("straight",), effects=effects)
    first, second = (read_run(out / "run_01.csv") for out in (plain, other))
    assert second["volt"].mean() < first["volt"].mean() - 0.3
    with pytest.raises(InputError, match="--effects: a real robot has its own"):
        recorded(tmp_path / "real", excitation=("straight",), effects=("tired_battery",), emulated=False, yes=True)


# ---- simulators ----


@pytest.mark.parametrize(("backend", "effects"), [("gibbs_appell", None), ("mujoco", "tired_battery")])
def test_a_simulated_run_repeats_bit_for_bit(tmp_path, backend, effects):
    motion = excite("all_legs", 5, ROBOT, seconds=2.0)
    path = record_simulation(tmp_path / "run_01.parquet", motion, ROBOT, backend, 7, load_patch(effects))
    run = read_run(path)
    again = simulate_again(run, ROBOT)
    for name in SENSED:
        np.testing.assert_array_equal(again[name], run[name], err_msg=name)
    for joint, setpoints in zip(JOINTS, motion.setpoints.T, strict=True):
        np.testing.assert_array_equal(run[f"cmd_{joint}"], setpoints)
    assert run.meta.profile == GENTLE
    assert np.ptp(run["pos_leg_lr"]) > 0.05
    assert all(np.abs(run[f"vel_{joint}"][0]) < 0.05 for joint in JOINTS)  # it starts settled


def test_runs_are_numbered_on(tmp_path, capsys):
    assert recorded(tmp_path, excitation=("straight",), backend="gibbs_appell", emulated=False, seconds=0.5) == 0
    assert recorded(tmp_path, excitation=("turns",), backend="gibbs_appell", emulated=False, seconds=0.5) == 0
    assert [run.path.name for run in read_dataset(tmp_path).runs] == ["run_01.parquet", "run_02.parquet"]
    assert next_run(tmp_path).name == "run_03.parquet"
    assert "straight: 0.5 s on gibbs_appell" in capsys.readouterr().out


# ---- motions as files ----


def test_commands_go_through_a_file(tmp_path, capsys):
    assert recorded(tmp_path, excitation=("rear_legs", "turns"), commands_only=True, seconds=None) == 0
    for name in ("rear_legs", "turns"):
        motion, read = excite(name, 0, ROBOT), read_commands(tmp_path / f"{name}.csv")
        np.testing.assert_array_equal(read.setpoints, motion.setpoints)
        assert (read.period, read.profile, read.name) == (motion.period, GENTLE, name)
    driven = tmp_path / "driven"
    assert recorded(driven, commands=(tmp_path / "turns.csv",), backend="gibbs_appell", emulated=False, seconds=2.0) == 0
    np.testing.assert_array_equal(
        motion_of(read_run(driven / "run_01.parquet")).setpoints, excite("turns", 0, ROBOT).setpoints[:100]
    )
    assert "written:" in capsys.readouterr().out


def test_a_whole_run_is_a_motion_too(tmp_path):
    motion = excite("steps", 1, ROBOT, seconds=2.0)
    run = record_simulation(tmp_path / "run_01.parquet", motion, ROBOT, "gibbs_appell")
    read = read_commands(run)
    np.testing.assert_array_equal(read.setpoints, motion.setpoints)
    assert read.profile == Profile()


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("t,cmd_leg_lf\n0,1\n", "column 'cmd_leg_rf' is missing; found: t, cmd_leg_lf$"),
        ("t;cmd_leg_lf\n0;1\n", "column 't' is missing; separated by ';'. expected ','"),
        ("HEADER\n0,1,1,1,1,0,0,0,0\n", "two rows or more"),
        ("HEADER\n0,1,1,1,1,0,0,0,0\n0,1,1,1,1,0,0,0,0\n", "increasing"),
        (
            "HEADER\n0,1,1,1,1,0,0,0,0\n0.02,1,90,1,1,0,0,0,0\n",
            r"row 1 \(line 3\), column 'cmd_leg_rf': 90: expected -6.28 to 6.28 rad; in degrees\?",
        ),
        (
            "HEADER\n0,1,1,1,1,0,0,0,0\n0.02,1,1,1,1,0,inf,0,0\n",
            r"row 1 \(line 3\), column 'cmd_wheel_rf': inf: expected -30 to 30 rad/s",
        ),
        ("HEADER\n0,1,1,1,1,0,0,0,0\n0.02,1,1,1,x,0,0,0,0\n", "cannot be read"),
    ],
)
def test_command_files_that_are_none(tmp_path, text, words):
    path = tmp_path / "commands.csv"
    path.write_text(text.replace("HEADER", ",".join(["t", *COMMANDS])))
    with pytest.raises(InputError, match=words):
        read_commands(path)


# ---- the command line ----


def test_one_step_is_no_steps(capsys):
    drive = DriveResult(None, "", True, 1, {"interventions": {"slew": 1, "stale": 2}})
    record._report(excite("straight"), drive, Console())
    assert "command limiter: slew in 1 step, stale in 2 steps\n" in capsys.readouterr().out


def test_list_shows_every_excitation(capsys):
    assert record.run(record.RecordOptions(list=True)) == 0
    text = capsys.readouterr().out
    assert all(name in text for name in EXCITATIONS)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({}, "nothing to drive"),
        ({"excitation": ("strait",)}, "did you mean 'straight'"),
        ({"excitation": ("straight", "steps")}, "straight and steps are driven with different servo profiles"),
        ({"excitation": ("straight",), "backend": "mujoco"}, "leave --backend mujoco out"),
        ({"excitation": ("straight",), "backend": "mujocoo", "emulated": False}, "did you mean 'mujoco'"),
        ({"excitation": ("straight",), "out": None}, "--out: expected a folder"),
        ({"commands": ("nowhere.csv",)}, "nowhere.csv: expected a .csv"),
    ],
)
def test_refusals(tmp_path, options, words):
    options = {"out": tmp_path / "runs", **options}
    options["commands"] = tuple(map(Path, options.get("commands", ())))
    with pytest.raises(InputError, match=words):
        recorded(**options)
    assert not (tmp_path / "runs").exists()


def test_a_drive_of_no_time_is_refused(tmp_path):
    with pytest.raises(InputError, match="--seconds -1"):
        run_command("record", ["--excitation", "straight", "--emulated", "--seconds", "-1", "--out", str(tmp_path)])


#: Ports that are there.
THERE = ("legs=/dev/null", "wheels=/dev/null", "imu=/dev/null")


def test_a_real_robot_is_asked_for_first(tmp_path, monkeypatch):
    monkeypatch.setattr("sys.stdin", io.StringIO(""))
    with pytest.raises(InputError, match="nobody there to start the robot"):
        recorded(tmp_path, excitation=("straight",), emulated=False, port=THERE)
    with pytest.raises(InputError, match=r"legs port /dev/ttyUSB0: not there\. Plug the adapter in"):
        recorded(tmp_path, excitation=("straight",), emulated=False)
    assert list(tmp_path.iterdir()) == []


class Operator:
    """Presses Enter so often, and then is gone; what was asked."""

    def __init__(self, times):
        self.times, self.asked = times, []

    def __call__(self, *_):
        self.asked.append("")
        if len(self.asked) > self.times:
            raise EOFError
        return ""


@pytest.fixture
def emulated_as_real(monkeypatch):
    """What is connected is an emulated robot that the commands take for a real one."""
    monkeypatch.setattr("wlr_gym.hardware.safety.preflight.require_ports", lambda hardware: None)
    monkeypatch.setattr(
        plant, "link_of", lambda robot, hardware, options, *rest: link_of(robot, hardware, replace(options, emulated=True))
    )


def test_every_motion_of_a_real_robot_is_asked_for(tmp_path, monkeypatch, capsys, emulated_as_real):
    operator = Operator(1)
    monkeypatch.setattr("builtins.input", operator)
    with pytest.raises(InputError, match="nobody there to start the robot"):
        recorded(tmp_path, excitation=("s_curve", "turns", "straight"), emulated=False, seconds=0.2)
    assert len(operator.asked) == 2
    assert [run.path.name for run in read_dataset(tmp_path).runs] == ["run_01.csv"]
    text = " ".join(capsys.readouterr().out.split())
    assert "stand up and drive s_curve: 0 s; it rolls +0.0 m in all" in text
    assert "stand up and drive turns" in text
    assert "straight" not in text


def test_every_repeated_run_of_a_real_robot_is_asked_for(tmp_path, monkeypatch, emulated_as_real):
    recorded(tmp_path / "runs", excitation=("straight", "turns"), emulated=True, seconds=0.2)
    operator = Operator(1)
    monkeypatch.setattr("builtins.input", operator)
    options = replay.ReplayOptions(tmp_path / "runs", tmp_path / "out", backend="dynamixel", plots=False)
    with pytest.raises(InputError, match="nobody there to start the robot"):
        replay.run(options)
    assert len(operator.asked) == 2
    assert len(list((tmp_path / "out" / "robot").glob("*/run_01.csv"))) == 1


def test_travel_is_what_the_wheels_roll():
    setpoints = np.full((100, 8), np.pi / 2)
    setpoints[:, 4:] = 2.0
    setpoints[50:, 4:] = [-6.0, np.nan, np.nan, -2.0]
    setpoints[99, 4:] = np.nan
    travel = Motion("to and fro", setpoints, 0.02).travel(0.1)
    assert travel.max() == pytest.approx(0.2)
    assert travel[-1] == pytest.approx(0.2 - 49 * 0.02 * 4.0 * 0.1)
