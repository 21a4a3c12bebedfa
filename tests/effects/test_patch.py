"""Effects and patch files: what each effect does to the parameter table, and what a bad patch is told."""

from __future__ import annotations

import numpy as np
import pytest

from wlr_gym.effects import EFFECTS, Patch, apply_patch, load_patch, save_patch
from wlr_gym.effects.registry import BEYOND_PARAMETERS
from wlr_gym.errors import InputError
from wlr_gym.parameters import Parameters
from wlr_gym.robot import load_robot

ROBOT = load_robot()


def patched(*effects: dict, count: int = 2) -> Parameters:
    return apply_patch(load_patch(list(effects)), Parameters.nominal(ROBOT, count))


def changes(parameters: Parameters) -> dict[str, float]:
    """Elements that differ from nominal, with their values; every robot of the batch must agree."""
    from wlr_gym.parameters import ELEMENTS

    nominal = Parameters.nominal(ROBOT, len(parameters)).values
    assert (parameters.values == parameters.values[0]).all()
    return {name: parameters.values[0, k] for k, name in enumerate(ELEMENTS) if parameters.values[0, k] != nominal[0, k]}


CHANGES = [
    (("coulomb_friction", ["leg_rf"], {"torque": 0.35}), {"servo.coulomb_friction[leg_rf]": 0.45}),
    (("viscous_friction", ["wheel_lr"], {"coefficient": 0.02}), {"servo.viscous_friction[wheel_lr]": 0.02}),
    (
        ("command_delay", ["wheel_lf", "leg_lr"], {"delay": 0.025}),
        {"command.delay[wheel_lf]": 0.025, "command.delay[leg_lr]": 0.025},
    ),
    (("joint_zero_offset", ["leg_rr"], {"angle": -0.03}), {"joint.zero_offset[leg_rr]": -0.03}),
    (
        ("friction_level", ["ground"], {"mu": 0.3}),
        {f"ground.mu_{axis}[wheel_{corner}]": 0.3 for corner in ("lf", "rf", "lr", "rr") for axis in "xy"},
    ),
    (("friction_asymmetry", ["wheel_lf"], {"mu": 0.3}), {"ground.mu_x[wheel_lf]": 0.3, "ground.mu_y[wheel_lf]": 0.3}),
    (
        ("friction_anisotropy", ["ground"], {"ratio": 0.5}),
        {f"ground.mu_y[wheel_{corner}]": 0.3 for corner in ("lf", "rf", "lr", "rr")},
    ),
    (("rolling_resistance", ["wheel_lf"], {"coefficient": 0.1}), {"ground.rolling_resistance[wheel_lf]": 0.1}),
    (("wheel_radius_error", ["wheel_lr"], {"scale": 1.025}), {"wheel.radius[wheel_lr]": 0.034 * 1.025}),
    (
        ("payload", ["body"], {"mass": 0.5, "x": 0.08, "z": 0.05}),
        {"payload.mass": 0.5, "payload.position[x]": 0.08, "payload.position[z]": 0.05},
    ),
    (("com_offset", ["body"], {"y": 0.02}), {"body.com_offset[y]": 0.02}),
    (("floor_slope", ["ground"], {"pitch": 0.1, "roll": -0.05}), {"ground.slope[pitch]": 0.1, "ground.slope[roll]": -0.05}),
    (("external_force", ["body"], {"fx": -2.0}), {"external_force[x]": -2.0}),
    (("gyro_bias", ["sensor"], {"z": 0.05}), {"imu.gyro_bias[z]": 0.05}),
    (("camera_delay", ["sensor"], {"delay": 0.04}), {"camera.delay": 0.04}),
    (("camera_misalignment", ["sensor"], {"yaw": 0.03}), {"camera.mount_yaw": 0.03}),
]


@pytest.mark.parametrize(("effect", "expected"), CHANGES)
def test_each_effect_changes_exactly_its_parameters(effect, expected):
    name, where, parameters = effect
    assert changes(patched({"name": name, "where": where, "parameters": parameters})) == pytest.approx(expected)


def test_every_available_effect_is_tested_above():
    assert {effect[0] for effect, _ in CHANGES} == set(EFFECTS)
    assert not set(EFFECTS) & set(BEYOND_PARAMETERS)


def test_effects_compose_in_order_and_leave_the_input_alone():
    nominal = Parameters.nominal(ROBOT, 3)
    before = nominal.values.copy()
    friction = {"name": "coulomb_friction", "where": ["leg_lf"], "parameters": {"torque": 0.1}}
    level = {"name": "friction_level", "parameters": {"mu": 0.8}}
    ratio = {"name": "friction_anisotropy", "parameters": {"ratio": 0.5}}
    result = apply_patch(load_patch([friction, friction, level, ratio]), nominal)
    np.testing.assert_array_equal(nominal.values, before)
    np.testing.assert_allclose(result["servo.coulomb_friction[leg_lf]"], 0.3)
    np.testing.assert_allclose(result["ground.mu_y"], 0.4)


