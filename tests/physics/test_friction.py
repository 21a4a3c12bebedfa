"""Friction of the wheels on the floor against closed forms: level, direction, ellipse, heading, stiction, rolling, creep."""

import numpy as np
import pytest
from energy import wheel_gaps
from rig import (
    BACKENDS,
    HOME,
    MASS,
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
    own_path,
    turn,
    wheels_off,
)

from wlr_gym.physics import servo

AXIS_SIGN = ((0, 1.0), (0, -1.0), (1, 1.0), (1, -1.0))
AXIS, SIGN = np.array(AXIS_SIGN).T
EACH = pytest.mark.parametrize("backend", BACKENDS)
#: The engine at every step, MuJoCo at its own.
AT_STEPS = pytest.mark.parametrize(("backend", "step"), [*(("gibbs_appell", step) for step in STEPS), ("mujoco", 1e-3)])


def level(mu_x, mu_y=None):
    return {"ground.mu_x": mu_x, "ground.mu_y": mu_x if mu_y is None else mu_y}


@AT_STEPS
def test_every_drawn_friction_is_the_one_measured(backend, step):
    """48 robots with random mu_x, mu_y, grip and heading skid with locked wheels, along the heading or the axle: mu g."""
    count = 48
    rng = np.random.default_rng(11)
    mu, grip = rng.uniform(0.1, 0.75, (count, 2)), rng.uniform(0.8, 1.15, count)  # at mu = 1 the robot tips over
    axis, sign = rng.integers(0, 2, count), rng.choice([-1.0, 1.0], count)
    rows = np.arange(count), axis

    def place(state):
        turn(state, rng.uniform(-np.pi, np.pi, count))
        state.linear_velocity_in_body[rows] = 6.0 * sign

    edit = [lock, level(mu[:, :1], mu[:, 1:]), {"wheel.grip": grip[:, None]}]
    plant = make_plant(count, edit, place, step=step, backend=backend)
    before, after = (drive(plant, seconds).linear_velocity_in_body for seconds in (0.3, 0.1))
    measured = (sign * (before - after)[rows] / 0.1) / G
    np.testing.assert_allclose(measured, (mu * grip[:, None])[rows], rtol=5e-3)
    shown = plant.truth().effective_friction.reshape(count, 4, 2)
    np.testing.assert_allclose(shown, np.repeat((mu * grip[:, None])[:, None], 4, axis=1), rtol=1e-12)


@AT_STEPS
@pytest.mark.parametrize("excess", [-0.2, 0.2])
def test_locked_robot_on_an_incline(backend, step, excess):
    """It holds 0.2 degrees below the friction angle and slides 0.2 degrees above it, up, down and across the slope."""
    angle = np.arctan(ROBOT.ground.mu_x) + np.radians(excess)
    rows = np.arange(4), AXIS.astype(int)
    slope, expected = np.zeros((2, 4, 2))
    slope[rows] = SIGN * angle
    plant = make_plant(4, [lock, {"ground.slope": slope}], step=step, backend=backend)
    start, end = drive(plant, 1.0), drive(plant, 1.0)
    if excess < 0:
        most = 1e-5 if backend == "gibbs_appell" else 1e-4  # MuJoCo's soft friction creeps
        assert np.linalg.norm((end.position - start.position)[:, :2], axis=1).max() < most
        return
    rate = G * (np.sin(angle) - ROBOT.ground.mu_x * np.cos(angle))
    expected[rows] = -SIGN * rate
    gained = (end.linear_velocity_in_body - start.linear_velocity_in_body)[:, :2]
    np.testing.assert_allclose(gained, expected, atol=5e-3 * rate)


def roll(edit, step, seconds, backend="gibbs_appell"):
    """Free-wheeling robots rolling at 0.5 m/s: their speed after a settling time and ``seconds`` later, and the truth then."""

    def place(state):
        state.linear_velocity_in_body[:, 0] = 0.5
        state.joint_velocity[:, 4:] = 0.5 / RADIUS

    plant = make_plant(2, [free_wheels, edit], place, step=step, backend=backend)
    before, after = (drive(plant, time, torque_on=wheels_off(2)) for time in (0.2, seconds))
    return before.linear_velocity_in_body[:, 0], after.linear_velocity_in_body[:, 0], after


@pytest.mark.parametrize("step", STEPS)
def test_free_rolling_keeps_its_speed(step):
    before, after, _ = roll(None, step, 1.0)
    np.testing.assert_allclose(after, before, rtol=1e-6)


