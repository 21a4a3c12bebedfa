"""The servo against data sheets, closed forms and the profile's own promises."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from wlr_gym.base.errors import InputError
from wlr_gym.physics import servo
from wlr_gym.physics.codegen import Graph, emit, load_module
from wlr_gym.robot import load_robot
from wlr_gym.robot.parameters import Parameters

RPM = 2 * math.pi / 60
PAPER_WHEEL_SPEED = 80 * 0.229 * RPM
PAPER_WHEEL_ACCELERATION = 214.577 * 2 * math.pi / 3600


# --- motor


def test_data_sheet_points_come_back():
    constant, resistance = servo.motor_constants(1.5, 6.388, 12.0)
    assert servo.motor_torque(constant, resistance, 12.0, 0.0) == pytest.approx(1.5)
    assert servo.motor_torque(constant, resistance, 12.0, 6.388) == pytest.approx(0.0, abs=1e-12)
    assert servo.motor_torque(constant, resistance, 6.0, 0.0) == pytest.approx(0.75)


def test_free_motor_follows_the_closed_form_step_response():
    inertia, voltage, step = 0.010, 12.0, 2e-6
    constant, resistance = servo.motor_constants(7.3, 5.55, 12.0)
    time_constant = inertia * resistance / constant**2
    speed = 0.0
    for _ in range(round(time_constant / step)):
        half = speed + 0.5 * step * servo.motor_torque(constant, resistance, voltage, speed) / inertia
        speed += step * servo.motor_torque(constant, resistance, voltage, half) / inertia
    elapsed = round(time_constant / step) * step
    assert speed == pytest.approx(5.55 * (1 - math.exp(-elapsed / time_constant)), rel=1e-6)


def test_voltage_is_the_wish_inside_the_supply_and_the_supply_beyond():
    assert servo.controller_voltage(8.63, 0.44, 0.5, 2.0, 0.1, 1.0, 12.0) == pytest.approx(8.63 * 0.4 + 0.44)
    assert servo.controller_voltage(55.0, 0.0, 2.0, 0.0, 0.0, 0.0, 11.0) == 11.0
    assert servo.controller_voltage(55.0, 0.0, -2.0, 0.0, 0.0, 0.0, 11.0) == -11.0


def test_what_a_controller_holds_is_the_motors_voltage():
    """Ohm's law with the robot's own winding; the effort is reported with the nominal motor's constant."""
    robot = load_robot()
    parameters = Parameters.nominal(robot)
    parameters["servo.stall_torque"], parameters["servo.no_load_speed"] = 1.2, 7.0
    parameters["servo.kp"], parameters["servo.integral_cycle"] = 9.0, 2e-3
    effort, rate = 0.3, 2.5
    ahead = effort * servo.reference_per_effort(robot, parameters) + rate * servo.reference_per_rate(robot, parameters)
    own = 12.0 / 7.0
    for joints, reported, kp in ((slice(0, 4), robot.servo.leg, 9.0), (slice(4, 8), robot.servo.wheel, 4.5)):
        current = effort / (12.0 / reported.no_load_speed)
        voltage = own * 12.0 / 1.2 * current + own * rate
        assert kp * ahead[0, joints] == pytest.approx(np.full(4, voltage), rel=1e-12)


# --- wheel profile


def drive_wheel(goal, acceleration, duration, step=1e-3, kp=0.0):
    position = velocity = 0.0
    for _ in range(round(duration / step)):
        position, velocity, *_ = servo.wheel_profile_step(position, velocity, goal, acceleration, step, 0.0, kp, 12.0)
    return position, velocity


