"""A policy that is fed past readings (``history: N``): trained, exported, played and on the emulated robot alike."""

import numpy as np
import pytest
from policy_log import act_again
from ppo_runs import ENVIRONMENT, train

from wlr_gym.hardware.deployment import deploy
from wlr_gym.learning.evaluation.conditions import Condition, play
from wlr_gym.learning.evaluation.rollout import make_core
from wlr_gym.learning.evaluation.subjects import read_subjects
from wlr_gym.policy import contract_of, export_policy, make_policy, policy_environment

pytest.importorskip("stable_baselines3")

READINGS = {name: {"history": 3} for name in ("wheel_velocity", "gyro", "last_action")}


class Watched:
    """A policy that keeps the observations it was shown of the first robot."""

    def __init__(self, policy):
        self.policy, self.reset, self.seen = policy, policy.reset, []

    def act(self, observations):
        self.seen.append(observations[0].copy())
        return self.policy.act(observations)


def assert_older_readings_are_those_of_earlier_ticks(seen, contract):
    """``seen`` (ticks, numbers): of every column with a lag, the column of that name without it was that many ticks before."""
    columns = contract["observation"]
    now = {column["name"]: index for index, column in enumerate(columns) if column["lag"] == 0}
    older = [(index, now[column["name"]], column["lag"]) for index, column in enumerate(columns) if column["lag"] > 0]
    assert len(older) == 2 * (4 + 3 + 8)
    for index, newest, lag in older:
        np.testing.assert_array_equal(seen[lag:, index], seen[:-lag, newest], err_msg=columns[index]["name"])
        assert np.any(seen[lag:, index] != seen[lag:, newest]), columns[index]["name"]


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """Run folder of a policy whose actions differ from tick to tick."""
    from stable_baselines3 import PPO

    folder = tmp_path_factory.mktemp("history") / "run"
    train(folder, total_steps=64, environment={"episode_length": 0.2, "task": {"observations": READINGS}})
    model = PPO.load(folder / "policy" / "model.zip", device="cpu")
    model.policy.get_parameter("action_net.weight").data *= 20.0
    model.save(folder / "policy" / "model.zip")
    return folder


@pytest.fixture(scope="module")
def exported(run, tmp_path_factory):
    """That policy as a file, compared with the network on readings of an episode."""
    for package in ("onnx", "onnxscript", "onnxruntime"):
        pytest.importorskip(package)
    path = tmp_path_factory.mktemp("exported") / "history.onnx"
    core = make_core(ENVIRONMENT, 4, policy_environment(run))
    core.begin_episodes(core.everyone)
    parity = export_policy(run, path, core.observation.copy())
    core.close()
    assert max(parity.random, parity.real) <= 1e-5
    return path


def test_the_contract_names_the_age_of_every_reading(run):
    columns = contract_of(run)["environment"]["observation"]
    lags = [column["lag"] for column in columns if column["name"].startswith("gyro[")]
    assert lags == [0, 0, 0, 1, 1, 1, 2, 2, 2]
    assert {column["lag"] for column in columns if column["name"].startswith("accelerometer[")} == {0}


def test_network_and_file_play_the_same_episodes_alike(run, exported):
    subjects = read_subjects([f"network={run}", f"file={exported}"])
    played = play(ENVIRONMENT, subjects, [Condition("short", {"episode_length": 1.0}, episodes=4)])["short"]
    rewards = [played[name].pairs["reward"] for name in ("network", "file")]
    np.testing.assert_allclose(rewards[0], rewards[1], rtol=1e-3)


def test_the_past_reaches_the_policy_on_the_robot(run, exported, tmp_path):
    """It sees what it saw one and two ticks before, acts on it, and the log alone gives the same actions again."""
    pytest.importorskip("dynamixel_sdk")
    pytest.importorskip("serial")
    hardware = {"backend": "dynamixel", "hardware": {"emulated": True, "log": tmp_path}, "episode_length": 1.0}
    core = make_core(ENVIRONMENT, 1, policy_environment(exported) | hardware)
    watched = Watched(make_policy(exported, core.contract()))
    result = deploy(core, watched, seed=3)
    assert result.run is not None
    assert result.ticks == 50
    assert_older_readings_are_those_of_earlier_ticks(np.array(watched.seen[-result.ticks :]), core.contract())
    forgetful = np.array(watched.seen[-1:])
    forgetful[:, [column["lag"] > 0 for column in core.contract()["observation"]]] = 0.0
    assert np.abs(watched.policy.act(forgetful) - watched.policy.act(np.array(watched.seen[-1:]))).max() > 1e-3
    given, answered = act_again(core, make_policy(exported, core.contract()), result.run)
    np.testing.assert_array_equal(answered, given)
    _, of_network = act_again(core, make_policy(run, core.contract()), result.run)
    np.testing.assert_allclose(of_network, given, atol=1e-5)
    core.close()