@AT_STEPS
def test_rolling_resistance_brakes_a_free_rolling_robot(backend, step):
    """c m g = (m + 4 I / r^2) a; MuJoCo's own rolling friction would take the wheel's grip away."""
    resistance = np.array([0.01, 0.02])
    before, after, truth = roll({"ground.rolling_resistance": resistance[:, None]}, step, 0.5, backend)
    expected = resistance * G * MASS / (MASS + 4 * WHEEL_INERTIA / RADIUS**2)
    np.testing.assert_allclose((before - after) / 0.5, expected, rtol=2e-3)
    np.testing.assert_allclose(truth.rolling_torque.sum(axis=1), -resistance * WEIGHT * RADIUS, rtol=2e-3)


@EACH
def test_rolling_resistance_holds_a_free_rolling_robot_on_a_gentle_slope(backend):
    """True stiction: slope below the coefficient holds it, slope above it does not."""
    slope = np.column_stack([np.arctan([0.019, 0.021]), np.zeros(2)])
    plant = make_plant(2, [free_wheels, {"ground.rolling_resistance": 0.02, "ground.slope": slope}], backend=backend)
    start, end = (drive(plant, seconds, torque_on=wheels_off(2)).position[:, 0] for seconds in (0.5, 1.0))
    travel = np.abs(end - start)
    assert travel[0] < (1e-6 if backend == "gibbs_appell" else 3e-4)
    assert travel[1] > 1e-3


def test_rolling_resistance_sticks_under_a_steady_load_in_mujoco():
    """A load below the bound does not creep: with true stiction the wheel ends still, and carries the load."""
    load = np.array([0.3, 0.6, 0.9]) * 0.05 * WEIGHT
    edit = [free_wheels, {"ground.rolling_resistance": 0.05, "external_force[x]": load}]
    truth = drive(make_plant(3, edit, backend="mujoco"), 1.0, torque_on=wheels_off(3))
    assert np.abs(truth.joint_velocity[:, 4:]).max() < 1e-5  # a viscous hold creeps at 1e-2; MuJoCo's soft contact at 1e-6
    np.testing.assert_allclose(truth.rolling_torque.sum(axis=1), -load * RADIUS, rtol=2e-3)


@pytest.mark.parametrize("step", STEPS)
def test_wheels_driven_above_their_grip_spin(step):
    """The robot accelerates at mu g, its wheels as a DC motor with load torque mu N r: w(t) = w_end (1 - exp(-t/T))."""
    mu, armature, wheel = 0.05, 0.05, ROBOT.servo.wheel
    loose = {"servo.coulomb_friction of wheels": wheel.coulomb_friction, "servo.armature of wheels": armature}
    plant = make_plant(2, [lock, loose, level(mu)], step=step)
    sign = np.array([1.0, -1.0])
    setpoints = np.hstack([np.tile(HOME[:4], (2, 1)), np.repeat(100.0 * sign[:, None], 4, axis=1)])
    early, late = (drive(plant, seconds, setpoints) for seconds in (0.1, 0.2))

    constant, resistance = servo.motor_constants(wheel.stall_torque, wheel.no_load_speed, 12.0)
    damping = constant**2 / resistance
    load = wheel.coulomb_friction + mu * WEIGHT / 4 * RADIUS
    end_speed = (wheel.stall_torque - load) / damping
    time_constant = (armature + ROBOT.wheel.spin_inertia) / damping
    for truth, time in ((early, 0.1), (late, 0.3)):
        expected = end_speed * (1 - np.exp(-time / time_constant))
        np.testing.assert_allclose(sign * truth.joint_velocity[:, 4:].mean(axis=1), expected, rtol=5e-3)
    gained = sign * (late.linear_velocity_in_body - early.linear_velocity_in_body)[:, 0]
    np.testing.assert_allclose(gained / 0.2, mu * G, rtol=5e-3)


# ---- direction ---------------------------------------------------------------------------------------------------------

DIRECTIONS = np.radians(np.arange(12) * 30.0)


def direction_case(backend, mode, mu, step):
    """Push twelve robots so that their wheels slip at 1 m/s in twelve directions; return slip (12, 4, 2) and force."""
    rolling = {"locked": 0.0, "free": 2.0, "driven": 0.2}[mode]

    def place(state):
        turn(state, 0.7 * DIRECTIONS)
        state.linear_velocity_in_body[:, 0] = np.cos(DIRECTIONS) + rolling
        state.linear_velocity_in_body[:, 1] = np.sin(DIRECTIONS)
        state.joint_velocity[:, 4:] = state.reference_velocity[:, 4:] = rolling / RADIUS

    edit = [lock if mode == "locked" else free_wheels, level(*mu)]
    plant = make_plant(12, edit, place, step=step, period=step, backend=backend)
    setpoints = np.concatenate([HOME[:4], np.full(4, 100.0)])
    truth = drive(plant, max(step, 0.005), setpoints, torque_on=None if mode == "driven" else wheels_off(12))
    return truth.slip_velocity.reshape(12, 4, 2), contact_force(truth)


