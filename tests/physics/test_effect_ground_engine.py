"""Effects of the floor in the engine: patches, slip weakening, creep, grip, tether; against closed forms."""

import numpy as np
import pytest
from rig import HOME, ROBOT, STEPS, WEIGHT, G, contact_force, drive, lock, make_plant, record, turn

from wlr_gym.physics.plants.base import Truth

MASS = WEIGHT / G


def sliding(parameters):
    lock(parameters)


def thrown(speed):
    def place(state):
        state.linear_velocity_in_body[:, 0] = speed

    return place


def friction_used(truth):
    """Friction over normal force of every wheel (N, 4)."""
    force = contact_force(truth)
    return np.hypot(force[..., 0], force[..., 1]) / force[..., 2]


def contact_x(truth):
    """Place of the contact points (N, 4) along the floor's x for a robot that heads along it, legs down."""
    hip = ROBOT.hip_position.x
    return truth.position[:, :1] + hip * np.array([1.0, 1.0, -1.0, -1.0])


def test_patch_acts_under_each_wheel_from_its_edge_on():
    mu, patch_mu, edge = 0.6, 0.2, 0.25

    def edit(parameters):
        sliding(parameters)
        parameters["ground.mu_x"] = parameters["ground.mu_y"] = mu
        parameters["patch.mu"][:, 1], parameters["patch.x_min"][:, 1], parameters["patch.x_max"][:, 1] = patch_mu, edge, 50.0
        parameters["patch.y_min"][:, 1], parameters["patch.y_max"][:, 1] = -9.0, 9.0

    plant = make_plant(2, edit, thrown(2.0), period=1e-3)
    on_patch, inside = [], []
    for values in record(plant, 0.4):
        truth = Truth(values)
        x = contact_x(truth)
        clear = np.abs(x - edge) > 4e-3
        is_inside = x > edge
        expected = np.where(is_inside, patch_mu, mu)
        np.testing.assert_allclose(np.where(clear, friction_used(truth), expected), expected, rtol=1e-5)
        np.testing.assert_allclose(np.where(clear, truth.effective_friction[:, ::2], expected), expected, rtol=1e-12)
        inside.append(is_inside[0])
        on_patch.append(is_inside[0].sum())
    assert {0, 2, 4} <= set(on_patch)  # front wheels enter first
    assert inside[0].sum() == 0


def test_sliding_slows_by_what_the_floor_under_it_gives():
    mu = 0.25

    def edit(parameters):
        sliding(parameters)
        parameters["ground.mu_x"] = parameters["ground.mu_y"] = 0.6
        parameters["patch.mu"][:, 0] = mu
        for name, value in (("x_min", -50.0), ("x_max", 50.0), ("y_min", -50.0), ("y_max", 50.0)):
            parameters[f"patch.{name}"][:, 0] = value

    plant = make_plant(2, edit, thrown(2.0))
    first, last = drive(plant, 0.2), drive(plant, 0.4)
    rate = (first.linear_velocity_in_body[:, 0] - last.linear_velocity_in_body[:, 0]) / 0.4
    np.testing.assert_allclose(rate, mu * G, rtol=2e-4)


def test_later_patch_wins_and_empty_patches_do_nothing():
    def edit(parameters):
        for k, mu in ((0, 0.1), (2, 0.7)):
            parameters["patch.mu"][0, k] = mu
            parameters["patch.x_min"][0, k], parameters["patch.x_max"][0, k] = -9.0, 9.0
            parameters["patch.y_min"][0, k], parameters["patch.y_max"][0, k] = -9.0, 9.0
        parameters["patch.mu"][1, 3], parameters["patch.x_max"][1, 3] = 0.1, 5.0  # no width along y
        parameters["wheel.grip"][0, 3] = 0.5
        parameters["ground.mu_x"][1], parameters["ground.mu_y"][1] = 0.6, 0.3
        parameters["ground.mu_x"][0], parameters["ground.mu_y"][0] = 0.6, 0.3

    shown = make_plant(2, edit).truth().effective_friction.reshape(2, 4, 2)
    np.testing.assert_allclose(shown[1], np.tile([0.6, 0.3], (4, 1)), rtol=1e-12)
    np.testing.assert_allclose(shown[0], np.outer([1, 1, 1, 0.5], [0.7, 0.35]), rtol=1e-12)


