"""What the safety rules decide, and what must be no fault: pure functions, tried with anything; nothing gets past them."""

import ast
import itertools
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from wlr_gym.data.format import Profile
from wlr_gym.hardware.config import SafetyLimits
from wlr_gym.hardware.safety import joints, limiter, rules
from wlr_gym.hardware.safety.rules import Level, Memory
from wlr_gym.hardware.safety.status import RobotStatus, ratings_of
from wlr_gym.hardware.servos import ServoRegisters
from wlr_gym.robot import JOINTS, load_robot

ROOT = Path(__file__).resolve().parents[2]
ROBOT = load_robot("emanual")
LIMITS = SafetyLimits()
RATINGS = ratings_of(ROBOT, 0.02)
HOME = np.r_[[np.pi / 2] * 4, [0.0] * 4]
STEP = 0.02 * np.r_[[LIMITS.leg_speed] * 4, [LIMITS.wheel_acceleration] * 4]


def status(**changes):
    """A robot that stands well."""
    plain = RobotStatus(
        time=1.0,
        position=HOME.copy(),
        velocity=np.zeros(8),
        effort=np.zeros(8),
        silence=np.zeros(8),
        alert=np.zeros(8, bool),
        restarted=np.zeros(8, bool),
        voltage=np.full(8, 12.0),
        temperature=np.full(8, 30.0),
        gyro=np.zeros(3),
        accelerometer=np.array([0.0, 0.0, 9.81]),
        imu_silence=0.0,
        up=np.array([0.0, 0.0, 1.0]),
    )
    return replace(plain, **changes)


def decide(wanted=HOME, previous=HOME, memory=None, torque_on=None, **changes):
    return rules.decide(LIMITS, RATINGS, status(**changes), memory or Memory(), previous, wanted, torque_on)


def noisy(seen, tick):
    """A status with the last bits of IMU and currents in motion, as real ones are."""
    return replace(seen, gyro=seen.gyro + 1e-4 * (tick % 2), effort=seen.effort + 1e-4 * (tick % 2))


def last_for(seconds, limits=LIMITS, **changes):
    """The decision after a status has lasted, and s until the level rose."""
    memory, seen, decision = Memory(), status(**changes), decide()
    for tick in range(round(seconds / 0.02)):
        decision = rules.decide(limits, RATINGS, noisy(seen, tick), memory, HOME, HOME)
        memory = decision.memory
        if decision.level > Level.DRIVE:
            return decision, tick * 0.02
    return decision, np.inf


def at(values, k, base=0.0, size=8, dtype=float):
    found = np.full(size, base, dtype)
    found[k] = values
    return found


# ---- whatever is asked for ---------------------------------------------------------------------------------------------

anything = arrays(np.float64, 8, elements=st.floats(allow_nan=True, allow_infinity=True))
sane = arrays(np.float64, 8, elements=st.floats(-20.0, 20.0))
legal = st.tuples(
    arrays(np.float64, 4, elements=st.floats(0.4, 2.74)), arrays(np.float64, 4, elements=st.floats(-6.4, 6.4))
).map(np.concatenate)
levels = st.sampled_from(
    [{}, {"asked_to_stop": "x"}, {"alert": np.ones(8, bool)}, {"silence": np.full(8, 0.02)}, {"silence": np.full(8, 0.2)}]
)


@settings(max_examples=300, deadline=None)
@given(wanted=anything, previous=sane, position=sane, changes=levels, heat=st.floats(20.0, 90.0))
def test_no_setpoint_ever_jumps_and_all_are_finite(wanted, previous, position, changes, heat):
    decision = decide(wanted, previous, position=position, temperature=np.full(8, heat), **changes)
    assert np.isfinite(decision.setpoints).all()
    assert (np.abs(decision.setpoints - previous) <= STEP + 1e-9).all()


@settings(max_examples=300, deadline=None)
@given(wanted=anything, previous=legal, position=sane)
def test_setpoints_within_limits_stay_within(wanted, previous, position):
    setpoints = decide(wanted, previous, position=position).setpoints
    low, high = ROBOT.leg_limits
    assert (setpoints[:4] >= low + LIMITS.leg_margin - 1e-9).all()
    assert (setpoints[:4] <= high - LIMITS.leg_margin + 1e-9).all()
    assert (np.abs(setpoints[4:]) <= LIMITS.wheel_speed + 1e-9).all()


