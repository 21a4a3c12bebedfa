"""The scorer on made-up results, and the sequence of data sets."""

from collections import Counter

import numpy as np
import pytest

from wlr_gym.bench.blind import score as scoring
from wlr_gym.bench.blind.cases import SEVERITIES, case, named, strange
from wlr_gym.bench.blind.copies import nominal, read_robot
from wlr_gym.bench.blind.truth import NAMED, STRANGE, hide
from wlr_gym.paths import data_directory


def truth(name, kind="effect", severity=2.0, *effects):
    return {"name": name, "kind": kind, "severity": severity, "effects": list(effects)}


def effect(name, where=("wheel_lf",), **parameters):
    return {"name": name, "where": list(where), "parameters": parameters}


def found(*effects, verdict="effect_found", equivalent=(), **more):
    written = [
        {
            **one,
            "parameters": {k: {"value": v, "ci95": [0.9 * v, 1.1 * v]} for k, v in one["parameters"].items()},
            "confidence": 0.9,
        }
        for one in effects
    ]
    return {"verdict": verdict, "effects": written, "equivalent": list(equivalent), **more}


NOTHING = {"verdict": "nothing_missing", "effects": []}


def test_false_alarms_have_exact_bounds():
    truths = {f"n{k}": truth(f"n{k}", "none", 0.0) for k in range(59)}
    clean = scoring.score(dict.fromkeys(truths, NOTHING), truths)["false_alarms"]["none"]
    assert clean["hits"] == 0
    assert clean["bound95"] == pytest.approx(1 - 0.05 ** (1 / 59)), "rule of three, exactly"
    results = dict.fromkeys(truths, NOTHING) | {"n0": found(effect("payload", ["body"], mass=0.3))}
    assert scoring.score(results, truths)["false_alarms"]["none"]["hits"] == 1
    unknown = dict.fromkeys(truths, NOTHING) | {"n0": {"verdict": "unknown_effect", "effects": []}}
    assert scoring.score(unknown, truths)["false_alarms"]["none"]["hits"] == 1


def test_right_name_place_parameter_and_interval():
    truths = {
        "a": truth("a", "effect", 2.0, effect("coulomb_friction", torque=0.1)),
        "b": truth("b", "effect", 4.0, effect("wheel_radius_error", scale=1.02)),
        "c": truth("c", "effect", 2.0, effect("backlash", angle=0.02)),
        "d": truth("d", "effect", 0.5, effect("backlash", angle=0.005)),
    }
    results = {
        "a": found(
            effect("coulomb_friction", torque=0.105), gap={"reduction": 0.9, "heldout_after": 1.1, "heldout_calibrated": 5.0}
        ),
        "b": found(effect("wheel_radius_error", ["wheel_rf"], scale=1.03)),
        "c": found(
            effect("viscous_friction", coefficient=0.1), equivalent=[["viscous_friction", "backlash", "run: reversals"]]
        ),
        "d": NOTHING,
    }
    single = scoring.score(results, truths)["single"]
    assert (single["top1"]["hits"], single["top1"]["count"]) == (2, 3)
    assert single["in_set"]["hits"] == 3
    assert single["mean_set_size"] == pytest.approx(4 / 3)
    assert (single["place"]["hits"], single["place"]["count"]) == (1, 2)
    assert single["parameter_error"]["median"] == pytest.approx((0.05 + 0.5) / 2), "a radius counts from 1"
    assert single["interval_coverage"]["hits"] == 2
    assert single["gap_reduction"]["median"] == 0.9
    assert single["by_severity"]["0.5"]["found"]["hits"] == 0


def test_an_effect_left_unsaid_is_no_right_answer():
    truths = {"a": truth("a", "effect", 2.0, effect("backlash", angle=0.02))}
    single = scoring.score({"a": {**NOTHING, "equivalent": [["backlash"]]}}, truths)["single"]
    assert single["top1"]["hits"] == single["in_set"]["hits"] == 0


