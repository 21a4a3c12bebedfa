"""Coulomb friction of the wheels on the floor against closed forms: sliding, sticking, direction, ellipse, heading."""

import numpy as np
import pytest
from rig import (
    HOME,
    RADIUS,
    ROBOT,
    STEPS,
    WEIGHT,
    WHEEL_INERTIA,
    G,
    contact_force,
    drive,
    free_wheels,
    lock,
    make_plant,
    turn,
    wheels_off,
)

from wlr_gym.physics import servo

MASS = ROBOT.total_mass
AXIS_SIGN = ((0, 1.0), (0, -1.0), (1, 1.0), (1, -1.0))


def anisotropic(parameters, robots):
    parameters["ground.mu_x"][robots], parameters["ground.mu_y"][robots] = 0.8, 0.4


@pytest.mark.parametrize("step", STEPS)
def test_locked_wheels_decelerate_at_mu_g(step):
    """Eight robots: forwards, backwards, left, right; isotropic 0.6, then 0.8 along and 0.4 across."""

    def edit(parameters):
        lock(parameters)
        anisotropic(parameters, slice(4, 8))

    def place(state):
        for robot, (axis, sign) in enumerate(AXIS_SIGN * 2):
            state.linear_velocity_in_body[robot, axis] = 5.0 * sign

    plant = make_plant(8, edit, place, step=step)
    before = drive(plant, 0.3).linear_velocity_in_body
    after = drive(plant, 0.1).linear_velocity_in_body
    axis, sign = np.array(AXIS_SIGN * 2).T
    rows = np.arange(8), axis.astype(int)
    expected = np.array([0.6] * 4 + [0.8, 0.8, 0.4, 0.4]) * G
    measured = sign * (before - after)[rows] / 0.1
    np.testing.assert_allclose(measured, expected, rtol=5e-3)


@pytest.mark.parametrize("step", STEPS)
@pytest.mark.parametrize("excess", [-0.2, 0.2])
def test_locked_robot_on_an_incline(step, excess):
    """It holds 0.2 degrees below the friction angle and slides 0.2 degrees above it, up, down and across the slope."""
    angle = np.arctan(ROBOT.ground.mu_x) + np.radians(excess)
    axis, sign = np.array(AXIS_SIGN).T

    def edit(parameters):
        lock(parameters)
        parameters["ground.slope"][np.arange(4), axis.astype(int)] = sign * angle

    plant = make_plant(4, edit, step=step)
    start = drive(plant, 1.0)
    position, velocity = start.position[:, :2], start.linear_velocity_in_body[:, :2]
    end = drive(plant, 1.0)
    if excess < 0:
        assert np.linalg.norm(end.position[:, :2] - position, axis=1).max() < 1e-5
        return
    rate = G * (np.sin(angle) - ROBOT.ground.mu_x * np.cos(angle))
    expected = np.zeros((4, 2))
    expected[np.arange(4), axis.astype(int)] = -sign * rate
    np.testing.assert_allclose(end.linear_velocity_in_body[:, :2] - velocity, expected, atol=5e-3 * rate)


def roll(parameters_edit, step, seconds, count=1):
    """Free-wheeling robots rolling at 0.5 m/s; return their speed after a settling time and ``seconds`` later."""

    def edit(parameters):
        free_wheels(parameters)
        parameters_edit(parameters)

    def place(state):
        state.linear_velocity_in_body[:, 0] = 0.5
        state.joint_velocity[:, 4:] = 0.5 / RADIUS

    plant = make_plant(count, edit, place, step=step)
    off = wheels_off(count)
    before = drive(plant, 0.2, torque_on=off).linear_velocity_in_body[:, 0]
    return before, drive(plant, seconds, torque_on=off).linear_velocity_in_body[:, 0]


@pytest.mark.parametrize("step", STEPS)
def test_free_rolling_keeps_its_speed(step):
    before, after = roll(lambda parameters: None, step, 1.0, count=2)
    np.testing.assert_allclose(after, before, rtol=1e-6)


