"""Named effects, formulas and patch files: what the nominal model lacks, added to any simulator."""

from wlr_gym.physics.effects.effect import STAGES, Effect, EffectParameter, PatchEffect
from wlr_gym.physics.effects.library import EFFECTS, UNKNOWN_EFFECT
from wlr_gym.physics.effects.patch import Patch, Source, apply_patch, compose, load_patch, save_patch

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
