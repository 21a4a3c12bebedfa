"""Trouble that is not the robot's: full disk, lost terminal, impatient operator, sleeping program; and legs out of place."""

import io
import os
import signal

import numpy as np
import pytest

pytest.importorskip("dynamixel_sdk")
pytest.importorskip("serial")

from robot_rig import DRIVE, HARDWARE, JOINTS, PERIOD, ROBOT, Phase, Rig, StoppedError

from wlr_gym.base.errors import InputError
from wlr_gym.data.runs import read_run
from wlr_gym.hardware.log import CsvTable, read_events
from wlr_gym.hardware.operator import STOP_SIGNALS, stop_on_signals
from wlr_gym.hardware.plant import RobotPlant
from wlr_gym.hardware.safety import preflight
from wlr_gym.hardware.safety.limiter import CALM_SPEED
from wlr_gym.physics.plants.base import PlantOptions, RobotOptions


@pytest.fixture
def rig(tmp_path):
    rig = Rig(tmp_path / "log")
    yield rig
    rig.loop.close()


class FullDisk:
    """A file that takes nothing more."""

    closed = False

    def write(self, _):
        raise OSError(28, "No space left on device")

    def close(self):
        pass


def fill_the_disk(log):
    log._events = FullDisk()
    for table in log._tables.values():
        table._file = FullDisk()


def wheel_speeds_at_off(rig):
    """Wheel speeds (4,) of the moment in which torque goes off."""
    speeds, step = [], rig.machine.step

    def watched():
        if rig.torque().all():
            speeds.append(rig.machine.plant.truth().joint_velocity[0, 4:].copy())
        step()

    rig.machine.step = watched
    return speeds


@pytest.mark.parametrize("phase", ["ramp", "running", "stopping"])
def test_a_full_disk_stops_the_robot_in_good_order(rig, phase):
    if phase == "ramp":
        rig.loop.operator.spare = lambda: fill_the_disk(rig.loop.recorder.log)
        with pytest.raises(StoppedError, match=r"computer: the log cannot be written: .*No space left"):
            rig.loop.start()
    else:
        rig.loop.start()
        rig.drive(0.3)
        fill_the_disk(rig.loop.recorder.log)
    speeds = wheel_speeds_at_off(rig)
    if phase == "running":
        with pytest.raises(StoppedError, match=r"computer: the log cannot be written: .*No space left"):
            rig.drive(0.2)
    rig.loop.stop()
    assert rig.loop.phase in (Phase.TORQUE_OFF, Phase.FAULT)
    assert not rig.torque().any()
    if phase != "ramp":
        assert np.abs(speeds[-1]).max() < 0.4  # of 3: the wheels were stopped before
    rig.loop.close()


class FillingDisk(io.FileIO):
    """A file on a disk with room for 30 bytes."""

    def write(self, data, /):
        room = 30 - self.tell()
        if not room:
            raise OSError(28, "No space left on device")
        return super().write(data[:room])


def test_a_log_ends_in_a_whole_row_when_the_disk_fills_up(tmp_path):
    table = CsvTable(tmp_path / "run_01.csv", ["t", "value"])
    table._file.close()
    table._file = FillingDisk(tmp_path / "partial_run_01.csv", "a")
    table.add(np.array([0.0, 0.125]))
    with pytest.raises(OSError, match="No space left"):
        table.add(np.array([0.02, 0.123456789012]))
    table.finish()
    assert (tmp_path / "run_01.csv").read_text() == "t,value\n0.0,0.125\n"


def test_a_terminal_that_is_gone_stops_the_robot_in_good_order(rig):
    """The connection breaks: keys and display raise, in every tick."""

    def gone():
        raise OSError(5, "Input/output error")

    rig.loop.start()
    rig.drive(0.5)
    speeds = wheel_speeds_at_off(rig)
    rig.loop.operator.spare = gone
    with pytest.raises(StoppedError, match="computer: the operator's terminal or gamepad is gone"):
        rig.drive(0.5)
    assert not rig.torque().any()
    assert np.abs(speeds[-1]).max() < 0.4


def test_no_signal_interrupts_switching_off(rig):
    """Ctrl-C pressed again and again: each motor is off all the same."""
    rig.loop.start()
    rig.drive(0.2)
    off = rig.loop._limiter.off

    def off_with_an_impatient_operator():
        for _ in range(3):
            os.kill(os.getpid(), signal.SIGINT)
        return off()

    rig.loop._limiter.off = off_with_an_impatient_operator
    with stop_on_signals(rig.loop.operator):
        os.kill(os.getpid(), signal.SIGINT)
        with pytest.raises((StoppedError, KeyboardInterrupt), match="SIGINT"):
            rig.drive(0.2)
        assert not rig.torque().any()
        with pytest.raises(KeyboardInterrupt):
            os.kill(os.getpid(), signal.SIGINT)
    assert rig.loop.phase is Phase.TORQUE_OFF


