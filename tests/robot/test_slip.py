"""Slip against cases known by hand, and contact velocities against a finite difference of positions."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from wlr_gym.robot import CORNER_SIGNS, load_robot, slip
from wlr_gym.robot.parameters import Parameters

LEVEL = np.array([[1.0, 0.0, 0.0, 0.0]])
RADIUS, LEG = 0.034, 0.135


@pytest.fixture
def parameters():
    return Parameters.nominal(load_robot())


def contact_slip(
    parameters, velocity=(0, 0, 0), rates=(0, 0, 0), angles=(np.pi / 2,) * 4, legs=(0,) * 4, wheels=(0,) * 4, attitude=LEVEL
):
    return slip.contact_slip_velocity(
        parameters,
        attitude,
        np.array([velocity], float),
        np.array([rates], float),
        np.array([[*angles, 0, 0, 0, 0]], float),
        np.array([[*legs, *wheels]], float),
    )[0]


def test_rolling_does_not_slip(parameters):
    assert np.abs(contact_slip(parameters, (0.5, 0, 0), wheels=[0.5 / RADIUS] * 4)).max() < 1e-15


def test_rolling_with_moving_legs_does_not_slip(parameters):
    """The body moves on while its legs turn: the wheel's encoder, relative to the leg, runs slower by the leg's rate."""
    angle, rate, speed = np.array([0.6, 0.6, np.pi - 0.6, np.pi - 0.6]), np.array([0.3, 0.3, -0.3, -0.3]), 0.2
    wheels = (speed - LEG * np.sin(angle) * rate) / RADIUS - rate
    heave = LEG * np.cos(angle[0]) * rate[0]
    result = contact_slip(parameters, (speed, 0, heave), (0, 0, 0), angle, rate, wheels)
    assert np.abs(result).max() < 1e-15


def test_spinning_braking_and_sliding_have_the_stated_signs(parameters):
    assert contact_slip(parameters, wheels=[2.0] * 4)[:, 0] == pytest.approx(np.full(4, -2.0 * RADIUS))
    assert contact_slip(parameters, (0.3, 0, 0))[:, 0] == pytest.approx(np.full(4, 0.3))
    assert contact_slip(parameters, (0, 0.2, 0))[:, 1] == pytest.approx(np.full(4, 0.2))


def test_turning_in_place_slides_each_wheel_across(parameters):
    rate = 0.7
    expected = [[-rate * 0.16 * y, rate * 0.175 * x] for x, y in CORNER_SIGNS]
    np.testing.assert_allclose(contact_slip(parameters, rates=(0, 0, rate)), expected, atol=1e-15)


def test_pitching_about_the_axles_counts_as_rolling(parameters):
    """A body pitching about fixed axles with wheels held to it: every contact point moves back at radius times rate."""
    rate, height = 0.4, LEG
    result = contact_slip(parameters, (rate * height, 0, 0), (0, rate, 0))
    assert result[:, 0] == pytest.approx(np.full(4, -RADIUS * rate))


def test_heading_in_the_world_does_not_matter(parameters):
    rng = np.random.default_rng(1)
    tilt = Rotation.from_euler("yx", [0.2, -0.1])
    case = {
        "velocity": rng.normal(size=3),
        "rates": rng.normal(size=3),
        "legs": rng.normal(size=4),
        "wheels": rng.normal(size=4),
    }
    results = []
    for heading in (0.0, 0.9, 2.5, -3.0):
        x, y, z, w = (Rotation.from_euler("z", heading) * tilt).as_quat()
        results.append(contact_slip(parameters, **case, attitude=np.array([[w, x, y, z]])))
    for other in results[1:]:
        np.testing.assert_allclose(other, results[0], atol=1e-14)


def axle_position(parameters, corner, attitude, position, leg_angle):
    """World position of a wheel's centre."""
    hip = parameters["hip.position"][0] * [*CORNER_SIGNS[corner], 1]
    return position + attitude.apply(hip + LEG * np.array([np.cos(leg_angle), 0, -np.sin(leg_angle)]))


