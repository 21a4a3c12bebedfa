"""Ends of a run: torque that is not confirmed off, requests that come late, faults on the way out; all of it is noticed."""

import os
import signal
from typing import Any

import numpy as np
import pytest

pytest.importorskip("dynamixel_sdk")
pytest.importorskip("serial")

from robot_rig import ROBOT, Phase, Rig, StoppedError, imu_that_reads, machine_of

from studies.paper.experiments import PROFILE
from wlr_gym.cli import FAILED, INTERRUPTED, OK, record, replay, run_command
from wlr_gym.data.excitations import excite
from wlr_gym.data.format import RunMeta
from wlr_gym.hardware.deployment import deploy, drive_robot, loop_of
from wlr_gym.hardware.operator import Keys, stop_on_signals
from wlr_gym.hardware.plant import RobotPlant
from wlr_gym.learning.adaptation.driving import interrupted
from wlr_gym.learning.evaluation.rollout import make_core
from wlr_gym.physics.plants.base import PlantOptions, RobotOptions
from wlr_gym.policy import make_policy

ADVICE = "CUT THE POWER: torque is not confirmed off at wheel_lf, wheel_rf, wheel_lr, wheel_rr"


@pytest.fixture
def rig(tmp_path):
    return Rig(tmp_path / "log", off_time=0.1)


def in_phase(loop, phase, act):
    """Do something once, when the loop is in a phase."""
    waiting = [act]

    def spare():
        if loop.phase is phase and waiting:
            waiting.pop()()

    loop.operator.spare = spare


def before_off(loop, act):
    """Do something while torque is switched off."""
    off = loop._limiter.off

    def watched():
        act()
        return off()

    loop._limiter.off = watched


def interrupt():
    os.kill(os.getpid(), signal.SIGINT)


def unplug(loop):
    """Take the wheels' adapter away, and let that be noticed."""
    loop.clock.inject("unplug wheels")
    loop.clock.wait_until(loop.clock.now() + 0.002)


def emulated_plant(folder):
    plant = RobotPlant(ROBOT, 1, PlantOptions(), RobotOptions(emulated=True, log=folder))
    machine: Any = plant.loop.clock
    return plant, machine


def short(name="straight"):
    return excite(name, robot=ROBOT, seconds=0.2)


# ---- torque that is not confirmed off ----------------------------------------------------------------------------------


def test_a_normal_end_without_confirmed_torque_off_is_no_success(rig, capsys):
    rig.start(0.1)
    in_phase(rig.loop, Phase.STOPPING, lambda: rig.inject("unplug wheels"))
    with pytest.raises(StoppedError, match="time is over.*" + ADVICE):
        rig.loop.finish("time is over")
    assert not rig.loop.ended_well
    assert rig.loop.phase is Phase.FAULT
    assert ADVICE in capsys.readouterr().err


def test_a_requested_end_without_confirmed_torque_off_is_none_either(rig, capsys):
    rig.loop.start()
    rig.loop.operator.ask_to_stop("stop key")
    before_off(rig.loop, lambda: unplug(rig.loop))
    with pytest.raises(StoppedError, match="stop: stop key; " + ADVICE):
        rig.drive(0.1)
    assert not rig.loop.ended_well
    assert ADVICE in capsys.readouterr().err


def test_closing_says_that_torque_is_not_confirmed_off(rig, capsys):
    rig.loop.start()
    before_off(rig.loop, lambda: unplug(rig.loop))
    rig.loop.close()
    assert ADVICE in capsys.readouterr().err


def test_a_deployment_whose_torque_stays_on_is_none_that_went_well(tmp_path):
    hardware = {"emulated": True, "log": tmp_path}
    core = make_core("WLR-Velocity-v0", 1, {"backend": "dynamixel", "hardware": hardware, "episode_length": 0.2})
    loop = loop_of(core)
    in_phase(loop, Phase.STOPPING, lambda: machine_of(core).inject("unplug wheels"))
    result = deploy(core, make_policy("pid", core.contract()))
    assert not result.well
    assert ADVICE in result.reason
    machine_of(core).clear()
    core.close()


def test_the_command_line_says_it_and_fails(tmp_path, capsys):
    """The adapter is unplugged when the time is over, while the wheels stop."""
    words = ["pid", "--emulated", "--stepped", "--seconds", "0.2", "--out", str(tmp_path)]
    assert run_command("deploy", words) == OK
    times = [float(line.split(",")[0]) for line in (tmp_path / "run_01.csv").read_text().splitlines()[1:]]
    moment = times[-1] - 0.3
    assert run_command("deploy", [*words, "--fault", f"unplug wheels after={moment:.3f}"]) == FAILED
    said = capsys.readouterr()
    assert ADVICE in " ".join(said.out.split())
    assert ADVICE in said.err


