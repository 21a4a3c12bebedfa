"""The result file: the schema others rely on, numbers that survive, a patch that loads."""

import json
import math
from dataclasses import replace

import gap_examples as examples
import pytest

from wlr_gym.base.errors import InputError
from wlr_gym.data.format import CHANNELS
from wlr_gym.envs.tasks.identified import identified_events
from wlr_gym.gap.analysis import Calibrated, Equivalent, FoundEffect, ParameterEstimate, RunGap
from wlr_gym.gap.report import result
from wlr_gym.gap.report.result import patch_of, read_result, result_of, write_result
from wlr_gym.gap.robot.candidates import knobs
from wlr_gym.physics.effects import load_patch
from wlr_gym.robot import load_robot

#: What every result file holds, by the format's description.
KEYS = {"verdict", "effects", "equivalent", "calibration", "localisation", "gap", "runs", "patch"}
GAP_KEYS = {
    "metric", "fit_before", "fit_after", "heldout_before", "heldout_calibrated", "heldout_after", "noise_floor", "reduction",
    "reduction_signed", "reduction_ci95",
}  # fmt: skip
EVERY = pytest.mark.parametrize("analysis", examples.ALL.values(), ids=list(examples.ALL))


def written(analysis, folder):
    return json.loads(write_result(analysis, folder).read_text(encoding="utf-8"))


@EVERY
def test_schema(analysis, tmp_path):
    content = written(analysis, tmp_path)
    assert content.keys() >= KEYS
    assert content["verdict"] == analysis.verdict
    assert content["runs"] == {"fit": list(analysis.fit_runs), "heldout": list(analysis.heldout_runs)}
    assert (content["gap"] is None) == (analysis.gap is None)
    assert content["gap"] is None or content["gap"].keys() >= GAP_KEYS
    for effect in content["effects"]:
        assert effect.keys() >= {"name", "where", "parameters", "confidence", "formula"}
        assert all(parameter.keys() >= {"value", "ci95", "unit"} for parameter in effect["parameters"].values())
        assert (effect["formula"] is not None) == (effect["name"] == "unknown_effect")
    assert all(entry.keys() >= {"nominal", "fitted", "unit"} for entry in content["calibration"].values())
    assert all(entry.keys() >= {"share_of_gap", "state_dependence"} for entry in content["localisation"].values())
    assert all(isinstance(name, str) for group in content["equivalent"] for name in group)
    assert all(entry.keys() >= {"parameter", "value", "unit"} for entry in content["detectable"].values())
    assert content["provenance"]["made_by"] == "wlr gap"


@EVERY
def test_patch_loads_and_holds_what_was_found(analysis, tmp_path):
    patch = load_patch(written(analysis, tmp_path)["patch"])
    assert [effect.name for effect in patch.effects] == [effect.name for effect in analysis.effects]
    for loaded, found in zip(patch.effects, analysis.effects, strict=True):
        assert loaded.where == found.where
        assert loaded.parameters == {name: estimate.value for name, estimate in found.parameters.items()}
        assert loaded.formula == found.formula
    assert patch.provenance["made_by"] == "wlr gap"
    assert patch.provenance["data"] == [analysis.data]
    assert patch.provenance.keys() >= {"date", "version"}


def test_numbers_survive(tmp_path):
    analysis = examples.EFFECT_FOUND
    content = written(analysis, tmp_path)
    (effect,) = content["effects"]
    assert effect["parameters"] == {"coefficient": {"value": 0.0412, "ci95": [0.0383, 0.0447], "unit": "-"}}
    assert effect["confidence"] == 0.97
    assert content["equivalent"] == [["rolling_resistance", "coulomb_friction"]]
    assert content["separating_runs"] == [analysis.equivalent[0].separating_run]
    mu = content["calibration"]["ground.mu"]
    assert (mu["nominal"], mu["fitted"]) == (0.6, 0.652)
    assert mu["ci95"] == pytest.approx([0.652 - 0.0157, 0.652 + 0.0157])
    assert content["gap"]["reduction"] == 0.951
    assert content["gap"]["reduction_ci95"] == [0.912, 0.973]
    assert len(content["evidence"]) == len(analysis.evidence)
    assert content["evidence"][0]["by_run"]["run_01"] == 885.4
    adequacy = content["adequacy"]
    assert adequacy["replicates"] == 19
    assert adequacy["level"]["channels"].keys() == adequacy["whiteness"]["channels"].keys() == set(CHANNELS)
    assert adequacy["level"]["channels"]["acc_z"] == {"value": 1.31, "expected": 1.0, "limit": 1.04, "p": 0.05, "ratio": 1.31}
    assert adequacy["whiteness"]["channels"]["acc_z"]["value"] == 6.9
    assert (adequacy["whiteness"]["value"], adequacy["constancy"]["ratio"]) == (7.6, 1.4)
    pulled = adequacy["constancy"]["pulled_most"]
    assert (pulled["number"], pulled["run"], pulled["value"]) == ("ground.mu", "run_05", 12.7)
    assert content["run_gaps"][2] == {"run": "run_03", "heldout": True, **{k: getattr(analysis.run_gaps[2], k) for k in GAPS}}