@settings(max_examples=15, deadline=None)
@given(wanted=legal, previous=sane)
def test_from_outside_the_limits_setpoints_come_back_and_arrive(wanted, previous):
    setpoints = previous
    for _ in range(250):
        setpoints = decide(wanted, setpoints, position=np.where(np.arange(8) < 4, setpoints, 0.0)).setpoints
    np.testing.assert_allclose(setpoints, wanted, atol=0.02)


@settings(max_examples=100, deadline=None)
@given(wanted=legal)
def test_small_steps_of_a_robot_that_is_well_pass_untouched(wanted):
    inner = np.clip(wanted, np.r_[[0.6] * 4, [-6.0] * 4], np.r_[[2.5] * 4, [6.0] * 4])
    previous = inner + 0.3 * STEP
    decision = decide(inner, previous, position=np.where(np.arange(8) < 4, inner, 0.0))
    np.testing.assert_array_equal(decision.setpoints, inner)
    assert decision.level == Level.DRIVE
    assert not decision.limited


@settings(max_examples=200, deadline=None)
@given(
    wanted=anything,
    changes=st.fixed_dictionaries(
        {},
        optional={
            "silence": st.floats(0.0, 1.0).map(lambda s: np.full(8, s)),
            "alert": arrays(bool, 8),
            "restarted": arrays(bool, 8),
            "imu_silence": st.floats(0.0, 1.0),
            "temperature": arrays(np.float64, 8, elements=st.floats(0, 100) | st.just(np.nan)),
            "voltage": arrays(np.float64, 8, elements=st.floats(0, 20) | st.just(np.nan)),
            "effort": arrays(np.float64, 8, elements=st.floats(-10, 10)),
            "gyro": arrays(np.float64, 3, elements=st.floats(-10, 10)),
            "late_ticks": st.integers(0, 10),
            "idle": st.floats(0.0, 1.0),
            "asked_off": st.sampled_from(["", "key"]),
            "lost": st.sampled_from(["", "port"]),
        },
    ),
)
def test_wheels_are_never_driven_when_anything_is_found(wanted, changes):
    """Above COAST the wheels' setpoints go towards zero and the legs' stay, whatever is asked for."""
    previous = np.r_[[1.5] * 4, [2.0, -2.0, 0.5, 0.0]]
    decision = decide(wanted, previous, **changes)
    assert decision.level == max((verdict.level for verdict in decision.verdicts), default=Level.DRIVE)
    if decision.level >= Level.HOLD:
        assert (np.abs(decision.setpoints[4:]) <= np.abs(previous[4:])).all()
        np.testing.assert_array_equal(decision.setpoints[:4], previous[:4])
    if decision.level == Level.COAST:
        np.testing.assert_array_equal(decision.setpoints[:4], previous[:4])
        assert (np.abs(decision.setpoints[4:]) <= np.abs(previous[4:])).all()  # a hot motor slows down all the same


def test_setpoints_brake_before_the_leg_limit():
    setpoints, steps = HOME.copy(), []
    for _ in range(60):
        new = decide(np.full(8, 3.0), setpoints, position=setpoints).setpoints
        steps.append(new[0] - setpoints[0])
        setpoints = new
    assert setpoints[0] == pytest.approx(ROBOT.leg_limits[1] - LIMITS.leg_margin, abs=1e-3)
    assert steps[0] == pytest.approx(0.16)
    assert all(later <= earlier + 1e-12 for earlier, later in itertools.pairwise(steps))


def test_an_inverted_range_drives_no_leg_past_its_end():
    """Clipping to a range from high to low gives one of its ends: a margin of 3 rad would lie far outside the leg's limits."""
    limits = LIMITS.model_copy(update={"leg_margin": 3.0})
    low, high = ROBOT.leg_limits
    setpoints = HOME
    for _ in range(200):
        setpoints, _ = rules.limit_setpoints(limits, RATINGS, HOME, setpoints, setpoints, 1.0)
        assert (setpoints[:4] >= low).all()
        assert (setpoints[:4] <= high).all()


