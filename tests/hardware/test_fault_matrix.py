"""Every fault in every phase, in emulated time: the robot ends in the documented safe state within its bound.

Bounds from when the fault acts: torque off 0.6 s after the last answer; standing 0.25 s after the last packet (the servos'
watchdog, where they cannot be told). Everywhere: no uncaught exception, no goal that jumps, a log complete to the end.
"""

from functools import cache
from typing import Any

import numpy as np
import pytest

pytest.importorskip("dynamixel_sdk")
pytest.importorskip("serial")

from robot_rig import DRIVE, HARDWARE, JOINTS, PERIOD, ROBOT, Phase, Rig, StoppedError

from wlr_gym.base.errors import InputError
from wlr_gym.data.runs import read_run
from wlr_gym.hardware.camera.reading import CAMERA_FAULTS
from wlr_gym.hardware.dynamixel.tables import load_table
from wlr_gym.hardware.emulator import FAULTS, MachineOptions
from wlr_gym.hardware.emulator.line import NO_TIME
from wlr_gym.hardware.log import read_events

_COUNTS = (load_table("XM540-W150-R").units["position"], load_table("XL430-W250-T").units["velocity"])
#: (8,) counts that a goal may change by in a tick, and one for rounding.
LARGEST_STEP = (
    PERIOD * np.repeat([HARDWARE.safety.leg_speed, HARDWARE.safety.wheel_acceleration], 4) / np.repeat(_COUNTS, 4) + 1
)
PHASES = ("start-up", "ramp", "running", "stopping")
SHORT: dict[str, Any] = {"start_speed": 3.0, "stop_time": 0.4, "off_time": 0.3}
OFF_BOUND, STAND_BOUND = 0.6, 0.25
#: Fault -> as it is injected, and what it leads to: "runs" (nothing happens), "off" (torque off at every servo that has power),
#: "unreachable" (nobody hears: the watchdog stops the motors; torque off when the line is back).
MATRIX = {
    "drop": ("drop legs wheels", "off"),
    "delay": ("delay value=0.002", "runs"),
    "late": ("late value=0.05", "off"),
    "flip": ("flip", "off"),
    "truncate": ("truncate", "off"),
    "noise": ("noise", "runs"),
    "echo": ("echo", "runs"),
    "deaf": ("deaf", "unreachable"),
    "dead": ("dead wheel_lf", "off"),
    "brownout": ("brownout", "off"),
    "unplug": ("unplug legs", "unreachable"),
    "overload": ("overload leg_rf", "off"),
    "overheat": ("overheat wheel_rr value=60", "off"),
    "sag": ("sag value=2.5", "off"),
    "imu dead": ("dead imu", "off"),
    "imu unplugged": ("unplug imu", "off"),
    "imu silent": ("drop imu", "off"),
    "one bus silent": ("drop wheels", "off"),
    "torque_lost": ("torque_lost leg_rf", "off"),
    "torque_lost wheel": ("torque_lost wheel_lr", "off"),
    "reboot_matching_tick": ("reboot_matching_tick leg_lf", "off"),
    "reboot_matching_tick wheel": ("reboot_matching_tick wheel_rf", "off"),
    "encoder_frozen": ("encoder_frozen leg_lr", "off"),
    "encoder_frozen wheel": ("encoder_frozen wheel_lf", "off"),
    "encoder_jump": ("encoder_jump leg_rr", "off"),
    "encoder_jump wheel": ("encoder_jump wheel_rr value=2", "off"),
    "encoder_jump small": ("encoder_jump leg_rr value=0.153", "off"),
    "encoder_gain": ("encoder_gain leg_lf value=0.3", "off"),
    "encoder_gain half": ("encoder_gain leg_rf value=0.5", "off"),
    "encoder_gain wheel": ("encoder_gain wheel_rf value=0.3", "off"),
    "encoder_reversed": ("encoder_reversed leg_lf", "off"),
    "encoder_reversed wheel": ("encoder_reversed wheel_lr", "off"),
    "motor_reversed": ("motor_reversed leg_rf", "off"),
    "motor_reversed wheel": ("motor_reversed wheel_rf", "off"),
    "current_stuck": ("current_stuck leg_rr value=300", "off"),
    "late_answers": ("late_answers value=0.035", "off"),
    "eeprom_worn": ("eeprom_worn", "runs"),
    "imu_axis_dead": ("imu_axis_dead value=0", "off"),
    "imu_axis_constant": ("imu_axis_constant value=5", "off"),
    "imu_axis_saturated": ("imu_axis_saturated value=0", "off"),
    "slow_servo": ("slow_servo leg_lf", "off"),
    "slow_servo wheel": ("slow_servo wheel_rf value=0.02", "off"),
    "limit_changed": ("limit_changed leg_rf", "off"),
    "limit_changed wheel": ("limit_changed wheel_lr", "off"),
    "duplicate_id": ("duplicate_id leg_lr", "off"),
    "imu_frozen": ("imu_frozen", "off"),
    "imu_stale": ("imu_stale", "off"),
}
#: s that an overheating or a sagging supply takes until its limit, and a stop in good order after that.
SLOW = {"overheat": 1.4, "sag": 1.1, "overload": 0.6, "imu dead": 0.6, "imu unplugged": 0.6, "imu silent": 0.6}
SLOW |= {"imu_frozen": 0.6, "imu_stale": 0.6, "current_stuck": 0.2}
SLOW |= {"imu_axis_dead": 0.6, "imu_axis_constant": 0.6, "imu_axis_saturated": 0.6}
#: Faults that may pass a start: they are over, or harmless, before torque comes on.
PASSING = ("overheat", "sag", "brownout", "overload")
PASSING += ("encoder_jump small", "encoder_gain", "encoder_gain half", "encoder_gain wheel")
PASSING += ("torque_lost", "torque_lost wheel", "encoder_jump", "encoder_jump wheel")
#: Faults of one joint, s until torque is off (a joint that does not follow must first be asked to), and how far it may move.
JOINT_FAULTS = {"torque_lost": 0.03, "encoder_jump": 0.03, "encoder_frozen": 0.36, "encoder_frozen wheel": 0.8}
JOINT_FAULTS |= {"reboot_matching_tick": 0.45, "duplicate_id": 0.45, "limit_changed": 0.45}
JOINT_FAULTS |= {"encoder_gain": 0.2, "encoder_gain wheel": 1.5}
JOINT_FAULTS |= {"encoder_gain half": 0.55, "encoder_reversed": 0.1, "motor_reversed": 0.2}
JOINT_FAULTS |= {"encoder_reversed wheel": 0.65, "motor_reversed wheel": 0.65}  # the ramp asks wheels after 0.42 s
JOINT_FAULTS |= {"slow_servo": 0.9, "slow_servo wheel": 1.5}
LEG_BOUND, LEG_BOUND_TIME, TRAVEL_BOUND = 0.1, 0.1, {"encoder_gain": 0.1}
LONG = {"overheat": 2.2, "sag": 2.2, "slow_servo": 2.2, "encoder_gain": 2.2}