GAPS = ("before", "calibrated", "after", "reduction")


def test_places_come_strongest_first(tmp_path):
    analysis = replace(examples.EFFECT_FOUND, localisation=examples.EFFECT_FOUND.localisation[::-1])
    shares = [entry["share_of_gap"] for entry in written(analysis, tmp_path)["localisation"].values()]
    assert shares == [0.44, 0.41, 0.15]


@pytest.mark.parametrize("analysis", [examples.EFFECT_FOUND, examples.NOTHING_MISSING])
def test_identified_randomization_reads_it(analysis, tmp_path):
    events = identified_events(write_result(analysis, tmp_path), load_robot())
    assert events["calibrated ground.mu"].mean == 0.652
    assert events["calibrated ground.mu"].sigma == pytest.approx(0.00801, rel=1e-3)
    found = [event for name, event in events.items() if name.startswith("identified")]
    assert len(found) == len(analysis.effects)
    assert all(event.mean == 0.0412 and event.sigma == pytest.approx(0.00163, rel=0.01) for event in found)


def test_formula_is_given_with_units(tmp_path):
    (effect,) = written(examples.UNKNOWN_EFFECT, tmp_path)["effects"]
    assert effect["formula"] == "-k * (leg_angle - a0) N m; k in N m/rad; a0 in rad"
    assert load_patch(tmp_path / "patch.yaml").effects[0].formula == "-k * (leg_angle - a0)"


def test_unknown_effect_without_formula_stays_out_of_the_patch(tmp_path):
    found = (FoundEffect("unknown_effect", ("leg_lr",), {}, 0.8, 900.0), *examples.EFFECT_FOUND.effects)
    analysis = replace(examples.UNKNOWN_EFFECT, effects=found)
    assert [effect["name"] for effect in written(analysis, tmp_path)["effects"]] == ["unknown_effect", "rolling_resistance"]
    assert [effect.name for effect in load_patch(tmp_path / "patch.yaml").effects] == ["rolling_resistance"]


def test_what_is_no_number_becomes_null(tmp_path):
    (effect,) = examples.EFFECT_FOUND.effects
    unsure = replace(effect, parameters={"coefficient": ParameterEstimate(0.04, math.nan, math.inf, "-")}, gain=math.nan)
    nothing = RunGap("run_01", False, math.nan, 2.0, 1.0, math.nan)
    few_runs = replace(examples.GAP, reduction_ci95=(math.nan, math.nan))
    analysis = replace(examples.EFFECT_FOUND, effects=(unsure,), run_gaps=(nothing,), gap=few_runs)
    text = write_result(analysis, tmp_path).read_text()
    assert "NaN" not in text
    assert "Infinity" not in text
    content = json.loads(text)
    assert content["effects"][0]["parameters"]["coefficient"]["ci95"] is None
    assert content["effects"][0]["gain"] is None
    assert content["run_gaps"][0]["before"] is None
    assert content["gap"]["reduction_ci95"] is None
    assert identified_events(tmp_path / "result.json", load_robot())


def test_interval_holds_its_value(tmp_path):
    (effect,) = examples.EFFECT_FOUND.effects
    beside = replace(effect, parameters={"coefficient": ParameterEstimate(0.05, 0.03, 0.04, "-")})
    content = written(replace(examples.EFFECT_FOUND, effects=(beside,)), tmp_path)
    assert content["effects"][0]["parameters"]["coefficient"]["ci95"] == [0.03, 0.05]


def test_a_reduction_is_a_share_and_what_got_worse_has_a_sign(tmp_path):
    worse = replace(examples.GAP, reduction=-0.27, reduction_ci95=(-0.33, -0.21))
    gap = written(replace(examples.EFFECT_FOUND, gap=worse), tmp_path)["gap"]
    assert (gap["reduction"], gap["reduction_signed"], gap["reduction_ci95"]) == (0.0, -0.27, [-0.33, -0.21])
    nothing = replace(examples.GAP, reduction=math.nan, reduction_ci95=(math.nan, math.nan))
    gap = written(replace(examples.EFFECT_FOUND, gap=nothing), tmp_path)["gap"]
    assert (gap["reduction"], gap["reduction_signed"], gap["reduction_ci95"]) == (0.0, None, None)


