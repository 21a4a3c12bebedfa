"""The blind test from end to end, with stand-ins for the workflow: sealing, resuming, failures, report."""

import dataclasses
import json
import os
import shutil
from collections import Counter
from pathlib import Path

import pandas as pd
import pytest
import yaml

from studies.bench import gap
from studies.bench.__main__ import main
from studies.bench.blind.cases import FIRST_SCORED_SEED, case
from studies.bench.blind.score import score
from wlr_gym.base.errors import InputError
from wlr_gym.data import read_dataset

FIRST, SECOND, THIRD = (f"set_{FIRST_SCORED_SEED + k}" for k in range(3))


def answers_nothing(folder: Path, out: Path):
    """Stand-in: reads what it is given, says nothing is missing."""
    assert sorted(file.name for file in folder.iterdir()) == ["meta.yaml", "run_01.parquet"]
    assert not list(folder.parent.glob("*truth*"))
    return {"verdict": "nothing_missing", "effects": []}


def refuses_and_fails(folder: Path, out: Path):
    """Stand-in: an input error for even seeds, a programming error for odd ones."""
    if int(folder.name[-1]) % 2:
        raise ZeroDivisionError("a bug")
    raise InputError(f"{folder}: this is not good")


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PYTHONPATH", str(Path(__file__).parent))
        plan = gap.Plan(tmp_path_factory.mktemp("blind"), sets=2, processes=1, runs=(6,), keep_data=True)
        said: list[str] = []
        report = gap.run_blind_test(plan, "test_blind_bench:answers_nothing", said.append)
        yield plan, report, said


@pytest.mark.slow
def test_progress_tells_the_time_left_and_no_truth(finished):
    _, report, said = finished
    assert report["sets"] == 2
    assert any("about" in line and "to go" in line for line in said)
    truth = case(0).effects[0]["name"]
    assert not any(truth in line for line in said)


@pytest.mark.slow
def test_sets_are_spread_on_ray(finished, tmp_path, monkeypatch):
    pytest.importorskip("ray")
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(Path(__file__).parent), os.environ.get("PYTHONPATH", "")]))
    plan, alone, _ = finished
    said: list[str] = []
    plan = dataclasses.replace(plan, out=tmp_path)
    report = gap.run_blind_test(plan, "test_blind_bench:answers_nothing", said.append, ray="local")
    assert [line.partition(":")[0] for line in said if "to go" in line] == [f"1/2  {FIRST}", f"2/2  {SECOND}"]
    timed = {"median_seconds", "seconds", "wall_seconds"}
    assert {k: v for k, v in report.items() if k not in timed} == {k: v for k, v in alone.items() if k not in timed}


def test_truths_are_sealed_away_from_the_data(finished):
    plan, _, said = finished
    sealed = list((plan.out / "sealed").iterdir())
    assert len(sealed) == 1
    truths = yaml.safe_load(sealed[0].read_text())
    assert truths[FIRST]["effects"][0]["name"] == case(0).effects[0]["name"]
    assert any("sha256" in line for line in said)
    text = "".join(file.read_text() for file in (plan.out / "data").rglob("*.yaml"))
    assert truths[FIRST]["effects"][0]["name"] not in text


def test_data_are_valid_measured_runs(finished):
    plan, _, _ = finished
    runs = read_dataset(plan.out / "data" / SECOND).runs
    assert len(runs) == 1
    assert {finding.kind for finding in runs[0].findings} <= {"gap"}


def test_results_say_what_they_are_about_and_what_made_them(finished):
    plan, report, _ = finished
    made = [gap.read_result(plan.result_file(one))["blind_test"] for one in plan.cases()]
    assert all(one["runs"] == [6] and len(one["truth_sha256"]) == 64 for one in made)
    assert made[0]["truth_sha256"] != made[1]["truth_sha256"]
    assert report["commits"] == Counter(one["commit"] or "unknown" for one in made)


def test_results_hold_the_hash_of_their_data(finished, tmp_path):
    plan, _, _ = finished
    one = case(1)
    made = gap.read_result(plan.result_file(one))["blind_test"]
    assert gap.make_data(tmp_path / "again", one, (6,)) == made["data_sha256"]
    assert gap.make_data(tmp_path / "other", dataclasses.replace(one, camera=not one.camera), (6,)) != made["data_sha256"]
    assert gap.make_data(tmp_path / "another", dataclasses.replace(one, seed=9), (6,)) != made["data_sha256"]


