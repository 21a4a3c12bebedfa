"""The library: every named effect, one definition each. Names, parameters and places are the project's fixed vocabulary."""

from __future__ import annotations

from wlr_gym.physics.effects import body, ground, joints, sensors
from wlr_gym.physics.effects.effect import STAGES, Effect

#: Effects by name, joints first, then ground, body and sensors.
EFFECTS: dict[str, Effect] = {effect.name: effect for family in (joints, ground, body, sensors) for effect in family.EFFECTS}

#: What is missing but in no library: a formula for a generalised force (:mod:`wlr_gym.physics.plants.forces`).
UNKNOWN_EFFECT = "unknown_effect"


def stage(name: str) -> int:
    """Return the place of an effect in the order of application; formulas come last."""
    return STAGES.index(EFFECTS[name].stage) if name in EFFECTS else len(STAGES)
