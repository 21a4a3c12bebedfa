"""A start from a policy that was trained before: its weights, and a critic that knows how it does."""

from __future__ import annotations

from pathlib import Path

import torch
from stable_baselines3 import PPO

from wlr_gym.base.errors import require_package
from wlr_gym.envs import Sb3VecEnv
from wlr_gym.learning.ppo.config import PpoConfig
from wlr_gym.learning.ppo.export import LEARNER
from wlr_gym.learning.ppo.layers import scale_residual
from wlr_gym.learning.ppo.policy import ACTOR, actor, contract_to_start_from, load_actor, parse_settings, saved_weights
from wlr_gym.learning.ppo.warm_start import fit_critic
from wlr_gym.policy import check_contract, find_policy, load_policy


def start_from(model: PPO, env: Sb3VecEnv, config: PpoConfig, source: str | Path) -> None:
    """Put a trained policy into ``model``, so that the finished one would act as it does.

    Where its critic is not known, a critic is fitted; the steps of that count.

    Raises:
        InputError: a policy that does not fit the environment, naming the first difference.
    """
    place, contract = find_policy(source), contract_to_start_from(source)
    check_contract(contract["environment"], env.contract(), str(source))
    acting, learner = _file_weights(place) if place.is_file() else (None, saved_weights(place))
    if acting is None:
        load_actor(model.policy, learner)
    else:
        actor(model.policy).load_state_dict(acting)
    scale_residual(model.policy, parse_settings(contract["config"]).residual_share / config.residual_share)
    own = model.policy.state_dict()
    needed = [name for name in own if not name.startswith(ACTOR)]
    if all(name in learner and learner[name].shape == own[name].shape for name in needed):
        model.policy.load_state_dict({**own, **{name: learner[name] for name in needed}})
    else:
        fit_critic(model, env, config, load_policy(source, env.contract()))


def _file_weights(place: Path) -> tuple[dict[str, torch.Tensor], dict[str, torch.Tensor]]:
    """Return the weights of a policy file: those that act, as the graph names them, and those that a training needs."""
    require_package("onnx", "export")
    import onnx
    from onnx import numpy_helper

    constants = {one.name: torch.from_numpy(numpy_helper.to_array(one).copy()) for one in onnx.load(place).graph.initializer}
    acting = {name: value for name, value in constants.items() if name[0].isdigit()}
    return acting, {name.removeprefix(LEARNER): value for name, value in constants.items() if name.startswith(LEARNER)}
