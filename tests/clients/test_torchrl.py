"""TorchRL: ``GymEnv`` probes keywords, and has a ``backend`` of its own."""

import pytest

pytest.importorskip("torchrl", reason="TorchRL is not installed: see tests/clients/conftest.py")

from torchrl.envs import GymEnv, ParallelEnv  # pyright: ignore[reportMissingImports]
from torchrl.envs.utils import check_env_specs  # pyright: ignore[reportMissingImports]


@pytest.mark.parametrize("plant", ["gibbs_appell", "mujoco"])
def test_one_environment(env_id, plant):
    env = GymEnv(env_id, plant=plant, episode_length=1.0)
    check_env_specs(env)
    rollout = env.rollout(200, break_when_any_done=False)
    assert rollout["next", "reward"].isfinite().all()
    assert rollout["next", "truncated"].any()
    env.close()


def test_workers(env_id):
    env = ParallelEnv(2, lambda: GymEnv(env_id), mp_start_method="spawn")
    rollout = env.rollout(100, break_when_any_done=False)
    assert rollout.shape == (2, 100)
    env.close()