@pytest.mark.parametrize("step", STEPS)
def test_slip_weakening_slows_a_slide_by_its_law(step):
    """dv/dt = -g mu (ratio + (1 - ratio) exp(-v/v_s)), integrated finely by hand."""
    mu, ratio, slip_speed, start = 0.5, 0.4, 0.3, 1.5

    def edit(parameters):
        sliding(parameters)
        parameters["ground.mu_x"] = parameters["ground.mu_y"] = mu
        parameters["ground.kinetic_ratio"], parameters["ground.weakening_speed"] = ratio, slip_speed
        parameters["body.com_offset"] = (0.0, 0.0, -0.05)

    plant = make_plant(2, edit, thrown(start), step=step)
    seen = record(plant, 0.4)
    speed = seen[:, 0, :]
    v, expected = Truth(seen[3]).linear_velocity_in_body[0, 0], []
    for _ in range(3, len(seen)):
        expected.append(v)
        for _ in range(200):  # 20 ms
            middle = v - 0.5e-4 * G * mu * (ratio + (1 - ratio) * np.exp(-v / slip_speed))
            v -= 1e-4 * G * mu * (ratio + (1 - ratio) * np.exp(-middle / slip_speed))
    measured = np.array([Truth(values).linear_velocity_in_body[0, 0] for values in seen[3:]])
    assert measured[-1] > 0.1
    np.testing.assert_allclose(measured, expected, atol=2e-3 + step)
    truth = Truth(seen[-1])
    slip = np.abs(truth.slip_velocity[:, ::2])
    np.testing.assert_allclose(
        friction_used(truth), mu * (ratio + (1 - ratio) * np.exp(-slip / slip_speed)), rtol=0.1 * step / 1e-3
    )
    assert speed.shape[0] == len(seen)


@pytest.mark.parametrize("step", STEPS)
def test_creep_slips_steadily_under_a_steady_pull(step):
    """v = v_c atanh(F/(mu N)) summed over the wheels: here all carry alike."""
    mu, creep_speed, share = 0.5, 0.05, np.array([0.2, 0.6, 0.9, 0.97])

    def edit(parameters):
        sliding(parameters)
        parameters["ground.mu_x"] = parameters["ground.mu_y"] = mu
        parameters["ground.creep_speed"] = creep_speed
        parameters["external_force"][:, 1] = share * mu * WEIGHT

    truth = drive(make_plant(4, edit, step=step), 4.0)
    speed = np.abs(truth.slip_velocity.reshape(4, 4, 2)[..., 1])
    normal = contact_force(truth)[..., 2]
    np.testing.assert_allclose(friction_used(truth), mu * np.tanh(speed / creep_speed), rtol=1e-6)
    np.testing.assert_allclose(np.abs(contact_force(truth)[..., 1]).sum(axis=1), share * mu * WEIGHT, rtol=1e-6)
    alike = np.abs(truth.linear_velocity_in_body[:, 1])
    np.testing.assert_allclose(alike, creep_speed * np.arctanh(share), rtol=0.02)
    assert normal.min() > 0.0


def test_slow_creep_is_dry_friction():
    """Thrown robots come to rest where dry friction stops them, as the creep speed goes to zero."""
    creep_speed = np.array([0.0, 1e-4, 1e-3, 1e-2])

    def edit(parameters):
        sliding(parameters)
        parameters["ground.creep_speed"] = creep_speed[:, None]

    truth = drive(make_plant(4, edit, thrown(1.0)), 0.6)
    off = np.abs(truth.position[1:, 0] - truth.position[0, 0])
    assert off[0] < 1e-4
    assert off[0] < off[1] < off[2]