def test_results_of_other_data_are_refused(finished, tmp_path):
    plan = dataclasses.replace(finished[0], out=tmp_path)
    shutil.copytree(finished[0].out, tmp_path, dirs_exist_ok=True)
    with pytest.raises(InputError, match=rf"{FIRST}\.json: is about other runs \(\[6\]\)"):
        _again(dataclasses.replace(plan, runs=(5, 6)))
    file = plan.result_file(case(1))
    result = gap.read_result(file)
    result["blind_test"]["truth_sha256"] = "0" * 64
    file.write_text(json.dumps(result))
    with pytest.raises(InputError, match=rf"{SECOND}\.json: is about another hidden truth"):
        _again(plan)


def test_results_of_other_commits_are_counted(finished, tmp_path):
    plan = dataclasses.replace(finished[0], out=tmp_path)
    shutil.copytree(finished[0].out, tmp_path, dirs_exist_ok=True)
    old, other = plan.result_file(case(0)), plan.result_file(case(1))
    old.write_text(json.dumps({"verdict": "nothing_missing", "effects": []}))
    other.write_text(other.read_text().replace('"commit": ', '"commit": "abc", "was": '))
    report = _again(plan)
    assert report["commits"] == {"unknown": 1, "abc": 1}
    assert "Sets analysed by commit: unknown 1, abc 1." in gap.markdown(report)
    assert json.loads((tmp_path / "score.json").read_text())["commits"] == report["commits"]


def _again(plan):
    return gap.run_blind_test(plan, "no_such_module:analyse", lambda line: None)


def test_goes_on_where_it_stopped(finished):
    plan, report, _ = finished
    said: list[str] = []
    assert gap.run_blind_test(plan, "test_blind_bench:refuses_and_fails", said.append) == report
    assert not any("to go" in line for line in said)


@pytest.mark.slow
def test_goes_on_from_the_answers_of_another_folder(finished, tmp_path):
    first, report, _ = finished
    plan = dataclasses.replace(first, out=tmp_path / "again")
    answers = first.out / "answers.json"
    assert gap.run_blind_test(plan, "no_such_module:analyse", lambda line: None, answers) == report
    assert (plan.out / "answers.json").read_text() == answers.read_text()
    longer = dataclasses.replace(plan, out=tmp_path / "longer", sets=3)
    assert gap.run_blind_test(longer, "no_such_module:analyse", lambda line: None, answers)["failed"] == [THIRD]
    one_more = dataclasses.replace(longer, out=tmp_path / "one_more")
    failed = longer.out / "answers.json"  # not taken over: the reason may be the other machine's
    assert gap.run_blind_test(one_more, "test_blind_bench:answers_nothing", lambda line: None, failed)["failed"] == []


def test_a_result_that_is_there_is_not_replaced_by_an_answer(finished, tmp_path):
    plan = dataclasses.replace(finished[0], out=tmp_path)
    shutil.copytree(finished[0].out, tmp_path, dirs_exist_ok=True)
    file, answers = plan.result_file(case(0)), json.loads((tmp_path / "answers.json").read_text())
    file.write_text(json.dumps(gap.read_result(file) | {"verdict": "not_excited"}))
    other = tmp_path / "other.json"
    other.write_text(json.dumps(answers))
    gap.run_blind_test(plan, "no_such_module:analyse", lambda line: None, other)
    assert gap.read_answers(tmp_path / "answers.json")[FIRST]["verdict"] == "not_excited"


