"""What names a policy, and what its environment must be made with."""

import shutil

import gymnasium
import numpy as np
import pytest
import yaml

from wlr_gym.base.errors import InputError
from wlr_gym.envs.core import make_task
from wlr_gym.envs.settings import EnvironmentOptions
from wlr_gym.envs.tasks.describe import contract
from wlr_gym.envs.tasks.task import read_task
from wlr_gym.learning.evaluation.rollout import make_core
from wlr_gym.policy import agents as sources
from wlr_gym.policy import (
    contract_of,
    environment_for,
    find_policy,
    load_agent_config,
    load_policy,
    make_policy,
    policy_environment,
    shipped_names,
    trained_environment,
    write_contract,
)

ID = "WLR-Velocity-v0"
#: A robot that the numbers of a task follow.
WIDE = {"base": "nominal", "name": "wide", "hip_position": {"x": 0.35, "y": 0.32}}
#: A policy that is fed no gyroscope and wants its wheel commands scaled by 3; the rest are conditions.
BLIND = {"observations": {"gyro": None, "command": {"scale": 4.0}}, "action": {"wheel_scale": 3.0}}
KEYWORDS = {
    "task": BLIND | {"rewards": {"slip": None}, "episode_length": 1.0},
    "precision": "float32",
    "randomization": "wide",
    "backend": "mujoco",
}


def blind_folder(folder):
    core = make_core(ID, 1, {"task": BLIND})
    write_contract(folder, "do_nothing", {"environment": KEYWORDS}, core.contract(), {"environment": ID})
    core.close()
    return folder


def test_a_policy_called_as_an_agent_is_not_taken_for_it(tmp_path, monkeypatch):
    (tmp_path / "ppo").mkdir()
    blind_folder(tmp_path / "ppo")
    monkeypatch.chdir(tmp_path)
    with pytest.raises(InputError, match=r"'ppo' is an agent, and a policy in this folder: give \./ppo"):
        policy_environment("ppo")
    assert policy_environment("./ppo") == {"task": BLIND}


def test_keywords_are_those_that_decide_what_a_policy_is_fed(tmp_path):
    assert policy_environment(blind_folder(tmp_path)) == {"task": BLIND}
    core = make_core(ID, 1, {"randomization": "none"} | policy_environment(tmp_path))
    sources.check_contract(contract_of(tmp_path)["environment"], core.contract(), "here")
    core.close()
    core = make_core(ID, 1, {})
    with pytest.raises(InputError, match=r"observation\[0\]\.scale is 4\.0 in the policy, 5\.0 in the environment"):
        sources.check_contract(contract_of(tmp_path)["environment"], core.contract(), "here")
    core.close()


def task_file(folder, **changes):
    """Path of a task file with the observations of velocity in another order, without the gyroscope."""
    task = read_task("velocity").model_dump(mode="json", exclude_none=True)
    task["observations"] = {name: one for name, one in reversed(task["observations"].items()) if name != "gyro"}
    path = folder / "my_task.yaml"
    path.write_text(yaml.safe_dump(task | changes, sort_keys=False))
    return str(path)


def test_of_a_task_file_only_what_a_policy_is_fed_holds(tmp_path):
    rewards = read_task("velocity").rewards | {"action_rate": {"weight": -7.0}}
    task = task_file(tmp_path, sensors={"camera": 1.0}, rewards=rewards, observer={"camera": False}, control_period=0.04)
    trained = make_task("velocity", EnvironmentOptions(task=task, robot=WIDE))
    write_contract(tmp_path, "do_nothing", {"environment": {"task": task}}, contract(trained, {}), {})
    assert policy_environment(tmp_path)["task"]["observer"] == {"camera": False}
    keywords = environment_for(tmp_path, {"task": {"sensors": {"camera": 0.0}}})
    played = make_task("velocity", EnvironmentOptions(**keywords))
    sources.check_contract(contract(trained, {}), contract(played, {}), "here")
    assert played.config.sensors.camera == 0.0
    assert played.config.rewards["action_rate"] == read_task("velocity").rewards["action_rate"]


def test_a_task_file_with_other_commands_is_another_task(tmp_path):
    task = task_file(tmp_path)
    played = make_task("path", EnvironmentOptions(**sources.fed_environment({"task": task})))
    assert played.config == read_task(task)


@pytest.mark.parametrize("config", [{}, {"environment": None}, {"environment": {"task": {"rewards": {"slip": None}}}}])
def test_the_task_that_ships_needs_no_keywords(tmp_path, config):
    write_contract(tmp_path, "do_nothing", config, {}, {})
    assert policy_environment(tmp_path) == {}


def test_agents_have_the_keywords_of_their_settings(monkeypatch):
    assert trained_environment("do_nothing") is None
    assert policy_environment("do_nothing") == {}
    monkeypatch.setattr(sources, "load_agent_config", lambda name: load_agent_config(name) | {"environment": KEYWORDS})
    assert policy_environment("do_nothing") == {"task": BLIND}


def test_the_environment_of_the_training_is_known(tmp_path):
    assert trained_environment(blind_folder(tmp_path)) == ID


def test_a_run_folder_and_its_policy_are_the_same(tmp_path):
    (tmp_path / "policy").mkdir()
    write_contract(tmp_path / "policy", "do_nothing", {}, {}, {})
    assert find_policy(tmp_path) == find_policy(tmp_path / "policy") == tmp_path / "policy"


def test_shipped_policies_go_by_their_names(exported, tmp_path, monkeypatch):
    monkeypatch.setattr(sources, "shipped_directory", lambda: tmp_path)
    shutil.copy(exported, tmp_path / "velocity_slip_aware.onnx")
    assert shipped_names() == ["velocity_slip_aware"]
    assert trained_environment("velocity_slip_aware") == ID
    environment = contract_of("velocity_slip_aware")["environment"]
    seen = np.full((2, len(environment["observation"])), 0.1, np.float32)
    mine = make_policy("velocity_slip_aware", environment).act(seen)
    np.testing.assert_array_equal(mine, make_policy(exported, environment).act(seen))
    with pytest.raises(InputError, match=r"did you mean 'velocity_slip_aware'.*shipped: velocity_slip_aware"):
        find_policy("velocty_slip_aware")


def test_a_policy_is_loaded_for_an_environment_or_its_contract():
    env = gymnasium.make("WLR-Velocity-v0", **policy_environment("velocity_slip_aware"))
    by_env, by_contract = (load_policy("velocity_slip_aware", it) for it in (env, env.unwrapped.contract()))  # type: ignore[attr-defined]
    observation = np.zeros((1, *env.observation_space.shape), np.float32)  # type: ignore[misc]
    np.testing.assert_array_equal(by_env.act(observation), by_contract.act(observation))
    with pytest.raises(InputError, match="expected one that was made"):
        load_policy("velocity_slip_aware", "WLR-Velocity-v0")  # type: ignore[arg-type]


def test_an_agent_is_not_taken_for_an_unknown_name():
    with pytest.raises(InputError, match=r"^'pid' is an agent: expected a trained policy"):
        find_policy("pid")


def test_what_is_no_policy(tmp_path):
    (tmp_path / "notes.txt").write_text("hello")
    for source, message in (
        (tmp_path, r"no policy there"),
        (tmp_path / "notes.txt", r"expected a folder, or a file \.onnx"),
        (tmp_path / "none.onnx", r"none\.onnx' is no policy"),
        ("do_nothin", r"neither a folder, .* nor a shipped policy \(did you mean 'do_nothing'"),
    ):
        with pytest.raises(InputError, match=message):
            policy_environment(source)