def test_a_blocked_leg_winds_up_no_setpoint():
    setpoints = HOME.copy()
    for _ in range(50):
        setpoints = decide(np.r_[[2.5] * 4, [0.0] * 4], setpoints, position=HOME).setpoints
    np.testing.assert_allclose(setpoints[:4], np.pi / 2 + LIMITS.leg_lead)


def test_setpoints_of_motors_that_are_off_are_not_looked_at():
    on = np.r_[[True] * 4, [False] * 4]
    decision = decide(np.r_[HOME[:4], [np.nan] * 4], torque_on=on)
    assert decision.level == Level.DRIVE
    np.testing.assert_array_equal(decision.setpoints, HOME)
    np.testing.assert_array_equal(decision.torque_on, on)


def test_register_limits_are_kept_too():
    ratings = ratings_of(ROBOT, 0.02, low=np.r_[[1.5] * 4, [-1.0] * 4], high=np.r_[[1.6] * 4, [1.0] * 4])
    setpoints = HOME.copy()
    for _ in range(100):
        setpoints = rules.decide(LIMITS, ratings, status(), Memory(), setpoints, np.r_[[2.5] * 4, [5.0] * 4]).setpoints
    np.testing.assert_allclose(setpoints, [1.6] * 4 + [1.0] * 4, atol=1e-3)


# ---- supervision -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("changes", "rule", "level"),
    [
        ({"silence": at(0.02, 2)}, "silence", Level.COAST),
        ({"silence": at(0.10, 2)}, "silence", Level.HOLD),
        ({"silence": at(0.45, 2)}, "silence", Level.OFF),
        ({"imu_silence": 0.15}, "imu", Level.STOP),
        ({"alert": at(True, 5, False, dtype=bool)}, "alert", Level.STOP),
        ({"restarted": at(True, 5, False, dtype=bool)}, "restart", Level.OFF),
        ({"temperature": at(70.0, 1, 30.0)}, "temperature", Level.STOP),
        ({"late_ticks": 5}, "deadlines", Level.STOP),
        ({"late_share": 0.2}, "deadlines", Level.STOP),
        ({"idle": 0.25}, "idle", Level.OFF),
        ({"lost": "port gone"}, "port", Level.OFF),
        ({"asked_to_stop": "SIGINT"}, "stop", Level.STOP),
        ({"asked_off": "key"}, "emergency stop", Level.OFF),
    ],
)
def test_what_acts_at_once(changes, rule, level):
    decision = decide(**changes)
    assert decision.level == level
    assert [verdict.rule for verdict in decision.verdicts] == [rule]


@pytest.mark.parametrize(
    ("changes", "rule", "level", "after"),
    [
        ({"effort": at(-0.75 * 7.3, 0)}, "load", Level.STOP, LIMITS.load_time),
        ({"effort": at(0.75 * 1.5, 6)}, "load", Level.STOP, LIMITS.load_time),
        ({"effort": np.r_[[4.2] * 4, [0.2] * 4]}, "current", Level.STOP, LIMITS.current_time),
        ({"voltage": at(9.9, 3, 12.0)}, "voltage", Level.STOP, LIMITS.low_voltage_time),
        ({"up": np.array([np.sin(0.75), 0.0, np.cos(0.75)])}, "tilt", Level.OFF, LIMITS.tilt_time),
        ({"gyro": np.array([4.5, 0.0, 0.0])}, "tilt ahead", Level.STOP, LIMITS.tilt_time),
    ],
)
def test_what_must_last(changes, rule, level, after):
    decision, waited = last_for(3.0, **changes)
    assert [verdict.rule for verdict in decision.verdicts] == [rule]
    assert decision.level == level
    assert waited == pytest.approx(after, abs=0.021)


@pytest.mark.parametrize(
    "changes",
    [
        {"effort": at(0.65 * 7.3, 0)},
        {"effort": np.r_[[3.7] * 4, [0.2] * 4]},  # 9.7 A
        {"voltage": np.full(8, 10.3)},
        {"voltage": np.full(8, np.nan), "temperature": np.full(8, np.nan)},
        {
            "up": np.array([np.sin(0.35), 0.0, np.cos(0.35)]),
            "accelerometer": 9.81 * np.array([np.sin(0.35), 0.0, np.cos(0.35)]),
        },
        {"gyro": np.array([0.0, 0.0, 6.0])},
        {"temperature": np.full(8, 60.0)},
        {"imu_silence": 0.05},
        {"idle": 0.1},
        {"late_ticks": 4},
    ],
)
def test_what_is_still_well(changes):
    decision, _ = last_for(3.0, **changes)
    assert decision.level == Level.DRIVE


