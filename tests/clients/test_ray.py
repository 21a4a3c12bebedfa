"""Ray: an actor gets the spec of an environment, nothing else."""

import gymnasium as gym
import pytest

ray = pytest.importorskip("ray", reason="Ray is not installed: see tests/clients/conftest.py")


def test_an_actor_steps_an_environment(env_id):
    spec = gym.make(env_id).spec

    class Worker:
        def __init__(self, spec):
            self.env = gym.make(spec, max_episode_steps=-1)

        def drive(self, steps):
            total, _ = 0.0, self.env.reset(seed=5)
            self.env.action_space.seed(5)
            for _ in range(steps):
                _, reward, terminated, truncated, _ = self.env.step(self.env.action_space.sample())
                total += float(reward)
                if terminated or truncated:
                    self.env.reset()
            return total

    ray.init(address="local", num_cpus=1, include_dashboard=False, log_to_driver=False)
    try:
        remote = ray.get(ray.remote(Worker).remote(spec).drive.remote(200))
    finally:
        ray.shutdown()
    assert remote == Worker(spec).drive(200)
