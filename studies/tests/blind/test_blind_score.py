"""The scorer on made-up results, and the sequence of data sets."""

from collections import Counter
from pathlib import Path

import numpy as np
import pytest

from studies.bench.blind import score as scoring
from studies.bench.blind.cases import FIRST_TYRE_SEED, LATER, NAMED, SEVERITIES, STRANGE, case, hide, named, strange, tyre_case
from studies.bench.gap import Plan


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
    assert single["size_error"]["median"] == pytest.approx((0.05 + 0.5) / 2), "a radius counts from 1"
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
    assert report["bad_data"]["hits"] == 1
    assert report["confusion"]["(veer)"] == {"unknown_effect": 1, "external_force": 1, "nothing_missing": 1}


UNSAID = {"verdict": "unknown_effect", "effects": [effect("unknown_effect", ["body_force_y"])]}
CRASHED, REFUSED = {"verdict": "failed"}, {"verdict": "refused"}


@pytest.mark.parametrize(
    ("answer", "right", "unnamed"),
    [
        (UNSAID, 1, 1),
        ({"verdict": "unknown_effect", "effects": []}, 1, 1),
        ({"verdict": "effect_found", "effects": [*UNSAID["effects"], effect("tether", ["body"])]}, 0, 0),
        (NOTHING, 0, 1),
        (CRASHED, 0, 0),
        (REFUSED, 0, 0),
        ({"verdict": "bad_data"}, 0, 0),
        ({"verdict": "not_excited", "effects": []}, 0, 0),
    ],
)
def test_a_stranger_is_answered_by_unknown_alone(answer, right, unnamed):
    truths = {"s": truth("s", "stranger", 2.0, effect("veer", ["body"], coefficient=4.0))}
    outside = scoring.score({"s": answer}, truths)["outside"]
    assert (outside["unknown"]["hits"], outside["unknown"]["count"]) == (right, 1)
    assert (outside["not_misnamed"]["hits"], outside["not_misnamed"]["count"]) == (unnamed, 1)


def test_crashes_and_refusals_are_no_success_anywhere():
    hidden = effect("backlash", angle=0.02)
    kinds = {"n": ("none",), "m": ("parameters",), "e": ("effect", 2.0, hidden), "p": ("pair", 2.0, hidden), "b": ("bad",)}
    truths = {name: truth(name, *kind) for name, kind in kinds.items()}
    for answer, crashed in ((CRASHED, 5), (REFUSED, 0), ({"verdict": "not_excited"}, 0)):
        report = scoring.score(dict.fromkeys(truths, answer), truths)
        assert report["false_alarms"]["none"]["count"] == report["false_alarms"]["parameters"]["count"] == 0
        assert report["false_alarms"]["refused_good_data"]["hits"] == (0 if crashed else 4)
        assert report["crashed"]["hits"] == crashed
        assert report["bad_data"]["hits"] == (not crashed)
        assert report["single"]["top1"]["hits"] == report["pairs"]["both"]["hits"] == 0
        assert report["single"]["gap_reduction_of_all"]["median"] == 0.0


def test_misses_close_no_gap():
    truths = {f"e{k}": truth(f"e{k}", "effect", 2.0, effect("backlash", angle=0.02)) for k in range(5)}
    hit = found(effect("backlash", angle=0.02), gap={"reduction": 0.95})
    miss = {**NOTHING, "gap": {"reduction": 0.0}}
    single = scoring.score(dict.fromkeys(truths, miss) | {"e0": hit}, truths)["single"]
    assert (single["gap_reduction"]["median"], single["gap_reduction"]["count"]) == (0.95, 1)
    assert (single["gap_reduction_of_all"]["median"], single["gap_reduction_of_all"]["count"]) == (0.0, 5)


@pytest.mark.parametrize(
    ("gap", "surely", "by_value"),
    [
        ({"reduction": -0.2, "reduction_ci95": [-0.3, -0.1], "heldout_after": 3.0, "heldout_calibrated": 2.0}, (1, 1), 1),
        ({"reduction": -0.2, "reduction_ci95": [-0.5, 0.1], "heldout_after": 3.0, "heldout_calibrated": 2.0}, (0, 1), 1),
        ({"reduction": 0.9, "reduction_ci95": None, "heldout_after": 1.0, "heldout_calibrated": 2.0}, (0, 0), 0),
        ({"reduction": 0.9, "reduction_ci95": [None, None], "heldout_after": 1.0, "heldout_calibrated": 2.0}, (0, 0), 0),
    ],
)
def test_a_gap_grows_surely_when_its_whole_interval_says_so(gap, surely, by_value):
    truths = {"e": truth("e", "effect", 2.0, effect("backlash", angle=0.02))}
    single = scoring.score({"e": found(effect("backlash", angle=0.02), gap=gap)}, truths)["single"]
    assert (single["gap_grew_surely"]["hits"], single["gap_grew_surely"]["count"]) == surely
    assert single["gap_grew"]["hits"] == by_value


