"""The gamepad, on a synthetic byte stream: sticks, dead-man button, stop buttons, unplugging; and a drive with it."""

import os
import struct

import numpy as np
import pytest

pytest.importorskip("dynamixel_sdk")
pytest.importorskip("serial")

from policy_log import read_policy_log
from robot_rig import machine_of

from wlr_gym.base.errors import InputError
from wlr_gym.cli import run_command
from wlr_gym.hardware.config import PadButtons
from wlr_gym.hardware.deployment import deploy, loop_of
from wlr_gym.hardware.log import read_events
from wlr_gym.hardware.operator import DrivingPad, Operator
from wlr_gym.learning.evaluation.rollout import make_core
from wlr_gym.policy import make_policy

RANGES = {"linear_velocity_x": (-0.1, 0.2), "yaw_rate": (-0.5, 0.5)}
BUTTONS = PadButtons()
#: What an Xbox gamepad says when it is opened: 11 buttons up, 8 axes at rest, the triggers (2 and 5) at their end.
AT_START = b"".join(
    [struct.pack("<IhBB", 8000, 0, 0x81, k) for k in range(11)]
    + [struct.pack("<IhBB", 8000, -32767 if k in (2, 5) else 0, 0x82, k) for k in range(8)]
)


def button(number, down):
    return struct.pack("<IhBB", 9000, int(down), 1, number)


def axis(number, value):
    return struct.pack("<IhBB", 9000, value, 2, number)


class Clock:
    time = 0.0

    def now(self):
        return self.time

    def wait_until(self, moment):
        self.time = moment


class Wire:
    """A named pipe that stands for the device."""

    def __init__(self, folder):
        self.path = str(folder / "js0")
        os.mkfifo(self.path)
        self.pad = DrivingPad(self.path, BUTTONS, RANGES)
        self.clock = Clock()
        self.operator = Operator(self.clock)

    def __enter__(self):
        self.pad.__enter__()
        self.end = os.open(self.path, os.O_WRONLY)
        return self

    def __exit__(self, *error):
        self.pad.__exit__(*error)

    def say(self, *events):
        os.write(self.end, b"".join(events))
        self.pad.serve(self.operator)


@pytest.fixture
def wire(tmp_path):
    with Wire(tmp_path) as wire:
        wire.say(AT_START)
        yield wire


def test_sticks_steer_only_while_the_deadman_button_is_held(wire):
    wire.say(axis(1, -32767), axis(0, 16000))
    assert wire.pad.command() == {"linear_velocity_x": 0.0, "yaw_rate": 0.0}
    assert wire.operator.silence == np.inf
    wire.say(button(4, True))
    assert wire.pad.command() == pytest.approx({"linear_velocity_x": 0.2, "yaw_rate": -0.5 * (16000 / 32767 - 0.12) / 0.88})
    wire.say(axis(1, 32767), axis(0, 3000))  # the latter within the dead zone
    assert wire.pad.command() == pytest.approx({"linear_velocity_x": -0.1, "yaw_rate": 0.0})
    wire.say(axis(1, -32768))  # some gamepads
    assert wire.pad.command()["linear_velocity_x"] == 0.2
    wire.say(button(4, False))
    assert wire.pad.command() == {"linear_velocity_x": 0.0, "yaw_rate": 0.0}


def test_the_deadman_button_is_a_sign_of_the_operator_while_it_is_held(wire):
    wire.say(button(4, True))
    for wire.clock.time in (0.02, 0.04, 1.0):
        wire.pad.serve(wire.operator)
        assert wire.operator.silence == 0.0
    wire.say(button(4, False))
    wire.clock.time = 1.3
    wire.pad.serve(wire.operator)
    assert wire.operator.silence == pytest.approx(0.3)


def test_a_short_press_between_two_looks_is_not_lost(wire):
    wire.say(button(0, True), button(0, False))
    assert (wire.operator.asked_to_stop, wire.operator.asked_off) == ("gamepad: stop button", "")
    wire.say(button(3, True), button(1, True), button(1, False))
    assert wire.operator.asked_off == "gamepad: motors-off button"


def test_events_may_come_in_pieces(wire):
    event = button(4, True)
    wire.say(event[:5])
    assert not wire.pad.is_held
    wire.say(event[5:] + axis(1, -32767)[:7])
    assert wire.pad.is_held
    assert wire.pad.command()["linear_velocity_x"] == 0.0
    wire.say(axis(1, -32767)[7:])
    assert wire.pad.command()["linear_velocity_x"] == 0.2


def test_an_unplugged_gamepad_stops_the_robot(wire):
    wire.say(button(4, True), axis(1, -32767))
    os.close(wire.end)
    wire.operator.spare = lambda: wire.pad.serve(wire.operator)
    wire.operator.serve()
    assert wire.operator.trouble.endswith(f"gamepad {wire.path} is gone")
    assert wire.pad.command() == {"linear_velocity_x": 0.0, "yaw_rate": 0.0}


def test_a_drive_by_gamepad_is_logged_with_its_interventions(tmp_path):
    """Held, driven forward, let go, held again, stopped: each is in the log."""
    script = {0: button(4, True), 60: axis(1, -32767), 100: button(4, False), 130: button(4, True), 160: button(0, True)}
    hardware = {"emulated": True, "log": tmp_path / "log", "deadman": 0.2}
    core = make_core("WLR-Velocity-v0", 1, {"backend": "dynamixel", "hardware": hardware, "episode_length": 20.0})
    loop = loop_of(core)
    with Wire(tmp_path) as wire:
        ticks = iter(range(10000))

        def spare():
            if event := script.get(next(ticks)):
                os.write(wire.end, event)
            wire.pad.serve(loop.operator)

        loop.operator.spare = spare
        result = deploy(core, make_policy("pid", core.contract()), command={"linear_velocity_x": 9.0}, steer=wire.pad.command)
    assert result.run is not None
    assert (result.well, result.reason) == (True, "stop: gamepad: stop button")
    speed = read_policy_log(result.run)["command_linear_velocity_x"]
    steps = np.flatnonzero(np.diff(speed))
    assert [speed[0], *speed[steps + 1].tolist()] == [0.0, 0.2, 0.0, 0.2]
    assert np.diff(steps).tolist() == [40, 30]
    events = [event for event in read_events(result.run) if event["event"] == "intervention"]
    texts = {event["rule"]: event["text"] for event in events if "text" in event}
    assert texts["stop"] == "gamepad: stop button"
    assert texts["deadman"].startswith("no sign of the operator for 0.2 s")
    assert [event for event in events if "joints" in event]  # what the command limiter changed
    assert not any(servo["torque_enable"] for servo in machine_of(core).servos.values())
    core.close()


def test_what_cannot_be_driven_with(tmp_path):
    words = ["pid", "--emulated", "--stepped", "--out", str(tmp_path), "--gamepad", str(tmp_path / "js7")]
    with pytest.raises(InputError, match=r"gamepad .*js7: cannot be opened: No such file.* ls /dev/input/js\*"):
        run_command("deploy", words)
    with pytest.raises(InputError, match="a gamepad steer others"):
        DrivingPad("js0", BUTTONS, {"leg_angle": (0.0, 1.0)})
    with pytest.raises(ValueError, match="expected three buttons"):
        PadButtons(stop=4)
