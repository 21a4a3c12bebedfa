"""The library against the fixed vocabulary, and every effect's own numbers against each other."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

from wlr_gym.base.errors import InputError
from wlr_gym.physics.effects import EFFECTS, STAGES, UNKNOWN_EFFECT, Effect, EffectParameter, apply_patch, load_patch
from wlr_gym.physics.effects.effect import add, multiply, put
from wlr_gym.physics.effects.library import places
from wlr_gym.robot import JOINTS, load_robot
from wlr_gym.robot.parameters import Parameters

ROBOT = load_robot()
NOMINAL = Parameters.nominal(ROBOT)
VOCABULARY = Path(__file__).parents[4] / "shared" / "effects.md"
#: Effects that the vocabulary does not have.
LATER = ("flow_misalignment",)
EACH = pytest.mark.parametrize("effect", EFFECTS.values(), ids=list(EFFECTS))


def patched(effect: Effect, where: tuple[str, ...], values: dict[str, float]) -> Parameters:
    return apply_patch(
        load_patch({"name": effect.name, "where": list(where), "parameters": values}), Parameters.nominal(ROBOT, 2)
    )


def changed(effect: Effect, where: tuple[str, ...], values: dict[str, float]) -> set[int]:
    differs = (patched(effect, where, values).values != Parameters.nominal(ROBOT, 2).values).any(axis=0)
    return set(np.flatnonzero(differs).tolist())


def severe(effect: Effect) -> dict[str, float]:
    return {name: parameter.severity for name, parameter in effect.parameters.items()}


@pytest.mark.skipif(not VOCABULARY.is_file(), reason="the project's vocabulary is not beside the repository")
def test_the_library_is_the_vocabulary():
    text = VOCABULARY.read_text(encoding="utf-8")
    rows = [line.strip("|").split("|") for line in text.split("# Conventions")[0].splitlines() if line.startswith("| `")]
    units = {"\u2013": "-", "N·m": "N m", "N·m·s/rad": "N m s/rad", "Ω": "ohm"}
    wanted = {}
    for name, _, parameters, where in rows:
        names, found = [], {}
        listed = parameters.replace("(and `y_min` `y_max` where bounded)", ", `y_min` `y_max` m")
        for quoted, after in re.findall(r"`(\w+)`([^`]*)", listed):
            names.append(quoted)
            unit = re.sub(r"mu_y/mu_x|\(.*\)|,", "", after).strip()
            if unit:
                found |= dict.fromkeys(names, units.get(unit, unit))
                names = []
        assert not names, f"no unit for {names} of {name}"
        wanted[name.strip(" `")] = (found, where.strip())
    named = {
        name: ({p: spec.unit for p, spec in e.parameters.items()}, places(e))
        for name, e in EFFECTS.items()
        if name not in LATER
    }
    assert len(wanted) == 27
    assert {name: row[0] for name, row in named.items()} == {name: row[0] for name, row in wanted.items()}
    assert {name: row[1] for name, row in named.items()} == {name: row[1] for name, row in wanted.items()}
    assert f"`{UNKNOWN_EFFECT}`" in text


@EACH
def test_neutral_values_change_nothing(effect):
    neutral = {name: parameter.neutral_in(NOMINAL) for name, parameter in effect.parameters.items()}
    assert changed(effect, effect.where, neutral) == set()


@EACH
def test_what_may_be_left_out_is_then_neutral(effect):
    values = {name: value for name, value in severe(effect).items() if not effect.parameters[name].optional}
    optional = {name: effect.parameters[name].neutral_in(NOMINAL) for name in effect.parameters if name not in values}
    short, full = (patched(effect, effect.where, given) for given in (values, values | optional))
    np.testing.assert_array_equal(short.values, full.values)


@EACH
def test_a_severe_case_changes_something_at_each_place_alone(effect):
    each = [changed(effect, (place,), severe(effect)) for place in effect.where]
    assert all(each)
    assert sum(map(len, each)) == len(set().union(*each))
    assert changed(effect, effect.where, severe(effect)) == set().union(*each)


@EACH
def test_numbers_of_an_effect_fit_together(effect):
    assert effect.stage in STAGES
    for name, parameter in effect.parameters.items():
        low, high = parameter.prior
        assert parameter.low <= low < high <= parameter.high, name
        assert parameter.low <= parameter.neutral_in(NOMINAL) <= parameter.high, name
        assert parameter.low <= parameter.severity <= parameter.high, name
        assert low <= parameter.severity <= high or effect.name == "friction_patch", name
        assert re.search(rf"\b{name}\b", effect.equation) or name in "xyz" or name in {"angle", "roll", "pitch", "yaw"}, name


@EACH
@pytest.mark.parametrize("end", [0, 1])
def test_the_whole_plausible_range_can_be_applied(effect, end):
    for name, parameter in effect.parameters.items():
        values = severe(effect) | {name: parameter.prior[end]}
        if effect.name == "slip_weakening":
            values["mu_k"] = min(values["mu_k"], ROBOT.ground.mu_x)
        if effect.name == "friction_patch":
            values["x_min"] = min(values["x_min"], values["x_max"])
            values["y_min"] = min(values["y_min"], values["y_max"])
        patched(effect, effect.where, values)


@EACH
def test_values_outside_the_bounds_are_refused(effect):
    for name, parameter in effect.parameters.items():
        for outside in (parameter.low - 1e-3 * (1 + abs(parameter.low)), parameter.high * 1.001):
            with pytest.raises(InputError, match=rf"{effect.name}.*{name} = .* is outside"):
                patched(effect, effect.where, severe(effect) | {name: outside})


def test_mistakes_in_an_effect_of_ones_own_are_named():
    parameters = {"scale": EffectParameter("-", "cold over hot", 0.2, 1.0, 1.0, (0.6, 1.0), 0.7)}

    def own(**more):
        return Effect("hot", "hot motor", "", JOINTS, parameters, multiply("servo.stall_torque", "scal"), **more)

    with pytest.raises(InputError, match=re.escape("effect 'hot': unknown stage 'scal' (did you mean 'scale'?)")):
        own(stage="scal")
    with pytest.raises(InputError, match=re.escape("EFFECTS['k']: the effect calls itself 'hot'; expected the same name")):
        EFFECTS["k"] = own()
    for apply in (add, multiply, put):
        with pytest.raises(InputError, match=re.escape("unknown parameter of the effect 'scal' (did you mean 'scale'?)")):
            apply("servo.stall_torque", "scal")(Parameters.nominal(ROBOT, 1), ["leg_lf"], {"scale": 0.5})
