"""A small sweep, trials that wait in mid-run, and how a trial is compared with the same training run alone."""

import os
from contextlib import suppress
from pathlib import Path
from typing import Any

from wlr_gym import train
from wlr_gym.learning.curves import read_curve

ENVIRONMENT = "brief_task:WLR-Brief-v0"
#: 8 robots, 8 ticks per update; scored every 4 updates, with a checkpoint every 2.
SETTINGS: dict[str, Any] = {
    "total_steps": 512,
    "num_envs": 8,
    "steps_per_env": 8,
    "batch_size": 32,
    "epochs": 1,
    "checkpoint_every": 128,
    "evaluate_every": 256,
    "evaluation_episodes": 2,
    "environment": {"episode_length": 0.2},
}


def checkpoints(out: Path) -> set[Path]:
    """Return the checkpoints of all trials of a sweep."""
    return set(out.glob("trials/*/checkpoints/step_*"))


def trials_at_work(hold: Path) -> int:
    """Return how many processes of trials that know the file ``hold`` there are on this machine (Linux)."""
    found = 0
    for process in Path("/proc").glob("[0-9]*"):
        with suppress(OSError):  # it has just ended
            is_trial = b"wlr_gym.learning.sweep.trial" in (process / "cmdline").read_bytes()
            found += is_trial and os.fsencode(hold) in (process / "environ").read_bytes()
    return found


def weights(folder: Path) -> dict[str, Any]:
    from stable_baselines3.common.save_util import load_from_zip_file

    return load_from_zip_file(folder / "policy" / "model.zip", device="cpu", load_data=False)[1]["policy"]  # type: ignore[return-value]


def assert_like_alone(result: Any, alone: Path, settings: dict[str, Any] = SETTINGS) -> None:
    """Train the settings of a trial alone, and compare scores, curve and weights to the bit."""
    import torch

    trial = result.trial
    train(ENVIRONMENT, alone, settings=settings | dict(trial.settings), seed=trial.seed)
    mine, theirs = weights(result.folder), weights(alone)
    assert all(torch.equal(mine[name], theirs[name]) for name in theirs), trial.name
    if settings["evaluate_every"]:
        assert (result.folder / "held_out.csv").read_text() == (alone / "held_out.csv").read_text(), trial.name
    clock = {"seconds", "steps_per_second"}
    first, second = (
        [{name: row[name] for name in row if name not in clock} for row in read_curve(folder / "learning_curve.csv")]
        for folder in (result.folder, alone)
    )
    assert first == second, trial.name