def test_further_names_and_confidence_are_told():
    truths = {f"e{k}": truth(f"e{k}", "effect", 2.0, effect("backlash", angle=0.02)) for k in range(4)}
    right, wrong = effect("backlash", angle=0.02), effect("tether", ["body"], stiffness=1.0)
    answers = {"e0": found(right), "e1": found(right, wrong), "e2": found(wrong), "e3": NOTHING}
    single = scoring.score(answers, truths)["single"]
    assert (single["extra_name"]["hits"], single["extra_name"]["count"]) == (1, 2)
    assert single["confidence"] == {"mean_confidence": pytest.approx(0.9), "right": pytest.approx(2 / 3), "count": 3}


def test_medians_have_bounds_that_hold_whatever_the_distribution():
    values = np.random.default_rng(0).lognormal(size=(1000, 12))  # median 1
    low, high = np.array([[scoring._quantiles(row)[key] for key in ("at_least95", "at_most95")] for row in values]).T
    exact = 1 - (1 + 12 + 66) / 2**12  # at most two of twelve beyond
    assert (high >= 1.0).mean() == pytest.approx(exact, abs=0.01)
    assert (low <= 1.0).mean() == pytest.approx(exact, abs=0.01)
    assert scoring._quantiles([1.0] * 4)["at_most95"] is None, "four values may all be on one side"


def test_sizes_that_are_vectors_are_compared_as_vectors():
    true = effect("external_force", ["body"], fx=3.0, fy=0.01)
    assert scoring.size_error(true, effect("external_force", ["body"], fx=3.0, fy=0.31)) == pytest.approx(0.1, rel=1e-3)
    opposite = scoring.size_error(effect("gyro_bias", ["sensor"], z=0.01), effect("gyro_bias", ["sensor"], x=0.01))
    assert opposite == pytest.approx(np.sqrt(2))
    turned = scoring.size_error(
        effect("camera_misalignment", ["sensor"], yaw=0.04), effect("camera_misalignment", ["sensor"], yaw=0.04, scale=1.004)
    )
    assert turned == pytest.approx(0.1), "a scale that is not there counts from 1"


#: What says how large an effect is, at the value where it vanishes (table of effects; the nominal floor has 0.6).
VANISHED = {
    "coulomb_friction": {"torque": 0.0},
    "viscous_friction": {"coefficient": 0.0},
    "stribeck_friction": {"extra_static_torque": 0.0},
    "load_dependent_friction": {"ratio": 0.0},
    "backlash": {"angle": 0.0},
    "torque_ripple": {"amplitude": 0.0},
    "weak_motor": {"scale": 1.0},
    "supply_sag": {"resistance": 0.0},
    "command_delay": {"delay": 0.0},
    "joint_zero_offset": {"angle": 0.0},
    "friction_level": {"mu": 0.6},
    "friction_asymmetry": {"mu": 0.6},
    "friction_anisotropy": {"ratio": 1.0},
    "friction_patch": {"mu": 0.6},
    "slip_weakening": {"mu_k": 0.6},
    "tyre_creep": {"creep_speed": 0.0},
    "tyre_brush": {"slip_compliance": 0.0},
    "rolling_resistance": {"coefficient": 0.0},
    "wheel_radius_error": {"scale": 1.0},
    "payload": {"mass": 0.0},
    "com_offset": {"x": 0.0, "y": 0.0, "z": 0.0},
    "floor_slope": {"pitch": 0.0, "roll": 0.0},
    "external_force": {"fx": 0.0, "fy": 0.0},
    "tether": {"stiffness": 0.0},
    "gyro_bias": {"x": 0.0, "y": 0.0, "z": 0.0},
    "imu_misalignment": {"roll": 0.0, "pitch": 0.0, "yaw": 0.0},
    "camera_misalignment": {"yaw": 0.0, "scale": 1.0},
    "camera_delay": {"delay": 0.0},
}


@pytest.mark.parametrize("name", [*NAMED, *LATER])
def test_sizes_count_from_where_an_effect_vanishes(name):
    true = named(name, 2.0, np.random.default_rng(3))
    vanished = {**true, "parameters": {**true["parameters"], **VANISHED[name]}}
    assert scoring.size_error(true, vanished) == pytest.approx(1.0), "nothing seen"
    twice = {key: 2 * true["parameters"].get(key, zero) - zero for key, zero in VANISHED[name].items()}
    assert scoring.size_error(true, {**true, "parameters": {**true["parameters"], **twice}}) == pytest.approx(1.0), (
        "twice the size"
    )
    assert scoring.size_error(true, true) == 0.0
    others = {key: 1.3 * value for key, value in true["parameters"].items() if key not in VANISHED[name]}
    moved = {**true, "parameters": {**true["parameters"], **others}}
    assert scoring.size_error(true, moved) == 0.0, "place and form are not the size"
    if others and name != "torque_ripple":
        assert scoring.shape_error(true, moved) == pytest.approx(0.3)
    else:
        assert scoring.shape_error(true, moved) is None


def test_a_component_that_is_left_out_is_said_to_be_neutral():
    true = {"name": "gyro_bias", "parameters": {"x": 0.01, "y": 0.0}}
    part = {"parameters": {"z": {"value": 0.01, "ci95": [0.0, 0.02]}}}
    assert scoring.intervals_hold(true, part) == [False]  # y is neutral