def test_loads_that_come_and_go_are_forgiven():
    memory = Memory()
    for tick in range(500):
        high = tick % 100 < 40
        decision = rules.decide(LIMITS, RATINGS, noisy(status(effort=at(6.0 * high, 0)), tick), memory, HOME, HOME)
        memory = decision.memory
        assert decision.level == Level.DRIVE


def test_hot_motors_slow_the_wheels_down_before_they_stop_the_robot():
    speeds = []
    for heat in (55.0, 62.0, 65.0, 67.9):
        setpoints = HOME.copy()
        for _ in range(10):
            setpoints = decide(np.r_[HOME[:4], [5.0] * 4], setpoints, temperature=at(heat, 7, 30.0)).setpoints
        speeds.append(setpoints[4])
    np.testing.assert_allclose(speeds, [5.0, 5.0, 6.4 * 0.5, 6.4 * 0.1 / 6.0], atol=1e-9)


def test_deadman_is_off_unless_asked_for():
    assert decide(operator_silence=1e9).level == Level.DRIVE
    limits = LIMITS.model_copy(update={"deadman": 0.5})
    assert rules.decide(limits, RATINGS, status(operator_silence=0.6), Memory(), HOME, HOME).level == Level.HOLD


def test_late_ticks_are_not_blamed_while_answers_are_missing():
    assert decide(late_ticks=9, silence=np.full(8, 0.02)).level == Level.COAST


# ---- the vertical ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("axis", [0, 1])
def test_the_vertical_follows_a_turn_and_forgets_a_wrong_start(axis):
    rate, angle = np.zeros(3), 0.0
    rate[axis] = 0.5
    up = np.array([0.0, 0.0, 1.0])
    for _ in range(50):
        angle += 0.5 * 0.02
        up = rules.next_up(up, rate, np.array([99.0, 0.0, 0.0]), 0.02)  # no gravity to be seen: gyroscope only
    assert rules.tilt_of(up) == pytest.approx(angle, abs=0.003)
    still = np.array([0.0, 0.0, 9.81])
    for _ in range(200):
        up = rules.next_up(up, np.zeros(3), still, 0.02)
    assert rules.tilt_of(up) < 0.001


def test_tilt_is_seen_before_it_is_there():
    """Falling over the side at 3 rad/s: stopped before the body has passed the limit."""
    memory, up, rate, tilt = Memory(), np.array([0.0, 0.0, 1.0]), np.array([3.0, 0.0, 0.0]), 0.0
    decision = decide()
    for tick in range(40):
        tilt += 0.06
        up = rules.next_up(up, rate, np.zeros(3), 0.02)
        decision = rules.decide(LIMITS, RATINGS, noisy(status(up=up, gyro=rate), tick), memory, HOME, HOME)
        memory = decision.memory
        if decision.level >= Level.STOP:
            break
    assert decision.verdicts[0].rule == "tilt ahead"
    assert tilt < LIMITS.tilt


# ---- joints that do not do what they are told, readings that are not true -----------------------------------------------

ARMED = replace(RATINGS, watchdog=10.0, goal_pwm=np.full(8, 885.0))
ROLL = np.r_[HOME[:4], [3.0] * 4]


def registers(**changes):
    """Registers of a robot that stands well."""
    well = {"torque": 1.0, "error": 0.0, "watchdog": 10.0, "goal_pwm": 885.0, "voltage_share": 0.0}
    return ServoRegisters(**{name: np.full(8, value) for name, value in well.items()} | changes)


def run(ticks, see, setpoints=HOME, ratings=ARMED, torque_on=None, noise=noisy):
    """The first verdict, and after how many control steps it came, while ``see(tick)`` gives the status' changes."""
    memory = Memory()
    for tick in range(ticks):
        seen = noise(status(**{"registers": registers()} | see(tick)), tick)
        decision = rules.decide(LIMITS, ratings, seen, memory, setpoints, setpoints, torque_on)
        memory = decision.memory
        if decision.verdicts:
            return decision.worst, tick
    return rules.FINE, ticks


