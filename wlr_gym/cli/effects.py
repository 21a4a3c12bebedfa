"""List the effects that can be added to the nominal model, explain some, or check patch files.

Without names the whole library; with names of effects their laws and numbers (unknown_effect: where formulas may act, and
what they may depend on); with "check FILE ..." patches are read and applied to the robot, and what they change is printed.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import tyro
from rich.console import Console

from wlr_gym.base.errors import InputError, check_name, nearest
from wlr_gym.base.paths import config_names
from wlr_gym.cli import OK
from wlr_gym.cli.options import JsonOption
from wlr_gym.cli.terminal import print_json, print_table
from wlr_gym.physics.effects import EFFECTS, UNKNOWN_EFFECT, Effect, Patch, PatchEffect, apply_patch, load_patch
from wlr_gym.physics.effects.library import coordinates, places
from wlr_gym.physics.plants.forces import FEATURES
from wlr_gym.robot import load_robot
from wlr_gym.robot.parameter_table import ELEMENTS, spec_of
from wlr_gym.robot.parameters import Parameters


@dataclass(frozen=True)
class EffectsOptions(JsonOption):
    names: tyro.conf.Positional[tuple[str, ...]] = ()
    """Effects to explain; or check FILE ...: patch files (.yaml), or names in configs/effects/, to read and apply."""
    robot: str = "nominal"
    """Robot that check applies the patches to: robot file, or name in configs/robot/."""


def run(options: EffectsOptions) -> int:
    """Print the library, one effect, or what patch files change."""
    match options.names:
        case () if options.json:
            print_json([_content(effect) for effect in EFFECTS.values()])
        case ():
            rows = [(one.name, places(one), f"{one.doc}\n  {one.equation}") for one in EFFECTS.values()]
            print_table(_console(), ("name", "where", "what is missing, and its law"), rows)
            print("one of them, with its numbers: wlr effects NAME; beyond the library: wlr effects unknown_effect")
        case ("check",):
            raise InputError("give the patch files to check: wlr effects check FILE ...")
        case ("check", *files):
            _check([load_patch(file) for file in files], load_patch(list(files)), options)
        case (word, *_) if word not in EFFECTS and (hint := nearest(word, ["check"])):
            raise InputError(f"unknown word '{word}'{hint}; see: wlr effects --help")
        case names if options.json:
            print_json([_formulas() if name == UNKNOWN_EFFECT else _content(_effect(name)) for name in names])
        case names:
            for name in names:
                _explain_formulas() if name == UNKNOWN_EFFECT else _explain(_effect(name))
    return OK


def _console() -> Console:
    return Console(highlight=False)


def _effect(name: str) -> Effect:
    if name not in EFFECTS and (name.endswith((".yaml", ".yml")) or name in config_names("effects")):
        raise InputError(f"'{name}' is a patch, not an effect: wlr effects check {name}")
    check_name("effect", name, [*EFFECTS, UNKNOWN_EFFECT])
    return EFFECTS[name]


def _content(effect: Effect) -> dict[str, Any]:
    """Return an effect as JSON has it."""
    fields = ("unit", "doc", "low", "high", "prior", "neutral", "severity", "optional")
    parameters = {name: {field: getattr(p, field) for field in fields} for name, p in effect.parameters.items()}
    law = {"name": effect.name, "what": effect.doc, "equation": effect.equation}
    return law | {"where": effect.where, "parameters": parameters}


def _explain(effect: Effect) -> None:
    rows = []
    for name, p in effect.parameters.items():
        bounds = (f"[{low:.3g}, {high:.3g}]" for low, high in ((p.low, p.high), p.prior))
        neutral = f"the robot's {p.neutral}" if isinstance(p.neutral, str) else f"{p.neutral:g}"
        rows.append((f"{name} (optional)" if p.optional else name, p.unit, p.doc, *bounds, neutral, f"{p.severity:g}"))
    print(f"{effect.name}: {effect.doc}\n  {effect.equation}\n  where: {', '.join(effect.where)}\n")
    print_table(_console(), ("parameter", "unit", "meaning", "bounds", "plausible range", "neutral", "typical"), rows)


def _explain_formulas() -> None:
    acts = [(", ".join(names), unit, text) for names, unit, text in coordinates()]
    print_table(_console(), ("where", "unit", "meaning"), acts, "where a formula may act")
    features = [(name, one.unit, one.doc, one.scope) for name, one in FEATURES.items()]
    print_table(_console(), ("name", "unit", "meaning", "of the"), features, "what it may depend on")


def _formulas() -> dict[str, Any]:
    """Return what :func:`_explain_formulas` prints, as JSON has it."""
    acts = [{"names": names, "unit": unit, "what": text} for names, unit, text in coordinates()]
    features = [{"name": name, "unit": one.unit, "what": one.doc, "of": one.scope} for name, one in FEATURES.items()]
    return {"name": UNKNOWN_EFFECT, "may_act": acts, "may_depend_on": features}


def _check(patches: Sequence[Patch], together: Patch, options: EffectsOptions) -> None:
    robot = load_robot(options.robot)
    nominal = Parameters.nominal(robot)
    patched = apply_patch(together, nominal)
    changed = {
        name: {"nominal": before, "patched": after, "unit": spec_of(name).unit}
        for name, before, after in zip(ELEMENTS, nominal.values[0], patched.values[0], strict=True)
        if before != after
    }
    if options.json:
        print_json({"robot": robot.name, "effects": together.content()["effects"], "changes": changed})
        return
    rows = [(one.name, ", ".join(one.where), _numbers(one), patch.source) for patch in patches for one in patch.effects]
    print_table(_console(), ("effect", "where", "parameters", "from"), rows)
    changes = [(name, f"{one['nominal']:.6g}", f"{one['patched']:.6g}", one["unit"]) for name, one in changed.items()]
    if changes:
        title = f"what changes in robot '{robot.name}'"
        print_table(_console(), ("parameter", "nominal", "patched", "unit"), changes, title)
    else:
        print("no parameter changes")


def _numbers(effect: PatchEffect) -> str:
    units = effect.units or {name: EFFECTS[effect.name].parameters[name].unit for name in effect.parameters}
    numbers = ", ".join(f"{name} = {value:g} {units[name]}" for name, value in effect.parameters.items())
    return f"{effect.formula}; {numbers}" if effect.formula else numbers