def test_paper_ramp_takes_5_1226_seconds():
    ramp = PAPER_WHEEL_SPEED / PAPER_WHEEL_ACCELERATION
    assert ramp == pytest.approx(5.1226, abs=1e-4)
    position, velocity = drive_wheel(PAPER_WHEEL_SPEED, PAPER_WHEEL_ACCELERATION, 5.122)
    assert velocity == pytest.approx(PAPER_WHEEL_ACCELERATION * 5.122, rel=1e-9)
    assert position == pytest.approx(0.5 * PAPER_WHEEL_ACCELERATION * 5.122**2, rel=1e-9)
    assert drive_wheel(PAPER_WHEEL_SPEED, PAPER_WHEEL_ACCELERATION, 5.123)[1] == PAPER_WHEEL_SPEED


@pytest.mark.parametrize("step", [2.5e-4, 1e-3, 4e-3])
@pytest.mark.parametrize("acceleration", [3.0, 11.2, servo.NO_LIMIT])
def test_reference_position_is_the_exact_integral_at_every_step_size(step, acceleration):
    goal, duration = 1.9, 1.2
    expected = goal * duration - 0.5 * goal**2 / acceleration
    assert drive_wheel(goal, acceleration, duration, step)[0] == pytest.approx(expected, abs=1e-12)


def test_anti_windup_holds_the_integral_at_the_supply_and_lets_go_at_once():
    kp, supply, step = 8.63, 12.0, 1e-3
    position = velocity = mean = 0.0
    for _ in range(3000):  # stalled shaft
        position, velocity, mean, _ = servo.wheel_profile_step(position, velocity, 6.0, servo.NO_LIMIT, step, 0.0, kp, supply)
    assert kp * position == pytest.approx(supply, abs=1.01 * kp * 6.0 * step)
    assert kp * mean <= supply + kp * 6.0 * step
    position, *_ = servo.wheel_profile_step(1e3, 0.0, 0.0, servo.NO_LIMIT, step, 2.0, kp, supply)
    assert kp * (position - 2.0) == pytest.approx(supply)
    position, *_ = servo.wheel_profile_step(-1e3, 0.0, 0.0, servo.NO_LIMIT, step, 2.0, kp, supply)
    assert kp * (position - 2.0) == pytest.approx(-supply)


def test_no_integral_gain_needs_no_division():
    assert np.isfinite(servo.wheel_profile_step(5.0, 1.0, 1.0, 10.0, 1e-3, 0.0, 0.0, 12.0)).all()


# --- leg profile


def run_leg(start, goal, limit, acceleration, step, dtype=np.float64, longest=20.0):
    """Positions and velocities after every substep until the profile rests at the goal."""
    position, velocity, goal = dtype(start), dtype(0), dtype(goal)
    positions, velocities = [position], [velocity]
    for _ in range(round(longest / step)):
        position, velocity, *_ = (
            dtype(x) for x in servo.leg_profile_step(position, velocity, goal, dtype(limit), dtype(acceleration), dtype(step))
        )
        positions.append(position)
        velocities.append(velocity)
        if position == goal and velocity == 0:
            return np.array(positions), np.array(velocities)
    raise AssertionError(f"not at rest after {longest} s: {goal - position} rad to go at {velocity} rad/s")


def trapezoid_time(distance, limit, acceleration):
    if distance * acceleration > limit**2:
        return distance / limit + limit / acceleration
    return 2 * math.sqrt(distance / acceleration)


def test_paper_leg_turn_takes_5_8224_seconds():
    limit = 15 * 0.229 * RPM
    assert limit == pytest.approx(0.359712, abs=1e-6)
    positions, velocities = run_leg(math.radians(30), math.radians(150), limit, servo.NO_LIMIT, 1e-3)
    arrival = int(np.argmax(positions == math.radians(150))) * 1e-3
    assert 5.8224 <= arrival < 5.8234
    assert velocities.max() == pytest.approx(limit)