def test_contact_velocity_is_the_derivative_of_a_material_point(parameters):
    """A mark on the tyre where it touches: move everything a little and see where it went, in the floor frame."""
    rng = np.random.default_rng(7)
    velocity, rates, angles, legs, wheels = (rng.normal(size=n) for n in (3, 3, 4, 4, 4))
    attitude = Rotation.from_euler("zyx", [1.1, 0.25, -0.15])
    normal = attitude.inv().apply([0, 0, 1])
    mark = -(normal - normal[1] * np.array([0, 1, 0]))
    mark *= RADIUS / np.linalg.norm(mark)

    def place(corner, dt):
        turned = attitude * Rotation.from_rotvec(rates * dt)
        spin = Rotation.from_rotvec([0, (legs[corner] + wheels[corner]) * dt, 0])
        centre = axle_position(parameters, corner, turned, attitude.apply(velocity) * dt, angles[corner] + legs[corner] * dt)
        return centre + turned.apply(spin.apply(mark))

    heading = np.cross(attitude.apply([0, 1, 0]), [0, 0, 1])
    heading /= np.linalg.norm(heading)
    x, y, z, w = attitude.as_quat()
    result = contact_slip(parameters, velocity, rates, angles, legs, wheels, np.array([[w, x, y, z]]))
    for corner in range(4):
        moved = (place(corner, 1e-5) - place(corner, -1e-5)) / 2e-5
        np.testing.assert_allclose(result[corner], [moved @ heading, moved @ np.cross([0, 0, 1], heading)], atol=1e-8)


def test_heading_speed_is_slip_plus_rolling(parameters):
    wheels = np.array([[0, 0, 0, 0, 3.0, 3.0, 3.0, 3.0]])
    rolling = slip.rolling_speed(parameters, np.array([[0, 0.5, 0]]), wheels)
    assert rolling == pytest.approx(np.full((1, 4), 3.5 * RADIUS))
    assert contact_slip(parameters, (0.5 * LEG + 0.2, 0, 0), (0, 0.5, 0), wheels=[3.0] * 4)[:, 0] + rolling[0] == pytest.approx(
        np.full(4, 0.2)
    )


@pytest.mark.parametrize(
    ("heading", "rolling", "ratio"),
    [
        (1.0, 1.0, 0),
        (1.0, 0.0, -1),
        (0.0, 1.0, 1),
        (0.5, 1.0, 0.5),
        (1.0, 0.5, -0.5),
        (-1.0, 1.0, 2),
        (-1.0, -0.5, 0.5),
        (0, 0, 0),
    ],
)
def test_slip_ratio(heading, rolling, ratio):
    assert slip.slip_ratio(heading, rolling) == pytest.approx(ratio)


def test_slip_measures_fade_at_standstill():
    assert abs(slip.slip_ratio(0.0, 1e-4)) < 0.01
    assert abs(slip.slip_angle(0.0, 1e-4)) < 0.01
    assert slip.slip_angle(0.3, 0.3) == pytest.approx(np.pi / 4)
    assert slip.slip_angle(-0.3, 0.3) == pytest.approx(np.pi / 4)
    assert slip.slip_angle(0.3, -0.3) == pytest.approx(-np.pi / 4)


def test_speed_and_accumulation():
    time = np.linspace(0, 2, 201)
    velocity = np.stack([np.broadcast_to(0.3 * time[:, None], (201, 4)), np.full((201, 4), -0.4)], axis=-1)
    assert slip.slip_speed(velocity[-1]) == pytest.approx(np.full(4, np.hypot(0.6, 0.4)))
    displacement = slip.accumulate(velocity, time)
    assert displacement.shape == velocity.shape
    assert displacement[0].tolist() == np.zeros((4, 2)).tolist()
    np.testing.assert_allclose(displacement[-1], [[0.6, -0.8]] * 4, rtol=1e-12)
    assert slip.accumulate(slip.slip_speed(velocity), time)[-1, 0] > np.hypot(0.6, 0.8)


def test_no_slip_error_is_the_missing_share_of_the_predicted_path():
    assert slip.no_slip_error(0.885, 1.0) == pytest.approx(0.115)
    assert slip.no_slip_error(1.05, 1.0) == pytest.approx(-0.05)
    assert np.isnan(slip.no_slip_error(0.1, 0.0))
