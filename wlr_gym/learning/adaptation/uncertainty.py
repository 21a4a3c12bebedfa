"""What a gap result states, as what a policy is trained with and tested over: a patch, and randomisation."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from wlr_gym.base.files import write_json
from wlr_gym.base.provenance import write_yaml
from wlr_gym.envs.tasks.randomization import load_randomization
from wlr_gym.gap.report.result import NOTHING, EffectEntry, Explanation, Result, explanations
from wlr_gym.gap.report.text import listed, plain
from wlr_gym.physics.effects import EFFECTS, UNKNOWN_EFFECT, Patch, PatchEffect, save_patch
from wlr_gym.robot import Robot

#: Least probability of an explanation that the adapted policy has to be good for, too.
LEAST_PROBABILITY = 0.05
#: Randomisation of one robot on its own floor, over which the result is laid: no patches, no other floors.
OWN_FLOOR = "nominal"
#: Family in which the adapted policy must be better.
STATED = "as stated"
#: Share of the intervals that is trained in: over all of it, policies suit every robot and none well. The test covers all.
TRAINED_SHARE = 0.5


@dataclass(frozen=True)
class Family:
    """Robots that a policy is tested on.

    Attributes:
        name: in tables.
        randomization: complete. effects: formulas, which have no place in the parameter table.
    """

    name: str
    randomization: Mapping[str, Any]
    effects: Sequence[Mapping[str, Any]] = ()


@dataclass(frozen=True)
class Uncertainty:
    """What a result states.

    Attributes:
        patch: effects that were found, formulas included.
        training: what is trained with: the result, its intervals narrowed, over the task's own randomisation.
        families: what is tested over: ``as stated`` first.
        said: what was taken of the result, and what was not.
    """

    patch: Patch
    training: Family
    families: tuple[Family, ...]
    said: tuple[str, ...]


def uncertainty_of(result: Result, found: Patch, base: str | Mapping[str, Any], robot: Robot, folder: Path) -> Uncertainty:
    """Return what a result states; ``patch.yaml``, ``randomization.yaml`` and the families go into ``folder``.

    Args:
        result: with numbers: not of the verdicts ``bad_data`` and ``not_excited``. found: its patch.
        base: the task's own randomisation: name, path or content.
        robot: whose numbers they are.
        folder: must be there.
    """
    refuted = makes_worse(result)
    found = Patch() if refuted else found
    named = [] if refuted else [one for one in result.effects if one.name in EFFECTS]
    effects = [dict(one.content()) for one in found.effects if one.name == UNKNOWN_EFFECT]
    make = partial(_family, result.model_dump(mode="json"), robot, folder)
    if not isinstance(base, str):  # a result lies over files
        write_yaml(folder / "base.yaml", dict(base))
        base = str((folder / "base.yaml").resolve())
    training = make("training", base, named, effects, TRAINED_SHARE)
    families = [make(STATED, OWN_FLOOR, named, effects)]
    for end, name in enumerate(("lower ends", "upper ends")):
        if named and any(one.ci95 for entry in named for one in entry.parameters.values()):
            families.append(make(name, OWN_FLOOR, [_at_end(one, end) for one in named], effects))
    floors = make("other floors", base, named, effects)
    families.append(floors)
    for one in _others(result, named):
        title = "nothing missing" if one.name == NOTHING else f"or {plain(one.name)}"
        families.append(make(title, OWN_FLOOR, [_entry(effect) for effect in one.effects]))
    save_patch(found, folder / "patch.yaml")
    write_yaml(folder / "randomization.yaml", dict(floors.randomization))
    return Uncertainty(found, training, tuple(families), _said(result, named, effects))


def _others(result: Result, named: Sequence[EffectEntry]) -> list[Explanation]:
    """Return the explanations in play besides what is taken of the result, without formulas."""
    taken = {(one.name, tuple(one.where)) for one in named}
    found = [one for one in explanations(result) if one.probability >= LEAST_PROBABILITY]
    found = [one for one in found if all(effect.name in EFFECTS for effect in one.effects)]
    return [one for one in found if {(effect.name, tuple(effect.where)) for effect in one.effects} != taken]


def makes_worse(result: Result) -> bool:
    """Whether what was found makes the error of the held-out runs larger: then it is not taken."""
    gap = result.gap
    return gap is not None and gap.reduction_signed is not None and gap.reduction_signed < 0.0


def _family(
    content: Mapping[str, Any],
    robot: Robot,
    folder: Path,
    name: str,
    base: str,
    entries: Sequence[EffectEntry],
    formulas: Sequence[Mapping[str, Any]] = (),
    share: float = 1.0,
) -> Family:
    """Robots as a result says, with these or those effects of the library, and formulas; ``share``: of every interval."""
    effects = [one.model_dump(mode="json") for one in entries]
    for one in effects:
        one["parameters"] = {key: _narrowed(number, "value", share) for key, number in one["parameters"].items()}
    calibration = {key: _narrowed(number, "fitted", share) for key, number in content["calibration"].items()}
    verdict = "effect_found" if effects else "nothing_missing"
    path = folder / f"{name.replace(' ', '_')}.json"
    write_json(path, {**content, "verdict": verdict, "effects": effects, "calibration": calibration})
    source = {"name": name, "base": base, "result": str(path.resolve())}
    return Family(name, load_randomization(source, robot).config.model_dump(mode="json", exclude_none=True), formulas)


def _narrowed(number: Mapping[str, Any], key: str, share: float) -> dict[str, Any]:
    """An estimate, its value under ``key``, with a share of its interval."""
    interval = number.get("ci95")
    ends = None if interval is None else [number[key] + share * (end - number[key]) for end in interval]
    return {**number, "ci95": ends}


def _at_end(entry: EffectEntry, end: int) -> EffectEntry:
    """The effect with every number at an end of its interval, within what it may be."""

    def moved(name: str, one: Any) -> Any:
        if one.ci95 is None:
            return one
        bounds = EFFECTS[entry.name].parameters[name]
        value = min(max(one.ci95[end], bounds.low), bounds.high)
        return one.model_copy(update={"value": value, "ci95": None})

    return entry.model_copy(update={"parameters": {name: moved(name, one) for name, one in entry.parameters.items()}})


def _entry(effect: PatchEffect) -> EffectEntry:
    parameters = {name: {"value": value, "ci95": None, "unit": ""} for name, value in effect.parameters.items()}
    return EffectEntry.model_validate(
        {"name": effect.name, "where": list(effect.where), "parameters": parameters, "confidence": 1.0}
    )


def _said(result: Result, named: Sequence[EffectEntry], formulas: Sequence[Any]) -> tuple[str, ...]:
    lines = []
    if result.effects and makes_worse(result):
        lines.append("What was named makes the error of the held-out runs larger: it is not taken.")
    if named:
        lines.append(f"Effects of the result: {listed([plain(one.name) for one in named])}, each within its interval.")
    if formulas:
        lines.append("A formula of the result acts as it is, without an interval.")
    if not (named or formulas):
        lines.append("No effect is taken: only what calibration knows.")
    elif len(explanations(result)) > 1:
        lines.append("The runs do not decide between names; the others are families of the acceptance test.")
    return (*lines, f"{len(result.calibration)} calibrated numbers, each within its interval.")