def turning(k, speed, share=None):
    """Changes of a status in which joint k reads a speed while its motor turns at a part of its no-load speed (its own)."""
    share = speed / RATINGS.no_load_speed[k] if share is None else share
    return {"registers": registers(voltage_share=at(share, k)), "velocity": at(speed, k)}


@pytest.mark.parametrize(
    ("changes", "rule", "level", "text"),
    [
        ({"torque": at(0.0, 2, 1.0)}, "torque", Level.OFF, "leg_lr: Torque Enable is 0, expected 1"),
        ({"watchdog": at(0.0, 5, 10.0)}, "register", Level.STOP, "wheel_rf: Bus Watchdog is 0, expected 10"),
        ({"watchdog": at(-1.0, 5, 10.0)}, "watchdog", Level.STOP, "wheel_rf heard nothing"),
        ({"goal_pwm": at(200.0, 0, 885.0)}, "register", Level.STOP, "leg_lf: Goal PWM is 200, expected 885"),
    ],
)
def test_registers_are_what_was_written(changes, rule, level, text):
    verdict, ticks = run(5, lambda tick: {"registers": registers(**changes)})
    assert (verdict.rule, verdict.level, ticks) == (rule, level, 0)
    assert text in verdict.text


def test_a_motor_that_is_off_on_purpose_is_none_that_lost_torque():
    on = np.ones(8, bool)
    on[1] = False
    memory = replace(Memory(), torque_on=on)
    seen = status(registers=registers(torque=on.astype(float)))
    assert not rules.decide(LIMITS, ARMED, seen, memory, HOME, HOME, on).verdicts
    seen = status(registers=registers())
    assert rules.decide(LIMITS, ARMED, seen, memory, HOME, HOME, on).worst.text.startswith("leg_rf: Torque Enable is 1")


def test_a_shutdown_and_a_reboot_are_called_by_their_names():
    lost = registers(torque=at(0.0, 0, 1.0), error=at(32.0, 0))
    verdict, _ = run(1, lambda tick: {"registers": lost, "alert": at(True, 0, False, dtype=bool)})
    assert (verdict.rule, verdict.text) == ("alert", "leg_lf has a hardware error: overload")
    verdict, _ = run(1, lambda tick: {"registers": lost, "restarted": at(True, 0, False, dtype=bool)})
    assert verdict.rule == "restart"


def test_what_no_motor_can_have_made_stays_impossible_by_waiting():
    before = status(suspect=at(True, 0, False, dtype=bool), unseen=np.full(8, 0.02), silence=np.full(8, 0.3))
    seconds = joints.unseen(RATINGS, before, 1.02)
    assert seconds.tolist() == pytest.approx([0.02] + [0.32] * 7)
    assert joints.reach(LIMITS, RATINGS, seconds)[0] == pytest.approx(1.5 * ROBOT.servo.leg.no_load_speed * 0.02 + 0.03)


def test_a_jump_names_what_was_read():
    verdict = decide(jump=at(0.5, 3), unseen=np.full(8, 0.02), reach=np.full(8, 0.2)).worst
    assert (verdict.rule, verdict.level) == ("jump", Level.OFF)
    assert "leg_rr reads 2.07 rad, 0.50 rad from its reading 0.020 s before" in verdict.text
    assert "limit 0.20 rad" in verdict.text


def test_a_leg_that_stands_repeats_its_count_for_minutes():
    standing = {"effort": at(2.0, 1), "registers": registers(voltage_share=at(2.0 / 7.3, 1))}
    assert run(9000, lambda tick: standing) == (rules.FINE, 9000)


@pytest.mark.parametrize("factor", [0.75, 1.3])
def test_a_blocked_leg_with_a_resistance_that_is_off_is_not_frozen(factor):
    """Its motor gives 4 N m; the voltage that it takes for that is off by as much as warm windings make it."""
    blocked = {"effort": at(4.0, 1), "registers": registers(voltage_share=at(factor * 4.0 / 7.3, 1))}
    assert run(1000, lambda tick: blocked)[0] is rules.FINE


