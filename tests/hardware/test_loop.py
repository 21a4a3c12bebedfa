"""The control loop on the emulated robot, in emulated time: phases, start-up, deadlines, stops, logs, trouble from outside."""

import io
import os
import signal
from typing import Any

import numpy as np
import pytest

pytest.importorskip("dynamixel_sdk")
pytest.importorskip("serial")

import robot_rig
from robot_rig import DRIVE, HARDWARE, JOINTS, PERIOD, ROBOT, Phase, Rig, StoppedError, imu_that_reads

from wlr_gym.base.errors import InputError
from wlr_gym.data.runs import read_dataset, read_run
from wlr_gym.hardware.log import CsvTable, read_events
from wlr_gym.hardware.operator import STOP_SIGNALS, Keys, stop_on_signals
from wlr_gym.hardware.plant import RobotPlant
from wlr_gym.hardware.safety import preflight
from wlr_gym.hardware.safety.limiter import CALM_SPEED
from wlr_gym.hardware.timing import Pacer
from wlr_gym.physics.plants.base import PlantOptions, RobotOptions

#: What one count of a goal register is: rad of a leg, rad/s of a wheel (e-manuals: 4096 per turn, 0.229 rpm).
ANGLE_COUNT, SPEED_COUNT = 2.0 * np.pi / 4096, 0.229 * 2.0 * np.pi / 60.0


@pytest.fixture
def rig(tmp_path):
    return Rig(tmp_path / "log")


# ---- from torque off to torque off ------------------------------------------------------------------------------------


def test_making_a_loop_moves_and_opens_nothing(rig):
    assert rig.loop.phase is Phase.TORQUE_OFF
    assert not rig.torque().any()
    with pytest.raises(StoppedError, match="has not been started"):
        rig.loop.tick(DRIVE)


def test_a_run_from_start_to_end(rig):
    view = rig.loop.start([1.3, 1.3, 1.8, 1.8])
    assert rig.loop.phase is Phase.RUNNING
    assert rig.torque().all()
    np.testing.assert_allclose(view.position[:4], [1.3, 1.3, 1.8, 1.8], atol=0.05)
    assert [rig.machine.servos[joint]["bus_watchdog"] for joint in JOINTS] == [10] * 8
    rig.drive(1.0)
    np.testing.assert_allclose(rig.loop.status.velocity[4:], 3.0, atol=0.1)
    rig.loop.stop()
    assert rig.loop.phase is Phase.TORQUE_OFF
    assert not rig.torque().any()
    assert np.abs(rig.loop.status.velocity[4:]).max() < 0.4  # of 3: wheels all but stood before torque went off
    assert [rig.machine.servos[joint]["bus_watchdog"] for joint in JOINTS] == [0] * 8
    with pytest.raises(StoppedError, match="end"):
        rig.loop.tick(DRIVE)


def test_torque_comes_on_without_a_jerk(rig):
    """Whatever setpoints the registers held before, the robot stays as it stands."""
    for joint in JOINTS[:4]:
        rig.machine.servos[joint].set("goal_position", 1500)
    start = rig.machine.plant.truth().joint_position[0, :4].copy()
    far = []
    rig.loop.operator.spare = lambda: far.append(np.abs(rig.machine.plant.truth().joint_position[0, :4] - start).max())
    rig.loop.start()
    assert max(far) < 0.02


def test_gains_and_profiles_of_another_program_are_set_back(rig):
    gains = ("position_p_gain", "position_i_gain", "position_d_gain", "feedforward_1st_gain", "feedforward_2nd_gain")
    for joint in JOINTS:
        for item in (*gains, "profile_acceleration"):
            rig.machine.servos[joint].set(item, 500)
    rig.loop.start()
    leg, wheel = rig.machine.servos["leg_rr"], rig.machine.servos["wheel_rr"]
    assert [leg[item] for item in gains] == [800, 0, 0, 0, 0]
    assert [wheel[item] for item in (*gains[1:], "profile_acceleration")] == [0, 4000, 0, 0, 0]