class Watch:
    """Looks at the emulated servos at every tick of emulated time.

    Attributes:
        angles: (8,) rad, true, at every tick of emulated time.
        off_at: s from which on all motors were off. jump: largest change of a goal from tick to tick, over what is allowed.
    """

    def __init__(self, rig):
        self.rig, self.jump = rig, 0.0
        self.angles: list[np.ndarray] = []
        self.off_at: float | None = None
        self.setpoints, self.driven = rig.goal_counts(), np.zeros(8, bool)
        step = rig.machine.step

        def watched():
            step()
            self.look()

        rig.machine.step = watched

    def look(self):
        rig = self.rig
        self.angles.append(true_angles(rig))
        setpoints, on = rig.goal_counts(), rig.torque()
        # setpoints of a servo that is off mean nothing, and its watchdog sets its own
        driven = on & [servo["bus_watchdog"] >= 0 for servo in rig.machine.servos.values()]
        both = driven & self.driven
        self.jump = max(self.jump, float((np.abs(setpoints - self.setpoints) / LARGEST_STEP)[both].max(initial=0.0)))
        self.setpoints, self.driven = setpoints, driven
        if on.any():
            self.off_at = None
        elif self.off_at is None:
            self.off_at = rig.machine.time


def true_angles(rig):
    return np.array([servo.shaft.true_position for servo in rig.machine.servos.values()])


def moving(rig, seconds):
    """Drive with legs that move up to 1.4 rad/s, wheels 3 rad/s."""
    for _ in range(round(seconds / PERIOD)):
        rig.swing += PERIOD
        rig.loop.tick(DRIVE + 0.45 * np.sin(np.pi * rig.swing) * (np.arange(8) < 4))