def test_a_wheel_whose_motor_still_brakes_is_not_frozen():
    """Told to turn back slowly, it stands until the servo's integral has changed its sign."""
    turn_back = HOME + at(-0.4, 6)
    for share, found in ((0.05, False), (-0.05, True)):
        verdict, _ = run(120, lambda tick, share=share: {"registers": registers(voltage_share=at(share, 6))}, turn_back)
        assert (verdict.rule == "frozen") is found


@pytest.mark.parametrize("factor", [0.85, 1.15])
def test_a_leg_that_is_held_after_it_carried_little_is_not_frozen(factor):
    """What its resistance is at small loads is not taken for sure at large ones."""

    def see(tick):
        strain = (0.05 if tick < 200 else 0.6) + 0.001 * (tick % 2)
        return {"effort": at(strain * RATINGS.stall_torque[0], 0), "registers": registers(voltage_share=at(factor * strain, 0))}

    assert run(245, see)[0] is rules.FINE


def test_a_wheel_that_stands_once_it_is_told_to_stop_is_not_frozen():
    """A bump or a weak battery stops it at once, faster than its velocity loop would."""
    memory, position = Memory(), HOME.copy()
    for tick in range(200):
        setpoints, speed = (HOME + at(4.0, 6), 4.0) if tick < 100 else (HOME, 0.0)
        position = position + at(0.02 * speed, 6)
        share = registers(voltage_share=at(speed / RATINGS.no_load_speed[6], 6))
        rolled = status(position=position, velocity=at(speed, 6), registers=share)
        decision = rules.decide(LIMITS, ARMED, noisy(rolled, tick), memory, setpoints, setpoints)
        memory = decision.memory
        assert not decision.verdicts


def test_a_leg_whose_motor_turns_and_whose_count_does_not_is_frozen():
    verdict, ticks = run(50, lambda tick: turning(2, 0.0, 0.2), HOME + at(0.2, 2))
    assert (verdict.rule, verdict.level) == ("frozen", Level.OFF)
    assert "leg_lr reads 1.571 rad" in verdict.text
    assert "limit 0.02 rad" in verdict.text
    assert ticks * 0.02 <= 0.1


@pytest.mark.parametrize(
    ("speed", "share", "rule", "words"),
    [
        (0.33, 0.2, "encoder", "leg_lr reads 0.33 rad/s, 30% of that while its motor turns at 1.11"),
        (-1.11, 0.2, "reversed", "leg_lr turns at -1.11 rad/s, its motor at 1.11"),
        (0.0, 0.03, "frozen", "its encoder drifts"),
    ],
)
def test_an_encoder_that_lies_is_told_what_it_does(speed, share, rule, words):
    moves = 0.01 * np.sign(speed)
    verdict, ticks = run(50, lambda tick: turning(2, speed, share) | {"position": HOME + at(moves * tick, 2)})
    assert (verdict.rule, verdict.level) == (rule, Level.OFF)
    assert words in verdict.text
    assert 2 <= ticks <= 15


def test_a_current_that_never_changes_is_called_that():
    stuck = lambda tick: turning(2, 0.0) | {"effort": at(0.6, 2), "gyro": np.full(3, 1e-4 * tick)}  # noqa: E731
    verdict, ticks = run(50, stuck, noise=lambda seen, tick: seen)
    assert (verdict.rule, verdict.level) == ("current sensor", Level.STOP)
    assert "leg_lr: its current reads the same for 0." in verdict.text
    assert ticks <= 5
    assert run(50, stuck)[0].rule == "frozen"


def test_one_reading_that_is_off_is_a_spike():
    assert run(30, lambda tick: turning(2, 0.0, 0.9 * (tick == 10)))[0] is rules.FINE


@pytest.mark.parametrize("factor", [0.7, 1.3])
def test_a_motor_as_far_from_its_file_as_may_be_is_learned(factor):
    """After a while it is known well enough for an encoder that reads 70 % of the motion to be found."""

    def see(tick, gain=1.0):
        speed = 2.0 * np.sin(0.1 * tick)
        return turning(2, gain * speed, speed / (factor * RATINGS.no_load_speed[2])) | {
            "position": HOME + at(gain * 0.05 * (1.0 - np.cos(0.1 * tick)), 2)
        }

    assert run(2000, see)[0] is rules.FINE
    verdict, ticks = run(1100, lambda tick: see(tick, 1.0 if tick < 1000 else 0.7))
    assert (verdict.rule, ticks > 1000) == ("encoder", True)


