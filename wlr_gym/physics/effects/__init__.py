"""Named effects, formulas and patch files: what the nominal model lacks, added to any simulator.

The library loads when it is asked for.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

from wlr_gym.physics.effects.patch import (
    UNKNOWN_EFFECT,
    Patch,
    PatchEffect,
    Source,
    apply_patch,
    compose,
    load_patch,
    save_patch,
)

if TYPE_CHECKING:
    from wlr_gym.physics.effects.effect import STAGES, Effect, EffectParameter
    from wlr_gym.physics.effects.library import EFFECTS

#: Name -> module that it is loaded from.
HOMES = {
    "EFFECTS": "wlr_gym.physics.effects.library",
    "STAGES": "wlr_gym.physics.effects.effect",
    "Effect": "wlr_gym.physics.effects.effect",
    "EffectParameter": "wlr_gym.physics.effects.effect",
}

__all__ = [
    "EFFECTS",
    "STAGES",
    "UNKNOWN_EFFECT",
    "Effect",
    "EffectParameter",
    "Patch",
    "PatchEffect",
    "Source",
    "apply_patch",
    "compose",
    "load_patch",
    "save_patch",
]


def __getattr__(name: str) -> Any:
    if name not in HOMES:
        raise AttributeError(f"module '{__name__}' has no attribute '{name}'")
    return getattr(importlib.import_module(HOMES[name]), name)
