"""Joints that do not do what they are told, and readings that are not true: pure functions, and what must not be a fault."""

from dataclasses import replace

import numpy as np
import pytest
from test_rules import HOME, LIMITS, RATINGS, ROBOT, at, decide, noisy, status

from wlr_gym.data.format import Profile
from wlr_gym.hardware.config import SafetyLimits
from wlr_gym.hardware.safety import rules
from wlr_gym.hardware.safety.rules import Level, Memory, reach, unseen
from wlr_gym.hardware.servos import ServoRegisters
from wlr_gym.robot import JOINTS

ARMED = replace(RATINGS, watchdog=10.0, goal_pwm=np.full(8, 885.0))
ROLL = np.r_[HOME[:4], [3.0] * 4]


def registers(**changes):
    """Registers of a robot that stands well."""
    well = {"torque": 1.0, "error": 0.0, "watchdog": 10.0, "goal_pwm": 885.0, "voltage_share": 0.0}
    return ServoRegisters(**{name: np.full(8, value) for name, value in well.items()} | changes)


def run(ticks, see, setpoints=HOME, ratings=ARMED, torque_on=None):
    """The first verdict, and how many control steps it took, while ``see(tick)`` gives the status' changes."""
    memory = Memory()
    for tick in range(ticks):
        seen = noisy(status(**{"registers": registers()} | see(tick)), tick)
        decision = rules.decide(LIMITS, ratings, seen, memory, setpoints, setpoints, torque_on)
        memory = decision.memory
        if decision.verdicts:
            return decision.worst, tick
    return None, ticks


def turning(k, speed, share):
    """Changes of a status in which joint k's motor turns at a part of its no-load speed."""
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
    assert verdict is not None
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
    assert verdict is not None
    assert (verdict.rule, verdict.text) == ("alert", "leg_lf has a hardware error: overload")
    verdict, _ = run(1, lambda tick: {"registers": lost, "restarted": at(True, 0, False, dtype=bool)})
    assert verdict is not None
    assert verdict.rule == "restart"


def test_what_no_motor_can_have_made_stays_impossible_by_waiting():
    before = status(suspect=at(True, 0, False, dtype=bool), unseen=np.full(8, 0.02), silence=np.full(8, 0.3))
    seconds = unseen(RATINGS, before, 1.02)
    assert seconds.tolist() == pytest.approx([0.02] + [0.32] * 7)
    assert reach(LIMITS, RATINGS, seconds)[0] == pytest.approx(1.5 * ROBOT.servo.leg.no_load_speed * 0.02 + 0.03)


def test_a_jump_names_what_was_read():
    verdict = decide(jump=at(0.5, 3), unseen=np.full(8, 0.02)).worst
    assert (verdict.rule, verdict.level) == ("jump", Level.OFF)
    assert "leg_rr reads 2.07 rad, 0.50 rad from its reading 0.020 s before" in verdict.text
    assert "limit 0.20 rad" in verdict.text


def test_a_leg_that_stands_repeats_its_count_for_minutes():
    standing = {"effort": at(2.0, 1), "registers": registers(voltage_share=at(2.0 / 7.3, 1))}
    assert run(9000, lambda tick: standing) == (None, 9000)


@pytest.mark.parametrize("factor", [0.75, 1.3])
def test_a_blocked_leg_with_a_resistance_that_is_off_is_not_frozen(factor):
    """Its motor gives 4 N m; the voltage that it takes for that is off by as much as warm windings make it."""
    blocked = {"effort": at(4.0, 1), "registers": registers(voltage_share=at(factor * 4.0 / 7.3, 1))}
    assert run(1000, lambda tick: blocked)[0] is None


def test_a_leg_whose_motor_turns_and_whose_count_does_not_is_frozen():
    verdict, ticks = run(50, lambda tick: turning(2, 0.0, 0.2))
    assert verdict is not None
    assert (verdict.rule, verdict.level) == ("frozen", Level.OFF)
    assert "leg_lr reads 1.571 rad" in verdict.text
    assert "limit 0.03 rad" in verdict.text
    assert ticks * 0.02 <= 0.1
    count = 0.0015
    assert run(50, lambda tick: turning(2, 1.0, 0.2) | {"position": HOME + at(count * tick, 2)})[0] is None