def test_pairs_strangers_and_bad_data():
    pair = truth("p", "pair", 2.0, effect("backlash", angle=0.02), effect("payload", ["body"], mass=0.3))
    strangers = {f"s{k}": truth(f"s{k}", "stranger", 2.0, effect("veer", ["body"], coefficient=4.0)) for k in range(3)}
    bad = {"x": truth("x", "bad", 0.0), "y": truth("y", "bad", 0.0)}
    results = {
        "p": found(
            effect("payload", ["body"], mass=0.3), effect("backlash", angle=0.02), effect("tether", ["body"], stiffness=1.0)
        ),
        "s0": {
            "verdict": "unknown_effect",
            "effects": [{"name": "unknown_effect", "where": ["body_force_y"], "parameters": {}}],
        },
        "s1": found(effect("external_force", ["body"], fx=1.0)),
        "s2": NOTHING,
        "x": {"verdict": "refused", "message": "no"},
        "y": NOTHING,
    }
    report = scoring.score(results, {"p": pair} | strangers | bad)
    assert report["pairs"]["both"]["hits"] == 1
    assert report["pairs"]["exact"]["hits"] == 0
    assert report["outside"]["not_misnamed"]["hits"] == 2
    assert report["outside"]["unknown"]["hits"] == 1
    assert report["outside"]["silent"] == 1
    assert report["bad_data"]["hits"] == 1
    assert report["confusion"]["(veer)"] == {"unknown_effect": 1, "external_force": 1, "nothing_missing": 1}


def test_vectors_are_compared_as_vectors():
    true = effect("external_force", ["body"], fx=3.0, fy=0.01)
    errors = scoring.parameter_errors(true, effect("external_force", ["body"], fx=3.0, fy=0.31))
    assert errors == {"fx+fy": pytest.approx(0.1, rel=1e-3)}
    opposite = scoring.parameter_errors(effect("gyro_bias", ["sensor"], z=0.01), effect("gyro_bias", ["sensor"], x=0.01))
    assert opposite == {"x+z": pytest.approx(np.sqrt(2))}


def test_any_stretch_of_the_sequence_is_a_fair_sample():
    cases = [case(index) for index in range(240)]
    kinds = Counter(one.kind for one in cases)
    assert kinds == {"effect": 110, "parameters": 50, "none": 30, "pair": 20, "stranger": 20, "bad": 10}
    singles = [(one.effects[0]["name"], one.severity) for one in cases if one.kind == "effect"]
    assert set(singles) == {(name, severity) for name in NAMED for severity in SEVERITIES}
    assert {one.effects[0]["name"] for one in cases if one.kind == "stranger"} == set(STRANGE)
    assert len({one.seed for one in cases}) == 240
    assert case(17) == case(17)


@pytest.mark.parametrize("name", [*NAMED, *STRANGE])
def test_every_hidden_effect_reaches_the_simulator_and_grows_with_severity(name):
    robot = read_robot(data_directory("configs") / "robot" / "nominal.yaml")
    draw = named if name in NAMED else strange
    weak, strong = (draw(name, severity, np.random.default_rng(3)) for severity in (1.0, 4.0))
    assert weak["where"] == strong["where"]
    assert weak["parameters"] != strong["parameters"]
    plain, changed = vars(hide([], nominal(robot))), vars(hide([strong], nominal(robot)))
    assert any(not np.array_equal(plain[key], changed[key], equal_nan=True) for key in plain)


def test_a_wheel_keeps_its_own_friction_whatever_the_level():
    robot = read_robot(data_directory("configs") / "robot" / "nominal.yaml")
    pair = [effect("friction_asymmetry", ["wheel_rf"], mu=0.2), effect("friction_level", ["ground"], mu=0.4)]
    for order in (pair, pair[::-1]):
        assert list(hide(order, nominal(robot)).wheel_mu) == [0.4, 0.2, 0.4, 0.4]
