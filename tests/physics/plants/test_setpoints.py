"""Delayed setpoints."""

import numpy as np

from wlr_gym.physics.plants import make_plant
from wlr_gym.physics.plants.base import PlantOptions
from wlr_gym.robot import load_robot
from wlr_gym.robot.parameters import Parameters


def test_nothing_moves_after_a_reset_with_a_delay_and_a_zero_offset():
    robot = load_robot()
    delayed, prompt = (Parameters.nominal(robot, 2) for _ in range(2))
    for parameters in (delayed, prompt):
        parameters["joint.zero_offset"] = [0.05, -0.05, 0.05, -0.05]
    delayed["command.delay"] = 0.07
    setpoints = np.zeros((2, 8))
    setpoints[:, :4] = robot.home.leg_angle + prompt["joint.zero_offset"]
    angles = []
    for parameters in (delayed, prompt):
        plant = make_plant("gibbs_appell", robot, 2, PlantOptions(sensor_noise=False))
        plant.reset(parameters=parameters)
        for _ in range(10):
            plant.step(setpoints)
            angles.append(plant.truth().joint_position.copy())
        plant.close()
    assert np.array_equal(angles[:10], angles[10:])
    assert np.abs(np.array(angles)[:, :, :4] - robot.home.leg_angle).max() < 0.002