@pytest.mark.parametrize(("joint", "setpoints"), [(2, HOME), (6, HOME + at(1.5, 6))])
def test_an_encoder_whose_last_bits_rattle_is_frozen_all_the_same(joint, setpoints):
    """At a wheel's 1.5 rad/s the tracking rule never sees it, and its servo would drive it at full voltage."""

    def rattling(tick):
        seen = turning(joint, 0.2 * np.sin(2.0 * tick), 0.2)
        return seen | {"position": HOME + at(0.0015 * (tick % 3 - 1), joint)}

    verdict, ticks = run(100, rattling, setpoints)
    assert verdict is not None
    assert (verdict.rule, verdict.level) == ("frozen", Level.OFF)
    assert verdict.text.startswith(JOINTS[joint])
    assert ticks * 0.02 <= (0.1 if joint == 2 else 0.8)


def test_a_leg_that_turns_back_may_repeat_its_count_by_chance():
    """At full voltage, in a dozen control steps: its velocity says that it moves."""

    def swinging(tick):
        return turning(2, 3.0 * (-1) ** tick, 0.8)

    assert run(12, swinging)[0] is None


def test_a_wheel_told_to_turn_whose_count_does_not_is_frozen():
    others = np.arange(8) > 4
    speed = np.r_[np.zeros(4), np.full(4, 3.0)]
    verdict, ticks = run(50, lambda tick: {"position": HOME + 0.06 * tick * others, "velocity": speed}, ROLL)
    assert verdict is not None
    assert verdict.rule == "frozen"
    assert verdict.text.startswith("wheel_lf")
    assert 0.1 < ticks * 0.02 < 0.5
    assert run(5000, lambda tick: {}, np.r_[HOME[:4], [0.04] * 4])[0] is None  # may be less than its friction


def test_a_leg_that_stays_away_from_its_setpoint_does_not_follow():
    ahead = HOME + at(0.25, 0)
    verdict, ticks = run(50, lambda tick: {}, ahead)
    assert verdict is not None
    assert (verdict.rule, verdict.level) == ("tracking", Level.OFF)
    assert "leg_lf is at 1.57 rad, more than 0.2 rad from its setpoint for 0.32 s (limit 0.30 s)" in verdict.text
    assert ticks * 0.02 == pytest.approx(LIMITS.leg_error_time, abs=0.021)
    assert run(50, lambda tick: {"velocity": at(1.5, 0)}, ahead)[0] is None  # it comes
    assert run(50, lambda tick: {}, HOME + at(0.19, 0))[0] is None


def test_a_profile_is_given_its_time():
    slow = replace(ARMED, profile=Profile(leg_velocity=0.36, leg_acceleration=0.374, wheel_acceleration=0.374))
    assert run(50, lambda tick: {"velocity": at(min(0.36, 0.374 * 0.02 * tick), 0)}, HOME + at(0.4, 0), slow)[0] is None
    wheels = np.arange(8) > 3
    speed = [0.374 * 0.02 * tick for tick in range(300)]
    rolling = lambda tick: {"velocity": speed[tick] * wheels, "position": HOME + sum(speed[:tick]) * 0.02 * wheels}  # noqa: E731
    assert run(300, rolling, ROLL, slow)[0] is None


def test_a_wheel_that_is_too_slow_does_not_follow():
    crawling = lambda tick: {"velocity": at(0.2, 6), "position": HOME + 0.004 * tick * (np.arange(8) > 3)}  # noqa: E731
    setpoints = HOME + at(3.0, 6)
    verdict, ticks = run(100, crawling, setpoints)
    assert verdict is not None
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


def test_an_error_that_the_lead_limit_never_lets_happen_is_refused():
    with pytest.raises(ValueError, match=r"safety\.leg_error = 0\.5 rad: expected below leg_lead"):
        SafetyLimits(leg_error=0.5)
