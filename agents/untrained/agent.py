"""PPO's network at initialisation, with the seed of its settings: what a trained policy must be better than."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from wlr_gym.policy import Policy, load_agent, load_agent_config


def make_policy(contract: Mapping[str, Any], config: Mapping[str, Any]) -> Policy:
    """Return PPO's policy before any training; ``config`` is laid over PPO's own."""
    return load_agent("ppo").make_policy(contract, {**load_agent_config("ppo"), **config})
