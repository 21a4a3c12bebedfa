"""Patches: effects as YAML, loaded, checked, composed, applied and saved.

```yaml
effects:
  - name: rolling_resistance
    where: [wheel_lf, wheel_rf]
    parameters: {coefficient: 0.04}
provenance: {made_by: hand}     # optional
```
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

import yaml

from wlr_gym.base.errors import InputError, unknown_name
from wlr_gym.base.files import write_text
from wlr_gym.base.paths import as_path, find_config
from wlr_gym.base.settings import read_yaml
from wlr_gym.physics.codegen.expression import finite_number
from wlr_gym.physics.plants.base import COORDINATES
from wlr_gym.robot.parameter_table import range_in_words, unit_in_words
from wlr_gym.robot.parameters import Parameters

if TYPE_CHECKING:
    from wlr_gym.physics.effects.effect import Effect, EffectParameter
    from wlr_gym.physics.plants.forces import Force

#: What is missing but in no library: a formula for a generalised force (:mod:`wlr_gym.physics.plants.forces`).
UNKNOWN_EFFECT = "unknown_effect"
#: Keys of such an effect in a patch file.
KEYS = ("name", "where", "formula", "parameters", "units")


@dataclass(frozen=True)
class PatchEffect:
    """One effect of a patch.

    Attributes:
        name: of the library, or ``unknown_effect``.
        where: places it acts on.
        parameters: its numbers, SI; optional ones that are left out are neutral.
        formula, units: law of an unknown effect and the units of its parameters; empty for an effect of the library.
        place: where it was read, for messages; does not count in comparisons.
    """

    name: str
    where: tuple[str, ...]
    parameters: Mapping[str, float]
    formula: str = ""
    units: Mapping[str, str] = field(default_factory=dict)
    place: str = field(default="", compare=False)

    def content(self) -> dict[str, Any]:
        """Return the effect as plain YAML types."""
        content: dict[str, Any] = {"name": self.name, "where": list(self.where)}
        if self.formula:
            content["formula"] = self.formula
        content["parameters"] = dict(self.parameters)
        if self.units:
            content["units"] = dict(self.units)
        return content


@dataclass(frozen=True)
class Patch:
    """Effects to add to the nominal model, in order, and where they come from."""

    effects: tuple[PatchEffect, ...] = ()
    provenance: Mapping[str, Any] = field(default_factory=dict)
    source: str = "patch"

    def __bool__(self) -> bool:
        return bool(self.effects)

    @cached_property
    def forces(self) -> tuple[Force, ...]:
        """What the plant itself must be given: the formulas of unknown effects."""
        return tuple(force_of(effect) for effect in self.effects if effect.name == UNKNOWN_EFFECT)

    def summary(self) -> str:
        """Return the effects' names in order, or ``none``."""
        return ", ".join(effect.name for effect in self.effects) or "none"

    def content(self) -> dict[str, Any]:
        """Return the patch as plain YAML types: what :func:`save_patch` writes and :func:`load_patch` reads."""
        content: dict[str, Any] = {"effects": [effect.content() for effect in self.effects]}
        if self.provenance:
            content["provenance"] = dict(self.provenance)
        return content


Source = Patch | str | Path | Mapping[str, Any] | Sequence[Any] | None


class EffectKind(Protocol):
    """What a patch file may say of an effect: its places and its parameters."""

    @property
    def where(self) -> tuple[str, ...]: ...

    @property
    def parameters(self) -> Mapping[str, EffectParameter]: ...


#: Name -> effect that a patch may have; None = those of the library, and formulas.
EffectKinds = Mapping[str, EffectKind] | None


def load_patch(source: Source, kinds: EffectKinds = None) -> Patch:
    """Load a patch from what users pass as ``effects=`` or after ``--effects``.

    Args:
        source: path of a YAML file or name of one in ``configs/effects/``, an effect or a whole patch as a mapping, a
            :class:`Patch`, a list of any of these (composed in order), or None (no effects).
        kinds: effects that it may have, of a system that is not the robot; None = those of the library, and formulas.

    Raises:
        InputError: naming file, effect, key and the nearest valid name.
    """
    match source:
        case Patch():
            return source
        case None:
            return Patch()
        case str() | Path():
            if source in (*_library(), UNKNOWN_EFFECT):
                raise InputError(
                    f"'{source}' is an effect, not a patch: write a file with its numbers (wlr effects {source}), "
                    f"or give it as a mapping in Python: {{'name': '{source}', 'parameters': {{...}}}}"
                )
            if Path(source).suffix == ".json":
                raise InputError(
                    f"{source}: not a patch: expected a YAML file; of a result of wlr gap that is the patch.yaml beside it"
                )
            path = find_config("effects", source)
            return _parse(read_yaml(path), str(path), kinds)
        case Mapping():
            return _parse({"effects": [source]} if "name" in source else source, "effects", kinds)
        case Sequence():
            return _compose_entries(source, kinds)
    raise InputError(f"effects = {source!r}: expected a path, a mapping or a list of effects")