def test_answers_hold_all_that_the_score_reads(tmp_path):
    estimate = {"value": 0.2, "ci95": [0.1, 0.3], "unit": "N m"}
    effect = {"name": "coulomb_friction", "where": ["leg_lf"], "parameters": {"torque": estimate}, "confidence": 0.9}
    numbers = {"reduction": 0.8, "reduction_ci95": [0.5, 0.9], "heldout_after": 1.2, "heldout_calibrated": 2.0}
    result = {"verdict": "effect_found", "effects": [effect], "equivalent": [["coulomb_friction", "payload"]], "gap": numbers}
    plan = gap.Plan(tmp_path, sets=24)
    truths = {one.name: one.as_dict() for one in plan.cases()}
    gap.make_output_folder(tmp_path / "results")
    for one in plan.cases():
        made = {"commit": "abc", **gap._subject(plan, one)}
        plan.result_file(one).write_text(json.dumps(result | {"wall_seconds": 7.0, "evidence": [1], "blind_test": made}))
    gap.write_answers(tmp_path)
    answers = gap.read_answers(tmp_path / "answers.json")
    assert "evidence" not in answers[FIRST]
    assert score(answers, truths) == score(
        {name: gap.read_result(tmp_path / "results" / f"{name}.json") for name in truths}, truths
    )


def test_answers_to_other_sets_are_refused_whole(finished, tmp_path):
    plan = dataclasses.replace(finished[0], out=tmp_path / "out")
    answers = gap.read_answers(finished[0].out / "answers.json")
    answers[SECOND]["blind_test"]["runs"] = [5, 6]
    file = tmp_path / "answers.json"
    file.write_text(json.dumps(answers))
    with pytest.raises(InputError, match=rf"answers\.json: is about other runs \(\[5, 6\]\) than set {SECOND}"):
        gap.run_blind_test(plan, "no_such_module:analyse", lambda line: None, file)
    assert not plan.out.exists()


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (None, "cannot be read as answers"),
        ("{", "cannot be read as answers"),
        ("[]", "expected a mapping of sets to answers"),
        (json.dumps({FIRST: {"effects": []}}), f"{FIRST}: expected a mapping with a verdict"),
        (json.dumps({FIRST: {"verdict": "effect_found", "effects": 5}}), f"{FIRST}: effects: expected a list of mappings"),
        (json.dumps({FIRST: {"verdict": "nothing_missing"}}), f"{FIRST}: blind_test: expected a mapping with truth_sha256"),
    ],
)
def test_answers_that_are_none_are_refused(tmp_path, text, message):
    file = tmp_path / "answers.json"
    if text is not None:
        file.write_text(text)
    with pytest.raises(InputError, match=rf"answers\.json: {message}"):
        gap.run_blind_test(gap.Plan(tmp_path / "out", 1), "no_such_module:analyse", lambda line: None, file)


def test_errors_of_the_workflow_are_its_answers(tmp_path, monkeypatch):
    monkeypatch.setattr(gap, "git_commit", lambda: "abc-dirty")
    plan = gap.Plan(tmp_path, sets=1, runs=(6,))
    said = f"data/{case(0).name}: this is not good".replace("/", os.sep)  # without the folder of this machine
    for index, verdict, message in ((0, "refused", said), (1, "failed", "ZeroDivisionError: a bug")):
        gap.make_output_folder(tmp_path / "results")
        gap.run_case(plan, case(index), refuses_and_fails)
        result = json.loads((tmp_path / "results" / f"{case(index).name}.json").read_text())
        assert (result["verdict"], result["message"]) == (verdict, message)
        assert result["blind_test"]["commit"] == "abc-dirty"
        assert not (tmp_path / "data" / case(index).name).exists(), "data are not kept unless asked for"


def test_a_process_that_dies_has_failed(tmp_path):
    report = gap.run_blind_test(gap.Plan(tmp_path, sets=1, processes=1, runs=(6,)), "no_such_module:analyse", lambda line: None)
    assert report["failed"] == [FIRST]
    result = gap.read_result(tmp_path / "results" / f"{FIRST}.json")
    assert "No module named 'no_such_module'" in result["message"]
    assert result["blind_test"]["runs"] == [6]


def test_report_reads_as_a_table(finished):
    _, report, _ = finished
    text = gap.markdown(report)
    assert "| false alarms, parameters only | 0/1 = 0% (at most 95%)" in text
    assert "| parameters only | nothing_missing 1 |" in text
    assert "| analyses that crashed | 0/2 = 0% (at most 78%) | 0 | yes |" in text
    assert len({line.what for line in gap.lines(report)}) == 27