def test_the_ramp_is_slow_and_smooth(tmp_path):
    rig = Rig(tmp_path)
    rig.loop.start([1.0, 1.0, 2.1, 2.1])
    rig.loop.close()
    ramp = read_run(tmp_path / "ramp_01.csv")
    steps = np.diff([ramp[f"cmd_{joint}"] for joint in JOINTS[:4]], axis=1)
    assert np.abs(steps).max() < 2.0 * PERIOD  # peak of a minimum-jerk path is 1.9 times its mean speed of 1 rad/s
    assert np.abs(np.diff(steps, axis=1)).max() < 0.004 + 2.0 * ANGLE_COUNT  # setpoints are whole counts


def test_start_again_after_an_end(rig):
    for _ in range(2):
        rig.start(0.2)
        rig.loop.stop()
    rig.start(0.2)
    rig.loop.start([1.4] * 4)  # a new episode, from standing
    rig.drive(0.2)
    rig.loop.close()
    runs = read_dataset(rig.loop.recorder.folder).runs
    assert [run.name for run in runs] == ["run_01", "run_02", "run_03", "run_04"]
    np.testing.assert_allclose([run["pos_wheel_lf"][0] for run in runs], 0.0, atol=1e-12)


def test_a_dry_run_writes_nothing(tmp_path):
    rig = Rig(tmp_path, dry_run=True)
    before = {joint: bytes(servo.memory) for joint, servo in rig.machine.servos.items()}
    rig.start(0.3)
    rig.loop.close()
    for joint, servo in rig.machine.servos.items():
        assert servo.memory[64:120] == before[joint][64:120], joint  # all setpoints, gains, torque and the watchdog
    assert rig.loop.reason == "end"
    assert read_run(tmp_path / "run_01.csv")["cmd_wheel_lf"][-1] == 0.0


@pytest.mark.parametrize(
    ("break_it", "words"),
    [
        (lambda m: m.servos["leg_lf"].set("operating_mode", 4), "operating_mode"),
        (lambda m: m.servos["wheel_lf"].set("torque_enable", 1), "torque: on"),
        (lambda m: m.inject("dead leg_rr"), "leg_rr.*answer"),
        (lambda m: m.inject("unplug legs"), "unplugged"),
        (lambda m: m.inject("dead imu"), "imu: no reading"),
        (lambda m: setattr(m, "_imu", imu_that_reads(0, 0, 0)), "imu: the accelerometer reads 0.0"),
        (lambda m: m.inject("overload wheel_lf"), "hardware error: overload"),
    ],
)
def test_a_robot_that_is_not_right_does_not_start(tmp_path, break_it, words):
    rig = Rig(tmp_path)
    break_it(rig.machine)
    rig.machine.advance(0.01)
    before = rig.torque()
    with pytest.raises((StoppedError, InputError), match=f"(?s){words}"):
        rig.loop.start()
    rig.loop.close()
    np.testing.assert_array_equal(rig.torque(), before)  # and a robot that something else holds up is not dropped


def test_a_watchdog_left_latched_is_cleared(rig):
    rig.loop.start()
    rig.machine.advance(0.5)  # the program hangs
    assert rig.machine.servos["leg_lf"]["bus_watchdog"] == -1
    with pytest.raises(StoppedError, match="idle: nothing was sent"):
        rig.loop.tick(DRIVE)
    assert not rig.torque().any()
    for servo in rig.machine.servos.values():
        servo.set("bus_watchdog", -1)
    again = Rig(machine=rig.machine)
    again.loop.start()
    again.drive(0.1)