def compose(*patches: Patch) -> Patch:
    """Return one patch with the effects of all, in order."""
    given = [patch for patch in patches if patch.effects or patch.provenance]
    if len(given) == 1:
        return given[0]
    effects = tuple(effect for patch in given for effect in patch.effects)
    origins = [{"source": patch.source, **patch.provenance} for patch in given if patch.provenance]
    sources = dict.fromkeys(patch.source for patch in given)
    return Patch(effects, {"composed_of": origins} if origins else {}, ", ".join(sources))


def _compose_entries(entries: Sequence[Any], kinds: EffectKinds) -> Patch:
    patches: list[Patch] = []
    for index, entry in enumerate(entries):
        if isinstance(entry, Patch | str | Path) or (isinstance(entry, Mapping) and "effects" in entry):
            patches.append(load_patch(entry, kinds))
        else:
            patches.append(Patch((_parse_effect(entry, "effects", index, kinds),), source="effects"))
    return compose(*patches)


def save_patch(patch: Patch, path: str | Path) -> Path:
    """Write a patch as YAML; :func:`load_patch` reads back the same effects, neutral numbers filled in."""
    text = yaml.dump(patch.content(), Dumper=_Dumper, sort_keys=False)  # in ASCII: PyYAML loses U+0085 and its kin otherwise
    path = as_path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    write_text(path, text)
    return path


class _Dumper(yaml.SafeDumper):
    """Quotes text that :func:`wlr_gym.base.settings.read_yaml` would take for a number, such as the commit 12345e6."""


_Dumper.add_implicit_resolver(
    "tag:yaml.org,2002:float", re.compile(r"^[-+]?[0-9][0-9_]*(\.[0-9_]*)?[eE][-+]?[0-9]+$"), list("-+0123456789")
)


def apply_patch(patch: Patch, parameters: Parameters) -> Parameters:
    """Return ``parameters`` with every effect added; kinds act in the order of :data:`wlr_gym.physics.effects.effect.STAGES`.

    Optional parameters of an effect that are left out are neutral. Formulas are no parameters: the plant takes them as
    ``forces=patch.forces``.

    Raises:
        InputError: an effect that these parameters cannot take, or a result outside the bounds of the table.
    """
    patched = parameters.copy()
    named = [effect for effect in patch.effects if effect.name != UNKNOWN_EFFECT]
    kinds = _library() if named else {}
    for effect in sorted(named, key=lambda effect: kinds[effect.name].order):
        kind = kinds[effect.name]
        neutral = {name: float(spec.neutral) for name, spec in kind.parameters.items() if spec.has_default}
        try:
            kind.apply(patched, effect.where, {**neutral, **effect.parameters})
            patched.validate()
        except InputError as error:
            raise InputError(f"{effect.place or effect.name}: {error}") from None
    return patched


def _library() -> Mapping[str, Effect]:
    """Return the library, which loads when a patch has effects."""
    from wlr_gym.physics.effects.library import EFFECTS

    return EFFECTS


# ---- reading ---------------------------------------------------------------------------------------------------------


def _parse(data: Any, source: str, kinds: EffectKinds) -> Patch:
    if data is None:
        raise InputError(f"{source}: is empty; expected a mapping with 'effects'")
    if not isinstance(data, Mapping):
        raise InputError(f"{source}: expected a mapping with 'effects', got {type(data).__name__}")
    _require_keys(data, ("effects", "provenance"), source)
    effects, provenance = data.get("effects"), data.get("provenance") or {}
    if not isinstance(effects, list | tuple):
        raise InputError(f"{source}: 'effects' must be a list of effects, got {type(effects).__name__}")
    if not isinstance(provenance, Mapping):
        raise InputError(f"{source}: 'provenance' must be a mapping, got {type(provenance).__name__}")
    parsed = tuple(_parse_effect(entry, source, index, kinds) for index, entry in enumerate(effects))
    return Patch(parsed, dict(provenance), source)


