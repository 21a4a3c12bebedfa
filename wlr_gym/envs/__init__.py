"""Environments: one batched core (``core.Core``) with three thin faces. Faces load when asked for."""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from wlr_gym.envs.sb3 import Sb3VecEnv
    from wlr_gym.envs.single import WlrEnv
    from wlr_gym.envs.vector import WlrVectorEnv

_FACES = {"WlrEnv": "single", "WlrVectorEnv": "vector", "Sb3VecEnv": "sb3"}

__all__ = ["Sb3VecEnv", "WlrEnv", "WlrVectorEnv"]


def __getattr__(name: str) -> Any:
    if name not in _FACES:
        raise AttributeError(f"module '{__name__}' has no attribute '{name}'")
    return getattr(importlib.import_module(f"wlr_gym.envs.{_FACES[name]}"), name)