@pytest.mark.parametrize(
    "broken",
    [
        replace(examples.EFFECT_FOUND, verdict="perhaps"),
        replace(examples.EFFECT_FOUND, effects=(replace(examples.EFFECT_FOUND.effects[0], confidence=1.2),)),
        replace(examples.EFFECT_FOUND, gap=replace(examples.GAP, reduction=1.3)),
        replace(
            examples.EFFECT_FOUND,
            effects=(FoundEffect("payload", ("body",), {"mass": ParameterEstimate(math.nan, 0, 1, "kg")}, 0.5, 1.0),),
        ),
    ],
)
def test_nonsense_is_not_written(broken, tmp_path):
    broken = replace(broken, summary="-")
    with pytest.raises(ValueError, match="validation error"):
        write_result(broken, tmp_path)
    assert not list(tmp_path.iterdir())


def test_result_comes_last(tmp_path, monkeypatch):
    def fail(path, content):
        assert (tmp_path / "patch.yaml").exists()
        raise InputError("disk full")

    monkeypatch.setattr(result, "write_json", fail)
    with pytest.raises(InputError, match="disk full"):
        write_result(examples.EFFECT_FOUND, tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["patch.yaml"]


def test_text_survives(tmp_path):
    name = 'Prüfstand "A" 机器人\n<b>'
    group = Equivalent(("rolling_resistance",), name)
    content = written(replace(examples.EFFECT_FOUND, data=name, equivalent=(group,)), tmp_path)
    assert content["provenance"]["data"] == name
    assert content["separating_runs"] == [name]
    assert load_patch(tmp_path / "patch.yaml").provenance["data"] == [name]


# ---- reading ---------------------------------------------------------------------------------------------------------


@EVERY
def test_round_trip(analysis, tmp_path):
    path = write_result(analysis, tmp_path)
    assert read_result(path) == result_of(analysis, tmp_path / "patch.yaml")


def test_own_keys_of_other_versions_are_kept(tmp_path):
    path = write_result(examples.NOTHING_MISSING, tmp_path)
    path.write_text(json.dumps(json.loads(path.read_text()) | {"later": [1]}))
    assert read_result(path).model_dump()["later"] == [1]


def test_a_result_of_an_earlier_version_is_read(tmp_path):
    """As they were before reductions had a sign, the closure and what would have shown were told, and adequacy was a test."""
    path = write_result(examples.EFFECT_FOUND, tmp_path)
    content = json.loads(path.read_text())
    del content["gap"]["reduction_signed"], content["closure"], content["detectable"]
    content["adequacy"] = {"acc_z": 1.31, "volt": None}
    path.write_text(json.dumps(content))
    result = read_result(path)
    assert result.gap is not None
    assert (result.gap.reduction, result.gap.reduction_signed) == (0.951, None)
    assert (result.closure, result.detectable, result.adequacy) == ("", {}, {"acc_z": 1.31, "volt": None})


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"verdict": "fine"}, r"verdict = 'fine': expected 'bad_data'"),
        ({"effects": [{"name": "payload", "where": ["body"], "parameters": {}, "confidence": 2.0}]}, r"effects\.0\.confidence"),
        ({"calibration": {"ground.mu": {"nominal": 0.6}}}, r"'calibration\.ground\.mu\.fitted' is missing"),
        ({"runs": None}, r"runs = None: "),
        (
            {"effects": [
                {"name": "payload", "where": ["body"], "confidence": 0.5,
                 "parameters": {"mass": {"value": 2.0, "ci95": [0.0, 1.0], "unit": "kg"}}}
            ]},
            r"effects\.0\.parameters\.mass = .*value 2 is not within its ci95",
        ),
    ],
)  # fmt: skip
def test_a_broken_result_is_refused(tmp_path, change, words):
    path = write_result(examples.EFFECT_FOUND, tmp_path)
    path.write_text(json.dumps(json.loads(path.read_text()) | change))
    with pytest.raises(InputError, match=words):
        read_result(path)


def test_what_is_no_result_is_refused(tmp_path):
    with pytest.raises(InputError, match=r"nowhere\.json: cannot be read: No such file"):
        read_result(tmp_path / "nowhere.json")
    (tmp_path / "a.json").write_text('{"verdict": ')
    with pytest.raises(InputError, match=r"a\.json, line 1, column 13: broken JSON"):
        read_result(tmp_path / "a.json")


def test_patch_leaves_out_what_was_known_already():
    analysis = replace(examples.EFFECT_FOUND, known_effects=({"name": "payload", "parameters": {"mass": 0.2}},))
    assert [effect.name for effect in patch_of(analysis).effects] == ["rolling_resistance"]
    assert result_of(analysis).model_dump()["known_effects"] == [{"name": "payload", "parameters": {"mass": 0.2}}]


def test_every_number_that_calibration_moves_can_be_drawn_from(tmp_path):
    robot = load_robot()
    moved = {
        q.name: Calibrated(q.nominal, q.nominal, q.unit, q.sigma, 0.1 * q.sigma)
        for q in (knob.quantity for knob in knobs(robot, 0.001))
    }
    events = identified_events(write_result(replace(examples.NOTHING_MISSING, calibration=moved), tmp_path), robot)
    assert len(events) == len(moved)
