"""A start from a policy that was trained before: its weights, and a critic that knows how it does."""

from __future__ import annotations

from pathlib import Path

import torch
from stable_baselines3 import PPO
from stable_baselines3.common.save_util import load_from_zip_file

from wlr_gym.envs import Sb3VecEnv
from wlr_gym.learning.ppo.config import PpoConfig
from wlr_gym.learning.ppo.policy import MODEL_FILE, actor, contract_to_start_from, load_actor
from wlr_gym.learning.ppo.warm_start import fit_critic
from wlr_gym.policy import check_contract, find_policy, load_policy


def start_from(model: PPO, env: Sb3VecEnv, config: PpoConfig, source: str | Path) -> None:
    """Put a trained policy into ``model``. Where its critic is not known, a critic is fitted; the steps of that count.

    Raises:
        InputError: a policy that does not fit the environment, naming the first difference.
    """
    place = find_policy(source)
    check_contract(contract_to_start_from(source)["environment"], env.contract(), str(source))
    weights = _weights(place)
    own = model.policy.state_dict()
    if weights.keys() == own.keys() and all(weights[name].shape == own[name].shape for name in own):
        model.policy.load_state_dict(weights)
        return
    if place.is_file():
        actor(model.policy).load_state_dict(weights)
    else:
        load_actor(model.policy, weights)
    fit_critic(model, env, config, load_policy(source, env.contract()))


def _weights(place: Path) -> dict[str, torch.Tensor]:
    """Return the weights of a policy folder, all of the network, or of a policy file, those that act."""
    if not place.is_file():
        return load_from_zip_file(place / MODEL_FILE, device="cpu", load_data=False)[1]["policy"]  # type: ignore[return-value]
    import onnx
    from onnx import numpy_helper

    initializers = onnx.load(place).graph.initializer
    return {one.name: torch.from_numpy(numpy_helper.to_array(one).copy()) for one in initializers if one.name[0].isdigit()}