@pytest.mark.parametrize("step", STEPS)
def test_rolling_resistance_brakes_a_free_rolling_robot(step):
    """c m g = (m + 4 I / r^2) a."""
    resistance = np.array([0.01, 0.02])

    def edit(parameters):
        parameters["ground.rolling_resistance"] = resistance[:, None]

    before, after = roll(edit, step, 0.5, count=2)
    expected = resistance * G * MASS / (MASS + 4 * WHEEL_INERTIA / RADIUS**2)
    np.testing.assert_allclose((before - after) / 0.5, expected, rtol=2e-3)


def test_rolling_resistance_holds_a_free_rolling_robot_on_a_gentle_slope():
    """True stiction: slope below the coefficient holds it, slope above it does not."""

    def edit(parameters):
        free_wheels(parameters)
        parameters["ground.rolling_resistance"] = 0.02
        parameters["ground.slope"][:, 0] = np.arctan([0.019, 0.021])

    plant = make_plant(2, edit)
    start = drive(plant, 0.5, torque_on=wheels_off(2)).position[:, 0]
    travel = np.abs(drive(plant, 1.0, torque_on=wheels_off(2)).position[:, 0] - start)
    assert travel[0] < 1e-6
    assert travel[1] > 1e-3


@pytest.mark.parametrize("step", STEPS)
def test_wheels_driven_above_their_grip_spin(step):
    """The robot accelerates at mu g, its wheels as a DC motor with load torque mu N r: w(t) = w_end (1 - exp(-t/T))."""
    mu, armature, spin_inertia = 0.05, 0.05, ROBOT.wheel.spin_inertia

    def edit(parameters):
        lock(parameters)
        parameters["servo.coulomb_friction"][:, 4:] = ROBOT.servo.wheel.coulomb_friction
        parameters["servo.armature"][:, 4:] = armature
        parameters["ground.mu_x"] = parameters["ground.mu_y"] = mu

    plant = make_plant(2, edit, step=step)
    sign = np.array([1.0, -1.0])
    setpoints = np.concatenate([np.tile(HOME[:4], (2, 1)), np.repeat(100.0 * sign[:, None], 4, axis=1)], axis=1)
    early = drive(plant, 0.1, setpoints)
    late = drive(plant, 0.2, setpoints)

    wheel = ROBOT.servo.wheel
    constant, resistance = servo.motor_constants(wheel.stall_torque, wheel.no_load_speed, 12.0)
    damping = constant**2 / resistance
    load = wheel.coulomb_friction + mu * WEIGHT / 4 * RADIUS
    end_speed = (wheel.stall_torque - load) / damping
    time_constant = (armature + spin_inertia) / damping
    for truth, time in ((early, 0.1), (late, 0.3)):
        expected = end_speed * (1 - np.exp(-time / time_constant))
        np.testing.assert_allclose(sign * truth.joint_velocity[:, 4:].mean(axis=1), expected, rtol=5e-3)
    gained = sign * (late.linear_velocity_in_body - early.linear_velocity_in_body)[:, 0]
    np.testing.assert_allclose(gained / 0.2, mu * G, rtol=5e-3)


def test_external_force_moves_the_locked_robot_only_above_its_grip():
    grip = ROBOT.ground.mu_x * WEIGHT
    directions = np.radians(np.arange(8) * 45.0)
    factor = np.array([0.99, 1.01])

    def edit(parameters):
        lock(parameters)
        course = np.tile(np.column_stack([np.cos(directions), np.sin(directions)]), (2, 1))
        parameters["external_force"] = np.repeat(factor, 8)[:, None] * grip * course

    plant = make_plant(16, edit)
    drive(plant, 1.0)
    start = plant.mechanical_state()
    drive(plant, 1.0)
    end = plant.mechanical_state()
    travel = np.linalg.norm(end.position - start.position, axis=1)
    speed = np.linalg.norm(end.linear_velocity_in_body, axis=1) - np.linalg.norm(start.linear_velocity_in_body, axis=1)
    assert travel[:8].max() < 1e-5
    np.testing.assert_allclose(speed[8:], 0.01 * grip / MASS, rtol=5e-3)


# ---- direction ---------------------------------------------------------------------------------------------------------

DIRECTIONS = np.radians(np.arange(12) * 30.0)


