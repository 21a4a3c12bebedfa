"""Effects and patch files: what each effect does to the parameter table, and what a bad patch is told."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from wlr_gym.base.errors import InputError
from wlr_gym.base.paths import data_directory
from wlr_gym.physics.effects import EFFECTS, Patch, apply_patch, compose, load_patch, save_patch
from wlr_gym.physics.model.dynamics import inertial_constants
from wlr_gym.robot import load_robot
from wlr_gym.robot.parameters import Parameters

ROBOT = load_robot()


def patched(*effects: dict, count: int = 2) -> Parameters:
    return apply_patch(load_patch(list(effects)), Parameters.nominal(ROBOT, count))


def changes(parameters: Parameters) -> dict[str, float]:
    """Elements that differ from nominal, with their values; every robot of the batch must agree."""
    from wlr_gym.robot.parameter_table import ELEMENTS

    nominal = Parameters.nominal(ROBOT, len(parameters)).values
    assert (parameters.values == parameters.values[0]).all()
    return {name: parameters.values[0, k] for k, name in enumerate(ELEMENTS) if parameters.values[0, k] != nominal[0, k]}


CHANGES = [
    (("coulomb_friction", ["leg_rf"], {"torque": 0.35}), {"servo.coulomb_friction[leg_rf]": 0.45}),
    (
        ("stribeck_friction", ["wheel_rf"], {"extra_static_torque": 0.02, "stribeck_speed": 0.3}),
        {"servo.stribeck_torque[wheel_rf]": 0.02, "servo.stribeck_speed[wheel_rf]": 0.3},
    ),
    (("load_dependent_friction", ["leg_lf"], {"ratio": 0.2}), {"servo.load_friction[leg_lf]": 0.2}),
    (
        ("backlash", ["leg_lr", "leg_rr"], {"angle": 0.035}),
        {"servo.backlash[leg_lr]": 0.035, "servo.backlash[leg_rr]": 0.035},
    ),
    (
        ("torque_ripple", ["leg_rr"], {"amplitude": 0.1, "order": 7, "phase": 0.5}),
        {"servo.ripple_amplitude[leg_rr]": 0.1, "servo.ripple_order[leg_rr]": 7, "servo.ripple_phase[leg_rr]": 0.5},
    ),
    (("weak_motor", ["wheel_lf"], {"scale": 0.8}), {"servo.torque_scale[wheel_lf]": 0.8}),
    (("supply_sag", ["body"], {"resistance": 0.3}), {"servo.supply_resistance": 0.3}),
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
    (
        ("friction_patch", ["ground"], {"mu": 0.1, "x_min": 1.0, "x_max": 2.0}),
        {
            "patch.mu[patch_1]": 0.1,
            "patch.x_min[patch_1]": 1.0,
            "patch.x_max[patch_1]": 2.0,
            "patch.y_min[patch_1]": -1e3,
            "patch.y_max[patch_1]": 1e3,
        },
    ),
    (
        ("slip_weakening", ["ground"], {"mu_k": 0.45, "slip_speed": 0.2}),
        {f"ground.kinetic_ratio[wheel_{corner}]": 0.75 for corner in ("lf", "rf", "lr", "rr")}
        | {f"ground.weakening_speed[wheel_{corner}]": 0.2 for corner in ("lf", "rf", "lr", "rr")},
    ),
    (("tyre_creep", ["wheel_rr"], {"creep_speed": 0.05}), {"ground.creep_speed[wheel_rr]": 0.05}),
    (
        ("tyre_brush", ["wheel_rr"], {"slip_compliance": 0.05, "relaxation_length": 0.01}),
        {"ground.slip_compliance[wheel_rr]": 0.05, "ground.relaxation_length[wheel_rr]": 0.01},
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
    (
        ("tether", ["body"], {"stiffness": 4.0, "x": 0.5, "y": -1.0}),
        {"tether.stiffness": 4.0, "tether.anchor[x]": 0.5, "tether.anchor[y]": -1.0},
    ),
    (("imu_misalignment", ["sensor"], {"roll": 0.1, "yaw": -0.2}), {"imu.mount[roll]": 0.1, "imu.mount[yaw]": -0.2}),
    (("gyro_bias", ["sensor"], {"z": 0.05}), {"imu.gyro_bias[z]": 0.05}),
    (("camera_delay", ["sensor"], {"delay": 0.04}), {"camera.delay": 0.04}),
    (("camera_misalignment", ["sensor"], {"yaw": 0.03, "scale": 1.05}), {"camera.mount_yaw": 0.03, "camera.scale": 1.05}),
    (("flow_misalignment", ["sensor"], {"yaw": 0.03, "scale": 1.05}), {"flow.mount_yaw": 0.03, "flow.scale": 1.05}),
]


def test_a_tread_keeps_what_the_robot_file_says_of_it():
    soft = load_robot({"base": "nominal", "name": "soft", "ground": {"slip_compliance": 0.1, "relaxation_length": 0.015}})
    patch = load_patch([{"name": "tyre_brush", "where": ["wheel_lf"], "parameters": {"slip_compliance": 0.1}}])
    nominal = Parameters.nominal(soft, 2)
    np.testing.assert_array_equal(apply_patch(patch, nominal).values, nominal.values)


@pytest.mark.parametrize(("effect", "expected"), CHANGES)
def test_each_effect_changes_exactly_its_parameters(effect, expected):
    name, where, parameters = effect
    assert changes(patched({"name": name, "where": where, "parameters": parameters})) == pytest.approx(expected)


def test_every_available_effect_is_tested_above():
    assert {effect[0] for effect, _ in CHANGES} == set(EFFECTS)


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
        (
            "effects: [{name: backlash, where: [body], parameters: {angle: 0.03}}]",
            ["effect 1 (backlash)", "where 'body'", "leg_lf"],
        ),
        ("effects: [{name: payload, formula: '1', parameters: {mass: 1}}]", ["unknown key 'formula'"]),
        ("effects: [{name: payload, parameters: {mass: 1%s}}]" % ("0" * 400), ["mass = 1000", "finite number"]),
        ("effects: [{name: payload, parameters: {mass: true}}]", ["mass = True"]),
        ("effects: [{name: payload, parameters: [1]}]", ["'parameters' must be a mapping of mass, x, y, z"]),
        ("effects: []\nprovenance: hand", ["'provenance' must be a mapping"]),
        ("effects: [{name: payload, wher: [body]}]", ["effect 1 (payload)", "unknown key 'wher'", "did you mean 'where'"]),
        ("effects: [{name: coulomb_friction, where: [leg_fl], parameters: {torque: 1}}]", ["'leg_fl'", "did you mean 'leg_"]),
        ("effects: [{name: coulomb_friction, parameters: {torque: 1}}]", ["where", "leg_lf"]),
        ("effects: [{name: joint_zero_offset, where: [wheel_lf], parameters: {angle: 0}}]", ["'wheel_lf'"]),
        ("effects: [{name: friction_level, parameters: {mux: 1}}]", ["unknown key 'mux'", "did you mean 'mu'"]),
        ("effects: [{name: friction_level}]", ["parameter 'mu' (a pure number) is missing"]),
        (
            "effects: [{name: friction_level, parameters: {mu: high}}]",
            ["mu = 'high'", "expected a finite number (a pure number)"],
        ),
        ("effects: [{name: friction_level, parameters: {mu: .nan}}]", ["mu = nan"]),
        ("effects: [{name: friction_level, parameters: {mu: -0.1}}]", ["mu = -0.1", "[0, 5] (a pure number)"]),
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


ICE = {"mu": 0.1, "x_min": 1.0, "x_max": 2.0}
RIPPLE = {"amplitude": 0.1, "order": 7.0}
STICK = {"extra_static_torque": 0.1, "stribeck_speed": 0.2}


@pytest.mark.parametrize(
    ("effects", "words"),
    [
        ([("friction_patch", ICE)] * 5, ["effect 5 (friction_patch)", "holds 4 patches"]),
        ([("friction_patch", ICE | {"x_min": 3})], ["x_min = 3 m is above x_max = 2 m"]),
        ([("friction_patch", ICE | {"y_min": 1, "y_max": -1})], ["y_min = 1 m is above y_max = -1 m"]),
        (
            [("torque_ripple", RIPPLE), ("torque_ripple", RIPPLE | {"order": 3})],
            ["leg_lf has a ripple of another order already"],
        ),
        ([("stribeck_friction", STICK), ("stribeck_friction", STICK | {"stribeck_speed": 1})], ["another stribeck_speed"]),
        (
            [("com_offset", {"x": 0.15}), ("com_offset", {"x": 0.15})],
            ["effect 2 (com_offset)", "body.com_offset[x]", "outside"],
        ),
    ],
)
def test_effects_the_parameters_cannot_take_are_refused(effects, words):
    with pytest.raises(InputError) as error:
        patched(*({"name": name, "where": EFFECTS[name].where[:1], "parameters": values} for name, values in effects))
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


# ---- the same effect twice -------------------------------------------------------------------------------------------


def twice(name: str, first: dict[str, float], second: dict[str, float]) -> Parameters:
    where = list(EFFECTS[name].where[:1])
    return patched(*({"name": name, "where": where, "parameters": values} for values in (first, second)))


def test_two_payloads_at_one_place_are_one():
    place = {"x": 0.1, "y": 0.0, "z": 0.05}
    both = twice("payload", {"mass": 0.5, **place}, {"mass": 0.25, **place})
    np.testing.assert_array_equal(both["payload.mass"], 0.75)
    np.testing.assert_array_equal(both["payload.position"], [[0.1, 0.0, 0.05]] * 2)


def test_loads_add_up_to_one_rigid_body():
    """Platform mass, first moment and inertia of three loads are the sums of those of each load alone."""
    loads = [
        {"mass": m, "x": x, "y": y, "z": z} for m, x, y, z in ((0.5, 0.1, 0, 0.05), (0.3, -0.1, 0.08, 0), (1, 0, -0.1, 0.1))
    ]
    effects = [{"name": "payload", "where": ["body"], "parameters": load} for load in loads]
    names = ("platform_mass", "platform_first_moment", "platform_inertia")
    bare, together = inertial_constants(patched()), inertial_constants(patched(*effects))
    for name in names:
        alone = [inertial_constants(patched(effect))[name] - bare[name] for effect in effects]
        np.testing.assert_allclose(together[name] - bare[name], sum(alone), atol=1e-15, rtol=1e-13)


def test_two_tethers_pull_like_one():
    both = twice("tether", {"stiffness": 3.0, "x": 1.0, "y": -1.0}, {"stiffness": 1.0, "x": -2.0, "y": 2.0})
    for point in np.array([[0.0, 0.0], [5.0, -3.0]]):
        separate = -3.0 * (point - [1.0, -1.0]) - 1.0 * (point - [-2.0, 2.0])
        one = -both["tether.stiffness"][0] * (point - both["tether.anchor"][0])
        np.testing.assert_allclose(one, separate, rtol=1e-14)


def test_ripples_and_stick_frictions_of_one_shape_add_up():
    np.testing.assert_allclose(twice("torque_ripple", RIPPLE, RIPPLE)["servo.ripple_amplitude[leg_lf]"], 0.2)
    np.testing.assert_allclose(twice("stribeck_friction", STICK, STICK)["servo.stribeck_torque[leg_lf]"], 0.2)


def test_factors_multiply():
    np.testing.assert_allclose(twice("weak_motor", {"scale": 0.8}, {"scale": 0.5})["servo.torque_scale[leg_lf]"], 0.4)
    np.testing.assert_allclose(twice("camera_misalignment", {"scale": 0.8}, {"scale": 0.9})["camera.scale"], 0.72)


def test_each_robot_lays_a_patch_into_its_own_first_empty_place():
    parameters = Parameters.nominal(ROBOT, 3)
    parameters["patch.x_max"][1, 0] = parameters["patch.y_max"][1, 0] = 1.0
    parameters["patch.x_max"][2, 1] = parameters["patch.y_max"][2, 1] = 1.0
    ice = {"name": "friction_patch", "parameters": ICE}
    result = apply_patch(load_patch([ice, {"name": "friction_patch", "parameters": ICE | {"mu": 0.2}}]), parameters)
    np.testing.assert_array_equal(result["patch.mu"], [[0.1, 0.2, 0, 0], [0, 0.1, 0.2, 0], [0.1, 0, 0.2, 0]])


@pytest.mark.parametrize(("name", "where"), [("friction_level", ["ground"]), ("friction_asymmetry", ["wheel_lf"])])
def test_friction_levels_are_of_the_floor_outside_its_patches(name, where):
    parameters = Parameters.nominal(ROBOT, 1)
    parameters["patch.mu"][0, 0], parameters["patch.x_max"][0, 0] = 0.7, 1.0
    result = apply_patch(load_patch({"name": name, "where": where, "parameters": {"mu": 0.4}}), parameters)
    assert result["patch.mu"][0, 0] == 0.7
    assert "patches" in EFFECTS[name].doc


def test_slip_weakening_counts_from_each_wheels_own_friction():
    result = patched(
        {"name": "slip_weakening", "parameters": {"mu_k": 0.2, "slip_speed": 0.1}},
        {"name": "friction_asymmetry", "where": ["wheel_rf"], "parameters": {"mu": 0.4}},
        {"name": "friction_anisotropy", "parameters": {"ratio": 0.5}},
    )
    np.testing.assert_allclose(result["ground.kinetic_ratio"][0] * result["ground.mu_x"][0], 0.2)
    np.testing.assert_allclose(result["ground.kinetic_ratio"][0], [1 / 3, 0.5, 1 / 3, 1 / 3])


def test_a_floor_below_mu_k_keeps_its_friction():
    """Randomisation may draw one at any reset: no reason to end a training."""
    drawn = Parameters.nominal(ROBOT, 3)
    drawn["ground.mu_x"] = np.array([0.2, 0.4, 0.8])[:, None]
    result = apply_patch(load_patch({"name": "slip_weakening", "parameters": {"mu_k": 0.4, "slip_speed": 0.1}}), drawn)
    np.testing.assert_allclose(result["ground.kinetic_ratio"], np.repeat([[1.0], [1.0], [0.5]], 4, axis=1), rtol=1e-15)
    np.testing.assert_array_equal(result["ground.mu_x"], drawn["ground.mu_x"])


# ---- composing -------------------------------------------------------------------------------------------------------


def test_files_names_effects_and_patches_compose_in_order(tmp_path):
    path = tmp_path / "mine.yaml"
    path.write_text("effects: [{name: friction_level, parameters: {mu: 0.3}}]\nprovenance: {made_by: me}")
    load = {"name": "payload", "parameters": {"mass": 0.5}}
    patch = load_patch([str(path), "icy_patch", load, load_patch({"name": "gyro_bias", "parameters": {"z": 0.1}})])
    names = [effect.name for effect in patch.effects]
    assert names == ["friction_level", "friction_patch", "slip_weakening", "payload", "gyro_bias"]
    assert patch.provenance["composed_of"][0] == {"source": str(path), "made_by": "me"}
    assert str(path) in patch.source
    assert patch.summary() == ", ".join(names)
    assert compose(load_patch(path), load_patch("icy_patch")).effects == patch.effects[:3]
    assert load_patch([path]) == load_patch(path)
    assert not load_patch([])
    assert load_patch([]).summary() == "none"
    again = load_patch(save_patch(patch, tmp_path / "all.yaml"))
    assert (again.effects, again.provenance) == (patch.effects, patch.provenance)


def test_a_composed_patch_is_blamed_by_file_and_place(tmp_path):
    path = tmp_path / "second.yaml"
    path.write_text("effects: [{name: com_offset, parameters: {x: 0.15}}]")
    patch = load_patch([{"name": "com_offset", "parameters": {"x": 0.15}}, path])
    with pytest.raises(InputError, match=r"second\.yaml: effect 1 \(com_offset\): parameter body\.com_offset\[x\]"):
        apply_patch(patch, Parameters.nominal(ROBOT))


@pytest.mark.parametrize(
    ("source", "words"),
    [
        ("icy_ptch", ["icy_ptch", "did you mean 'icy_patch'"]),
        (3, ["effects = 3", "expected a path"]),
        ([3], ["effects: effect 1", "got 3"]),
        ([{"name": "payload", "parameters": {"mass": 1}}, {"name": "paylod"}], ["effects: effect 2", "did you mean 'payload'"]),
        ({"effects": [], "effect": 1}, ["unknown key 'effect'"]),
    ],
)
def test_bad_sources_are_refused(source, words):
    with pytest.raises(InputError) as error:
        load_patch(source)
    for word in words:
        assert word in str(error.value)


def test_every_ready_patch_can_be_applied_to_the_nominal_robot():
    paths = sorted((data_directory("configs") / "effects").glob("*.yaml"))
    assert len(paths) >= 5
    for path in paths:
        patch = load_patch(path.stem)
        assert patch == load_patch(path)
        changed = (apply_patch(patch, Parameters.nominal(ROBOT)).values != Parameters.nominal(ROBOT).values).any()
        assert changed or patch.forces


# ---- any patch at all ------------------------------------------------------------------------------------------------


@st.composite
def any_effect(draw: st.DrawFn) -> dict[str, Any]:
    effect = EFFECTS[draw(st.sampled_from(sorted(EFFECTS)))]
    where = draw(st.lists(st.sampled_from(effect.where), min_size=1, unique=True))
    given = {name for name, spec in effect.parameters.items() if not spec.optional or draw(st.booleans())}
    values = {name: draw(st.floats(effect.parameters[name].low, effect.parameters[name].high)) for name in sorted(given)}
    return {"name": effect.name, "where": where, "parameters": values}


@settings(deadline=None)
@example([], {"commit": "12345e6", "made_by": "\x85 Jürgen"})
@given(st.lists(any_effect(), max_size=4), st.dictionaries(st.text(max_size=8), st.text(max_size=20), max_size=2))
def test_any_patch_reads_back_as_it_was_saved(effects, provenance):
    patch = Patch(load_patch(effects).effects, provenance)
    with tempfile.TemporaryDirectory() as folder:
        again = load_patch(save_patch(patch, Path(folder) / "patch.yaml"))
    assert again.effects == patch.effects
    assert again.provenance == patch.provenance


@settings(deadline=None)
@given(st.lists(any_effect(), max_size=4, unique_by=lambda effect: effect["name"]), st.randoms())
def test_the_order_of_different_effects_never_matters(effects, random):
    shuffled = random.sample(effects, len(effects))

    def result(order: list[dict[str, Any]]) -> np.ndarray | None:
        try:
            return patched(*order, count=1).values
        except InputError:
            return None

    first, second = result(effects), result(shuffled)
    assert (first is None) == (second is None)
    if first is not None:
        np.testing.assert_array_equal(first, second)
