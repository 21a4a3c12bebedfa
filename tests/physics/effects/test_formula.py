"""Unknown effects in patch files: read, refused, saved, and handed on as forces."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from wlr_gym.base.errors import InputError
from wlr_gym.physics.effects import PatchEffect, apply_patch, load_patch, save_patch
from wlr_gym.physics.plants.forces import make_force
from wlr_gym.robot import load_robot
from wlr_gym.robot.parameters import Parameters

ROBOT = load_robot()
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