def test_a_wheel_turns_unless_more_than_half_of_the_robot_holds_it():
    held = lambda share: lambda tick: turning(6, 0.4, share) | {"position": HOME + at(0.01 * tick, 6)}  # noqa: E731
    assert run(100, held(0.3), HOME + at(0.2, 6))[0] is rules.FINE
    verdict, _ = run(100, held(0.9), HOME + at(0.2, 6))
    assert (verdict.rule, verdict.level) == ("encoder", Level.OFF)
    assert verdict.text.startswith("wheel_lr reads 0.40 rad/s")


@pytest.mark.parametrize(("joint", "setpoints"), [(2, HOME), (6, HOME + at(1.5, 6))])
def test_an_encoder_whose_last_bits_rattle_is_frozen_all_the_same(joint, setpoints):
    """At a wheel's 1.5 rad/s the tracking rule never sees it, and its servo would drive it at full voltage."""

    def rattling(tick):
        seen = turning(joint, 0.2 * np.sin(2.0 * tick), 0.2)
        return seen | {"position": HOME + at(0.0015 * (tick % 3 - 1), joint)}

    verdict, ticks = run(100, rattling, setpoints)
    assert (verdict.rule, verdict.level) == ("frozen", Level.OFF)
    assert verdict.text.startswith(JOINTS[joint])
    assert ticks * 0.02 <= (0.1 if joint == 2 else 0.8)


def test_a_leg_that_turns_back_may_repeat_its_count_by_chance():
    """In a dozen control steps, nearly at full speed: its velocity says that it moves."""
    assert run(12, lambda tick: turning(2, 3.0 * (-1) ** tick))[0] is rules.FINE


def test_a_wheel_told_to_turn_whose_count_does_not_is_frozen():
    others = np.arange(8) > 4
    speed = np.r_[np.zeros(4), np.full(4, 3.0)]
    rolling = {"velocity": speed, "registers": registers(voltage_share=speed / RATINGS.no_load_speed)}
    verdict, ticks = run(50, lambda tick: rolling | {"position": HOME + 0.06 * tick * others}, ROLL)
    assert verdict.rule == "frozen"
    assert verdict.text.startswith("wheel_lf")
    assert 0.1 < ticks * 0.02 < 0.5
    assert run(5000, lambda tick: {}, np.r_[HOME[:4], [0.04] * 4])[0] is rules.FINE  # may be less than its friction


def test_a_leg_that_stays_away_from_its_setpoint_does_not_follow():
    ahead = HOME + at(0.25, 0)
    verdict, ticks = run(50, lambda tick: {}, ahead)
    assert (verdict.rule, verdict.level) == ("tracking", Level.OFF)
    assert "leg_lf is at 1.57 rad, more than 0.2 rad from its setpoint for 0.32 s (limit 0.30 s)" in verdict.text
    assert ticks * 0.02 == pytest.approx(LIMITS.leg_error_time, abs=0.021)
    assert run(50, lambda tick: turning(0, 1.5), ahead)[0] is rules.FINE  # it comes
    assert run(50, lambda tick: {}, HOME + at(0.19, 0))[0] is rules.FINE


def test_a_profile_is_given_its_time():
    slow = replace(ARMED, profile=Profile(leg_velocity=0.36, leg_acceleration=0.374, wheel_acceleration=0.374))
    assert run(50, lambda tick: turning(0, min(0.36, 0.374 * 0.02 * tick)), HOME + at(0.4, 0), slow)[0] is rules.FINE
    wheels = np.arange(8) > 3
    speed = [0.374 * 0.02 * tick for tick in range(300)]
    rolling = lambda tick: {"velocity": speed[tick] * wheels, "position": HOME + sum(speed[:tick]) * 0.02 * wheels}  # noqa: E731
    assert run(300, rolling, ROLL, slow)[0] is rules.FINE


