"""The library of effects and unknown effects: what they are, what they do to the parameters, what the docs show of them."""

from __future__ import annotations

import math
import re
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st

import wlr_gym  # noqa: F401  (registers the environments)
from wlr_gym.base.errors import InputError
from wlr_gym.physics.codegen.expression import UNITS
from wlr_gym.physics.effects import (
    EFFECTS,
    STAGES,
    UNKNOWN_EFFECT,
    Effect,
    EffectParameter,
    PatchEffect,
    apply_patch,
    load_patch,
    save_patch,
)
from wlr_gym.physics.effects.effect import add, multiply, put
from wlr_gym.physics.effects.library import places
from wlr_gym.physics.plants import SIMULATORS, make_plant
from wlr_gym.physics.plants.base import PlantOptions
from wlr_gym.physics.plants.forces import make_force
from wlr_gym.robot import JOINTS, load_robot
from wlr_gym.robot.parameters import Parameters

ROBOT = load_robot()
NOMINAL = Parameters.nominal(ROBOT)
VOCABULARY = Path(__file__).parents[4] / "shared" / "effects.md"
#: Effects that the vocabulary does not have.
LATER = ("flow_misalignment", "tyre_brush")
EACH = pytest.mark.parametrize("effect", EFFECTS.values(), ids=list(EFFECTS))


def with_effect(effect: Effect, where: tuple[str, ...], values: dict[str, float]) -> Parameters:
    return apply_patch(
        load_patch({"name": effect.name, "where": list(where), "parameters": values}), Parameters.nominal(ROBOT, 2)
    )


def changed(effect: Effect, where: tuple[str, ...], values: dict[str, float]) -> set[int]:
    differs = (with_effect(effect, where, values).values != Parameters.nominal(ROBOT, 2).values).any(axis=0)
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
    short, full = (with_effect(effect, effect.where, given) for given in (values, values | optional))
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
        with_effect(effect, effect.where, values)


@EACH
def test_values_outside_the_bounds_are_refused(effect):
    for name, parameter in effect.parameters.items():
        for outside in (parameter.low - 1e-3 * (1 + abs(parameter.low)), parameter.high * 1.001):
            with pytest.raises(InputError, match=rf"{effect.name}.*{name} = .* is outside"):
                with_effect(effect, effect.where, severe(effect) | {name: outside})


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


# ---- unknown effects in patch files: read, refused, saved, and handed on as forces -----------------------------------


SPRING: dict[str, Any] = {
    "name": "unknown_effect",
    "where": ["leg_lr"],
    "formula": "-k * (leg_angle - a0)",
    "parameters": {"k": 0.8, "a0": 1.2},
    "units": {"k": "N m/rad", "a0": "rad"},
}


def test_a_formula_becomes_a_force_and_changes_no_parameter():
    patch = load_patch([SPRING, {"name": "payload", "parameters": {"mass": 0.5}}, SPRING | {"where": "leg_rr"}])
    spring = make_force(["leg_lr"], SPRING["formula"], SPRING["parameters"], SPRING["units"])
    assert patch.forces[0] == spring
    assert [force.where for force in patch.forces] == [("leg_lr",), ("leg_rr",)]
    nominal = Parameters.nominal(ROBOT)
    np.testing.assert_array_equal(apply_patch(load_patch(SPRING), nominal).values, nominal.values)
    assert apply_patch(patch, nominal)["payload.mass"] == 0.5
    assert load_patch([{"name": "payload", "parameters": {"mass": 0.5}}]).forces == ()


def test_a_formula_without_constants():
    patch = load_patch({"name": "unknown_effect", "where": "floor_force_x", "formula": "0 * floor_velocity_x"})
    assert patch.effects[0].parameters == {}
    assert len(patch.forces) == 1


def test_saved_formula_reads_back_the_same(tmp_path):
    patch = load_patch([SPRING])
    again = load_patch(save_patch(patch, tmp_path / "patch.yaml"))
    assert again.effects == patch.effects
    assert again.forces == patch.forces
    assert again.effects[0] == PatchEffect(
        "unknown_effect", ("leg_lr",), {"k": 0.8, "a0": 1.2}, SPRING["formula"], SPRING["units"]
    )


@settings(deadline=None)
@given(st.floats(allow_nan=False, allow_infinity=False), st.sampled_from(["k", "lam", "_c1", "Ä"]))
def test_any_constant_survives_saving(tmp_path_factory, value, name):
    entry = {
        "name": "unknown_effect", "where": ["body_torque_yaw"], "formula": f"-{name} * yaw_rate",
        "parameters": {name: value}, "units": {name: "N m s/rad"},
    }  # fmt: skip
    patch = load_patch(entry)
    again = load_patch(save_patch(patch, tmp_path_factory.mktemp("patch") / "patch.yaml"))
    assert again.forces == patch.forces
    assert math.copysign(1, again.effects[0].parameters[name]) == math.copysign(1, value)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"formula": None}, ["'formula' is None", "leg_angle - a0"]),
        ({"formula": 3}, ["'formula' is 3"]),
        ({"formula": "-k * (leg_angl - a0)"}, ["unknown name 'leg_angl'", "did you mean 'leg_angle'"]),
        ({"formula": "__import__('os').system('true')"}, ["not allowed"]),
        ({"formula": "-k * (leg_angle - a0) * normal_force"}, ["leg_lr takes N m"]),
        ({"where": None}, ["where = None", "body_force_x"]),
        ({"where": ["leg_lf", "leg_lf"]}, ["occurs twice"]),
        ({"where": ["body"]}, ["unknown where 'body'", "did you mean 'body_"]),
        ({"units": {"k": "N m/rad"}}, ["parameter 'a0': its unit is missing"]),
        ({"units": None}, ["unit is missing"]),
        ({"units": ["N m"]}, ["'units' must be a mapping"]),
        ({"units": {"k": 3, "a0": "rad"}}, ["unit 3: expected text"]),
        ({"parameters": {"k": 0.8}}, ["unknown parameter 'a0'"]),
        ({"parameters": {1: 0.8}}, ["'parameters' must be a mapping"]),
        ({"parameters": {"k": 0.8, "a0": math.inf}}, ["a0 = inf", "finite number"]),
        ({"strength": 1}, ["unknown key 'strength'"]),
    ],
)
def test_bad_formula_effects_are_refused_by_file_and_place(change, words):
    with pytest.raises(InputError) as error:
        load_patch([{"name": "payload", "parameters": {"mass": 1}}, SPRING | change])
    for word in ("effects: effect 2 (unknown_effect)", *words):
        assert word in str(error.value)


