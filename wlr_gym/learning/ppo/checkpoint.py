"""Checkpoints: a policy folder plus random state and robots, moved into place in one step. An interrupted write leaves none."""

from __future__ import annotations

import pickle
import random
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from wlr_gym.base.errors import InputError
from wlr_gym.learning.ppo.config import PpoConfig
from wlr_gym.learning.ppo.policy import MODEL_FILE
from wlr_gym.policy import read_contract, write_contract

if TYPE_CHECKING:
    from stable_baselines3 import PPO

    from wlr_gym.envs import Sb3VecEnv

RANDOM_FILE = "random_state.pt"
ROBOTS_FILE = "robots.pkl"
PREFIX = "step_"


def save(
    folder: Path, model: PPO, config: PpoConfig, env: Sb3VecEnv, notes: Mapping[str, Any], *, to_resume: bool = False
) -> Path:
    """Write weights, optimiser, contract and step count into ``folder``, replacing what is there.

    Args:
        folder: of the policy or checkpoint.
        model, config, env: what trains.
        notes: what the contract says of the training besides: its environment's id, scores.
        to_resume: also write random state and robots, so that :func:`restore` goes on where this was. Robots of a plant whose
            state cannot be set begin new episodes there.
    """
    folder.parent.mkdir(parents=True, exist_ok=True)
    temporary = folder.with_name(f".{folder.name}.part")
    shutil.rmtree(temporary, ignore_errors=True)
    temporary.mkdir()
    model.save(temporary / MODEL_FILE)
    if to_resume:
        torch.save(random_state(), temporary / RANDOM_FILE)
        can_set_state = env.core.plant.capabilities.can_set_state
        robots = (env.get_state() if can_set_state else None, np.asarray(model._last_episode_starts))
        (temporary / ROBOTS_FILE).write_bytes(pickle.dumps(robots))
    noise = float(model.policy.get_parameter("log_std").detach().mean())
    training = {"steps": model.num_timesteps, "updates": model._n_updates, "seed": config.seed, "log_std": noise, **notes}
    write_contract(temporary, "ppo", config.model_dump(mode="json"), env.contract(), training)
    shutil.rmtree(folder, ignore_errors=True)
    temporary.replace(folder)
    return folder


def newest(folder: Path) -> Path | None:
    """Return the newest checkpoint in ``folder``, None where there is none."""
    found = sorted(folder.glob(f"{PREFIX}*"))
    return found[-1] if found else None


def name_of(steps: int) -> str:
    """Return a checkpoint's folder name; names sort by steps."""
    return f"{PREFIX}{steps:012d}"


def drop_old(folder: Path, keep: int) -> None:
    """Remove all but the newest ``keep`` checkpoints."""
    for old in sorted(folder.glob(f"{PREFIX}*"))[:-keep]:
        shutil.rmtree(old)


def restore(folder: Path, model: PPO, env: Sb3VecEnv) -> None:
    """Put weights, optimiser, step count, random state and robots of a checkpoint into ``model`` and ``env``.

    Raises:
        InputError: the checkpoint cannot be read.
    """
    training = read_contract(folder)["training"]
    try:
        model.set_parameters(str(folder / MODEL_FILE), exact_match=True, device="cpu")
        state = torch.load(folder / RANDOM_FILE, weights_only=True)
        snapshot, starts = pickle.loads((folder / ROBOTS_FILE).read_bytes())  # as trusted as the model's own file
    except Exception as error:  # zip, pickle and torch each raise their own kinds for a broken file
        raise InputError(f"{folder}: not a readable checkpoint: {error}") from None
    model.num_timesteps, model._n_updates = training["steps"], training["updates"]
    model._last_obs, model._last_episode_starts = env.reset(), np.ones(env.num_envs, bool)
    if snapshot is not None:
        model._last_obs, model._last_episode_starts = env.set_state(snapshot), starts
    set_random_state(state)


def random_state() -> dict[str, Any]:
    """Return the state of the global generators of torch, numpy and Python."""
    name, keys, position, has_gauss, gauss = np.random.get_state(legacy=True)  # noqa: NPY002 - minibatches use it
    numpy_state = (str(name), torch.from_numpy(np.asarray(keys, dtype=np.int64)), int(position), int(has_gauss), float(gauss))
    return {"torch": torch.get_rng_state(), "numpy": numpy_state, "python": random.getstate()}


def set_random_state(state: dict[str, Any]) -> None:
    """Set the global generators to a saved state."""
    name, keys, position, has_gauss, gauss = state["numpy"]
    torch.set_rng_state(state["torch"])
    np.random.set_state((name, keys.numpy().astype(np.uint32), position, has_gauss, gauss))  # noqa: NPY002
    version, words, gauss_next = state["python"]
    random.setstate((version, tuple(words), gauss_next))
