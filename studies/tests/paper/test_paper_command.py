"""``python -m studies.paper``: files, and refusals that leave nothing behind."""

import json
import os
import signal

import numpy as np
import pytest

from studies.paper.__main__ import PaperOptions, run
from studies.paper.experiments import PROFILE, TESTS
from wlr_gym.base.errors import InputError
from wlr_gym.cli import run_options
from wlr_gym.cli.options import parse
from wlr_gym.data.record import read_commands
from wlr_gym.hardware.loop import Phase, StoppedError


def run_paper(words):
    return run_options(parse(PaperOptions, "python -m studies.paper", words), run)


@pytest.mark.slow
def test_report_is_written(tmp_path, capsys):
    out = tmp_path / "out"
    assert run_paper(["--out", str(out), "--plant", "gibbs_appell", "--draws", "0"]) == 0
    names = {path.name for path in out.iterdir()}
    figures = {f"figure_{number:02d}.png" for number in (7, 8, 9, 10, 11, 13, 14, 15, 16, 17)}
    assert names >= figures | {"test_1_slip.png", "test_2_slip.png"}
    assert names >= {"report.md", "claims.json", "agreement.json", "search.json", "config.yaml", "provenance.yaml"}
    assert len(json.loads((out / "claims.json").read_text())) == 25
    text = (out / "report.md").read_text()
    assert "| gibbs_appell | test_2 |" in text
    assert "(30)" in text
    assert "does not hold" in capsys.readouterr().out
    for name, test in TESTS.items():
        motion = read_commands(out / "commands" / f"{name}.csv")
        np.testing.assert_array_equal(motion.setpoints, test.motion().setpoints)
        assert motion.profile == PROFILE


def test_a_robot_is_asked_for_and_guarded(tmp_path, monkeypatch):
    """Like every command that moves a robot: nothing is driven without somebody there."""
    made = []
    monkeypatch.setattr("studies.paper.__main__.PaperOptions.plant_of", lambda *given: made.append(given))
    monkeypatch.setattr("builtins.input", lambda *_: (_ for _ in ()).throw(EOFError))
    words = ["--out", str(tmp_path / "out"), "--plant", "dynamixel", "--draws", "0"]
    with pytest.raises(InputError, match="legs port /dev/ttyUSB0: not there"):
        run_paper(words)
    with pytest.raises(InputError, match="nobody there to start the robot"):
        run_paper([*words, "--port", *(f"{name}=/dev/null" for name in ("legs", "wheels", "imu"))])
    assert not made


def test_an_interrupt_leaves_no_folder(tmp_path, monkeypatch):
    def interrupt(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr("studies.paper.experiments.drive_both", interrupt)
    with pytest.raises(KeyboardInterrupt):
        run_paper(["--out", str(tmp_path / "out"), "--plant", "gibbs_appell", "--draws", "0"])
    assert not (tmp_path / "out").exists()


def test_a_robot_that_had_to_stop_ends_the_command(tmp_path, monkeypatch, capsys):
    def stop(*_):
        raise StoppedError("a leg is too hot")

    monkeypatch.setattr("studies.paper.experiments.drive_plant", stop)
    arguments = ["--out", str(tmp_path / "out"), "--plant", "dynamixel", "--emulated", "--draws", "0"]
    assert run_paper(arguments) == 1
    assert "a leg is too hot" in capsys.readouterr().out


@pytest.mark.slow
def test_an_emulated_robot_drives_both_tests_and_keeps_its_runs(tmp_path):
    out = tmp_path / "out"
    arguments = ["--out", str(out), "--plant", "dynamixel", "--emulated", "--draws", "0", "--no-plots"]
    assert run_paper(arguments) == 0
    assert len(list((out / "runs").glob("run_*.csv"))) == 2
    assert "| dynamixel | test_2 |" in (out / "report.md").read_text()


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--plant", "mujocco"], "did you mean 'mujoco'"),
        (["--draws", "-1"], "--draws -1"),
        (["--levels", "4"], "--levels 4"),
        (["--threads", "0"], "--threads 0"),
        (["--robot", "nowhere"], "nowhere"),
        (["--emulated"], "add dynamixel to --plant"),
        (["--plant", "dynamixel", "--hardware", "nowhere"], "nowhere"),
    ],
)
def test_bad_input_is_named_and_leaves_no_folder(tmp_path, arguments, words):
    out = tmp_path / "out"
    with pytest.raises(InputError, match=words):
        run_paper(["--out", str(out), *arguments])
    assert not out.exists()


@pytest.mark.parametrize("signals", [0, 1])
def test_a_robot_is_stopped_while_signals_are_looked_at(tmp_path, monkeypatch, capsys, signals):
    """Not by closing it, when Ctrl-C would interrupt the stop."""
    pytest.importorskip("dynamixel_sdk")
    phases, handler = [], signal.getsignal(signal.SIGINT)

    def drive(plant, *_):
        phases.append(plant.loop.phase)
        plant.reset()
        plant.step(np.r_[[np.pi / 2] * 4, [0.0] * 4][None])
        plant.loop.operator.spare = lambda: phases.append((plant.loop.phase, signal.getsignal(signal.SIGINT) is not handler))
        for _ in range(signals):
            os.kill(os.getpid(), signal.SIGINT)

    monkeypatch.setattr("studies.paper.experiments.drive_plant", drive)
    monkeypatch.setattr(
        "studies.paper.report.what_would_decide", lambda *_: (_ for _ in ()).throw(RuntimeError("both were driven"))
    )
    monkeypatch.setattr("studies.paper.claims.gather", lambda *_: None)
    monkeypatch.setattr("studies.paper.claims.check_all", lambda *_: [])
    arguments = ["--out", str(tmp_path / "out"), "--plant", "dynamixel", "--emulated", "--draws", "0"]
    monkeypatch.setattr("studies.paper.experiments.drive_both", lambda *_: {})
    if signals:
        assert run_paper(arguments) == 1
        assert "the test is over; SIGINT" in capsys.readouterr().out
    else:
        with pytest.raises(RuntimeError, match="both were driven"):
            run_paper(arguments)
    assert phases.count(Phase.TORQUE_OFF) == 2 - signals
    assert set(phases) == {Phase.TORQUE_OFF, (Phase.STOPPING, True)}
