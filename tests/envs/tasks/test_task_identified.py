"""Randomisation from a gap result: centred on what was identified, as wide as its uncertainty."""

import json
from typing import Any

import numpy as np
import pytest

from wlr_gym.base.errors import InputError
from wlr_gym.envs.tasks import load_randomization
from wlr_gym.physics.effects import EFFECTS, apply_patch, load_patch
from wlr_gym.robot import load_robot
from wlr_gym.robot.parameters import Parameters

SEEDS = np.arange(4000, dtype=np.uint64)


def estimate(value, half=0.0, unit="-"):
    return {"value": value, "ci95": [value - half, value + half], "unit": unit}


@pytest.fixture(scope="module")
def robot():
    return load_robot()


@pytest.fixture
def result(tmp_path):
    """Write a result and return its path."""

    def write(**content) -> Any:
        path = tmp_path / "result.json"
        path.write_text(json.dumps({"verdict": "effect_found"} | content))
        return path

    return write


def draw(randomization):
    return randomization.parameters(SEEDS, SEEDS)


def test_calibration_and_effects_replace_and_join_the_preset(robot, result):
    path = result(
        calibration={
            "ground.mu": {"nominal": 0.6, "fitted": 0.55, "ci95": [0.53, 0.57], "unit": "-"},
            "body.mass": {"fitted": 2.9},
        },
        effects=[
            {
                "name": "rolling_resistance",
                "where": ["wheel_lf", "wheel_rf"],
                "parameters": {"coefficient": estimate(0.04, 0.01)},
            },
            {"name": "friction_anisotropy", "where": ["ground"], "parameters": {"ratio": estimate(0.7, 0.05)}},
            {"name": "command_delay", "where": ["leg_lf"], "parameters": {"delay": estimate(0.02, 0.002, "s")}},
        ],
    )
    drawn, preset = draw(load_randomization(path, robot)), draw(load_randomization("nominal", robot))
    assert drawn["ground.mu_x"].mean() == pytest.approx(0.55, abs=0.001)
    assert drawn["ground.mu_x"].std() == pytest.approx(0.02 / 1.96, rel=0.05)
    assert np.all(drawn["ground.mu_x"] == drawn["ground.mu_x"][:, :1])
    assert np.all(drawn["body.mass"] == 2.9)
    ratio = drawn["ground.mu_y"] / drawn["ground.mu_x"]
    assert ratio.mean() == pytest.approx(0.7, abs=0.002)
    assert ratio.std() == pytest.approx(0.05 / 1.96, rel=0.05)
    rolling = drawn["ground.rolling_resistance"]
    assert rolling[:, :2].mean() == pytest.approx(0.04, abs=0.001)
    assert rolling[:, :2].std() == pytest.approx(0.01 / 1.96, rel=0.05)
    assert not rolling[:, 2:].any()
    added = drawn["command.delay"] - preset["command.delay"]
    assert added[:, 0].mean() == pytest.approx(0.02, abs=1e-4)
    assert not added[:, 1:].any()
    assert np.array_equal(drawn["wheel.radius"], preset["wheel.radius"])


@pytest.mark.parametrize("name", EFFECTS)
def test_without_uncertainty_a_result_is_its_patch(robot, result, name):
    """Every effect of the library: the events say exactly what the effect does to the nominal robot."""
    effect = EFFECTS[name]
    values = {key: spec.severity for key, spec in effect.parameters.items()}
    where = list(effect.where[:2])
    path = result(effects=[{"name": name, "where": where, "parameters": {k: {"value": v} for k, v in values.items()}}])
    drawn = load_randomization({"base": "none", "result": str(path)}, robot).parameters(SEEDS[:2], SEEDS[:2])
    patch = load_patch([{"name": name, "where": where, "parameters": values}])
    expected = apply_patch(patch, Parameters.nominal(robot, 2))
    np.testing.assert_allclose(drawn.values, expected.values, rtol=1e-12, atol=1e-15)
    assert not np.array_equal(expected.values, Parameters.nominal(robot, 2).values)


