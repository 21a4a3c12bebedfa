"""The Stable-Baselines3 face."""

import pickle
import warnings
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from velocity import ID, TIMED

pytest.importorskip("stable_baselines3")
from stable_baselines3 import PPO
from stable_baselines3.common.env_checker import check_env
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import DummyVecEnv, VecMonitor, VecNormalize

from wlr_gym.base.errors import InputError
from wlr_gym.envs import Sb3VecEnv

SHORT = {"episode_length": 0.4, "randomization": "wide"}


@pytest.mark.parametrize("observation", ["policy", "dict"])
def test_check_env_without_a_warning(fake, observation):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(gym.make(ID, observation=observation).unwrapped, warn=True)


@pytest.mark.parametrize(("observation", "randomization"), [("policy", "wide"), ("dict", "wide"), ("policy", TIMED)])
def test_equals_dummy_vec_env_with_the_same_seeds(fake, observation, randomization):
    keywords = {"episode_length": 0.4, "observation": observation, "randomization": randomization}
    ours = Sb3VecEnv(ID, 3, seed=5, **keywords)
    loop = DummyVecEnv([lambda: gym.make(ID, **keywords)] * 3)
    loop.seed(5)
    same(ours.reset(), loop.reset())
    actions = np.random.default_rng(0).uniform(-1, 1, (70, 3, 8)).astype(np.float32)
    ended = told = 0
    for action in actions:
        a, b = ours.step(action), loop.step(action)
        same(a[0], b[0])
        assert np.array_equal(a[1], b[1])
        assert np.array_equal(a[2], b[2])
        for one, two, done in zip(a[3], b[3], a[2], strict=True):
            ended += bool(done)
            told += "randomization" in one
            assert one.get("randomization") == two.get("randomization")
            if done:
                same(one["terminal_observation"], two["terminal_observation"])
                assert one["TimeLimit.truncated"] == two["TimeLimit.truncated"]
                assert one["episode_reward_terms"] == two["episode_reward_terms"]
            else:
                assert set(one) <= {"randomization"}
    assert ended == 9
    assert (told > 20) == (randomization == TIMED)
    assert ours.reset_infos == loop.reset_infos


def same(a, b):
    if isinstance(a, dict):
        assert a.keys() == b.keys()
        assert all(np.array_equal(a[key], b[key]) for key in a)
    else:
        assert a.dtype == b.dtype
        assert np.array_equal(a, b)


def test_a_fall_is_not_a_time_limit(fake):
    fake["fall_at"] = 0.1
    env = Sb3VecEnv(ID, 2, seed=0)
    env.reset()
    _, _, done, infos = [env.step(np.zeros((2, 8), np.float32)) for _ in range(5)][-1]
    assert done.all()
    assert not infos[0]["TimeLimit.truncated"]


def test_works_with_sb3s_own_tools(fake):
    env = VecNormalize(VecMonitor(Sb3VecEnv(ID, 4, seed=0, **SHORT)))
    model = PPO("MlpPolicy", env, n_steps=32, batch_size=64, n_epochs=1, device="cpu", seed=0)
    model.learn(256)
    assert model.ep_info_buffer is not None
    assert len(model.ep_info_buffer) > 0
    assert model.ep_info_buffer[0]["l"] == 20


def test_episodes_are_reported_as_a_monitor_does(fake):
    ours, loop = Sb3VecEnv(ID, 3, seed=5, **SHORT), VecMonitor(Sb3VecEnv(ID, 3, seed=5, **SHORT))
    ours.reset()
    loop.reset()
    for action in np.random.default_rng(0).uniform(-1, 1, (45, 3, 8)).astype(np.float32):
        a, b = ours.step(action), loop.step(action)
        for one, two, done in zip(a[3], b[3], a[2], strict=True):
            assert ("episode" in one) == bool(done)
            if done:
                assert one["episode"]["l"] == two["episode"]["l"] == 20
                assert one["episode"]["r"] == pytest.approx(two["episode"]["r"], abs=1e-4)
    model = PPO("MlpPolicy", Sb3VecEnv(ID, 4, seed=0, **SHORT), n_steps=32, batch_size=64, n_epochs=1, device="cpu", seed=0)
    model.learn(256)
    assert [one["l"] for one in model.ep_info_buffer or []][:4] == [20] * 4


