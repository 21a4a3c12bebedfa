"""``wlr emulate``: what it prints, takes and refuses."""

import os
import shlex
import socket
import subprocess
import sys

import numpy as np
import pytest

from wlr_gym.base.errors import InputError
from wlr_gym.cli import emulate, main
from wlr_gym.hardware.calibration import find_sign
from wlr_gym.hardware.emulator.server import run_command
from wlr_gym.robot import JOINTS, LEGS

pytest.importorskip("termios")


def options(**changes):
    return emulate.EmulateOptions(**{"seconds": 0.05, **changes})


def test_prints_ports_and_ends(tmp_path, capsys):
    assert emulate.run(options(links=tmp_path, stepped=True)) == 0
    lines = capsys.readouterr().out.splitlines()
    assert [line.split()[0] for line in lines] == ["legs", "wheels", "imu"]
    assert str(tmp_path / "legs") in lines[0]
    assert "XM540-W150-R, 1000000 bit/s: leg_lf, leg_rf, leg_lr, leg_rr" in lines[0]
    assert os.listdir(tmp_path) == []


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("--fault 'dorp legs'", "did you mean 'drop'"),
        ("--backend dynamixel", "--backend: unknown backend 'dynamixel'; valid: gibbs_appell, mujoco\n"),
        ("--robot nominl", "did you mean 'nominal'"),
        ("--hardware nominl", "did you mean 'nominal'"),
        ("--tick 0", "--tick 0: expected more than 0 s"),
        ("--usb-latency -1", "--usb-latency -1: expected 0 or more s"),
        ("--firmware 300", "--firmware 300: expected a number from 0 to 255"),
        ("--seconds -3", "--seconds -3: expected 0 or more s"),
    ],
)
def test_refusals(words, message, capsys):
    assert main(["emulate", *shlex.split(words)]) == 2
    assert message in capsys.readouterr().err


@pytest.mark.parametrize(
    ("option", "words"),
    [
        ({"control": "mine"}, "--control .*mine: is there and no socket"),
        ({"links": "links"}, "--links .*links: 'legs' in it is no emulator's link"),
        ({"links": "adapters"}, "--links .*adapters: 'legs' in it is no emulator's link"),
        ({"links": "mine"}, "--links .*mine: cannot be a folder: it is a file"),
        ({"poses": "mine"}, "--poses .*mine: is there and no file of poses"),
    ],
)
def test_what_is_there_is_left_alone(tmp_path, option, words):
    for folder in ("links", "adapters"):
        (tmp_path / folder).mkdir()
    adapter = tmp_path / "adapters" / "legs"
    adapter.symlink_to("/dev/null")
    mine = [tmp_path / "mine", tmp_path / "links" / "legs"]
    for path in mine:
        path.write_text("precious")
    with pytest.raises(InputError, match=words):
        emulate.run(options(stepped=True, **{name: tmp_path / value for name, value in option.items()}))
    assert [path.read_text() for path in mine] == ["precious"] * 2
    assert not any(path.is_symlink() for path in (tmp_path / "links").iterdir())
    assert str(adapter.readlink()) == "/dev/null"


def test_what_an_emulator_left_is_replaced(tmp_path):
    places = {name: tmp_path / name for name in ("control", "links", "poses")}
    (tmp_path / "links").mkdir()
    (tmp_path / "links" / "legs").symlink_to("/dev/pts/gone")
    with socket.socket(socket.AF_UNIX) as stale:
        stale.bind(str(tmp_path / "control"))
    for _ in range(2):
        assert emulate.run(options(stepped=True, **places)) == 0


def test_the_control_socket_of_another_emulator_is_left_alone(tmp_path):
    with socket.socket(socket.AF_UNIX) as other:
        other.bind(str(tmp_path / "control"))
        other.listen()
        with pytest.raises(InputError, match="another emulator listens there"):
            emulate.run(options(stepped=True, control=tmp_path / "control"))


def test_effects_are_taken_by_name_and_refused_when_unknown():
    assert emulate.run(options(stepped=True, effects=("tired_battery",))) == 0
    with pytest.raises(InputError, match="did you mean 'tired_battery'"):
        emulate.run(options(stepped=True, effects=("tired_batery",)))


def test_a_robot_on_a_stand_keeps_what_hands_did_while_nobody_is_quick():
    """What practising ``wlr calibrate joints`` takes: on the floor a robot without torque collapses."""
    machine = emulate.machine_of(options(stand=True, tick=0.002))

    def counts(command=None):
        if command:
            run_command(machine, command)
        machine.advance(5.0)
        return np.array([machine.servos[joint]["present_position"] for joint in JOINTS])

    for joint in ("leg_rf", "wheel_lr"):
        before = counts()
        after = counts(f"turn {joint} 60")
        assert find_sign(joint, before, after) == machine.hardware.joints[joint].sign
    for k, leg in enumerate(LEGS):
        assert counts(f"straighten {leg}")[k] == 2048
    with pytest.raises(InputError, match="unknown leg 'leg_fl'"):
        run_command(machine, "straighten leg_fl")


@pytest.mark.slow
def test_takes_command_lines_from_a_pipe():
    script = "from wlr_gym.cli import emulate; emulate.run(emulate.EmulateOptions(stepped=True, seconds=1.0))"
    text = "drop legs probability=0.5\nfaults\nstep 0.25\nnonsense\n"
    done = subprocess.run([sys.executable, "-c", script], input=text, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    lines = done.stdout.splitlines()[3:]
    assert lines[0] == "0.000 s: drop legs probability=0.5"
    assert lines[1] == "drop legs probability=0.5"
    assert lines[2] == "0.250 s"
    assert lines[3].startswith("error: unknown command 'nonsense'")