# ---- a formula that says the same as a named effect moves every simulator alike; and environments hand formulas on ---


def formula(where: str, text: str, units: dict[str, str], **values: float) -> dict:
    return {"name": "unknown_effect", "where": where, "formula": text, "parameters": values, "units": units}


TETHER = {"name": "tether", "parameters": {"stiffness": 8.0, "x": 0.5, "y": -0.4}}
TETHER_FORMULAS = [
    formula("floor_force_x", "-k * (position_x - x)", {"k": "N/m", "x": "m"}, k=8.0, x=0.5),
    formula("floor_force_y", "-k * (position_y - y)", {"k": "N/m", "y": "m"}, k=8.0, y=-0.4),
]


def end_of(backend: str, effects: list[dict]) -> tuple[np.ndarray, np.ndarray]:
    """Pose and joint angles after a second of driving a curve."""
    patch = load_patch(effects)
    plant = make_plant(backend, ROBOT, 1, PlantOptions(sensor_noise=False), patch.forces)
    try:
        plant.reset(parameters=apply_patch(patch, Parameters.nominal(ROBOT)))
        for _ in range(50):
            plant.step(np.array([[*[ROBOT.home.leg_angle] * 4, 1.0, 3.0, 1.0, 3.0]]))
        truth = plant.truth()
        return truth["position"][0].copy(), truth["joint_position"][0].copy()
    finally:
        plant.close()


@pytest.mark.slow
@pytest.mark.parametrize("backend", SIMULATORS)
def test_a_formula_for_a_named_effect_moves_the_robot_alike(backend):
    named, written, nominal = (end_of(backend, effects) for effects in ([TETHER], TETHER_FORMULAS, []))
    change = np.abs(named[0] - nominal[0]).max()
    assert change > 1e-4
    np.testing.assert_allclose(written[0], named[0], atol=1e-3 * change)
    np.testing.assert_allclose(written[1], named[1], atol=1e-3 * np.abs(named[1] - nominal[1]).max())


@pytest.mark.parametrize("backend", SIMULATORS)
def test_a_spring_moves_its_own_leg(backend):
    spring = formula("leg_lr", "-k * (leg_angle - a0)", {"k": "N m/rad", "a0": "rad"}, k=0.8, a0=0.5)
    moved = np.abs(end_of(backend, [spring])[1] - end_of(backend, [])[1])[:4]
    assert np.argmax(moved) == 2
    assert moved[2] > 3 * np.delete(moved, 2).max()
    # the servo holds the leg with the stiffness kp K/R, give or take gear friction in either run
    leg = ROBOT.servo.leg
    stiffness = leg.kp * leg.stall_torque / ROBOT.servo.supply_voltage
    torque = 0.8 * (ROBOT.home.leg_angle - 0.5)
    assert moved[2] == pytest.approx(torque / stiffness, abs=2 * leg.coulomb_friction / stiffness)


@pytest.mark.slow
def test_environments_give_formulas_to_their_plant():
    def yaw_rate(effects: list[dict] | None) -> float:
        env = gymnasium.make("WLR-Velocity-v0", effects=effects, randomization="none", episode_length=1.0)
        try:
            env.reset(seed=0, options={"command": {"linear_velocity_x": 0.0, "yaw_rate": 0.0}})
            for _ in range(20):
                env.step(np.zeros(8, np.float32))
            return float(env.unwrapped.core.plant.truth()["angular_velocity_in_body"][0, 2])  # type: ignore[attr-defined]
        finally:
            env.close()

    twist = formula("body_torque_yaw", "m", {"m": "N m"}, m=8.0)
    assert abs(yaw_rate(None)) < 1e-3
    assert yaw_rate([twist]) > 0.1


# ---- docs/effects.md says what the code does, and its examples work --------------------------------------------------


ROOT = Path(__file__).parents[3]
TEXT = (ROOT / "docs" / "effects.md").read_text(encoding="utf-8")


@pytest.mark.parametrize("number", range(len(re.findall("```yaml", TEXT))))
def test_yaml_examples_load(number):
    assert load_patch(yaml.safe_load(re.findall("```yaml\n(.*?)```", TEXT, re.S)[number])).effects


def test_ready_patches_and_units_are_all_named():
    text = " ".join(TEXT.split())
    assert f"`configs/effects/`: {', '.join(f'`{path.stem}`' for path in ready_patches())}." in text
    assert f"SI symbols without prefixes ({', '.join(UNITS)})" in text


def test_prose_names_only_effects_and_parameters_that_exist():
    prose = TEXT.split("## Conventions")[1].split("## Patch files")[0]
    known = {*EFFECTS, *(parameter for effect in EFFECTS.values() for parameter in effect.parameters), "cam_yaw", "mu"}
    assert [name for name in re.findall(r"`([a-z_]+)`", prose) if name not in known] == []


def ready_patches() -> list[Path]:
    return sorted((ROOT / "configs" / "effects").glob("*.yaml"))