def test_make_vec_env(fake):
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message=".*render_mode.*")
        env: Any = make_vec_env(ID, n_envs=2, seed=0, env_kwargs={"randomization": "none"})
    assert np.shape(env.reset()) == (2, 52)
    assert np.shape(env.step(np.zeros((2, 8), np.float32))[0]) == (2, 52)


def test_options_attributes_and_methods(fake):
    env = Sb3VecEnv(ID, 3, seed=0, randomization="none")
    env.set_options([{}, {"command": {"linear_velocity_x": 0.05, "yaw_rate": 0.1}}, {"parameters": {"ground.mu_x": 0.2}}])
    env.reset()
    assert env.core.command[1].tolist() == [0.05, 0.1]
    assert env.core.parameters["ground.mu_x"][:, 0].tolist() == [0.6, 0.6, 0.2]
    assert env.get_attr("render_mode", [0, 2]) == [None, None]
    assert [contract["task"] for contract in env.env_method("contract", indices=[2, 0, 1])] == ["velocity"] * 3
    env.env_method("set_command", linear_velocity_x=0.02)
    assert env.core.command[:, 0].tolist() == [0.02] * 3
    assert env.has_attr("core")
    assert not env.has_attr("no_such_thing")
    with pytest.raises(InputError, match="without indices"):
        env.set_attr("anything", 1, indices=[0])
    for indices in (0, [0], [0, 0, 0]):
        with pytest.raises(InputError, match="'set_command' is shared by all robots: call it without indices"):
            env.env_method("set_command", linear_velocity_x=0.07, indices=indices)
    assert env.core.command[:, 0].tolist() == [0.02] * 3
    env.close()


def test_pickle_builds_a_fresh_environment(fake):
    env = Sb3VecEnv(ID, 3, seed=5, effects=[{"name": "friction_level", "parameters": {"mu": 0.4}}], **SHORT)
    copy = pickle.loads(pickle.dumps(env))
    same(copy.reset(), env.reset())
    assert np.array_equal(copy.core.parameters.values, env.core.parameters.values)


def test_an_id_may_name_its_module(fake):
    spec = Sb3VecEnv(f"wlr_gym:{ID}", 2, episode_length=1.0).spec
    assert spec is not None
    assert (spec.id, spec.max_episode_steps) == (ID, 50)


def test_a_spec_brings_its_render_mode_and_limit(fake):
    spec = gym.make(ID, render_mode="rgb_array", max_episode_steps=100).spec
    assert spec is not None
    env = Sb3VecEnv(spec, 2)
    assert (env.render_mode, env.core.limit) == ("rgb_array", 100)
    copy = pickle.loads(pickle.dumps(env))
    assert (copy.render_mode, copy.core.limit) == ("rgb_array", 100)
    assert Sb3VecEnv(spec, 2, max_episode_steps=7).core.limit == 7
    assert Sb3VecEnv(spec, 2, episode_length=60.0, max_episode_steps=-1).core.limit == 3000
    with pytest.raises(InputError, match="max_episode_steps = 0: expected a whole number of 1 or more, or -1"):
        Sb3VecEnv(spec, 2, max_episode_steps=0)


def test_bad_input(fake):
    with pytest.raises(InputError, match="did you mean 'WLR-Velocity-v0'"):
        Sb3VecEnv("WLR-Velocty-v0", 2)
    with pytest.raises(InputError, match="did you mean 'randomization'"):
        Sb3VecEnv(ID, 2, randomisation="none")  # pyright: ignore[reportCallIssue]
    for seed in (-1, 0.5):
        with pytest.raises(InputError, match=f"seed = {seed}: expected a whole number of 0 or more"):
            Sb3VecEnv(ID, 2, seed=seed)  # type: ignore[arg-type]
    env = Sb3VecEnv(ID, 2, seed=0)
    with pytest.raises(gym.error.ResetNeeded, match=r"call reset\(\) before step\(\)"):
        env.step(np.zeros((2, 8), np.float32))
    env.reset()
    with pytest.raises(InputError, match="leg_lf of robot 1"):
        env.step(np.array([[0.0] * 8, [np.nan] * 8]))