def test_watchdogs_are_armed_at_once_and_for_no_less_than_they_are_judged_by(tmp_path):
    """Answers of one bus are lost while they are armed: those of the other one must not starve meanwhile."""
    rig, lost = Rig(tmp_path, watchdog=0.13), []

    def lossy(data, answers):
        arming = rig.torque().all() and b"\x62\0" in data and len(lost) < 3  # its address
        if arming and answers:
            lost.append(data)
            return []
        return answers

    rig.hear("wheels", lossy)
    rig.loop.start()
    assert len(lost) == 3
    assert [rig.machine.servos[joint]["bus_watchdog"] for joint in JOINTS] == [7] * 8


def test_a_watchdog_that_cannot_be_armed_stops_the_start(rig):
    def trip(data, answers):
        if rig.torque().all():
            rig.machine.servos["wheel_rf"].set("bus_watchdog", -1)
        return answers

    rig.hear("wheels", trip)
    with pytest.raises(StoppedError, match="the watchdog of wheel_rf does not say that it is armed"):
        rig.loop.start()
    assert not rig.torque().any()


def test_checks_that_fail_write_nothing(rig):
    rig.machine.servos["leg_lf"].set("bus_watchdog", -1)
    rig.machine.servos["wheel_rr"].set("drive_mode", 1)
    before = {joint: bytes(servo.memory)[:120] for joint, servo in rig.machine.servos.items()}
    with pytest.raises(StoppedError, match="drive_mode"):
        rig.loop.start()
    assert {joint: bytes(servo.memory)[:120] for joint, servo in rig.machine.servos.items()} == before


def test_the_watchdog_of_a_servo_that_does_not_confirm_torque_off_stays_armed(tmp_path):
    rig = Rig(tmp_path, off_time=0.0, stop_time=0.0)
    rig.loop.start()
    silent = rig.machine.servos["leg_lf"]["id"]
    rig.hear("legs", lambda data, answers: [] if data[4] == silent else answers)
    rig.loop.stop()
    assert "not confirmed off at leg_lf" in rig.loop.reason
    assert [rig.machine.servos[joint]["bus_watchdog"] for joint in JOINTS] == [10] + [0] * 7


def test_servo_limits_are_kept(monkeypatch):
    """A servo ignores setpoints beyond its registers; the command limiter reads the registers and stays inside."""
    wheels = HARDWARE.buses["wheels"]
    slow = wheels.model_copy(update={"eeprom": {**wheels.eeprom, "velocity_limit": 100}})  # 2.4 rad/s
    monkeypatch.setattr(robot_rig, "HARDWARE", HARDWARE.model_copy(update={"buses": {**HARDWARE.buses, "wheels": slow}}))
    rig = Rig()
    rig.start(1.0)
    assert np.abs(rig.goal_counts()[4:]).max() == 100
    assert rig.loop.interventions["limit"] > 40


# ---- requests ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", STOP_SIGNALS)
def test_every_way_to_end_or_stop_a_program_stops_the_robot(rig, name):
    """Ctrl-Z too: a program that sleeps would leave torque on."""
    rig.loop.start()
    with stop_on_signals(rig.loop.operator):
        os.kill(os.getpid(), getattr(signal, name))
        with pytest.raises(StoppedError, match=name):
            rig.drive(0.2)
    assert rig.loop.phase is Phase.TORQUE_OFF
    assert not rig.torque().any()
    assert signal.getsignal(getattr(signal, name)) is not None


def test_a_stop_that_is_asked_for_before_anything_moves(rig):
    with stop_on_signals(rig.loop.operator):
        os.kill(os.getpid(), signal.SIGTERM)
        with pytest.raises(StoppedError, match="SIGTERM"):
            rig.loop.start()
    assert not rig.torque().any()
    assert rig.machine.time < 0.1
    assert rig.loop.phase is Phase.TORQUE_OFF
    rig.loop.start()  # the next one is a new one
    rig.drive(0.1)


def test_a_second_signal_interrupts_at_once(rig):
    rig.loop.start()
    with stop_on_signals(rig.loop.operator):
        os.kill(os.getpid(), signal.SIGINT)
        with pytest.raises(KeyboardInterrupt):
            os.kill(os.getpid(), signal.SIGINT)