def play(rig, phase, fault, seconds, struck):
    """Drive from start to stop with a fault that begins in a phase; ``struck`` gets the time (s) at which it does."""
    loop, machine = rig.loop, rig.machine

    def strike():
        struck.append(machine.time)
        machine.inject(fault)

    if phase == "start-up":
        strike()
    elif phase == "ramp":
        ticks = iter(range(1000))
        loop.operator.spare = lambda: strike() if next(ticks) == 5 else None
    loop.start([1.4] * 4)
    loop.operator.spare = None
    rig.swing = 0.0
    moving(rig, 0.3)
    if phase == "running":
        strike()
    moving(rig, seconds)
    if phase == "stopping":
        strike()
    loop.stop()


@pytest.mark.parametrize("phase", PHASES)
@pytest.mark.parametrize("name", MATRIX)
def test_matrix(tmp_path, name, phase):
    fault, outcome = MATRIX[name]
    rig = Rig(tmp_path, **SHORT)
    watch = Watch(rig)
    struck, reason = [], ""
    try:
        play(rig, phase, fault, LONG.get(name.split()[0], 0.9), struck)
    except (StoppedError, InputError) as error:
        reason = str(error)
    ended = rig.machine.time
    watch.look()
    time_to_off = np.inf if watch.off_at is None else watch.off_at - struck[0]
    assert watch.jump <= 1.0
    assert rig.loop.phase in (Phase.TORQUE_OFF, Phase.FAULT)
    if outcome == "runs":
        assert reason == ""
        assert rig.loop.phase is Phase.TORQUE_OFF
    elif phase == "start-up":
        assert rig.torque().sum() == 0
        assert reason or name in PASSING
    elif phase == "stopping":
        assert time_to_off <= max(OFF_BOUND, SHORT["stop_time"] + 0.2) or outcome == "unreachable"
    elif outcome == "off":
        assert reason
        bound = JOINT_FAULTS.get(name, JOINT_FAULTS.get(name.split()[0], OFF_BOUND + SLOW.get(name, 0.0)))
        assert time_to_off <= bound + 1e-9, reason
    if outcome == "unreachable" and phase != "start-up":
        assert reason or phase == "stopping"
        assert "CUT THE POWER" in rig.loop.reason
        stands_from_now(rig, struck[0])
        rig.machine.clear()
        rig.loop._limiter.off()  # as the watchdog process does it, once the line is back
    assert not any(servo["torque_enable"] for servo in rig.machine.servos.values() if not servo.dead)
    if name.split()[0] in JOINT_FAULTS and phase in ("ramp", "running", "stopping"):
        check_motion(watch, phase, fault, struck[0])
    rig.loop.close()
    check_log(tmp_path, rig, phase, ended)


@cache
def healthy_angles(phase, seconds):
    """(ticks, 8) rad, true, of a robot that is well, driven the same way."""
    rig = Rig(**SHORT)
    watch = Watch(rig)
    play(rig, phase, "drop probability=0", seconds, [])
    rig.loop.close()
    return np.array(watch.angles)


def check_motion(watch, phase, fault, struck):
    """Until torque was off the joint moved hardly further than a healthy one on the same setpoints."""
    k = JOINTS.index(fault.split()[1])
    begin, end = round(struck / 0.001) - 1, round(watch.off_at / 0.001) - 1
    healthy = healthy_angles(phase, LONG.get(fault.split()[0], 0.9))
    moved = watch.angles[end][k] - watch.angles[begin][k]
    well = healthy[min(end, len(healthy) - 1), k] - healthy[begin, k]
    speed = abs(healthy[begin, k] - healthy[begin - 5, k]) / 0.005
    if k < 4:
        beyond = max(moved * np.sign(well) - abs(well), -moved * np.sign(well)) if well else abs(moved)
        assert beyond <= LEG_BOUND + LEG_BOUND_TIME * speed, (moved, well, speed)
    else:
        assert abs(moved) * ROBOT.wheel.radius <= TRAVEL_BOUND.get(fault.split()[0], 0.035), moved


def stands_from_now(rig, struck):
    """The motors that could not be told stand, and refuse setpoints, ``STAND_BOUND`` after they heard the last packet."""
    assert rig.machine.time > struck + STAND_BOUND
    for joint, servo in rig.machine.servos.items():
        if servo["torque_enable"]:
            assert servo["bus_watchdog"] == -1, joint
            assert abs(servo["goal_velocity"]) == 0, joint


