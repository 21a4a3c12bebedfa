"""Tables about effects and formulas, made from the data they run on: for the documentation and the command line."""

from __future__ import annotations

from collections.abc import Sequence

from wlr_gym.physics.effects.effect import Effect, EffectParameter
from wlr_gym.physics.effects.registry import EFFECTS
from wlr_gym.physics.plants.forces import COORDINATES, FEATURES
from wlr_gym.robot import JOINTS, LEGS, WHEELS

_PLACES = {JOINTS: "joints", LEGS: "legs", WHEELS: "wheels"}


def places(effect: Effect) -> str:
    """Return where an effect can act, in a word: joints, legs, wheels, body, ground or sensor."""
    return _PLACES.get(effect.where, ", ".join(effect.where))


def parameter_text(name: str, parameter: EffectParameter) -> str:
    """Return ``torque N m [0, 2]``: name, unit and prior range; in brackets if it may be left out."""
    low, high = parameter.prior
    text = f"`{name}` {parameter.unit} [{low:.3g}, {high:.3g}]"
    return f"({text})" if parameter.optional else text


def effect_table() -> list[str]:
    """Return the library as lines of a Markdown table."""
    rows = [
        (
            f"`{effect.name}`",
            effect.doc,
            f"`{effect.equation}`",
            ", ".join(parameter_text(name, parameter) for name, parameter in effect.parameters.items()),
            places(effect),
        )
        for effect in EFFECTS.values()
    ]
    return _markdown(("name", "what is missing", "law", "parameters [plausible range]", "where"), rows)


def feature_table() -> list[str]:
    """Return what a formula may depend on as lines of a Markdown table."""
    rows = [(f"`{name}`", feature.unit, feature.doc, feature.scope) for name, feature in FEATURES.items()]
    return _markdown(("name", "unit", "meaning", "of the"), rows)


def coordinate_table() -> list[str]:
    """Return where a formula may act as lines of a Markdown table."""
    rows = [
        (
            ", ".join(f"`{joint}`" for joint in JOINTS),
            "N m",
            "torque like the motor's: on the child link, opposite on the parent",
        ),
        (_names("body_force_"), "N", "force on the body origin, along the body's axes"),
        (_names("floor_force_"), "N", "force on the body origin, along the floor's axes"),
        (_names("body_torque_"), "N m", "torque on the body about its own x, y and z axes"),
    ]
    return _markdown(("where", "unit", "meaning"), rows)


def _names(start: str) -> str:
    return ", ".join(f"`{name}`" for name in COORDINATES if name.startswith(start))


def _markdown(header: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    lines = [header, ["---"] * len(header), *rows]
    return [f"| {' | '.join(line)} |" if line[0] != "---" else f"|{'|'.join(line)}|" for line in lines]
