"""Named effects and patch files: what the nominal model lacks, added to any plant through its parameters."""

from wlr_gym.effects.patch import Patch, PatchEffect, apply_patch, load_patch, save_patch
from wlr_gym.effects.registry import EFFECTS, Effect, EffectParameter

__all__ = ["EFFECTS", "Effect", "EffectParameter", "Patch", "PatchEffect", "apply_patch", "load_patch", "save_patch"]