def test_a_size_that_is_not_given_is_not_found():
    true = effect("payload", ["body"], mass=0.3, x=0.1, y=0.0, z=0.05)
    assert scoring.size_error(true, {**true, "parameters": {"x": 0.1}}) == 1.0


@pytest.mark.parametrize(("order", "right"), [(8.4, True), (7.51, True), (8.6, False), (None, False)])
def test_the_order_of_a_ripple_is_right_or_wrong(order, right):
    true = effect("torque_ripple", ["leg_lf"], amplitude=0.1, order=8.0, phase=1.0)
    parameters = {"amplitude": 0.13, "phase": 1.0} | ({} if order is None else {"order": order})
    answer = effect("torque_ripple", ["leg_lf"], **parameters)
    single = scoring.score({"r": found(answer)}, {"r": truth("r", "effect", 2.0, true)})["single"]
    assert (single["order"]["hits"], single["order"]["count"]) == (right, 1)
    assert (single["size_error"]["median"], single["size_error"]["count"]) == (pytest.approx(0.3), 1), (
        "a right order is no size"
    )
    assert single["shape_error"]["count"] == 0


def test_any_stretch_of_the_sequence_is_a_fair_sample():
    cases = [case(index) for index in range(240)]
    kinds = Counter(one.kind for one in cases)
    assert kinds == {"effect": 110, "parameters": 50, "none": 30, "pair": 20, "stranger": 20, "bad": 10}
    singles = [(one.effects[0]["name"], one.severity) for one in cases if one.kind == "effect"]
    assert set(singles) == {(name, severity) for name in NAMED for severity in SEVERITIES}
    assert {one.effects[0]["name"] for one in cases if one.kind == "stranger"} == set(STRANGE)
    assert len({one.seed for one in cases}) == 240
    assert case(17) == case(17)


def test_further_nulls_come_after_the_cycle():
    more = [case(index) for index in range(240, 400)]
    assert Counter(one.kind for one in more) == {"none": 80, "parameters": 80}
    assert not any(one.effects for one in more)


def test_sets_about_tyres():
    cases = [tyre_case(index) for index in range(90)]
    assert Counter(one.kind for one in cases) == {"none": 30, "parameters": 30, "effect": 30}
    assert Counter(one.severity for one in cases if one.effects) == {1.0: 8, 2.0: 15, 3.0: 7}
    assert {effect["name"] for one in cases for effect in one.effects} == {"tyre_brush"}
    assert {one.bumps for one in cases} == {1e-4}
    assert len({one.seed for one in cases} - {case(index).seed for index in range(400)}) == 90
    assert Plan(Path(), 90, first_seed=FIRST_TYRE_SEED).cases() == cases


def test_half_of_all_sets_have_no_camera_and_some_fewer_runs():
    cases = [case(index) for index in range(400)]
    nulls = [one for one in cases if one.kind in ("none", "parameters")]
    assert 0.42 < np.mean([not one.camera for one in cases]) < 0.58
    assert 0.42 < np.mean([not one.camera for one in nulls]) < 0.58
    assert all(one.camera for one in cases if any(effect["name"].startswith("camera") for effect in one.effects))
    counts = Counter(len(one.runs) for one in cases)
    assert set(counts) == {8, 6, 4}
    assert min(counts.values()) > 40


@pytest.mark.parametrize("name", [*NAMED, *LATER, *STRANGE])
def test_every_hidden_effect_reaches_the_simulator_and_grows_with_severity(name):
    draw = strange if name in STRANGE else named
    weak, strong = (draw(name, severity, np.random.default_rng(3)) for severity in (1.0, 4.0))
    assert weak["where"] == strong["where"]
    assert weak["parameters"] != strong["parameters"]
    plain, changed = vars(hide([])), vars(hide([strong]))
    assert any(not np.array_equal(plain[key], changed[key], equal_nan=True) for key in plain)


def test_a_wheel_keeps_its_own_friction_whatever_the_level():
    pair = [effect("friction_asymmetry", ["wheel_rf"], mu=0.2), effect("friction_level", ["ground"], mu=0.4)]
    for order in (pair, pair[::-1]):
        assert list(hide(order).wheel_mu) == [0.4, 0.2, 0.4, 0.4]


def test_what_a_patch_leaves_is_counted_in_noise_floors_beside_what_no_effect_leaves():
    hidden = effect("coulomb_friction", torque=0.1)
    truths = {"a": truth("a", "effect", 2.0, hidden), "n": truth("n", "none", 0.0)}
    results = {
        "a": found(hidden, gap={"heldout_after": 3.0, "noise_floor": 1.5}),
        "n": {**NOTHING, "gap": {"heldout_after": 1.8, "noise_floor": 1.5}},
    }
    left = scoring.score(results, truths)["left"]
    assert left["named"]["median"] == pytest.approx(2.0)
    assert left["nothing hidden"]["median"] == pytest.approx(1.2)