def test_effects_act_on_top_of_a_randomised_robot():
    parameters = Parameters.nominal(ROBOT, 2)
    parameters["wheel.radius[wheel_lf]"] = [0.03, 0.04]
    patch = load_patch([{"name": "wheel_radius_error", "where": "wheel_lf", "parameters": {"scale": 1.1}}])
    np.testing.assert_allclose(apply_patch(patch, parameters)["wheel.radius[wheel_lf]"], [0.033, 0.044])


def test_no_patch_changes_nothing():
    assert not load_patch(None)
    assert changes(apply_patch(load_patch(None), Parameters.nominal(ROBOT, 1))) == {}


def test_saved_patch_reads_back_the_same(tmp_path):
    patch = load_patch(
        [
            {"name": "payload", "parameters": {"mass": 1 / 3, "x": 0.1}},
            {"name": "friction_asymmetry", "where": ["wheel_rr"], "parameters": {"mu": 0.2}},
        ]
    )
    patch = Patch(patch.effects, {"made_by": "hand", "data": ["run_01"]})
    again = load_patch(save_patch(patch, tmp_path / "new" / "patch.yaml"))
    assert again.effects == patch.effects
    assert again.provenance == patch.provenance
    assert again.source.endswith("patch.yaml")


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("effects: [", ["broken YAML", "line 1"]),
        ("just text", ["expected a mapping"]),
        ("effect: []", ["unknown key 'effect'", "did you mean 'effects'"]),
        ("effects: {name: payload}", ["must be a list"]),
        ("effects: [payload]", ["effect 1", "mapping with 'name'"]),
        ("effects: [{name: rolling_resistence, where: [wheel_lf]}]", ["did you mean 'rolling_resistance'"]),
        ("effects: [{name: backlash, where: [leg_lf], parameters: {angle: 0.03}}]", ["backlash", "available", "payload"]),
        ("effects: [{name: payload, wher: [body]}]", ["effect 1 (payload)", "unknown key 'wher'", "did you mean 'where'"]),
        ("effects: [{name: coulomb_friction, where: [leg_fl], parameters: {torque: 1}}]", ["'leg_fl'", "did you mean 'leg_"]),
        ("effects: [{name: coulomb_friction, parameters: {torque: 1}}]", ["where", "leg_lf"]),
        ("effects: [{name: joint_zero_offset, where: [wheel_lf], parameters: {angle: 0}}]", ["'wheel_lf'"]),
        ("effects: [{name: friction_level, parameters: {mux: 1}}]", ["unknown key 'mux'", "did you mean 'mu'"]),
        ("effects: [{name: friction_level}]", ["parameter 'mu' (-) is missing"]),
        ("effects: [{name: friction_level, parameters: {mu: high}}]", ["mu = 'high'", "finite number"]),
        ("effects: [{name: friction_level, parameters: {mu: .nan}}]", ["mu = nan"]),
        ("effects: [{name: friction_level, parameters: {mu: -0.1}}]", ["mu = -0.1", "[0, 5]"]),
        ("effects: [{name: wheel_radius_error, where: [wheel_lf, wheel_lf], parameters: {scale: 1}}]", ["occurs twice"]),
    ],
)
def test_bad_patch_files_are_refused(tmp_path, text, words):
    path = tmp_path / "patch.yaml"
    path.write_text(text)
    with pytest.raises(InputError) as error:
        load_patch(path)
    for word in ("patch.yaml", *words):
        assert word in str(error.value)


@pytest.mark.parametrize(
    ("effects", "words"),
    [
        ([("payload", {"mass": 1}), ("payload", {"mass": 1})], ["effect 2 (payload)", "one payload"]),
        ([("camera_misalignment", {"scale": 1.1})], ["effect 1 (camera_misalignment)", "scale = 1.1"]),
        (
            [("com_offset", {"x": 0.15}), ("com_offset", {"x": 0.15})],
            ["effect 2 (com_offset)", "body.com_offset[x]", "outside"],
        ),
    ],
)
def test_effects_the_parameters_cannot_take_are_refused(effects, words):
    with pytest.raises(InputError) as error:
        patched(*({"name": name, "parameters": parameters} for name, parameters in effects))
    for word in words:
        assert word in str(error.value)


def test_missing_patch_file():
    with pytest.raises(InputError, match=r"nowhere\.yaml"):
        load_patch("nowhere.yaml")


def test_the_order_in_the_patch_does_not_matter(tmp_path):
    effects = [
        {"name": "friction_anisotropy", "parameters": {"ratio": 0.5}},
        {"name": "friction_asymmetry", "where": ["wheel_lf"], "parameters": {"mu": 0.2}},
        {"name": "friction_level", "parameters": {"mu": 0.8}},
    ]
    there, back = patched(*effects), patched(*reversed(effects))
    np.testing.assert_array_equal(there.values, back.values)
    np.testing.assert_allclose(there["ground.mu_y"][0], [0.1, 0.4, 0.4, 0.4])
    patch = load_patch(effects)
    assert load_patch(save_patch(patch, tmp_path / "patch.yaml")).effects == patch.effects
