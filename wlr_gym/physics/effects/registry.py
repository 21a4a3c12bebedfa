"""The library: every named effect, one definition each. Names, parameters and places are the project's fixed vocabulary."""

from __future__ import annotations

from wlr_gym.base.errors import InputError
from wlr_gym.physics.effects import body, ground, joints, sensors
from wlr_gym.physics.effects.effect import STAGES, Effect


class Library(dict[str, Effect]):
    """Effects, each under its own name."""

    def __setitem__(self, name: str, effect: Effect) -> None:
        if effect.name != name:
            raise InputError(f"EFFECTS['{name}']: the effect calls itself '{effect.name}'; expected the same name")
        super().__setitem__(name, effect)


#: Effects by name, joints first, then ground, body and sensors.
EFFECTS = Library({effect.name: effect for family in (joints, ground, body, sensors) for effect in family.EFFECTS})

#: What is missing but in no library: a formula for a generalised force (:mod:`wlr_gym.physics.plants.forces`).
UNKNOWN_EFFECT = "unknown_effect"


def stage(name: str) -> int:
    """Return the place of an effect in the order of application; formulas come last."""
    return STAGES.index(EFFECTS[name].stage) if name in EFFECTS else len(STAGES)
