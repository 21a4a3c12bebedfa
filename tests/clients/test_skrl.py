"""skrl: ``wrap_env`` recognises single and vector environments."""

import gymnasium as gym
import pytest

pytest.importorskip("skrl", reason="skrl is not installed: see tests/clients/conftest.py")

import torch
from skrl.envs.wrappers.torch import wrap_env  # pyright: ignore[reportMissingImports]


@pytest.mark.parametrize("count", [1, 4])
def test_it_recognises_the_environment(env_id, count):
    made = gym.make(env_id) if count == 1 else gym.make_vec(env_id, num_envs=count)
    env = wrap_env(made)
    assert env.num_envs == count
    observations, _ = env.reset()
    assert observations.shape[0] == count
    for _ in range(300):
        observations, rewards, terminated, truncated, _ = env.step(torch.zeros(count, 8))
        assert torch.isfinite(rewards).all()
        assert observations.shape[0] == count
        assert rewards.shape == terminated.shape == truncated.shape == (count, 1)