def test_a_result_lies_over_any_preset_and_under_the_users_events(robot, result):
    patch = {"mu": estimate(0.1, 0.02), "x_min": estimate(0.5), "x_max": estimate(1.0)}
    path = str(result(effects=[{"name": "friction_patch", "parameters": patch}] * 2))
    drawn = draw(load_randomization({"base": "patches", "result": path}, robot))
    assert drawn["patch.mu"][:, :2].mean() == pytest.approx(0.1, abs=0.001)
    assert np.all(drawn["patch.x_max"][:, :2] == 1.0)
    assert drawn["patch.mu"][:, 2:].max() > 0.9
    weight = {"parameters": ["payload.mass"], "distribution": "choice", "operation": "set", "values": [0.3]}
    config = load_randomization({"result": path, "events": {"weight": weight}}, robot).config
    assert {"weight", "floor_slope"} < set(config.events)
    again = load_randomization(config, robot)
    assert again.config == config


@pytest.mark.parametrize(
    ("content", "expected"),
    [
        ({"verdict": "bad_data"}, "verdict = 'bad_data': expected nothing_missing"),
        ({}, "nothing to draw from"),
        ({"calibration": {"servo.kq": {"fitted": 1.0}}}, "calibration.servo.kq: unknown parameter .*did you mean 'servo.k"),
        ({"calibration": {"body.mass": {"fitted": "heavy"}}}, "fitted = 'heavy'"),
        ({"calibration": {"body.mass": {"fitted": 1.0, "ci95": [2.0, 3.0]}}}, "fitted = 1 is not within its ci95"),
        ({"calibration": {"body.mass": {"fitted": 1.0, "ci95": [0.9]}}}, r"ci95 = \[0.9\]: expected"),
        ({"effects": [{"name": "paylod"}]}, "effect 1: unknown effect 'paylod' .did you mean 'payload'"),
        ({"effects": [{"name": "unknown_effect"}]}, "pass the result's patch as effects="),
        ({"effects": [{"name": "payload", "parameters": {"mas": estimate(1.0)}}]}, "effect 1: .*did you mean 'mass'"),
        ({"effects": [{"name": "payload", "parameters": {"mass": 1.0}}]}, "expected a mapping"),
    ],
)
def test_bad_results_are_refused(robot, result, content, expected):
    with pytest.raises(InputError, match=expected):
        load_randomization(result(**content), robot)


def test_a_result_is_looked_for_beside_the_file(robot, result, tmp_path):
    path = result(calibration={"body.mass": {"fitted": 2.5}})
    (tmp_path / "mine.yaml").write_text("result: result.json\n")
    assert load_randomization(tmp_path / "mine.yaml", robot).config.events == load_randomization(path, robot).config.events


def test_unreadable_results(robot, tmp_path):
    with pytest.raises(InputError, match="cannot be read"):
        load_randomization(tmp_path / "none.json", robot)
    (tmp_path / "broken.json").write_text("{]")
    with pytest.raises(InputError, match="line 1, column 2: broken JSON"):
        load_randomization(tmp_path / "broken.json", robot)


def test_an_effect_that_sets_some_wheels_takes_them_out_of_the_calibration(robot, result):
    path = result(
        calibration={"ground.mu": {"fitted": 0.55, "ci95": [0.53, 0.57]}},
        effects=[{"name": "friction_asymmetry", "where": ["wheel_lf"], "parameters": {"mu": estimate(0.2, 0.02)}}],
    )
    drawn = draw(load_randomization(path, robot))
    assert drawn["ground.mu_x"].mean(axis=0) == pytest.approx([0.2, 0.55, 0.55, 0.55], abs=0.002)
    assert drawn["ground.mu_x"][:, 0].std() == pytest.approx(0.04 / 3.92, rel=0.1)