@pytest.fixture
def unplugged_at_the_end(monkeypatch):
    """Robots of the command line lose their wheels' adapter while torque is switched off; the motions driven."""
    driven = []

    def drive(plant, motion):
        driven.append(motion.name)
        before_off(plant.loop, lambda: unplug(plant.loop))
        return drive_robot(plant, motion)

    monkeypatch.setattr("wlr_gym.hardware.deployment.drive_robot", drive)
    return driven


def test_no_motion_is_recorded_after_that(tmp_path, unplugged_at_the_end, capsys):
    options = record.RecordOptions(excitation=("straight", "turns"), out=tmp_path, emulated=True, seconds=0.2)
    assert record.run(options) == FAILED
    assert unplugged_at_the_end == ["straight"]
    assert ADVICE in capsys.readouterr().out


def test_no_run_is_repeated_after_that(tmp_path, monkeypatch, request, capsys):
    options = record.RecordOptions(excitation=("straight", "turns"), out=tmp_path / "runs", emulated=True, seconds=0.4)
    assert record.run(options) == OK
    driven = request.getfixturevalue("unplugged_at_the_end")
    again = replay.ReplayOptions(tmp_path / "runs", tmp_path / "out", backend="dynamixel", plots=False, emulated=True)
    assert replay.run(again) == FAILED
    assert len(driven) == 1
    assert ADVICE in " ".join(capsys.readouterr().out.split())


# ---- a stop that is asked for late -------------------------------------------------------------------------------------


@pytest.mark.parametrize("when", ["last tick", "stopping", "off"])
def test_a_stop_asked_for_at_the_very_end_ends_the_command(tmp_path, when):
    plant, _ = emulated_plant(tmp_path)
    motion = short()
    if when == "off":
        before_off(plant.loop, interrupt)
    elif when == "stopping":
        in_phase(plant.loop, Phase.STOPPING, interrupt)
    else:
        ticks = iter(range(len(motion.setpoints)))
        plant.loop.operator.spare = lambda: (
            interrupt() if plant.loop.phase is Phase.RUNNING and next(ticks) == len(motion.setpoints) - 1 else None
        )
    drive = drive_robot(plant, motion)
    plant.close()
    assert drive.reason == "the motion is over; SIGINT"
    assert drive.well
    assert drive.ticks == len(motion.setpoints)


@pytest.mark.parametrize(("key", "reason"), [(b" ", "emergency stop key"), (b"q", "stop key")])
def test_keys_of_a_terminal_end_a_motion(tmp_path, monkeypatch, key, reason):
    """Of wlr record, replay and adapt as of wlr deploy."""
    plant, _ = emulated_plant(tmp_path)
    master, slave = os.openpty()
    step = plant.step
    monkeypatch.setattr(plant, "step", lambda *given: (os.write(master, key), step(*given)))
    with open(slave) as terminal:
        monkeypatch.setattr("sys.stdin", terminal)
        drive = drive_robot(plant, short())
    plant.close()
    os.close(master)
    assert reason in drive.reason
    assert drive.well
    assert drive.ticks < len(short().setpoints)
    assert interrupted(drive.reason)


def test_a_stop_in_the_last_motion_tick_starts_no_other(tmp_path, monkeypatch):
    driven = []

    def drive(plant, motion):
        driven.append(motion.name)
        in_phase(plant.loop, Phase.STOPPING, interrupt)
        return drive_robot(plant, motion)

    monkeypatch.setattr("wlr_gym.hardware.deployment.drive_robot", drive)
    options = record.RecordOptions(excitation=("straight", "turns"), out=tmp_path, emulated=True, seconds=0.2)
    assert record.run(options) == INTERRUPTED
    assert driven == ["straight"]


def test_a_signal_after_torque_off_interrupts_like_any_other(rig):
    def play():
        with stop_on_signals(rig.loop.operator):
            rig.loop.start()
            rig.loop.stop()
            interrupt()

    with pytest.raises(KeyboardInterrupt, match="SIGINT"):
        play()


def test_a_stop_asked_for_between_two_starts_counts(rig):
    rig.loop.start()
    rig.loop.stop()
    rig.loop.operator.ask_to_stop("SIGINT")
    with pytest.raises(StoppedError, match="SIGINT"):
        rig.loop.start()
    assert not rig.torque().any()
    assert rig.loop.ended_well
    rig.loop.start()  # what was asked for has happened
    rig.drive(0.1)


