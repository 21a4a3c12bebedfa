"""Unknown effects: a formula for a generalised force, as the gap workflow reports what no named effect explains.

```yaml
effects:
  - name: unknown_effect
    where: [leg_lr]
    formula: "-k * (leg_angle - a0)"
    parameters: {k: 0.8, a0: 1.2}
    units: {k: N m/rad, a0: rad}
```
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from wlr_gym.base.errors import InputError
from wlr_gym.physics.effects.effect import PatchEffect
from wlr_gym.physics.plants.forces import COORDINATES, Force, make_force

KEYS = ("name", "where", "formula", "parameters", "units")


def parse_formula(entry: Mapping[str, Any], where: tuple[str, ...], place: str) -> PatchEffect:
    """Return the checked unknown effect of a patch file.

    Args:
        entry: mapping of :data:`KEYS`.
        where: its places, of :data:`wlr_gym.physics.plants.forces.COORDINATES`.
        place: start of every message.

    Raises:
        InputError: see :func:`wlr_gym.physics.plants.forces.make_force`.
    """
    formula = entry.get("formula")
    if not isinstance(formula, str):
        raise InputError(f"{place}: 'formula' is {formula!r}: expected text such as '-k * (leg_angle - a0)'")
    parameters, units = (_mapping(entry, key, place) for key in ("parameters", "units"))
    try:
        force = make_force(where, formula, parameters, units)
    except InputError as error:
        raise InputError(f"{place}: {error}") from None
    return PatchEffect(entry["name"], where, force.parameters, formula, units, place)


def force_of(effect: PatchEffect) -> Force:
    """Return the force of an unknown effect."""
    return make_force(effect.where, effect.formula, effect.parameters, effect.units)


def _mapping(entry: Mapping[str, Any], key: str, place: str) -> dict[str, Any]:
    given = entry.get(key)
    if given is not None and not (isinstance(given, Mapping) and all(isinstance(name, str) for name in given)):
        raise InputError(f"{place}: '{key}' must be a mapping of the formula's constants, got {given!r}")
    return dict(given or {})


PLACES = tuple(COORDINATES)