def check_log(folder, rig, phase, ended):
    """All rows up to the end are there, in the run format, evenly spaced; and the interventions."""
    if rig.loop.recorder.number == 0:
        assert phase == "start-up"
        return
    assert not list(folder.glob("partial*"))
    events = read_events(rig.loop.recorder.path())
    assert events[-1]["event"] == "end"
    if phase == "start-up" and not rig.loop.recorder.path().is_file():
        return
    path = rig.loop.recorder.path() if rig.loop.recorder.path().is_file() else folder / "ramp_01.csv"
    run = read_run(path)
    assert ended - run["t"][-1] < 1.0
    assert np.diff(run["t"]).max() < 0.1
    if rig.loop.phase is Phase.FAULT and phase in ("ramp", "running"):
        assert any(event["event"] == "intervention" for event in events)


def test_the_matrix_has_every_fault():
    elsewhere = {*CAMERA_FAULTS, "encoder_drift"} | {name for name in FAULTS if name.startswith("flow_")}
    assert {fault.split()[0] for fault, _ in MATRIX.values()} == set(FAULTS) - elsewhere  # test_flow_emulated, ...


@pytest.mark.parametrize("seed", [0, pytest.param(1, marks=pytest.mark.slow), pytest.param(2, marks=pytest.mark.slow)])
def test_one_percent_of_packets_lost_stops_nothing(tmp_path, seed):
    rig = Rig(tmp_path, MachineOptions(timing=NO_TIME, seed=seed))
    rig.inject("drop legs wheels probability=0.01")
    watch = Watch(rig)
    rig.loop.start()
    for tick in range(400):
        rig.loop.tick(np.r_[DRIVE[:4], [4.0 * np.sin(0.05 * tick)] * 4])
    rig.loop.stop()
    assert rig.loop.phase is Phase.TORQUE_OFF
    assert watch.jump <= 1.0
    assert rig.loop.interventions["silence"] < 15
    assert sum(group.statistics.fallbacks for group in rig.link.servos.groups.values()) > 20
    assert len(read_run(tmp_path / "run_01.csv").table) > 400


@pytest.mark.parametrize("minutes", [0.25, pytest.param(10.0, marks=pytest.mark.slow)])
def test_a_line_and_a_computer_that_are_not_perfect_stop_nothing(minutes):
    """1 % of answers lost, 5 % late, one hiccup of the computer of 0.15 s a minute (the first after 5 s)."""
    rig = Rig(options=MachineOptions(timing=NO_TIME, tick=0.002, seed=3))
    rig.loop.start()  # the preflight checks refuse a line that loses more than 1 %
    rig.inject("drop legs wheels probability=0.01")
    rig.inject("late legs wheels probability=0.05")
    for tick in range(round(minutes * 60.0 / PERIOD)):
        if tick % 3000 == 250:
            rig.link.clock.wait_until(rig.machine.time + 0.15)
        phase = 0.05 * tick
        rig.loop.tick(DRIVE + np.r_[[0.3 * np.sin(phase)] * 4, [5.0 * np.sin(0.7 * phase) - 3.0] * 4])
    assert rig.loop.pacer.missed > 5
    rig.loop.stop()
    assert rig.loop.reason == "end"
    assert rig.loop.phase is Phase.TORQUE_OFF


@pytest.mark.parametrize(("speed", "time", "way"), [(3.0, 0.2, 0.03), (1.0, 0.54, 0.04), (0.3, 1.7, 0.065), (0.1, 5.05, 0.12)])
def test_a_frozen_wheel_is_found_after_half_a_radian_of_setpoint(speed, time, way):
    """Not after a time: the velocity loop's integral breaks friction after so much of its setpoint, however slow that is."""
    rig = Rig()
    watch = Watch(rig)
    rig.loop.start()
    setpoints = np.r_[[np.pi / 2] * 4, [speed] * 4]
    rig.drive(1.0, setpoints)
    rig.inject("encoder_frozen wheel_lf")
    struck, begin = rig.machine.time, true_angles(rig)[4]
    with pytest.raises(StoppedError, match="frozen: wheel_lf"):
        rig.drive(6.0, setpoints)
    watch.look()
    assert watch.off_at is not None
    assert watch.off_at - struck <= time
    assert abs(true_angles(rig)[4] - begin) * ROBOT.wheel.radius <= way


