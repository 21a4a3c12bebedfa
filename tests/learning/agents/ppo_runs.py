"""Short PPO runs, and how two of them are compared."""

from typing import Any

from wlr_gym.learning.curves import read_curve
from wlr_gym.policy import Training, load_agent

ENVIRONMENT = "WLR-Velocity-v0"
#: 8 robots, 8 ticks per update; a checkpoint every 2 updates, the run has 6.
SETTINGS: dict[str, Any] = {
    "total_steps": 384,
    "num_envs": 8,
    "steps_per_env": 8,
    "batch_size": 32,
    "epochs": 2,
    "checkpoint_every": 128,
    "keep_checkpoints": 10,
    "evaluate_every": 0,
    "environment": {"episode_length": 0.2},
}


def train(folder, *, resume=False, **changes):
    return load_agent("ppo").train(Training(ENVIRONMENT, folder, SETTINGS | changes, resume=resume, progress=False))


def weights(folder) -> dict[str, Any]:
    from stable_baselines3.common.save_util import load_from_zip_file

    return load_from_zip_file(folder / "model.zip", device="cpu", load_data=False)[1]["policy"]  # type: ignore[return-value]


def assert_same_weights(first, second):
    import torch

    mine, theirs = weights(first), weights(second)
    assert mine.keys() == theirs.keys()
    assert all(torch.equal(mine[name], theirs[name]) for name in mine)


def curve(folder):
    clock = ("seconds", "steps_per_second")
    return [{key: value for key, value in row.items() if key not in clock} for row in read_curve(folder / "learning_curve.csv")]
