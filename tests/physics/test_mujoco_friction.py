"""Friction of the wheels in MuJoCo is the one asked for: level, direction, heading, stiction, rolling, creep."""

import numpy as np
import pytest
from rig import free_wheels, lock, turn
from two_plants import BACKENDS, ROBOT, drive, make

G, MASS, RADIUS = ROBOT.gravity, ROBOT.total_mass, ROBOT.wheel.radius


@pytest.mark.parametrize("backend", BACKENDS)
def test_every_drawn_friction_is_the_one_measured(backend):
    """48 robots with random mu_x, mu_y, grip and heading skid with locked wheels, along the heading or the axle: mu g."""
    count = 48
    rng = np.random.default_rng(11)
    mu, grip = rng.uniform(0.1, 0.75, (count, 2)), rng.uniform(0.8, 1.15, count)  # at mu = 1 the robot tips over
    axis, sign = rng.integers(0, 2, count), rng.choice([-1.0, 1.0], count)
    rows = np.arange(count), axis

    def edit(parameters):
        lock(parameters)
        parameters["ground.mu_x"], parameters["ground.mu_y"] = mu[:, :1], mu[:, 1:]
        parameters["wheel.grip"] = grip[:, None]

    def place(state):
        turn(state, rng.uniform(-np.pi, np.pi, count))
        state.linear_velocity_in_body[rows] = 6.0 * sign

    plant = make(backend, count, edit, place)
    before = drive(plant, 0.3)
    after = drive(plant, 0.1)
    measured = (sign * (before - after)[rows] / 0.1) / G
    expected = (mu * grip[:, None])[rows]
    np.testing.assert_allclose(measured, expected, rtol=5e-3)
    shown = plant.truth().effective_friction.reshape(count, 4, 2)
    np.testing.assert_allclose(shown, np.repeat((mu * grip[:, None])[:, None], 4, axis=1), rtol=1e-12)


@pytest.mark.parametrize("mu", [(0.5, 0.5), (0.8, 0.4)])
def test_friction_points_where_it_dissipates_most(mu):
    """Skidding at 1 m/s in twelve directions and headings: force along -(mu_x^2 s_x, mu_y^2 s_y), on the ellipse."""
    course = np.radians(np.arange(12) * 30.0)

    def edit(parameters):
        lock(parameters)
        parameters["ground.mu_x"], parameters["ground.mu_y"] = mu

    def place(state):
        turn(state, 0.7 * course)
        state.linear_velocity_in_body[:, 0], state.linear_velocity_in_body[:, 1] = np.cos(course), np.sin(course)

    plant = make("mujoco", 12, edit, place, period=1e-3)
    drive(plant, 0.005)
    slip, force = plant.truth().slip_velocity.reshape(12, 4, 2), plant.truth().contact_force.reshape(12, 4, 3)
    assert np.linalg.norm(slip, axis=2).min() > 0.5
    exact = np.arctan2(-(mu[1] ** 2) * slip[..., 1], -(mu[0] ** 2) * slip[..., 0])
    error = np.angle(np.exp(1j * (np.arctan2(force[..., 1], force[..., 0]) - exact)))
    assert np.degrees(np.abs(error)).max() < 0.05
    np.testing.assert_allclose(np.hypot(*(force[..., :2] / mu).transpose(2, 0, 1)), force[..., 2], rtol=1e-3)


def test_anisotropic_friction_is_the_same_at_any_heading():
    yaw = np.radians(np.arange(6) * 60.0 + 7.0)
    yaw[0] = 0.0
    rng = np.random.default_rng(5)

    def edit(parameters):
        parameters["ground.mu_x"], parameters["ground.mu_y"] = 0.8, 0.4

    plant = make("mujoco", 6, edit, lambda state: turn(state, yaw))
    for _ in range(8):
        setpoints = np.concatenate([np.pi / 2 + rng.uniform(-0.4, 0.4, 4), rng.uniform(-6, 6, 4)])
        drive(plant, 0.2, setpoints)
    truth = plant.truth()
    x, y = truth.position[:, 0], truth.position[:, 1]
    path = np.column_stack([np.cos(yaw) * x + np.sin(yaw) * y, np.cos(yaw) * y - np.sin(yaw) * x, truth.position[:, 2]])
    assert np.linalg.norm(path[0, :2]) > 0.02
    np.testing.assert_allclose(path, np.tile(path[0], (6, 1)), atol=1e-6)


@pytest.mark.parametrize("excess", [-0.2, 0.2])
def test_locked_robot_on_an_incline(excess):
    """0.2 degrees below the friction angle it creeps by MuJoCo's soft friction only, 0.2 degrees above it slides."""
    angle = np.arctan(ROBOT.ground.mu_x) + np.radians(excess)

    def edit(parameters):
        lock(parameters)
        parameters["ground.slope"][[0, 1], [0, 1]] = angle

    plant = make("mujoco", 2, edit)
    before = drive(plant, 1.0)
    start = plant.truth().position.copy()
    gained = drive(plant, 1.0) - before
    if excess < 0:
        assert np.linalg.norm((plant.truth().position - start)[:, :2], axis=1).max() < 1e-4
        return
    expected = -G * (np.sin(angle) - ROBOT.ground.mu_x * np.cos(angle)) * np.eye(2)
    np.testing.assert_allclose(gained[:, :2], expected, atol=5e-3 * np.abs(expected).max())