def test_a_drift_inside_the_servos_loop_is_found_where_a_leg_stands():
    """The servo follows its encoder: the reading stays, and the leg goes."""
    rig = Rig()
    rig.loop.start()
    rig.drive(6.0, np.r_[DRIVE[:4], [0.0] * 4])  # the motor's line is learned meanwhile
    rig.inject("encoder_drift leg_lr value=0.153")
    begin = true_angles(rig)[2]
    with pytest.raises(StoppedError, match=r"frozen: leg_lr .* its encoder drifts"):
        rig.drive(2.0, np.r_[DRIVE[:4], [0.0] * 4])
    assert abs(true_angles(rig)[2] - begin) < 0.14
    assert not rig.torque().any()


def test_two_servos_with_one_id_are_called_that():
    rig = Rig()
    rig.loop.start()
    rig.inject("duplicate_id leg_lr")
    words = r"leg_lr for 0\.4\d s \(limit 0\.4 s\).*broken packets.*two servos with the same id"
    with pytest.raises(StoppedError, match=words):
        rig.drive(1.0)
    again = Rig(machine=rig.machine)
    with pytest.raises(StoppedError, match=r"leg_lr +answer: \d+ broken packets.*second servo with id 1"):
        again.loop.start()


def test_torque_goes_off_in_time_after_total_loss():
    """The bound of the ladder, to the tick: from the last answer until the last motor is off."""
    rig = Rig()
    watch = Watch(rig)
    rig.start(0.5)
    rig.inject("drop legs wheels")
    lost = rig.machine.time
    rig.stops("silence: no answer from leg_lf", 2.0)
    watch.look()
    assert watch.off_at is not None
    assert watch.off_at - lost <= OFF_BOUND
    assert HARDWARE.safety.silence <= watch.off_at - lost


def test_wheels_stop_before_torque_goes_off():
    """Coast for three ticks, then hold, then off."""
    rig = Rig()
    rig.start(0.5)
    rig.inject("drop legs wheels")
    lost, setpoints = rig.machine.time, {}
    rig.loop.operator.spare = lambda: setpoints.__setitem__(round(rig.machine.time - lost, 3), rig.loop.setpoints[4])
    with pytest.raises(StoppedError):
        rig.drive(2.0)
    assert all(goal == 3.0 for time, goal in setpoints.items() if time < 0.06)
    assert all(goal == 0.0 for time, goal in setpoints.items() if time > 0.16)


def test_an_adapter_that_comes_back_is_told_to_switch_off():
    rig = Rig(off_time=2.0)
    rig.start(0.3)
    rig.inject("unplug wheels duration=0.8")
    with pytest.raises(StoppedError, match="port") as stop:
        rig.drive(2.0)
    assert "CUT THE POWER" not in str(stop.value)
    assert not rig.torque().any()


def test_servos_that_cannot_be_reached_are_named():
    rig = Rig(off_time=0.2)
    rig.start(0.3)
    rig.inject("unplug wheels")
    with pytest.raises(
        StoppedError, match="CUT THE POWER: torque is not confirmed off at wheel_lf, wheel_rf, wheel_lr, wheel_rr"
    ):
        rig.drive(2.0)
    assert rig.torque().tolist() == [False] * 4 + [True] * 4
    assert [rig.machine.servos[joint]["bus_watchdog"] for joint in JOINTS[4:]] == [-1] * 4


@pytest.mark.parametrize("seed", [0, 1, *(pytest.param(seed, marks=pytest.mark.slow) for seed in range(2, 12))])
def test_confirmations_of_torque_off_add_up_on_a_bad_line(seed):
    """Two of five answers are lost: no servo is asked for what it has confirmed, and nobody cries wolf."""
    rig = Rig(options=MachineOptions(timing=NO_TIME, seed=seed))
    rig.start(0.1)
    rig.inject("drop legs wheels probability=0.4")
    rig.loop.stop()
    assert not rig.torque().any()
    assert "CUT THE POWER" not in rig.loop.reason


def test_a_bus_that_does_not_answer_does_not_delay_the_other():
    """Torque off is said to all before anybody is asked to confirm."""
    rig, off_at = Rig(), {}
    rig.start(0.3)
    step = rig.machine.step

    def watched():
        step()
        for bus, part in (("legs", slice(0, 4)), ("wheels", slice(4, 8))):
            if not rig.torque()[part].any():
                off_at.setdefault(bus, rig.machine.time)

    rig.machine.step = watched
    rig.inject("drop legs wheels")
    rig.stops("silence", 2.0)
    assert abs(off_at["legs"] - off_at["wheels"]) < 0.012