@pytest.mark.parametrize(("key", "words", "steps"), [(b" ", "emergency stop key", 1.5), (b"xq", "stop key", 34.0)])
def test_keys_stop_in_good_order_or_switch_off_in_the_same_tick(rig, key, words, steps):
    read, write = os.pipe()
    with Keys(read) as keys:
        rig.loop.operator.spare = lambda: keys.serve(rig.loop.operator)
        rig.start(0.2)
        os.write(write, key)
        before = rig.machine.time
        rig.stops(words)
    assert rig.machine.time - before < steps * PERIOD
    assert rig.loop.phase is Phase.TORQUE_OFF
    os.close(write)
    assert keys.pressed() == ""  # a closed pipe is no key
    os.close(read)


def test_deadman_holds_and_lets_go(tmp_path):
    rig = Rig(tmp_path, deadman=0.3)
    rig.loop.operator.spare = rig.loop.operator.note_sign
    rig.loop.start()
    rig.loop.operator.spare = lambda: None
    rig.drive(0.2)
    assert rig.loop.setpoints[4] == 3.0
    rig.drive(0.3)
    assert rig.loop.setpoints[4] == 0.0
    assert rig.torque().all()
    rig.loop.operator.note_sign()
    rig.drive(0.1)
    assert rig.loop.setpoints[4] == 3.0


@pytest.mark.parametrize("error", [ValueError, KeyboardInterrupt, SystemExit])
@pytest.mark.parametrize("where", ["ramp", "running", "spare"])
def test_any_exception_ends_with_torque_off(tmp_path, error, where):
    rig = Rig(tmp_path)

    def fail():
        raise error("broken")

    def play():
        with rig.loop:
            if where == "ramp":
                rig.loop.operator.spare = lambda: fail() if rig.loop.phase is Phase.RAMP else None
            rig.start(0.1)
            if where == "spare":
                rig.loop.operator.spare = fail
                rig.drive(0.1)
            fail()

    with pytest.raises(error):
        play()
    assert not rig.torque().any()
    assert rig.loop.phase is not Phase.RUNNING
    assert len(read_events(tmp_path / "run_01.csv")) > 2
    if where != "ramp":
        assert len(read_run(tmp_path / "run_01.csv").table) > 5


@pytest.mark.parametrize(
    ("bad", "words"),
    [
        (np.full(8, np.nan), "finite: setpoint of leg_lf is nan"),
        (np.r_[DRIVE[:7], np.inf], "finite: setpoint of wheel_rr is inf"),
        (np.zeros(7), "shape"),
        ("fast", "no numbers"),
        (None, "finite|no numbers|shape"),
    ],
)
def test_setpoints_that_are_none_stop_the_robot(rig, bad, words):
    rig.start(0.2)
    before = rig.goal_counts()
    with pytest.raises(StoppedError, match=words):
        rig.loop.tick(bad)
    assert not rig.torque().any()
    np.testing.assert_array_equal(rig.goal_counts()[:4], before[:4])
    assert rig.loop.phase is Phase.FAULT
    with pytest.raises(InputError, match="stopped with a fault"):
        rig.loop.start()


def test_single_motors_off_and_on_again(rig):
    rig.loop.start()
    free = np.ones(8, bool)
    free[4:] = False
    setpoints = np.r_[DRIVE[:4], [np.nan] * 4]
    for _ in range(10):
        rig.loop.tick(setpoints, free)
    np.testing.assert_array_equal(rig.torque(), free)
    rig.drive(1.0)
    assert rig.torque().all()
    np.testing.assert_allclose(rig.loop.status.velocity[4:], 3.0, atol=0.2)
    rig.loop.stop()
    run = read_run(rig.loop.recorder.path())
    assert np.isnan(run["cmd_wheel_lf"][:10]).all()
    assert np.isfinite(run["cmd_wheel_lf"][10:]).all()


