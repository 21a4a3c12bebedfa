"""Every agent drives every robot of a batch; each does what it says."""

import numpy as np
import pytest

from wlr_gym.errors import InputError
from wlr_gym.evaluation import make_core
from wlr_gym.policy import agent_names, load_agent, load_agent_config, make_policy
from wlr_gym.robot import load_robot

ENVIRONMENT = "WLR-Velocity-v0"
LEFT, RIGHT = [4, 6], [5, 7]


@pytest.fixture(scope="module")
def contract():
    core = make_core(ENVIRONMENT, 1, {})
    yield core.contract()
    core.close()


def observations(contract, **readings):
    """One observation in which the named readings have the given values (SI), all else zero."""
    names = [column["name"] for column in contract["observation"]]
    row = np.zeros((1, len(names)), np.float32)
    for name, value in readings.items():
        column = contract["observation"][names.index(name)]
        row[0, names.index(name)] = column["scale"] * (value - column["offset"])
    return row


@pytest.mark.parametrize("name", agent_names())
def test_actions_fit_the_action_space(contract, name):
    policy = make_policy(name, contract)
    readings = np.random.default_rng(0).normal(0, 3, (5, len(contract["observation"]))).astype(np.float32)
    policy.reset(np.ones(5, bool))
    actions = policy.act(readings)
    assert actions.shape == (5, 8)
    assert actions.dtype == np.float32
    assert np.abs(actions).max() <= 1.0


@pytest.mark.parametrize("name", agent_names())
def test_a_robot_is_driven_alike_alone_and_in_a_batch(contract, name):
    policy = make_policy(name, contract)
    readings = np.random.default_rng(1).normal(0, 1, (6, len(contract["observation"]))).astype(np.float32)
    together = policy.act(readings)
    alone = np.concatenate([policy.act(row[None]) for row in readings])
    np.testing.assert_allclose(together, alone, atol=1e-6)


def test_do_nothing_does_nothing(contract):
    assert not make_policy("do_nothing", contract).act(np.ones((3, len(contract["observation"])))).any()


def test_proportional_rolls_straight_at_the_commanded_speed(contract):
    action = make_policy("proportional", contract).act(observations(contract, **{"command[linear_velocity_x]": 0.1}))[0]
    radius = load_robot().wheel.radius
    scale = contract["action"][4]["scale"]
    np.testing.assert_allclose(action[4:] * scale * radius, 0.1, rtol=1e-5)
    assert not action[:4].any()


def test_proportional_turns_left_with_the_right_wheels_faster(contract):
    config = {"robot": "nominal", "steering": 1.0, "yaw_rate_gain": 0.0}
    policy = load_agent("proportional").make_policy(contract, config)
    action = policy.act(observations(contract, **{"command[yaw_rate]": 0.3}))[0]
    robot = load_robot()
    speed = 0.3 * robot.hip_position.y / robot.wheel.radius / contract["action"][4]["scale"]
    np.testing.assert_allclose(action[RIGHT], speed, rtol=1e-5)
    np.testing.assert_allclose(action[LEFT], -speed, rtol=1e-5)


def test_proportional_pushes_harder_when_it_turns_too_slowly(contract):
    policy = load_agent("proportional").make_policy(contract, {"yaw_rate_gain": 2.0})
    slow = policy.act(observations(contract, **{"command[yaw_rate]": 0.3, "gyro[z]": 0.1}))[0]
    exact = policy.act(observations(contract, **{"command[yaw_rate]": 0.3, "gyro[z]": 0.3}))[0]
    assert (slow[RIGHT] > exact[RIGHT]).all()


def test_proportional_refuses_another_robot(contract):
    other = {**contract, "robot": {"name": "other", "hash": "0"}}
    with pytest.raises(InputError, match="robot 'nominal' is not the environment's"):
        make_policy("proportional", other)


def test_untrained_is_ppo_before_training(contract):
    readings = np.random.default_rng(2).normal(0, 1, (4, len(contract["observation"]))).astype(np.float32)
    mine = make_policy("untrained", contract).act(readings)
    assert np.array_equal(mine, make_policy("ppo", contract).act(readings))
    other_seed = load_agent("ppo").make_policy(contract, load_agent_config("ppo") | {"seed": 1})
    assert not np.array_equal(mine, other_seed.act(readings))


def test_unknown_agent_names_the_nearest():
    with pytest.raises(InputError, match="did you mean 'proportional'"):
        load_agent("proportionl")


@pytest.mark.parametrize(
    ("name", "setting", "message"),
    [
        ("ppo", {"learning_rat": 1e-3}, "did you mean 'learning_rate'"),
        ("ppo", {"batch_size": 1000}, "does not divide"),
        ("ppo", {"gamma": 1.5}, "gamma = 1.5"),
        ("proportional", {"yaw_gain": 1.0}, "did you mean 'yaw_rate_gain'"),
    ],
)
def test_bad_settings_are_named(contract, name, setting, message):
    with pytest.raises(InputError, match=message):
        load_agent(name).make_policy(contract, load_agent_config(name) | setting)


@pytest.mark.parametrize(("change", "message"), [("total_steps", "expected key=value"), ("seed.x=1", "a value, not a group")])
def test_bad_changes_are_named(change, message):
    with pytest.raises(InputError, match=message):
        load_agent_config("ppo", ("seed=3", change))


def test_changes_reach_nested_settings():
    config = load_agent_config("ppo", ("environment.precision=float64", "learning_rate=2.5e-4"))
    assert config["environment"]["precision"] == "float64"
    assert float(config["learning_rate"]) == 2.5e-4
