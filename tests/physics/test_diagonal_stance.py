"""Warped legs stand the robot on one wheel diagonal, and there it turns on floors of any ratio: docs/physics.md."""

import math

import numpy as np
import pytest
from rig import BACKENDS, HOME, RADIUS, ROBOT, WEIGHT, contact_force, make_plant

from wlr_gym.robot import CORNER_SIGNS

FRONT, LEFT = np.array(CORNER_SIGNS, float).T
#: +1 for the wheels of the diagonal left front, right rear.
DIAGONAL = FRONT * LEFT
LENGTH, HIP, SIDE = ROBOT.leg.length, ROBOT.hip_position.x, ROBOT.hip_position.y
STIFFNESS = ROBOT.ground.normal_stiffness


def run(plant, setpoints, ticks):
    for _ in range(ticks):
        plant.step(setpoints)
    return plant.truth()


def stance(inward, warp):
    """Setpoints (N, 8) of legs so far under the body and warped, rad (N,)."""
    inward, warp = np.broadcast_arrays(*map(np.atleast_1d, (inward, warp)))
    setpoints = np.tile(HOME, (len(inward), 1))
    setpoints[:, :4] += inward[:, None] * FRONT - warp[:, None] * LEFT
    return setpoints


@pytest.mark.parametrize("backend", BACKENDS)
def test_load_that_a_warp_moves(backend):
    """The share of the load on the left front and right rear wheel is 1/2 + 2 k l sin(inward) q/W, as far as it goes."""
    inward, warp = np.array([0.0, 0.1, 0.35, 0.35, 0.35, 0.35]), np.array([0.02, 0.02, 0.015, -0.015, 0.06, -0.06])
    truth = run(make_plant(6, {"servo.coulomb_friction": 0.0}, backend=backend), stance(inward, warp), 150)
    angle = truth.joint_position[:, :4] - HOME[:4]
    normal = contact_force(truth)[:, :, 2]
    share = normal[:, DIAGONAL > 0].sum(1) / normal.sum(1)
    expected = 0.5 - 2.0 * STIFFNESS * LENGTH * np.sin(angle * FRONT).mean(1) * (angle * LEFT).mean(1) / WEIGHT
    np.testing.assert_allclose(share, np.clip(expected, 0.0, 1.0), atol=0.03)
    assert share[4] > 0.97
    assert share[5] < 0.03


#: Half the wheelbase with the legs 0.35 rad inward, m, and the warp that puts the load on one diagonal, rad.
INWARD = 0.35
REACH = HIP - LENGTH * math.sin(INWARD)
WARP = 0.035
WANTED = 0.15  # rad/s
CASES = [
    (ratio, diagonal, grip, turn)
    for ratio in (2.0, 6.0, 15.0)
    for diagonal, grip, turn in ((1, 1, 1), (1, -1, 1), (-1, 1, -1), (-1, -1, 1), (1, 1, -1))
]


@pytest.mark.parametrize("backend", BACKENDS)
def test_turn_on_a_diagonal_at_any_ratio(backend):
    """Friction ratio, diagonal (+1: left front and right rear), side that grips, sense of the turn: it turns as fast as wanted.

    The gripping wheel rolls, the slippery one slides 2 x w aside and 2 x^2 w / y along its heading, the others carry nothing.
    """
    ratio, diagonal, grip, turn = np.array(CASES).T
    friction = 0.06 * np.where(grip[:, None] == LEFT, ratio[:, None], 1.0)
    plant = make_plant(len(CASES), {"ground.mu_x": friction, "ground.mu_y": friction}, backend=backend)
    setpoints = stance(INWARD, WARP * diagonal)
    run(plant, stance(INWARD, 0.0 * diagonal), 75)
    run(plant, setpoints, 50)
    slides = (diagonal[:, None] == DIAGONAL) & (grip[:, None] != LEFT)
    rate = (WANTED * turn)[:, None]
    setpoints[:, 4:] = -rate * LEFT * (SIDE + 2.0 * slides * REACH**2 / SIDE) / RADIUS
    run(plant, setpoints, 50)
    turned, slip = [], []
    for _ in range(75):
        truth = run(plant, setpoints, 1)
        turned.append(truth.angular_velocity_in_body[:, 2].copy())
        slip.append(truth.slip_displacement.reshape(-1, 4, 2) / plant.options.control_period)
    np.testing.assert_allclose(np.mean(turned, axis=0), rate[:, 0], atol=0.07 * WANTED)
    excess = np.abs(np.mean(slip, axis=0)) - WANTED * np.array([REACH**2 / SIDE, REACH])
    excess = np.hypot(*np.moveaxis(np.maximum(excess, 0.0), -1, 0)).mean(1)
    np.testing.assert_allclose(excess, WANTED * REACH * (1.0 + math.hypot(1.0, REACH / SIDE)) / 4.0, rtol=0.06)
