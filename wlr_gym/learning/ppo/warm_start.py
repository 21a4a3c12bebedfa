"""A start from a policy that works: its weights where it was trained before, and a critic that knows how it does.

What is not known is imitated, the whole policy or the critic alone: the policy drives all robots for a while, with noise on its
actions so that it is seen to correct errors. The actor learns its actions (without the noise), the critic its discounted
rewards. Own random numbers: nothing else is shifted.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from stable_baselines3 import PPO
from torch import nn

from wlr_gym.base.errors import require_package
from wlr_gym.envs.sb3 import Sb3VecEnv
from wlr_gym.learning.ppo.networks import grouped, scale_residual
from wlr_gym.learning.ppo.policy import (
    ACTOR,
    LEARNER,
    PpoConfig,
    actor,
    contract_to_start_from,
    load_actor,
    parse_settings,
    saved_weights,
)
from wlr_gym.policy import Policy, check_contract, find_policy, load_policy, make_policy

#: 1 sigma of the noise on the controller's actions.
NOISE = 0.03
#: Environment steps between the readings that are kept.
STRIDE = 5
#: Passes over the readings.
EPOCHS = 80
#: Readings per gradient step.
BATCH_SIZE = 512
#: At the start; it falls to zero: actions are met within 2 % of their range.
LEARNING_RATE = 2e-3

Observations = dict[str, NDArray[np.float32]]


def imitate(model: PPO, env: Sb3VecEnv, config: PpoConfig) -> None:
    """Fit the networks of ``model`` to the controller ``config.teacher``."""
    assert config.teacher is not None
    teacher = make_policy(config.teacher, env.contract())
    observations, actions, returns = _demonstrate(env, teacher, config, env.core.limit)
    _fit(model, observations, torch.as_tensor(actions), torch.as_tensor(returns), config.seed)


def start_from(model: PPO, env: Sb3VecEnv, config: PpoConfig, source: str | Path) -> None:
    """Put a trained policy into ``model``, so that the finished one would act as it does.

    Where its critic is not known, a critic is fitted; the steps of that count.
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
    else:  # the policy drives, which counts as training, and a critic is fitted to it
        ticks = min(env.core.limit, 2 * _horizon(config))
        observations, _, returns = _demonstrate(env, load_policy(source, env.contract()), config, ticks)
        _fit(model, observations, None, torch.as_tensor(returns), config.seed)
        model.num_timesteps += ticks * env.num_envs


def _file_weights(place: Path) -> tuple[dict[str, torch.Tensor], dict[str, torch.Tensor]]:
    """Return the weights of a policy file: those that act, as the graph names them, and those that a training needs."""
    require_package("onnx", "export")
    import onnx
    from onnx import numpy_helper

    constants = {one.name: torch.from_numpy(numpy_helper.to_array(one).copy()) for one in onnx.load(place).graph.initializer}
    acting = {name: value for name, value in constants.items() if name[0].isdigit()}
    return acting, {name.removeprefix(LEARNER): value for name, value in constants.items() if name.startswith(LEARNER)}


def _horizon(config: PpoConfig) -> int:
    """Return after how many environment steps a reward counts for nothing any more (0.7 %)."""
    return int(5.0 / (1.0 - config.gamma))


def _demonstrate(
    env: Sb3VecEnv, teacher: Policy, config: PpoConfig, ticks: int
) -> tuple[Observations, NDArray[np.float32], NDArray[np.float32]]:
    """Return observations {group: (M, ...)}, the teacher's actions (M, 8), and discounted rewards (M,) from there on."""
    noise = np.random.default_rng(config.seed)
    seen, actions, rewards, dones = [], [], [], []
    observation = grouped(env.reset())
    teacher.reset(np.ones(env.num_envs, bool))
    for _ in range(ticks):
        action = teacher.act(observation["policy"])
        seen.append(observation)
        actions.append(action)
        tried = np.clip(action + NOISE * noise.standard_normal(action.shape), -1.0, 1.0)
        new, reward, done, _ = env.step(tried.astype(np.float32))
        observation = grouped(new)
        teacher.reset(done)
        rewards.append(reward)
        dones.append(done)
    returns = _discounted(np.array(rewards), np.array(dones), config.gamma)
    horizon = min(_horizon(config), len(seen) // 2)  # later rewards are cut off
    kept = range(0, len(seen) - horizon, STRIDE)
    groups = {name: np.concatenate([seen[tick][name] for tick in kept]) for name in observation}
    return groups, np.concatenate([actions[tick] for tick in kept]), np.concatenate([returns[tick] for tick in kept])


def _discounted(rewards: NDArray[np.float32], dones: NDArray[np.bool_], gamma: float) -> NDArray[np.float32]:
    """Return the sums (T, N) of discounted rewards until the episode's end."""
    sums = np.zeros_like(rewards)
    later = np.zeros_like(rewards[0])
    for tick in reversed(range(len(rewards))):
        later = rewards[tick] + gamma * np.where(dones[tick], 0.0, later).astype(np.float32)
        sums[tick] = later
    return sums


def _fit(model: PPO, observations: Observations, actions: torch.Tensor | None, returns: torch.Tensor, seed: int) -> None:
    """Fit actor and critic to actions (M, 8) and returns (M,); without actions the critic alone, the actor stays."""
    policy: Any = model.policy
    critic = [*policy.mlp_extractor.value_net.parameters(), *policy.value_net.parameters()]
    moved = policy.parameters() if actions is not None else critic
    optimiser = torch.optim.Adam(moved, lr=LEARNING_RATE)
    tensors = {name: torch.as_tensor(values) for name, values in observations.items()}
    order = torch.Generator().manual_seed(seed)
    policy.set_training_mode(True)
    for epoch in range(EPOCHS):
        optimiser.param_groups[0]["lr"] = LEARNING_RATE * (1.0 - epoch / EPOCHS)
        for rows in torch.randperm(len(returns), generator=order).split(BATCH_SIZE):
            batch = {name: values[rows] for name, values in tensors.items()}
            seen = batch if len(batch) > 1 else batch["policy"]
            value = policy.predict_values(seen).flatten()
            loss = nn.functional.mse_loss(value, returns[rows])
            if actions is not None:
                mean = policy.get_distribution(seen).distribution.mean
                loss = nn.functional.mse_loss(mean, actions[rows]) + loss
            optimiser.zero_grad()
            loss.backward()
            optimiser.step()