# ---- log ---------------------------------------------------------------------------------------------------------------


def test_the_log_has_what_was_sent_and_read(rig):
    rig.loop.start()
    seen, sent = [], []
    for k in range(50):
        seen.append(rig.loop.status)
        rig.loop.tick(np.r_[DRIVE[:4], [0.05 * k] * 4])
        sent.append(rig.loop.setpoints)
    partial = rig.loop.recorder.folder / "partial_run_01.csv"
    assert len(read_run(partial).table) == 50  # while it is running, and after kill -9
    assert not read_run(partial).path.name.startswith("run_")
    rig.loop.stop()
    run = read_run(rig.loop.recorder.path())
    assert len(run.table) == 50 + 30
    for k, joint in enumerate(JOINTS):
        count = ANGLE_COUNT if k < 4 else SPEED_COUNT  # the register holds whole counts, and that is what the servo follows
        logged = run[f"cmd_{joint}"][:50]
        np.testing.assert_allclose(logged, np.array(sent)[:, k], rtol=0.0, atol=0.501 * count)
        np.testing.assert_allclose(logged / count, np.rint(logged / count), rtol=0.0, atol=1e-6)
        np.testing.assert_array_equal(run[f"vel_{joint}"][:50], [view.velocity[k] for view in seen])
    np.testing.assert_array_equal(run["gyro_z"][:50], [view.gyro[2] for view in seen])
    np.testing.assert_allclose(np.diff(run["t"]), PERIOD, atol=1e-9)
    assert {finding.kind for finding in run.findings} <= {"constant"}
    events = read_events(rig.loop.recorder.path())
    phases = [event["phase"] for event in events if event["event"] == "phase"]
    assert phases == ["ramp", "running", "stopping", "limp"]
    assert events[-1]["statistics"]["ticks"] == rig.loop.statistics()["ticks"]
    assert not list(rig.loop.recorder.folder.glob("partial*"))


def test_interventions_are_counted_and_logged_where_they_begin(rig):
    rig.start(0.2, np.r_[DRIVE[:4], [0.0] * 4])
    for _ in range(3):
        rig.drive(0.1, np.r_[DRIVE[:4], [6.0] * 4])
        rig.drive(0.1, np.r_[DRIVE[:4], [0.0] * 4])
    rig.loop.stop()
    events = [event for event in read_events(rig.loop.recorder.path()) if event.get("rule") == "slew"]
    assert len(events) == 6
    assert rig.loop.interventions["slew"] >= 6
    assert events[-1]["joints"] == list(JOINTS[4:])


# ---- deadlines ---------------------------------------------------------------------------------------------------------


class FakeClock:
    def __init__(self):
        self.time = 0.0

    def now(self):
        return self.time

    def wait_until(self, moment):
        self.time = max(self.time, moment) + 1e-4  # wakes a little late


def test_deadlines_do_not_drift_and_are_not_caught_up():
    clock = FakeClock()
    pacer = Pacer(clock, 0.02)
    pacer.start()
    for tick in range(1000):
        clock.time += 0.005 + 0.03 * (tick == 500)
        pacer.wait()
        late = clock.time - 0.02 * (tick + 1)
        assert late == pytest.approx(1e-4) or tick in (500, 501)
    assert pacer.missed == 0  # 35 ms of work: one tick starts late, the next is on the grid again
    clock.time += 0.1
    pacer.wait()
    assert pacer.missed == 4
    assert pacer.late_ticks == 1
    pacer.wait()
    assert pacer.late_ticks == 0
    statistics: dict[str, Any] = pacer.statistics()
    assert statistics["jitter"]["p50"] == pytest.approx(0.1)
    assert statistics["period"]["p50"] == pytest.approx(20.0, abs=1e-6)


def test_a_computer_that_does_not_keep_up_stops_the_robot(rig):
    rig.loop.start()
    rig.loop.operator.spare = lambda: rig.link.clock.wait_until(rig.machine.time + 0.045)
    rig.stops("deadlines: 5 ticks in a row late")


