"""Delayed setpoints."""

import numpy as np

from wlr_gym.physics.plants import make_plant
from wlr_gym.physics.plants.base import PlantOptions, standing_state
from wlr_gym.physics.plants.simulator import SetpointHistory
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


def test_a_robot_of_a_batch_gets_the_setpoints_it_would_get_alone():
    """Every joint of every robot has a delay of its own, none and whole ticks among them; some change in mid-run."""
    period, count, rng = 0.02, 6, np.random.default_rng(0)
    robot = load_robot()
    delays = rng.uniform(0.0, 0.1, (2, count, 8))
    delays[:, 0], delays[:, 1], delays[:, 2, :4] = 0.0, period * rng.integers(0, 6, (2, 8)), 0.06
    setpoints = rng.normal(size=(30, count, 8))

    def pushed(rows):
        parameters = Parameters.nominal(robot, len(rows))
        history, everyone = SetpointHistory(len(rows), period), np.arange(len(rows))
        parameters["command.delay"] = delays[0, rows]
        history.reset(everyone, standing_state(robot, parameters), parameters)
        for tick, written in enumerate(setpoints):
            if tick == 15:
                changed = everyone[np.isin(rows, (1, 3, 4))]
                parameters["command.delay"][changed] = delays[1, rows][changed]
                history.set_delays(changed, parameters)
            newer, older, switch = history.push(written[rows])
            yield np.stack([newer, np.where(switch > 0.0, older, newer), switch])

    for together in zip(pushed(np.arange(count)), *(pushed(np.array([row])) for row in range(count)), strict=True):
        assert np.array_equal(together[0], np.concatenate(together[1:], axis=1))


def test_a_setpoint_acts_once_its_delay_is_over():
    """Newer, older and switch time of each robot say what acts at any time of a tick: what was written a delay before."""
    period = 0.02
    robot, delay = load_robot(), np.array([0.0, 0.005, 0.02, 0.03, 0.1])
    parameters = Parameters.nominal(robot, len(delay))
    parameters["command.delay"] = delay[:, None]
    history, everyone = SetpointHistory(len(delay), period), np.arange(len(delay))
    history.reset(everyone, standing_state(robot, parameters), parameters)
    for tick in range(12):
        newer, older, switch = history.push(np.full((len(delay), 8), float(tick)))
        for since in (0.001, 0.004, 0.006, 0.009, 0.011, 0.019):
            acting = np.where(since < switch, older, newer)
            written = np.floor((tick * period + since - delay) / period + 1e-9)
            old_enough = written >= 0
            assert np.array_equal(acting[old_enough], np.repeat(written[old_enough, None], 8, axis=1))