@pytest.mark.parametrize("name", STOP_SIGNALS)
def test_every_way_to_end_or_stop_a_program_stops_the_robot(rig, name):
    """Ctrl-Z too: a program that sleeps would leave torque on."""
    rig.loop.start()
    with stop_on_signals(rig.loop.operator):
        os.kill(os.getpid(), getattr(signal, name))
        with pytest.raises(StoppedError, match=name):
            rig.drive(0.2)
    assert not rig.torque().any()


def test_motors_that_are_off_stay_off_in_a_stop(rig):
    """Somebody may hold the leg."""
    rig.loop.start()
    on = np.ones(8, bool)
    on[0] = False
    for _ in range(5):
        rig.loop.tick(DRIVE, on)
    seen = []
    rig.loop.operator.spare = lambda: seen.append(rig.torque())
    rig.loop.stop()
    np.testing.assert_array_equal(seen, np.tile(on, (len(seen), 1)))
    assert np.isnan(read_run(rig.loop.recorder.log.run)["cmd_leg_lf"]).all()


# ---- watchdogs that have stopped the motors ----------------------------------------------------------------------------


def test_servos_that_stopped_themselves_are_noticed_when_they_are_back(rig):
    """Silence shorter than the ladder's last step, but longer than the watchdog's time: setpoints are refused from then on."""
    rig.loop.start()
    rig.drive(0.3)
    rig.inject("deaf wheels duration=0.3")
    with pytest.raises(StoppedError, match="watchdog: wheel_lf, wheel_rf, wheel_lr, wheel_rr heard nothing"):
        rig.drive(1.0)
    assert not rig.torque().any()
    assert any(event.get("rule") == "watchdog" for event in read_events(rig.loop.recorder.log.run))


def test_lost_answers_alone_latch_no_watchdog(rig):
    """The servos heard everything, and were not stopped: the run goes on."""
    rig.loop.start()
    rig.drive(0.3)
    rig.inject("drop wheels duration=0.3")
    rig.drive(1.0)
    assert rig.loop.interventions["silence"] > 10
    assert rig.loop.setpoints[4] == 3.0


@pytest.mark.parametrize("when", [3, 200])
def test_a_display_that_hangs_is_noticed(rig, when):
    """Between sending and reading, in the first second too (where the share of late ticks is not known yet)."""
    ticks = iter(range(1000))
    rig.loop.operator.spare = lambda: rig.link.clock.wait_until(rig.machine.time + 0.3 * (next(ticks) == when))

    def play():
        rig.loop.start()
        rig.drive(5.0)

    with pytest.raises(StoppedError, match=r"idle: nothing was sent for 0\.3"):
        play()
    assert not rig.torque().any()


# ---- where the robot stands --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("angle", [-1.25, 1.25])
def test_a_leg_at_its_stop_comes_back_slowly(rig, angle):
    """A hand can follow it, also where it begins a little beyond the range."""
    rig.link.servos.open()
    rig.machine.turn("leg_lf", angle)
    rig.link.servos.close()
    low, high = ROBOT.leg_limits
    rig.loop.start()
    ramp = read_run(rig.loop.recorder.log.folder / "partial_ramp_01.csv")
    setpoints = np.r_[ramp["pos_leg_lf"][0], ramp["cmd_leg_lf"]]
    assert not low <= setpoints[0] <= high
    count = 2.0 * np.pi / 4096  # setpoints are whole counts of the register
    assert np.abs(np.diff(setpoints)).max() <= CALM_SPEED * HARDWARE.safety.start_speed * PERIOD + count
    np.testing.assert_allclose(rig.loop.status.position[0], ROBOT.home.leg_angle, atol=0.05)


def test_a_leg_outside_its_servos_limits_does_not_start(rig):
    """Its goal would be clipped to them, and the leg jump there at full speed when torque comes on."""
    place = rig.machine.servos["leg_rf"]["present_position"]
    rig.machine.servos["leg_rf"].set("min_position_limit", place + 300)
    with pytest.raises(StoppedError, match=f"leg_rf +min_position_limit: {place + 300}, expected 0"):
        rig.loop.start()
    assert not rig.torque().any()


