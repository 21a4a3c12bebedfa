"""Environments: one batched core (``core.Core``) with three thin interfaces, loaded when they are asked for."""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from wlr_gym.envs.sb3 import Sb3VecEnv
    from wlr_gym.envs.single import WlrEnv
    from wlr_gym.envs.user_tasks import register_task
    from wlr_gym.envs.vector import WlrVectorEnv

HOMES = {
    "WlrEnv": "wlr_gym.envs.single",
    "WlrVectorEnv": "wlr_gym.envs.vector",
    "Sb3VecEnv": "wlr_gym.envs.sb3",
    "register_task": "wlr_gym.envs.user_tasks",
}

__all__ = ["Sb3VecEnv", "WlrEnv", "WlrVectorEnv", "register_task"]


def __getattr__(name: str) -> Any:
    if name not in HOMES:
        raise AttributeError(f"module '{__name__}' has no attribute '{name}'")
    return getattr(importlib.import_module(HOMES[name]), name)