def test_creep_knows_no_heading():
    """Anisotropic tyres that creep, pushed along the same body direction at eight headings: the same motion in the body."""
    yaw = np.linspace(0.0, 2.0 * np.pi, 8, endpoint=False)
    push = 0.4 * WEIGHT

    def edit(parameters):
        sliding(parameters)
        parameters["ground.mu_x"], parameters["ground.mu_y"] = 0.8, 0.4
        parameters["ground.creep_speed"] = 0.05
        direction = yaw + 0.6
        parameters["external_force"] = push * np.column_stack([np.cos(direction), np.sin(direction)])

    def place(state):
        turn(state, yaw)
        state.linear_velocity_in_body[:] = (0.3, -0.2, 0.0)

    truth = drive(make_plant(8, edit, place), 1.0)
    c, s = np.cos(yaw), np.sin(yaw)
    x, y = truth.position[:, 0], truth.position[:, 1]
    own = np.column_stack([c * x + s * y, c * y - s * x])
    assert np.ptp(own, axis=0).max() < 1e-8
    assert np.ptp(truth.linear_velocity_in_body, axis=0).max() < 1e-8


def test_creep_force_opposes_the_scaled_slip():
    """Along (mu_x^2 sx, mu_y^2 sy), of size N |(mu_x^2 sx, mu_y^2 sy)|/|(mu_x sx, mu_y sy)| tanh(|s|/v_c)."""
    mu = np.array([0.8, 0.4])

    def edit(parameters):
        sliding(parameters)
        parameters["ground.mu_x"], parameters["ground.mu_y"] = mu
        parameters["ground.creep_speed"] = 0.2

    def place(state):
        state.linear_velocity_in_body[:, 0] = 0.3
        state.linear_velocity_in_body[:, 1] = np.linspace(0.0, 0.4, len(state))

    truth = drive(make_plant(6, edit, place, period=1e-3), 0.02)
    slip, force = truth.slip_velocity.reshape(6, 4, 2), contact_force(truth)
    scaled = mu * slip
    size = np.tanh(np.linalg.norm(slip, axis=2) / 0.2) / np.linalg.norm(scaled, axis=2)
    np.testing.assert_allclose(force[..., :2], -mu * scaled * (size * force[..., 2])[..., None], rtol=2e-2, atol=0.02)


def test_creep_converges_with_the_step():
    def edit(parameters):
        parameters["ground.creep_speed"] = 0.03
        parameters["servo.profile_acceleration"] = 15.0

    def end(step):
        plant = make_plant(2, edit, step=step)
        for left, right in ((3.0, -2.0), (-2.0, 4.0), (4.0, 3.0)):
            truth = drive(plant, 0.3, np.concatenate([HOME[:4], [left, right, left, right]]))
        return truth.position[0, :2]

    fine = end(2.5e-5)
    errors = [np.abs(end(step) - fine).max() for step in (2.5e-4, 1e-3, 4e-3)]
    assert errors[1] < 1e-4
    assert errors[0] < 0.5 * errors[1]
    assert errors[2] < 1e-3


def test_tether_is_a_horizontal_spring_to_the_anchor():
    """On ice the robot swings about the anchor with sqrt(k/m); the pull is k times the distance."""
    stiffness, anchor = 40.0, np.array([0.3, -0.2])

    def edit(parameters):
        lock(parameters)
        parameters["ground.mu_x"] = parameters["ground.mu_y"] = 0.0
        parameters["tether.stiffness"] = stiffness
        parameters["tether.anchor"] = anchor

    plant = make_plant(2, edit, period=1e-2)
    seen = record(plant, 2.0)
    time = 0.01 * np.arange(1, len(seen) + 1)
    expected = anchor * (1.0 - np.cos(np.sqrt(stiffness / MASS) * time))[:, None]
    measured = np.array([Truth(values).position[0, :2] for values in seen])
    np.testing.assert_allclose(measured, expected, atol=0.01 * float(np.linalg.norm(anchor)))

    def hold(parameters):
        lock(parameters)
        parameters["tether.stiffness"], parameters["tether.anchor"] = 10.0, (0.5, 0.0)

    held = drive(make_plant(2, hold), 1.0)
    np.testing.assert_allclose(contact_force(held)[..., 0].sum(axis=1), -10.0 * (0.5 - held.position[:, 0]), rtol=1e-4)
