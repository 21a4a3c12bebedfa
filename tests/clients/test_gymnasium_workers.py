"""Gymnasium's own vectorisation in fresh processes, and wrappers that read the spec."""

import gymnasium as gym
import numpy as np


def test_fresh_processes_step_as_this_one(env_id):
    workers = gym.make_vec(env_id, num_envs=2, vectorization_mode="async", vector_kwargs={"context": "spawn"})
    batch = gym.make_vec(env_id, num_envs=2)
    try:
        np.testing.assert_array_equal(workers.reset(seed=3)[0], batch.reset(seed=3)[0])
        for _ in range(300):
            action = batch.action_space.sample()
            for ours, theirs in zip(batch.step(action)[:4], workers.step(action)[:4], strict=True):
                np.testing.assert_array_equal(ours, theirs)
    finally:
        workers.close()


def test_the_time_is_observed(env_id):
    env = gym.wrappers.TimeAwareObservation(gym.make(env_id, episode_length=1.0))
    env.reset(seed=0)
    steps = [env.step(env.action_space.sample()) for _ in range(50)]
    assert [step[3] for step in steps] == [False] * 49 + [True]
    assert all(env.observation_space.contains(step[0]) for step in steps)
