"""Open a folder of the rig's recordings: read, check, and make a problem of them; and patches in the rig's own vocabulary."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Protocol

from wlr_gym.base.errors import InputError, unknown_name
from wlr_gym.base.paths import find_config
from wlr_gym.base.settings import read_yaml
from wlr_gym.gap.analysis import IntakeFinding
from wlr_gym.gap.rig.effects import RIG_EFFECTS
from wlr_gym.gap.rig.formula import rig_force
from wlr_gym.gap.rig.intake import findings
from wlr_gym.gap.rig.model import JOINT
from wlr_gym.gap.rig.problem import RigProblem
from wlr_gym.gap.rig.recording import read_recordings
from wlr_gym.physics.codegen.expression import finite_number
from wlr_gym.physics.effects import UNKNOWN_EFFECT, EffectParameter, Patch, PatchEffect, Source, compose
from wlr_gym.robot.parameter_table import range_in_words

#: Recordings that an analysis needs: two to fit, one to hold out.
LEAST_RUNS = 3


def open_rig(data: str | Path, known: Patch | None = None) -> tuple[RigProblem | None, list[IntakeFinding]]:
    """Return the problem, and what was noticed about the data; None where the data are too bad to go on.

    Args:
        data: folder of recordings.
        known: effects that are in the model from the start.

    Raises:
        InputError: files that are no such recordings, an effect the rig does not know.
    """
    recordings = read_recordings(data)
    found = list(findings(recordings))
    bad = {finding.run for finding in found if finding.fatal}
    good = [recording for recording in recordings if recording.name not in bad]
    if "" in bad:
        return None, found
    if len(good) < LEAST_RUNS:
        text = f"{len(good)} usable runs of {len(recordings)}: record {LEAST_RUNS} or more, two to fit and one to hold out"
        return None, [*found, IntakeFinding("", "", "few_runs", text, fatal=True)]
    return RigProblem(good, known.effects if known else ()), found


class Parametrised(Protocol):
    """What has numbers: an effect or a law of a rig."""

    @property
    def parameters(self) -> Mapping[str, EffectParameter]:
        """Its numbers, by name."""
        ...


def rig_patch(source: Source, effects: Mapping[str, Parametrised] = RIG_EFFECTS, joint: str = JOINT) -> Patch:
    """Load a patch of a rig, as its analyses write it.

    Args:
        source: as for :func:`wlr_gym.physics.effects.load_patch`.
        effects: what the rig knows; formulas only :data:`RIG_EFFECTS` can have beside them.
        joint: the one place where they act.

    Raises:
        InputError: naming file, effect, key and the nearest valid name.
    """
    if source is None or isinstance(source, Patch):
        return source or Patch()
    if isinstance(source, str | Path):
        path = find_config("effects", source)
        content, name = read_yaml(path), str(path)
    elif isinstance(source, Mapping):
        content, name = {"effects": [source]} if "name" in source else source, "effects"
    elif isinstance(source, Sequence):
        return compose(*(rig_patch(one, effects, joint) for one in source))
    else:
        raise InputError(f"effects = {source!r}: expected a path, a mapping or a list of effects")
    entries = content.get("effects") if isinstance(content, Mapping) else None
    if not isinstance(entries, list | tuple):
        raise InputError(f"{name}: expected a mapping with 'effects', a list of effects")
    found = tuple(_effect(entry, f"{name}: effect {k}", effects, joint) for k, entry in enumerate(entries, 1))
    return Patch(found, _mapping(content, "provenance", name), name)


def _effect(entry: Any, place: str, effects: Mapping[str, Parametrised], joint: str) -> PatchEffect:
    if not isinstance(entry, Mapping) or not isinstance(entry.get("parameters", {}), Mapping):
        raise InputError(f"{place}: expected a mapping with 'name', 'where' and 'parameters', got {entry!r}")
    name, given = str(entry.get("name")), dict(entry.get("parameters", {}))
    if name not in effects and not (name == UNKNOWN_EFFECT and effects is RIG_EFFECTS):
        raise unknown_name("effect of the test rig", name, effects, place)
    if entry.get("where", joint) not in (joint, [joint], (joint,)):
        raise InputError(f"{place} ({name}): where = {entry['where']!r}: the rig has one joint, {joint}")
    if name == UNKNOWN_EFFECT:
        place = f"{place} ({name})"
        if not isinstance(entry.get("formula"), str):
            raise InputError(
                f"{place}: formula = {entry.get('formula')!r}: expected a formula of the torque, such as '-b * rate'"
            )
        effect = PatchEffect(name, (joint,), given, entry["formula"], _mapping(entry, "units", place), place)
        rig_force(effect)
        return effect
    known = effects[name].parameters
    for key in given:
        if key not in known:
            raise unknown_name("parameter", str(key), known, f"{place} ({name})")
    numbers = {key: _number(given.get(key), spec, f"{place} ({name}): {key}") for key, spec in known.items()}
    return PatchEffect(name, (joint,), numbers, place=place)


def _mapping(entry: Mapping[str, Any], key: str, place: str) -> dict[str, Any]:
    """Return a copy of a mapping that an entry may leave out."""
    value = entry.get(key) or {}
    if not isinstance(value, Mapping):
        raise InputError(f"{place}: {key} = {value!r}: expected a mapping")
    return dict(value)


def _number(value: Any, spec: EffectParameter, place: str) -> float:
    number = finite_number(spec.neutral if value is None and spec.optional else value)
    if number is None or not spec.low <= number <= spec.high:
        raise InputError(f"{place} = {value!r}: expected a number in {range_in_words(spec.low, spec.high, spec.unit)}")
    return number