def _parse_effect(entry: Any, source: str, index: int, kinds: EffectKinds) -> PatchEffect:
    if not isinstance(entry, Mapping) or not isinstance(entry.get("name"), str):
        raise InputError(
            f"{source}: effect {index + 1}: expected a mapping with 'name', 'where' and 'parameters', got {entry!r}"
        )
    name = entry["name"]
    place = f"{source}: effect {index + 1} ({name})"
    if name == UNKNOWN_EFFECT and kinds is None:
        _require_keys(entry, KEYS, place)
        return parse_formula(entry, _parse_where(entry.get("where"), tuple(COORDINATES), place), place)
    known = _library() if kinds is None else kinds
    if name not in known:
        valid = [*known, UNKNOWN_EFFECT] if kinds is None else known
        raise unknown_name("effect", name, valid, f"{source}: effect {index + 1}")
    effect = known[name]
    _require_keys(entry, ("name", "where", "parameters"), place)
    where = _parse_where(entry.get("where"), effect.where, place)
    return PatchEffect(name, where, _parse_parameters(entry, effect, place), place=place)


def _parse_where(where: Any, valid: tuple[str, ...], place: str) -> tuple[str, ...]:
    if where is None and len(valid) == 1:
        return valid
    where = [where] if isinstance(where, str) else where
    if not isinstance(where, list | tuple) or not where:
        raise InputError(f"{place}: where = {where!r}: expected a list of {', '.join(valid)}")
    for name in where:
        if name not in valid:
            raise unknown_name("where", str(name), valid, place)
    if len(set(where)) < len(where):
        raise InputError(f"{place}: where = {list(where)}: a place occurs twice")
    return tuple(where)


def _parse_parameters(entry: Mapping[str, Any], effect: EffectKind, place: str) -> dict[str, float]:
    given = entry.get("parameters") or {}
    if not isinstance(given, Mapping):
        raise InputError(f"{place}: 'parameters' must be a mapping of {', '.join(effect.parameters)}, got {given!r}")
    _require_keys(given, effect.parameters, place)
    left = {name for name, spec in effect.parameters.items() if spec.optional and not spec.has_default} - set(given)
    read = {name: spec for name, spec in effect.parameters.items() if name not in left}
    return {name: _number(given.get(name), name, spec, place) for name, spec in read.items()}


def _number(value: Any, name: str, spec: EffectParameter, place: str) -> float:
    if value is None and spec.has_default:
        return float(spec.neutral)
    if value is None:
        raise InputError(f"{place}: parameter '{name}' ({unit_in_words(spec.unit)}) is missing")
    number = finite_number(value)
    if number is None:
        raise InputError(f"{place}: {name} = {value!r}: expected a finite number ({unit_in_words(spec.unit)})")
    if not spec.low <= number <= spec.high:
        raise InputError(f"{place}: {name} = {number:g} is outside {range_in_words(spec.low, spec.high, spec.unit)}")
    return number


def _require_keys(data: Mapping[str, Any], valid: Sequence[str] | Mapping[str, Any], place: str) -> None:
    for key in data:
        if key not in valid:
            raise unknown_name("key", str(key), valid, place)


# ---- unknown effects: a formula for a generalised force --------------------------------------------------------------

# As the gap workflow reports what no named effect explains:
#
#   - name: unknown_effect
#     where: [leg_lr]
#     formula: "-k * (leg_angle - a0)"
#     parameters: {k: 0.8, a0: 1.2}
#     units: {k: N m/rad, a0: rad}


def parse_formula(entry: Mapping[str, Any], where: tuple[str, ...], place: str) -> PatchEffect:
    """Return the checked unknown effect of a patch file.

    Args:
        entry: mapping of :data:`KEYS`.
        where: its places, of :data:`wlr_gym.physics.plants.forces.COORDINATES`.
        place: start of every message.
    """
    from wlr_gym.physics.plants.forces import make_force

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
    from wlr_gym.physics.plants.forces import make_force

    return make_force(effect.where, effect.formula, effect.parameters, effect.units)


def _mapping(entry: Mapping[str, Any], key: str, place: str) -> dict[str, Any]:
    given = entry.get(key)
    if given is not None and not (isinstance(given, Mapping) and all(isinstance(name, str) for name in given)):
        raise InputError(f"{place}: '{key}' must be a mapping of the formula's constants, got {given!r}")
    return dict(given or {})
