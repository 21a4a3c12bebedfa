"""Words about effects and formulas, made from the data they run on: for the documentation and the command line."""

from __future__ import annotations

from wlr_gym.physics.effects.effect import Effect, EffectParameter
from wlr_gym.physics.plants.forces import COORDINATES
from wlr_gym.robot import JOINTS, LEGS, WHEELS

_PLACES = {JOINTS: "joints", LEGS: "legs", WHEELS: "wheels"}


def places(effect: Effect) -> str:
    """Return where an effect can act, in a word: joints, legs, wheels, body, ground or sensor."""
    return _PLACES.get(effect.where, ", ".join(effect.where))


def parameter_text(name: str, parameter: EffectParameter) -> str:
    """Return ``torque N m [0, 2]``: name, unit and prior range; in brackets if it may be left out."""
    low, high = parameter.prior
    text = f"{name} {parameter.unit} [{low:.3g}, {high:.3g}]"
    return f"({text})" if parameter.optional else text


def coordinates() -> list[tuple[list[str], str, str]]:
    """Return where a formula may act: names that act alike, their unit, and what they mean."""
    return [
        (list(JOINTS), "N m", "torque like the motor's: on the child link, opposite on the parent"),
        (_names("body_force_"), "N", "force on the body origin, along the body's axes"),
        (_names("floor_force_"), "N", "force on the body origin, along the floor's axes"),
        (_names("body_torque_"), "N m", "torque on the body about its own x, y and z axes"),
    ]


def _names(start: str) -> list[str]:
    return [name for name in COORDINATES if name.startswith(start)]