@settings(max_examples=40, deadline=None)
@given(
    start=st.floats(0.35, 2.79),
    goal=st.floats(0.35, 2.79),
    limit=st.floats(0.5, 5.0),
    acceleration=st.floats(0.37, 100.0),
    step=st.sampled_from([1e-3, 2e-3, 4e-3]),
    dtype=st.sampled_from([np.float64, np.float32]),
)
def test_trapezoid_is_on_time_within_limits_and_never_overshoots(start, goal, limit, acceleration, step, dtype):
    positions, velocities = run_leg(start, goal, limit, acceleration, step, dtype)
    along = np.sign(dtype(goal) - dtype(start))
    assert (along * (positions - dtype(goal))).max() <= 0
    assert (along * velocities).min() >= 0
    assert np.abs(velocities).max() <= dtype(limit)
    change = np.diff(velocities[:-1])
    assert change.size == 0 or np.abs(change).max() <= 1.03 * acceleration * step + 1e-6
    elapsed = (len(positions) - 1) * step
    assert elapsed == pytest.approx(trapezoid_time(abs(goal - start), limit, acceleration), abs=2 * step + 2e-3)


@settings(max_examples=15, deadline=None)
@given(
    setpoints=st.lists(st.floats(0.35, 2.79), min_size=2, max_size=6),
    acceleration=st.sampled_from([0.3745, 7.49, 15.0, servo.NO_LIMIT]),
    dtype=st.sampled_from([np.float64, np.float32]),
)
def test_goals_that_change_on_the_way_are_reached_without_chatter(setpoints, acceleration, dtype):
    position, velocity = dtype(setpoints[0]), dtype(0)
    args = (dtype(1.0), dtype(acceleration), dtype(2e-3))
    for goal in setpoints:
        for _ in range(150):
            position, velocity, *_ = (dtype(x) for x in servo.leg_profile_step(position, velocity, dtype(goal), *args))
    for _ in range(4000):
        position, velocity, *_ = (dtype(x) for x in servo.leg_profile_step(position, velocity, dtype(setpoints[-1]), *args))
    for _ in range(5):
        assert position == dtype(setpoints[-1])
        assert velocity == 0
        position, velocity, *_ = (dtype(x) for x in servo.leg_profile_step(position, velocity, dtype(setpoints[-1]), *args))


def float32_kernel():
    """The leg profile compiled in float32 throughout, as the engine's fast mode runs it."""
    graph = Graph()
    outputs = servo.leg_profile_step(*(graph.input(name) for name in ("q", "w", "goal", "limit", "acceleration", "step")))
    lines = emit(
        {"q": outputs[0], "w": outputs[1]},
        lambda name: name,
        lambda name, value: f"{name} = {value}",
        "            ",
        constant=lambda value: f"np.float32({value!r})",
    )
    head = """
@compiled(error_model="numpy")
def run(start, setpoints, limits, accelerations, step, count, out):
    for i in range(start.shape[0]):
        q, w, goal, limit, acceleration = start[i], np.float32(0.0), setpoints[i], limits[i], accelerations[i]
        ahead = np.float32(1.0) if goal > q else np.float32(-1.0)
        beyond = np.float32(0.0)
        for _ in range(count):
"""
    tail = """
            beyond = max(beyond, ahead * (q - goal))
        out[i, 0], out[i, 1], out[i, 2] = q, w, beyond
"""
    return load_module("test_leg_profile", head + "\n".join(lines) + tail).run


@pytest.mark.parametrize("step", [5e-4, 1e-3, 2e-3, 4e-3])
def test_float32_arithmetic_does_not_overshoot(step):
    rng = np.random.default_rng(0)
    start, goal, limit = (rng.uniform(*span, 2000).astype(np.float32) for span in ((0.35, 2.79), (0.35, 2.79), (0.5, 5.0)))
    acceleration = np.exp(rng.uniform(np.log(0.37), np.log(100.0), 2000)).astype(np.float32)
    out = np.empty((2000, 3), np.float32)
    float32_kernel()(start, goal, limit, acceleration, np.float32(step), round(12 / step), out)
    assert np.array_equal(out[:, 0], goal)
    assert not out[:, 1].any()
    assert not out[:, 2].any()