def test_a_wheel_that_is_too_slow_does_not_follow():
    crawling = lambda tick: {"velocity": at(0.2, 6), "position": HOME + 0.004 * tick * (np.arange(8) > 3)}  # noqa: E731
    setpoints = HOME + at(3.0, 6)
    verdict, ticks = run(100, crawling, setpoints)
    assert verdict.rule == "tracking"
    assert "wheel_lr turns at 0.20 rad/s" in verdict.text
    assert "expected 3.0" in verdict.text or "expected 2." in verdict.text
    assert ticks * 0.02 > LIMITS.wheel_error_time


def test_an_imu_that_repeats_its_values_is_frozen():
    memory, decision, ticks = Memory(), decide(), 0
    while not decision.verdicts:
        decision, ticks = rules.decide(LIMITS, RATINGS, status(), memory, HOME, HOME), ticks + 1
        memory = decision.memory
    assert (decision.worst.rule, decision.worst.level) == ("imu frozen", Level.STOP)
    assert ticks * 0.02 <= LIMITS.imu_frozen + 0.061


# ---- limits are data ---------------------------------------------------------------------------------------------------


def test_every_limit_stands_in_the_file_with_its_reason():
    text = (ROOT / "configs/hardware/nominal.yaml").read_text(encoding="utf-8")
    section = text.split("\nsafety:", 1)[1]
    assert set(yaml.safe_load(text)["safety"]) == set(SafetyLimits.model_fields)
    assert SafetyLimits(**yaml.safe_load(text)["safety"]) == SafetyLimits()
    for name in SafetyLimits.model_fields:
        assert re.search(rf"^  {name}: \S+ +# .{{15,}}$", section, re.MULTILINE), name


@pytest.mark.parametrize(
    "wrong", [{"coast": 0.5}, {"warm": 70.0}, {"watchdog": 3.0}, {"start_error": 0.0}, {"speed": 1.0}, {"load": np.inf}]
)
def test_limits_that_make_no_sense_are_refused(wrong):
    with pytest.raises(ValueError, match=next(iter(wrong))):
        SafetyLimits(**wrong)


def test_every_limit_does_something():
    """Each attribute of SafetyLimits is read somewhere in the hardware package."""
    sources = "".join(path.read_text(encoding="utf-8") for path in (ROOT / "wlr_gym/hardware").rglob("*.py"))
    for name in SafetyLimits.model_fields:
        assert re.search(rf"(limits|safety)\.{name}\b", sources), name


# ---- nothing gets past it ----------------------------------------------------------------------------------------------

#: Functions that can move servos, and the modules that may call them (the benchmark of the bus: on the emulator only).
WRITERS = {"write_setpoints", "write_item", "write_all", "send_packet"}
ALLOWED = {
    "hardware/safety/limiter.py",
    "hardware/safety/watchdog.py",
    "hardware/servos.py",
    "hardware/dynamixel/bus.py",
    "hardware/dynamixel/port.py",
}


def test_only_command_limiter_and_watchdog_process_write_setpoints_and_torque():
    found = set()
    for path in (ROOT / "wlr_gym").rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute) and node.func.attr in WRITERS:
                found.add(path.relative_to(ROOT / "wlr_gym").as_posix())
    assert "hardware/safety/limiter.py" in found
    assert found <= ALLOWED, found - ALLOWED


#: Modules that write single items of servos. Preflight's registers are mended with torque off; commissioning has own limits.
SINGLE_WRITERS = {
    "hardware/safety/limiter.py",
    "hardware/safety/preflight.py",
    "hardware/commissioning/stand.py",
}


def test_single_items_are_written_by_limiter_preflight_and_commissioning_only():
    found = set()
    for path in (ROOT / "wlr_gym/hardware").rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if not (isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute) and node.func.attr == "set"):
                continue
            if len(node.args) == 3 or any(isinstance(one, ast.Starred) for one in node.args):
                found.add(path.relative_to(ROOT / "wlr_gym").as_posix())
    assert found == SINGLE_WRITERS


def test_the_command_limiter_does_not_hand_out_the_servos():
    assert not [
        name for name in dir(limiter.CommandLimiter) if "servos" in name.lower() and not name.startswith("_CommandLimiter__")
    ]
    assert "dry_run" in limiter.CommandLimiter.__init__.__code__.co_varnames
    assert not {"enabled", "off_switch", "bypass"} & set(limiter.CommandLimiter.__init__.__code__.co_varnames)