# ---- keys before torque is on ------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("key", "words"), [(b" ", "emergency stop key"), (b"q", "stop key")])
def test_keys_are_looked_at_before_torque_comes_on(rig, key, words):
    was_on: list[Any] = []
    step = rig.machine.step

    def watched():
        was_on.append(rig.torque().any())
        step()

    rig.machine.step = watched
    read, write = os.pipe()
    os.write(write, key)
    with Keys(read) as keys:
        rig.loop.operator.spare = lambda: keys.serve(rig.loop.operator)
        with pytest.raises(StoppedError, match=words):
            rig.loop.start()
    os.close(read)
    os.close(write)
    assert not np.any(was_on)
    assert rig.loop.ended_well


# ---- faults after a request --------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("fault", "words"),
    [
        (lambda rig: setattr(rig.machine, "_imu", imu_that_reads(0, 8192, 0)), "tilt: "),
        (lambda rig: rig.inject("unplug wheels"), "port: "),
    ],
)
def test_a_fault_during_a_requested_stop_is_the_reason(rig, fault, words):
    rig = Rig(off_time=0.1, stop_time=2.0)  # time to fall
    rig.loop.start()
    in_phase(rig.loop, Phase.STOPPING, lambda: fault(rig))
    rig.loop.operator.ask_to_stop("stop key")
    rig.stops(f"^{words}.*while stopping: stop: stop key", 0.1)
    assert rig.loop.phase is Phase.FAULT
    assert not rig.loop.ended_well


def test_a_fault_in_the_tick_of_a_request_is_no_good_end(rig):
    """A request excuses itself, not a body that is down."""
    rig.loop.start()
    rig.machine._imu = imu_that_reads(0, 8192, 0)
    asked = []

    def spare():
        if rig.loop._limiter._memory.tilted >= rig.loop.limits.tilt_time and not asked:
            asked.append(rig.loop.operator.ask_to_stop("stop key"))

    rig.loop.operator.spare = spare
    rig.stops(r"^tilt: ", 3.0)
    assert not rig.loop.ended_well


# ---- legs that do not follow -------------------------------------------------------------------------------------------


def hold(rig, joint):
    """Keep a leg about where it is: after the preflight checks its servo's own limits let it go no farther."""
    servo = rig.machine.servos[joint]
    place = servo["present_position"]

    def narrow():
        servo.set("min_position_limit", place - 50)
        servo.set("max_position_limit", place + 50)

    rig.loop.operator.spare = narrow


def test_a_leg_that_is_not_at_the_start_pose_stops_the_robot(rig):
    hold(rig, "leg_rf")
    words = r"^start pose: leg_rf is at 1\.\d\d rad, its setpoint is 1\.00 rad \(limit 0\.3 rad\)$"
    with pytest.raises(StoppedError, match=words):
        rig.loop.start([1.0] * 4)
    assert rig.loop.phase is Phase.FAULT
    assert not rig.torque().any()


def test_a_leg_may_be_as_far_off_as_the_limit_says():
    rig = Rig(start_error=0.6)
    hold(rig, "leg_rf")
    rig.loop.start([1.0] * 4)
    assert rig.loop.phase is Phase.RUNNING


def test_a_dry_run_asks_no_leg_to_be_anywhere():
    rig = Rig(dry_run=True)
    rig.loop.start([1.0] * 4)


def test_the_way_to_the_start_pose_waits_for_slow_servos():
    """The paper's profile is slower than the ramp would be."""
    plant = RobotPlant(ROBOT, 1, PlantOptions(), RobotOptions(emulated=True), meta=RunMeta(robot=ROBOT.name, profile=PROFILE))
    plant.loop.start([1.0, 1.0, 2.1, 2.1])
    assert plant.loop.status is not None
    np.testing.assert_allclose(plant.loop.status.position[:4], [1.0, 1.0, 2.1, 2.1], atol=0.05)
    plant.close()


def test_the_way_to_the_start_pose_waits_for_the_operator(tmp_path):
    """A dead-man's hold is no blocked leg: the way goes on when somebody is there again."""
    rig = Rig(tmp_path, deadman=0.3)
    held = []

    def look():
        if rig.loop.phase is Phase.RAMP:
            held.append(rig.loop.setpoints[0])
            if len(held) >= 50:  # a second later
                rig.loop.operator.note_sign()

    rig.loop.operator.spare = look
    rig.loop.start([1.0, 1.0, 2.1, 2.1])
    assert rig.loop.status is not None
    np.testing.assert_allclose(rig.loop.status.position[:4], [1.0, 1.0, 2.1, 2.1], atol=0.05)
    assert np.ptp(held[20:49]) == 0.0
    assert held[40] > 1.1


@pytest.mark.slow
def test_the_way_to_the_start_pose_does_not_wait_for_ever():
    with pytest.raises(StoppedError, match="held for 30 s on the way to the start pose: deadman: no sign of the operator"):
        Rig(deadman=0.3).loop.start([1.0, 1.0, 2.1, 2.1])