@pytest.mark.parametrize(
    ("backend", "step", "mode"),
    [*(("gibbs_appell", step, mode) for step in STEPS for mode in ("driven", "free", "locked")), ("mujoco", 1e-3, "locked")],
)
@pytest.mark.parametrize("mu", [(0.5, 0.5), (0.8, 0.4)])
def test_friction_points_where_it_dissipates_most(backend, step, mode, mu):
    """Force along -(mu_x^2 s_x, mu_y^2 s_y) and on the rim of the ellipse; row-by-row solvers fail this."""
    slip, force = direction_case(backend, mode, mu, step)
    squared = np.square(mu)
    exact = np.arctan2(-squared[1] * slip[..., 1], -squared[0] * slip[..., 0])
    error = np.angle(np.exp(1j * (np.arctan2(force[..., 1], force[..., 0]) - exact)))
    assert np.linalg.norm(slip, axis=2).min() > 0.5
    assert np.degrees(np.abs(error)).max() < 0.05
    rim = np.hypot(*(force[..., :2] / mu).transpose(2, 0, 1))
    np.testing.assert_allclose(rim, force[..., 2], rtol=1e-6 if backend == "gibbs_appell" else 1e-3)


def random_setpoints(rng, count):
    return np.concatenate([np.pi / 2 + rng.uniform(-0.4, 0.4, (count, 4)), rng.uniform(-6, 6, (count, 4))], axis=1)


def test_friction_never_leaves_its_ellipse():
    """200 robots with 800 different wheels' coefficients, driven at random for 2 s, every tick."""
    rng = np.random.default_rng(4)
    mu = rng.uniform(0.05, 1.2, (200, 4, 2))
    plant = make_plant(200, level(mu[..., 0], mu[..., 1]))
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


@EACH
def test_anisotropic_friction_is_the_same_at_any_heading(backend):
    """One random drive at eight headings: paths in the start frame agree, body velocities too."""
    yaw = np.radians(np.arange(8) * 45.0 + 7.0)
    yaw[0] = 0.0
    rng = np.random.default_rng(5)
    plant = make_plant(8, level(0.8, 0.4), lambda state: turn(state, yaw), backend=backend)
    for _ in range(10):
        drive(plant, 0.2, random_setpoints(rng, 1))
    truth = plant.truth()
    path = own_path(truth, yaw)
    assert np.linalg.norm(path[0, :2]) > 0.02
    np.testing.assert_allclose(path, np.tile(path[0], (8, 1)), atol=1e-6)
    np.testing.assert_allclose(truth.linear_velocity_in_body, np.tile(truth.linear_velocity_in_body[0], (8, 1)), atol=1e-6)


# ---- creep and contact in MuJoCo ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("step", [1e-3, 2.5e-4])
def test_tyre_creep_under_a_steady_pull_in_mujoco(step):
    """Locked wheels, pull F along or across: slip speed v_c atanh(F/(mu m g))."""
    share, rows = np.tile([0.2, 0.5, 0.8], 2), (np.arange(6), np.repeat([0, 1], 3))
    force = np.zeros((6, 2))
    force[rows] = share * ROBOT.ground.mu_x * WEIGHT
    plant = make_plant(6, [lock, {"ground.creep_speed": 0.03, "external_force": force}], step=step, backend="mujoco")
    velocity = drive(plant, 1.0).linear_velocity_in_body[rows]
    np.testing.assert_allclose(velocity, 0.03 * np.arctanh(share), rtol=2e-3)


def test_contact_geometry_of_mujoco_is_the_thin_discs():
    """A robot rolled and pitched on unequal legs: MuJoCo's normal forces are those of the disc's own spring."""
    plant = make_plant(1, period=1e-3, backend="mujoco")
    truth = drive(plant, 1.0, np.concatenate([[1.2, 1.5, 1.7, 2.0], np.zeros(4)]))
    w, x, y, z = truth.quaternion[0]
    assert abs(2 * (y * z + w * x)) > 0.01  # it rolls
    gap = wheel_gaps(plant.parameters, truth)
    expected = np.maximum(-plant.parameters["ground.normal_stiffness"] * gap, 0.0)
    np.testing.assert_allclose(contact_force(truth)[..., 2], expected, rtol=2e-3)