# ---- trouble that is not the robot's: full disk, lost terminal, impatient operator, sleeping program ----------------------


class FullDisk:
    """A file that takes nothing more."""

    closed = False

    def write(self, _):
        raise OSError(28, "No space left on device")

    def close(self):
        pass


def fill_the_disk(recorder):
    recorder._events = FullDisk()
    for table in recorder._tables.values():
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
        rig.loop.operator.spare = lambda: fill_the_disk(rig.loop.recorder)
        with pytest.raises(StoppedError, match=r"computer: the log cannot be written: .*No space left"):
            rig.loop.start()
    else:
        rig.start(0.3)
        fill_the_disk(rig.loop.recorder)
    speeds = wheel_speeds_at_off(rig)
    if phase == "running":
        rig.stops(r"computer: the log cannot be written: .*No space left", 0.2)
    rig.loop.stop()
    assert rig.loop.phase in (Phase.TORQUE_OFF, Phase.FAULT)
    assert not rig.torque().any()
    if phase != "ramp":
        assert np.abs(speeds[-1]).max() < 0.4  # of 3: the wheels were stopped before


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

    rig.start(0.5)
    speeds = wheel_speeds_at_off(rig)
    rig.loop.operator.spare = gone
    rig.stops("computer: the operator's terminal or gamepad is gone", 0.5)
    assert np.abs(speeds[-1]).max() < 0.4


def test_no_signal_interrupts_switching_off(rig):
    """Ctrl-C pressed again and again: each motor is off all the same."""
    rig.start(0.2)
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
    assert np.isnan(read_run(rig.loop.recorder.path())["cmd_leg_lf"]).all()


# ---- watchdogs that have stopped the motors ----------------------------------------------------------------------------


def test_servos_that_stopped_themselves_are_noticed_when_they_are_back(rig):
    """Silence shorter than the ladder's last step, but longer than the watchdog's time: setpoints are refused from then on."""
    rig.start(0.3)
    rig.inject("deaf wheels duration=0.3")
    rig.stops("watchdog: wheel_lf, wheel_rf, wheel_lr, wheel_rr heard nothing")
    assert any(event.get("rule") == "watchdog" for event in read_events(rig.loop.recorder.path()))


def test_lost_answers_alone_latch_no_watchdog(rig):
    """The servos heard everything, and were not stopped: the run goes on."""
    rig.start(0.3)
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
        rig.start(5.0)

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
    ramp = read_run(rig.loop.recorder.folder / "partial_ramp_01.csv")
    setpoints = np.r_[ramp["pos_leg_lf"][0], ramp["cmd_leg_lf"]]
    assert not low <= setpoints[0] <= high
    assert np.abs(np.diff(setpoints)).max() <= CALM_SPEED * HARDWARE.safety.start_speed * PERIOD + ANGLE_COUNT
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
    rig.machine._imu = imu_that_reads(0, 8192, 0)
    with pytest.raises(StoppedError, match=r"imu: the body leans by 1\.57 rad"):
        rig.loop.start()
    assert rig.machine.servos["leg_lf"]["bus_watchdog"] == 0  # nothing was prepared


@pytest.mark.parametrize("joint", ["leg_lf", "wheel_rf"])
def test_a_servo_that_dies_is_named_alone(rig, joint):
    """Those named behind it in a read of all wait for its answer; they are heard all the same."""
    rig.loop.start()
    rig.inject(f"dead {joint}")
    rig.stops(rf"^silence: no answer from {joint} for 0\.4")


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


@pytest.mark.parametrize("deadman", [0.0, -1.0, np.nan, np.inf, 300.0])
def test_a_deadman_that_never_acts_is_refused(deadman):
    number = "" if np.isfinite(deadman) else "a finite number, "
    with pytest.raises(InputError, match=f"deadman = {deadman:g}: expected {number}more than 0 and at most 10 s"):
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
