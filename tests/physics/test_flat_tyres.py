"""Tyres that flatten, in both simulators: they roll on their radius less a share of what a load presses them deeper."""

import numpy as np
import pytest
from rig import HOME, RADIUS, ROBOT, WEIGHT, G

from wlr_gym.physics.plants import make_plant
from wlr_gym.physics.plants.base import PlantOptions, standing_state
from wlr_gym.robot.parameters import Parameters

BACKENDS = ["gibbs_appell", "mujoco"]


def rolled(backend, parameters, setpoints, seconds=1.5):
    """Distance over angle (N, 4) of wheels that drive steadily, and the truth at the end."""
    count = len(parameters)
    plant = make_plant(backend, ROBOT, count, PlantOptions(control_period=0.02, physics_step=1e-3, sensor_noise=False))
    plant.reset(parameters=parameters, state=standing_state(ROBOT, parameters))
    setpoints, truths = np.tile(setpoints, (count, 1)), []
    for _ in range(round(seconds / 0.02)):
        plant.step(setpoints)
        truths.append(plant.truth().values.copy())
    truth = plant.truth()
    first, last = (type(truth)(values) for values in (truths[len(truths) // 2], truths[-1]))
    turned = (last.joint_position - first.joint_position)[:, 4:]
    way = np.hypot(*(last.position - first.position)[:, :2].T)
    return way[:, None] / turned, last


@pytest.mark.parametrize("backend", BACKENDS)
def test_a_load_shortens_the_rolling_radius(backend):
    """Four robots: none, a load, tyres that flatten, both."""
    parameters = Parameters.nominal(ROBOT, 4)
    parameters["payload.mass"][[1, 3]] = 1.5
    parameters["ground.flattening"][2:] = share = 0.4
    found, _ = rolled(backend, parameters, HOME + np.repeat([0.0, 4.0], 4))
    deeper = 1.5 * G / 4 / ROBOT.ground.normal_stiffness
    np.testing.assert_allclose(found.mean(axis=1), RADIUS - share * np.array([0.0, 0.0, 0.0, deeper]), atol=3e-6)


@pytest.mark.parametrize("backend", BACKENDS)
def test_it_is_the_arm_of_friction_too(backend):
    """Against a steady pull the wheels' torques are the pull times the radius on which they roll."""
    parameters, pull = Parameters.nominal(ROBOT, 2), 4.0
    parameters["payload.mass"] = load = 3.0
    parameters["external_force"][:, 0] = -pull
    parameters["ground.flattening"][1] = share = 0.5
    _, truth = rolled(backend, parameters, HOME + np.repeat([0.0, 3.0], 4))
    torque = (truth.motor_torque + truth.friction_torque)[:, 4:].sum(axis=1)
    deeper = load * G / 4 / ROBOT.ground.normal_stiffness
    np.testing.assert_allclose(torque, pull * (RADIUS - np.array([0.0, share * deeper])), rtol=3e-3)
    assert torque[1] / torque[0] == pytest.approx(1.0 - share * deeper / RADIUS, abs=1e-3)
    slip = truth.slip_velocity.reshape(2, 4, 2)
    assert np.abs(slip).max() < 1e-4


@pytest.mark.parametrize("backend", BACKENDS)
def test_a_wheel_in_the_air_lands_where_the_floor_is(backend):
    """Only the arm of friction changes: dropped without spin, robots fall, land and bounce alike."""
    parameters = Parameters.nominal(ROBOT, 2)
    parameters["ground.flattening"][1] = 1.0
    state = standing_state(ROBOT, parameters)
    state.position[:, 2] += 0.01
    plant = make_plant(backend, ROBOT, 2, PlantOptions(control_period=0.02, physics_step=1e-3, sensor_noise=False))
    plant.reset(parameters=parameters, state=state)
    lightest, truth = np.inf, plant.truth()
    for _ in range(40):
        plant.step(np.tile(HOME, (2, 1)))
        truth = plant.truth()
        lightest = min(lightest, truth.contact_force[:, 2::3].max())
        np.testing.assert_allclose(truth.position[1, 2], truth.position[0, 2], atol=1e-6)
    plant.close()
    assert lightest == 0.0
    assert truth.contact_force[:, 2::3].sum(axis=1) == pytest.approx(WEIGHT, rel=0.01)
