"""Environments: one batched core (``core.Core``) with three thin interfaces, loaded when they are asked for."""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from wlr_gym.envs.classes import register_task
    from wlr_gym.envs.sb3 import Sb3VecEnv
    from wlr_gym.envs.single import WlrEnv
    from wlr_gym.envs.vector import WlrVectorEnv

_HOMES = {"WlrEnv": "single", "WlrVectorEnv": "vector", "Sb3VecEnv": "sb3", "register_task": "classes"}

__all__ = ["Sb3VecEnv", "WlrEnv", "WlrVectorEnv", "register_task"]


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module '{__name__}' has no attribute '{name}'")
    return getattr(importlib.import_module(f"wlr_gym.envs.{_HOMES[name]}"), name)