def direction_case(mode, mu, step):
    """Push twelve robots so that their wheels slip at 1 m/s in twelve directions; return slip (12, 4, 2) and force."""
    rolling = {"locked": 0.0, "free": 2.0, "driven": 0.2}[mode]

    def edit(parameters):
        (lock if mode == "locked" else free_wheels)(parameters)
        parameters["ground.mu_x"], parameters["ground.mu_y"] = mu

    def place(state):
        turn(state, 0.7 * DIRECTIONS)
        state.linear_velocity_in_body[:, 0] = np.cos(DIRECTIONS) + rolling
        state.linear_velocity_in_body[:, 1] = np.sin(DIRECTIONS)
        state.joint_velocity[:, 4:] = rolling / RADIUS
        state.reference_velocity[:, 4:] = rolling / RADIUS

    plant = make_plant(12, edit, place, step=step, period=step)
    setpoints = np.concatenate([HOME[:4], np.full(4, 100.0)])
    truth = drive(plant, max(step, 0.005), setpoints, torque_on=None if mode == "driven" else wheels_off(12))
    return truth.slip_velocity.reshape(12, 4, 2), contact_force(truth)


@pytest.mark.parametrize("step", STEPS)
@pytest.mark.parametrize("mode", ["driven", "free", "locked"])
@pytest.mark.parametrize("mu", [(0.5, 0.5), (0.8, 0.4)])
def test_friction_points_where_it_dissipates_most(step, mode, mu):
    """Force along -(mu_x^2 s_x, mu_y^2 s_y) and on the rim of the ellipse; row-by-row solvers fail this."""
    slip, force = direction_case(mode, mu, step)
    squared = np.square(mu)
    exact = np.arctan2(-squared[1] * slip[..., 1], -squared[0] * slip[..., 0])
    error = np.angle(np.exp(1j * (np.arctan2(force[..., 1], force[..., 0]) - exact)))
    assert np.linalg.norm(slip, axis=2).min() > 0.5
    assert np.degrees(np.abs(error)).max() < 0.05
    np.testing.assert_allclose(np.hypot(*(force[..., :2] / mu).transpose(2, 0, 1)), force[..., 2], rtol=1e-6)


def random_setpoints(rng, count):
    return np.concatenate([np.pi / 2 + rng.uniform(-0.4, 0.4, (count, 4)), rng.uniform(-6, 6, (count, 4))], axis=1)


def test_friction_never_leaves_its_ellipse():
    """200 robots with 800 different wheels' coefficients, driven at random for 2 s, every tick."""
    rng = np.random.default_rng(4)
    mu = rng.uniform(0.05, 1.2, (200, 4, 2))

    def edit(parameters):
        parameters["ground.mu_x"], parameters["ground.mu_y"] = mu[..., 0], mu[..., 1]

    plant = make_plant(200, edit)
    worst, sliding = 0.0, 0
    for _ in range(100):
        plant.step(random_setpoints(rng, 200))
        force = contact_force(plant.truth())
        used = np.hypot(force[..., 0] / mu[..., 0], force[..., 1] / mu[..., 1])
        worst = max(worst, (used - force[..., 2]).max())
        sliding += np.count_nonzero(used > 0.999 * force[..., 2])
        assert force[..., 2].min() >= 0.0
    assert sliding > 1000
    assert worst < 1e-9


def test_anisotropic_friction_is_the_same_at_any_heading():
    """One random drive at eight headings: paths in the start frame agree, body velocities too."""
    yaw = np.radians(np.arange(8) * 45.0 + 7.0)
    yaw[0] = 0.0
    rng = np.random.default_rng(5)
    plant = make_plant(8, lambda p: anisotropic(p, slice(None)), lambda s: turn(s, yaw))
    for _ in range(10):
        setpoints = np.repeat(random_setpoints(rng, 1), 8, axis=0)
        for _ in range(10):
            plant.step(setpoints)
    truth = plant.truth()
    x, y = truth.position[:, 0], truth.position[:, 1]
    path = np.column_stack([np.cos(yaw) * x + np.sin(yaw) * y, np.cos(yaw) * y - np.sin(yaw) * x, truth.position[:, 2]])
    assert np.linalg.norm(path[0, :2]) > 0.02
    np.testing.assert_allclose(path, np.tile(path[0], (8, 1)), atol=1e-6)
    np.testing.assert_allclose(truth.linear_velocity_in_body, np.tile(truth.linear_velocity_in_body[0], (8, 1)), atol=1e-6)