def test_same_seed_same_bits_whatever_else_runs(tmp_path):
    first, again = tmp_path / "a", tmp_path / "b"
    gap.make_data(first, case(3), (6,))
    gap.make_data(tmp_path / "other", case(0), (6,))
    gap.make_data(again, case(3), (6,))
    pd.testing.assert_frame_equal(
        pd.read_parquet(first / "run_01.parquet"), pd.read_parquet(again / "run_01.parquet"), check_exact=True
    )


@pytest.mark.parametrize("text", ["something else", "{", ""])
def test_a_seal_that_is_none_is_refused(tmp_path, text):
    plan = gap.Plan(tmp_path, sets=1)
    gap.make_output_folder(tmp_path / "sealed")
    (tmp_path / "sealed" / f"truths_{FIRST_SCORED_SEED}_1.yaml").write_text(text)
    with pytest.raises(InputError, match=rf"truths_{FIRST_SCORED_SEED}_1\.yaml: holds no truths"):
        gap.seal(plan, plan.cases())


@pytest.mark.parametrize(("first", "second"), [(2, 3), (3, 2), (2, 2)])
def test_a_test_of_any_length_must_have_the_same_truths(tmp_path, first, second):
    gap.make_output_folder(tmp_path / "sealed")
    gap.seal(gap.Plan(tmp_path, first), gap.Plan(tmp_path, first).cases())
    plan = gap.Plan(tmp_path, second)
    same = plan.cases()
    with pytest.raises(
        InputError, match=rf"truths_{FIRST_SCORED_SEED}_{first}\.yaml: holds other truths .*1 sets, first {SECOND}"
    ):
        gap.seal(plan, [same[0], dataclasses.replace(same[1], severity=9.0), *same[2:]])
    assert len(list((tmp_path / "sealed").iterdir())) == 1
    gap.seal(plan, same)
    assert (tmp_path / "sealed" / f"truths_{FIRST_SCORED_SEED}_{second}.yaml").is_file()


def test_a_value_without_its_bound_is_not_shown():
    good = {"hits": 0, "count": 3, "share": 0.0, "bound95": 0.63}
    assert gap.judged("alarms", good, "at most", 0.05).met == "not shown"
    assert gap.judged("alarms", {**good, "bound95": 0.049}, "at most", 0.05).met == "yes"
    assert gap.judged("alarms", {**good, "hits": 1, "share": 0.33}, "at most", 0.05).met == "no"
    assert gap.judged("names", {"hits": 9, "count": 10, "share": 0.9, "bound95": 0.6}, "at least", 0.85).met == "not shown"
    assert gap.never("crashes", good).met == "yes"
    assert gap.never("crashes", {**good, "hits": 1}).met == "no"
    assert gap.judged("alarms", good, "at most").met == ""


@pytest.mark.parametrize(
    ("share", "low", "high", "met"),
    [(0.94, 0.93, 0.97, "yes"), (0.94, 0.9, 0.97, "not shown"), (0.94, 0.93, 0.99, "not shown"), (0.91, 0.93, 0.97, "no")],
)
def test_intervals_may_be_too_wide_as_well(share, low, high, met):
    numbers = {"hits": 1, "count": 1, "share": share, "bound95": low, "bound95_above": high}
    assert gap.coverage(numbers).met == met


@pytest.mark.parametrize(
    ("median", "bound", "met"), [(0.9, 0.81, "yes"), (0.9, 0.7, "not shown"), (0.9, None, "not shown"), (0.7, 0.6, "no")]
)
def test_medians_are_held_to_their_bounds(median, bound, met):
    numbers = {"median": median, "at_least95": bound, "at_most95": None, "count": 7}
    assert gap.judged("reduction", numbers, "at least", 0.8).met == met
    mirrored = {"median": -median, "at_most95": None if bound is None else -bound, "at_least95": None, "count": 7}
    assert gap.judged("error", mirrored, "at most", -0.8).met == met


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("gap", "--out", "DIR", "--answers", "answers.json"), "expected a mapping of sets to answers"),
        (("gap", "--out", "DIR", "--sets", "0"), "--sets"),
        (("decide", "--out", "DIR", "--processes", "0"), "--processes"),
        (("engine", "gap"), "run alone"),
    ],
)
def test_bad_options_of_a_study_are_named(words, said, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "answers.json").write_text("[]")
    assert main(list(words)) == 2
    assert said in capsys.readouterr().err