def test_rolling_resistance_brakes_a_free_rolling_robot():
    """c m g = (m + 4 I/r^2) a; MuJoCo's own rolling friction would take the wheel's grip away."""
    resistance = np.array([0.01, 0.02])
    inertia = ROBOT.wheel.spin_inertia + ROBOT.servo.wheel.armature

    def edit(parameters):
        free_wheels(parameters)
        parameters["ground.rolling_resistance"] = resistance[:, None]

    def place(state):
        state.linear_velocity_in_body[:, 0] = 0.5
        state.joint_velocity[:, 4:] = 0.5 / RADIUS

    plant = make("mujoco", 2, edit, place)
    off = np.ones((2, 8), bool)
    off[:, 4:] = False
    before = drive(plant, 0.2, torque_on=off)[:, 0]
    after = drive(plant, 0.5, torque_on=off)[:, 0]
    expected = resistance * G * MASS / (MASS + 4 * inertia / RADIUS**2)
    np.testing.assert_allclose((before - after) / 0.5, expected, rtol=2e-3)
    torque = plant.truth().rolling_torque
    np.testing.assert_allclose(torque.sum(axis=1), -resistance * MASS * G * RADIUS, rtol=2e-3)


def test_rolling_resistance_holds_on_a_gentle_slope():
    def edit(parameters):
        free_wheels(parameters)
        parameters["ground.rolling_resistance"] = 0.02
        parameters["ground.slope"][:, 0] = np.arctan([0.019, 0.021])

    plant = make("mujoco", 2, edit)
    off = np.ones((2, 8), bool)
    off[:, 4:] = False
    drive(plant, 0.5, torque_on=off)
    start = plant.truth().position[:, 0].copy()
    drive(plant, 1.0, torque_on=off)
    travel = np.abs(plant.truth().position[:, 0] - start)
    assert travel[0] < 3e-4
    assert travel[1] > 1e-3


def test_rolling_resistance_sticks_under_a_steady_load():
    """A load below the bound does not creep: with true stiction the wheel ends still, and carries the load."""
    share = np.array([0.3, 0.6, 0.9])

    def edit(parameters):
        free_wheels(parameters)
        parameters["ground.rolling_resistance"] = 0.05
        parameters["external_force"][:, 0] = share * 0.05 * MASS * G

    plant = make("mujoco", 3, edit)
    off = np.ones((3, 8), bool)
    off[:, 4:] = False
    drive(plant, 1.0, torque_on=off)
    truth = plant.truth()
    assert np.abs(truth.joint_velocity[:, 4:]).max() < 1e-5  # a viscous hold creeps at 1e-2; MuJoCo's soft contact at 1e-6
    np.testing.assert_allclose(truth.rolling_torque.sum(axis=1), -share * 0.05 * MASS * G * RADIUS, rtol=2e-3)


@pytest.mark.parametrize("step", [1e-3, 2.5e-4])
def test_tyre_creep_under_a_steady_pull(step):
    """Locked wheels, pull F along or across: slip speed v_c atanh(F/(mu m g))."""
    share = np.array([0.2, 0.5, 0.8, 0.2, 0.5, 0.8])
    axis = np.array([0, 0, 0, 1, 1, 1])
    speed = 0.03

    def edit(parameters):
        lock(parameters)
        parameters["ground.creep_speed"] = speed
        pull = share * ROBOT.ground.mu_x * MASS * G
        parameters["external_force"][np.arange(6), axis] = pull

    plant = make("mujoco", 6, edit, step=step)
    velocity = drive(plant, 1.0)[np.arange(6), axis]
    np.testing.assert_allclose(velocity, speed * np.arctanh(share), rtol=2e-3)


def test_contact_geometry_is_the_thin_discs():
    """A robot rolled and pitched on unequal legs: MuJoCo's normal forces are those of the disc's own spring."""
    plant = make("mujoco", 1, period=1e-3)
    setpoints = np.concatenate([[1.2, 1.5, 1.7, 2.0], np.zeros(4)])
    drive(plant, 1.0, setpoints)
    truth, p = plant.truth(), plant.parameters
    w, x, y, z = truth.quaternion[0]
    n = np.array([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)])
    assert abs(n[1]) > 0.01
    angle = truth.joint_position[0, :4]
    signs = np.array([[1, 1, 1], [1, -1, 1], [-1, 1, 1], [-1, -1, 1]])
    axle = p["hip.position"] * signs + p["leg.length"].T * np.stack([np.cos(angle), 0 * angle, -np.sin(angle)], axis=1)
    gap = truth.position[0, 2] + axle @ n - RADIUS * np.hypot(n[0], n[2])
    expected = np.maximum(-p["ground.normal_stiffness"][0] * gap, 0.0)
    np.testing.assert_allclose(truth.contact_force.reshape(4, 3)[:, 2], expected, rtol=2e-3)
