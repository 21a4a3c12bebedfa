"""Gears whose dry friction creeps before it is full, in both simulators, against closed forms."""

import numpy as np
import pytest
from rig import HOME, RADIUS, ROBOT, WEIGHT, WHEEL_INERTIA, G, wheels_off

from wlr_gym.physics.plants import make_plant
from wlr_gym.physics.plants.base import PlantOptions, standing_state
from wlr_gym.robot.parameters import Parameters

CREEP, FRICTION = 0.02, 0.05


def pulled(backend, share, step=1e-3, seconds=1.0, **changes):
    """Rates (ticks, N) and last friction (N) of the left front wheel of robots with wheels off, pulled by a share of what gears
    hold."""
    count = len(share)
    parameters = Parameters.nominal(ROBOT, count)
    parameters["servo.coulomb_friction"] = np.repeat([50.0, FRICTION], 4)
    parameters["servo.viscous_friction"] = 0.0
    parameters["servo.creep_rate"][:, 4:] = CREEP
    parameters["external_force"][:, 0] = share * 4 * FRICTION / RADIUS
    for name, value in changes.items():
        parameters[name.replace("__", ".")][:, 4:] = value
    options = PlantOptions(control_period=0.02, physics_step=step, sensor_noise=False)
    plant = make_plant(backend, ROBOT, count, options)
    plant.reset(parameters=parameters, state=standing_state(ROBOT, parameters))
    rates = []
    for _ in range(round(seconds / 0.02)):
        plant.step(np.tile(HOME, (count, 1)), wheels_off(count))
        rates.append(plant.truth().joint_velocity[:, 4].copy())
    friction = plant.truth().friction_torque[:, 4].copy()
    plant.close()
    return np.array(rates), friction


@pytest.mark.parametrize("backend", ["gibbs_appell", "mujoco"])
def test_a_gear_creeps_in_proportion_to_its_load(backend):
    """Below its dry friction F a gear turns at creep_rate x torque/F, and its friction is that torque."""
    share = np.array([0.2, 0.6, 0.95])
    rates, friction = pulled(backend, share)
    np.testing.assert_allclose(rates[-1], share * CREEP, rtol=2e-3)
    np.testing.assert_allclose(friction, -share * FRICTION, rtol=2e-3)


@pytest.mark.parametrize("backend", ["gibbs_appell", "mujoco"])
def test_beyond_it_the_friction_is_coulombs(backend):
    """Pulled by 1.5 F the robot gains what half of F accelerates: its mass, and four wheels that turn."""
    mass = WEIGHT / G + 4 * WHEEL_INERTIA / RADIUS**2
    for step in (1e-3, 2.5e-4):
        rates = pulled(backend, np.array([1.5]), step, seconds=0.4)[0][:, 0]
        gained = (rates[-1] - rates[9]) / (0.02 * (len(rates) - 10))
        assert gained == pytest.approx(0.5 * 4 * FRICTION / RADIUS**2 / mass, rel=2e-3)


def test_slow_creep_is_sticking():
    for creep in (0.0, 1e-7):
        assert np.abs(pulled("gibbs_appell", np.array([0.5]), servo__creep_rate=creep)[0][20:]).max() < 1e-6


@pytest.mark.parametrize("backend", ["gibbs_appell", "mujoco"])
def test_a_gear_with_play_creeps_too(backend):
    """The rotor rubs: once its teeth meet, the joint creeps as one without play."""
    share = np.array([0.2, 0.6, 0.95])
    rates, friction = pulled(backend, share, seconds=2.0, servo__backlash=0.01)
    np.testing.assert_allclose(rates[-1], share * CREEP, rtol=5e-3)
    np.testing.assert_allclose(friction, -share * FRICTION, rtol=5e-3)