def test_a_goal_too_close_to_stop_at_is_passed_by_the_braking_distance():
    position, velocity, acceleration = 1.0, 1.0, 4.0
    farthest = position
    for _ in range(2000):
        position, velocity, *_ = servo.leg_profile_step(position, velocity, 1.05, 2.0, acceleration, 1e-3)
        farthest = max(farthest, position)
    assert farthest - 1.0 == pytest.approx(1.0 / (2 * acceleration), rel=0.02)
    assert (position, velocity) == (1.05, 0.0)


def test_error_of_the_trapezoid_falls_with_the_square_of_the_step():
    start, goal, limit, acceleration, at = 0.5, 2.0, 1.0, 4.0, 1.5
    ramp = limit / acceleration
    exact = start + limit * (at - 0.5 * ramp)
    errors = []
    for step in (3e-3, 1.5e-3):
        positions, _ = run_leg(start, goal, limit, acceleration, step)
        errors.append(abs(positions[round(at / step)] - exact))
    assert errors[0] < acceleration * 3e-3**2
    assert errors[1] < acceleration * 1.5e-3**2


def test_a_step_lands_at_once_and_counts_half_in_its_first_substep():
    position, velocity, mean, mean_velocity = servo.leg_profile_step(1.0, 0.0, 1.4, servo.NO_LIMIT, servo.NO_LIMIT, 1e-3)
    assert (position, velocity, mean, mean_velocity) == (1.4, 0.0, pytest.approx(1.2), 0.0)


def test_profile_registers_at_zero_mean_no_profile():
    velocity, acceleration = servo.profile_limits([0, 1, 0, 1, 0, 0, 0, 0], [0, 0, 5, 5, 0, 5, 0, 5])
    assert velocity.tolist() == [servo.NO_LIMIT, 1, servo.NO_LIMIT, 1] + [servo.NO_LIMIT] * 4
    assert acceleration.tolist() == [servo.NO_LIMIT, servo.NO_LIMIT, servo.NO_LIMIT, 5, servo.NO_LIMIT, 5, servo.NO_LIMIT, 5]
    with pytest.raises(InputError, match=r"\(4,\).*8"):
        servo.profile_limits(np.zeros(4), np.zeros(4))


# --- registers


def test_counts_of_effort_are_those_of_the_registers():
    # XM540: 2.69 mA per count, 12 V / 5.55 rad/s; XL430: 0.1 % of 1.5 N m
    assert servo.effort_counts(load_robot()) == pytest.approx([2.69e-3 * 12 / 5.55] * 4 + [1.5e-3] * 4)


def test_a_servo_may_measure_its_current_or_not_on_either_joint():
    """Two servos on a leg's shaft (the current of one is read), one that measures no current; wheels that measure theirs."""
    given = load_robot("emanual").model_dump(mode="json")
    given["servo"]["leg"] |= {"current_count": 5.38e-3}
    given["servo"]["wheel"] |= {"current_count": 2.69e-3}
    changed = load_robot(given)
    assert servo.measures_current(changed) == (True, True)
    leg, wheel = 7.3 / 4.4, 1.5 / 1.4  # N m/A, of the e-manual's stall torques and currents
    assert servo.effort_counts(changed) == pytest.approx([5.38e-3 * leg] * 4 + [2.69e-3 * wheel] * 4)
    assert (servo.idle_effort(changed)[4:] > 0.0).all()
    given["servo"]["leg"] |= {"current_count": None, "load_count": 1e-3}
    without = load_robot(given)
    assert servo.measures_current(without) == (False, True)
    assert servo.effort_counts(without)[:4] == pytest.approx([7.3e-3] * 4)
    assert (servo.idle_effort(without)[:4] == 0.0).all()
    given["servo"]["leg"] |= {"current_count": 2.69e-3}
    with pytest.raises(InputError, match=r"servo\.leg: current_count and load_count"):
        load_robot(given)
