"""Patches: effects as YAML, loaded, checked, applied and saved.

```yaml
effects:
  - name: rolling_resistance
    where: [wheel_lf, wheel_rf]
    parameters: {coefficient: 0.04}
provenance: {made_by: hand}     # optional
```
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import yaml

from wlr_gym.effects.registry import BEYOND_PARAMETERS, EFFECTS, Effect, EffectParameter, stage
from wlr_gym.errors import InputError, unknown_name
from wlr_gym.files import replace_file
from wlr_gym.parameters import Parameters
from wlr_gym.robot import read_yaml


@dataclass(frozen=True)
class PatchEffect:
    """One effect of a patch: its name, where it acts, and all its parameters."""

    name: str
    where: tuple[str, ...]
    parameters: Mapping[str, float]


@dataclass(frozen=True)
class Patch:
    """Effects to add to the nominal model, in order, and where they come from."""

    effects: tuple[PatchEffect, ...] = ()
    provenance: Mapping[str, Any] = field(default_factory=dict)
    source: str = "patch"

    def __bool__(self) -> bool:
        return bool(self.effects)


def load_patch(source: Patch | str | Path | Sequence[Mapping[str, Any]] | None) -> Patch:
    """Load a patch from what users pass as ``effects=``.

    Args:
        source: path of a YAML file, list of effects as dictionaries, a :class:`Patch`, or None (no effects).

    Raises:
        InputError: naming file, effect, key and the nearest valid name.
    """
    if isinstance(source, Patch):
        return source
    if source is None:
        return Patch()
    if isinstance(source, str | Path):
        return _parse(read_yaml(source), str(source))
    return _parse({"effects": list(source)}, "effects")


def save_patch(patch: Patch, path: str | Path) -> Path:
    """Write a patch as YAML; :func:`load_patch` reads back the same effects."""
    effects = [
        {"name": effect.name, "where": list(effect.where), "parameters": dict(effect.parameters)} for effect in patch.effects
    ]
    content: dict[str, Any] = {"effects": effects}
    if patch.provenance:
        content["provenance"] = dict(patch.provenance)
    text = yaml.safe_dump(content, sort_keys=False, allow_unicode=True)
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    replace_file(path, lambda temporary: temporary.write_text(text, encoding="utf-8"))
    return path


def apply_patch(patch: Patch, parameters: Parameters) -> Parameters:
    """Return ``parameters`` with every effect added; the order in the patch does not matter.

    Levels come first, then ratios and scales, then additions (:data:`wlr_gym.effects.registry.STAGES`).

    Raises:
        InputError: an effect that these parameters cannot take, or a result outside the bounds of the table.
    """
    patched = parameters.copy()
    for index, effect in sorted(enumerate(patch.effects), key=lambda entry: stage(entry[1].name)):
        try:
            EFFECTS[effect.name].apply(patched, effect.where, effect.parameters)
            patched.validate()
        except InputError as error:
            raise InputError(f"{_place(patch.source, index, effect.name)}: {error}") from None
    return patched


def _parse(data: Any, source: str) -> Patch:
    if not isinstance(data, Mapping):
        raise InputError(f"{source}: expected a mapping with 'effects', got {type(data).__name__}")
    _require_keys(data, ("effects", "provenance"), source)
    effects, provenance = data.get("effects"), data.get("provenance") or {}
    if not isinstance(effects, list):
        raise InputError(f"{source}: 'effects' must be a list of effects, got {type(effects).__name__}")
    if not isinstance(provenance, Mapping):
        raise InputError(f"{source}: 'provenance' must be a mapping, got {type(provenance).__name__}")
    return Patch(tuple(_parse_effect(entry, source, index) for index, entry in enumerate(effects)), dict(provenance), source)


def _parse_effect(entry: Any, source: str, index: int) -> PatchEffect:
    if not isinstance(entry, Mapping) or not isinstance(entry.get("name"), str):
        raise InputError(
            f"{source}: effect {index + 1}: expected a mapping with 'name', 'where' and 'parameters', got {entry!r}"
        )
    name = entry["name"]
    place = _place(source, index, name)
    if name in BEYOND_PARAMETERS:
        reason = "not in this version (it takes more than a value of the parameter table)"
        raise InputError(f"{place}: {reason}; available: {', '.join(sorted(EFFECTS))}")
    if name not in EFFECTS:
        raise unknown_name("effect", name, EFFECTS, f"{source}: effect {index + 1}")
    effect = EFFECTS[name]
    _require_keys(entry, ("name", "where", "parameters"), place)
    return PatchEffect(name, _parse_where(entry.get("where"), effect, place), _parse_parameters(entry, effect, place))


def _parse_where(where: Any, effect: Effect, place: str) -> tuple[str, ...]:
    if where is None and len(effect.where) == 1:
        return effect.where
    where = [where] if isinstance(where, str) else where
    if not isinstance(where, list | tuple) or not where:
        raise InputError(f"{place}: where = {where!r}: expected a list of {', '.join(effect.where)}")
    for name in where:
        if name not in effect.where:
            raise unknown_name("where", str(name), effect.where, place)
    if len(set(where)) < len(where):
        raise InputError(f"{place}: where = {list(where)}: a place occurs twice")
    return tuple(where)


def _parse_parameters(entry: Mapping[str, Any], effect: Effect, place: str) -> dict[str, float]:
    given = entry.get("parameters") or {}
    if not isinstance(given, Mapping):
        raise InputError(f"{place}: 'parameters' must be a mapping of {', '.join(effect.parameters)}, got {given!r}")
    _require_keys(given, effect.parameters, place)
    return {name: _number(given.get(name, spec.default), name, spec, place) for name, spec in effect.parameters.items()}


def _number(value: Any, name: str, spec: EffectParameter, place: str) -> float:
    if value is None:
        raise InputError(f"{place}: parameter '{name}' ({spec.unit}) is missing")
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise InputError(f"{place}: {name} = {value!r}: expected a finite number in {spec.unit}")
    if not spec.low <= value <= spec.high:
        raise InputError(f"{place}: {name} = {value:g} is outside [{spec.low:g}, {spec.high:g}] {spec.unit}")
    return float(value)


def _require_keys(data: Mapping[str, Any], valid: Sequence[str] | Mapping[str, Any], place: str) -> None:
    for key in data:
        if key not in valid:
            raise unknown_name("key", str(key), valid, place)


def _place(source: str, index: int, name: str) -> str:
    return f"{source}: effect {index + 1} ({name})"
