"""Environments: one batched core (``core.Core``) with three thin interfaces, loaded when they are asked for."""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from wlr_gym.envs.interfaces import WlrEnv, WlrVectorEnv
    from wlr_gym.envs.registry import register_task
    from wlr_gym.envs.sb3 import Sb3VecEnv

HOMES = {
    "WlrEnv": "wlr_gym.envs.interfaces",
    "WlrVectorEnv": "wlr_gym.envs.interfaces",
    "Sb3VecEnv": "wlr_gym.envs.sb3",
    "register_task": "wlr_gym.envs.registry",
}

__all__ = ["Sb3VecEnv", "WlrEnv", "WlrVectorEnv", "register_task"]


def __getattr__(name: str) -> Any:
    if name not in HOMES:
        raise AttributeError(f"module '{__name__}' has no attribute '{name}'")
    return getattr(importlib.import_module(HOMES[name]), name)