@pytest.mark.parametrize(("degrees", "angle"), [(100, "3.32"), (-100, "-0.17"), (360, "7.85")])
def test_a_leg_outside_its_range_is_not_driven_back(rig, degrees, angle):
    """Through whatever it went past; a turn too far may be no more than its count, which torque on would take back."""
    rig.machine.turn("leg_rf", np.deg2rad(degrees))
    rig.machine.step()
    with pytest.raises(StoppedError, match=rf"leg_rf +position: {angle} rad .*expected 0.35 to 2.79 rad"):
        rig.loop.start()
    assert not rig.torque().any()


def test_a_robot_that_lies_on_its_side_does_not_start(rig):
    rig.machine._imu = Lying()
    with pytest.raises(StoppedError, match=r"imu: the body leans by 1\.57 rad"):
        rig.loop.start()
    assert rig.machine.servos["leg_lf"]["bus_watchdog"] == 0  # nothing was prepared


class Lying:
    """The IMU of a robot on its side."""

    def counts(self, accelerometer, gyro):
        return (0, 8192, 0), (0, 0, 0)


@pytest.mark.parametrize("joint", ["leg_lf", "wheel_rf"])
def test_a_servo_that_dies_is_named_alone(rig, joint):
    """Those named behind it in a read of all wait for its answer; they are heard all the same."""
    rig.loop.start()
    rig.inject(f"dead {joint}")
    with pytest.raises(StoppedError, match=rf"^silence: no answer from {joint} for 0\.4"):
        rig.drive(1.0)


def test_mending_leaves_servos_alone_that_are_on(rig):
    rig.link.open()
    for joint in ("leg_lf", "wheel_rr"):
        rig.machine.servos[joint].set("bus_watchdog", -1)
    rig.machine.servos["wheel_rr"].set("torque_enable", 1)
    servos = rig.link.servos
    left = preflight.mend(servos, preflight.check_servos(servos, ROBOT, HARDWARE))
    assert {(check.where, check.what) for check in left} == {("wheel_rr", "watchdog"), ("wheel_rr", "torque")}
    assert [servos.get(joint, "bus_watchdog") for joint in ("leg_lf", "wheel_rr")] == [0, -1]
    rig.link.close()


def test_latency_is_from_the_readings_to_their_setpoints(rig):
    """Thinking is slow in every second tick; the ramp, in which nobody thinks, must not mix in."""
    rig.loop.start()
    for tick in range(20):
        rig.link.clock.wait_until(rig.machine.time + 0.006 * (tick % 2))
        rig.loop.tick(DRIVE)
    latency = np.array(rig.loop.pacer._times["latency"])
    assert len(latency) == 20
    np.testing.assert_allclose(latency, [0.006 * (tick % 2) for tick in range(20)], atol=1.1e-3)


@pytest.mark.parametrize("deadman", [0.0, -1.0, np.nan, np.inf])
def test_a_deadman_that_never_acts_is_refused(deadman):
    with pytest.raises(InputError, match="deadman"):
        RobotPlant(ROBOT, 1, PlantOptions(), RobotOptions(emulated=True, deadman=deadman))


@pytest.mark.parametrize("dry_run", [False, True])
def test_a_leg_that_leaves_its_range_after_preflight_is_not_driven(tmp_path, monkeypatch, dry_run):
    rig = Rig(tmp_path, dry_run=dry_run)
    limiter = rig.loop._limiter
    prepare, on, step = limiter.prepare, [], rig.machine.step

    def jump():
        prepare()
        rig.inject("encoder_jump leg_lf value=2")
        rig.machine.advance(0.02)

    def watched():
        on.append(rig.torque().any())
        step()

    monkeypatch.setattr(limiter, "prepare", jump)
    monkeypatch.setattr(rig.machine, "step", watched)
    with pytest.raises(StoppedError, match=r"^preflight: FAULT +leg_lf +position: 3.57 rad .*turn it back by hand"):
        rig.loop.start()
    rig.loop.close()
    assert on
    assert not any(on)
    assert not rig.loop.ended_well
    assert "preflight: " in read_events(tmp_path / "run_01.csv")[-1]["reason"]


def test_gains_of_another_program_are_set_back(rig):
    for joint in JOINTS:
        for item in ("position_i_gain", "position_d_gain", "feedforward_1st_gain", "feedforward_2nd_gain"):
            rig.machine.servos[joint].set(item, 500)
    rig.loop.start()
    leg, wheel = rig.machine.servos["leg_rr"], rig.machine.servos["wheel_rr"]
    assert [leg["position_i_gain"], leg["position_d_gain"], leg["feedforward_1st_gain"]] == [0, 0, 0]
    assert [wheel["position_i_gain"], wheel["position_d_gain"], wheel["feedforward_2nd_gain"]] == [0, 4000, 0]
