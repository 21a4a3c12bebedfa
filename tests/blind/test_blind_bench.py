"""The blind test from end to end, with stand-ins for the workflow: sealing, resuming, failures, report."""

import json
from pathlib import Path

import pandas as pd
import pytest
import yaml

from wlr_gym.bench import gap
from wlr_gym.bench.blind.cases import case
from wlr_gym.cli import main
from wlr_gym.errors import InputError
from wlr_gym.runs import read_dataset


def answers_nothing(folder: Path, out: Path):
    """Stand-in: reads what it is given, says nothing is missing."""
    assert sorted(file.name for file in folder.iterdir()) == ["meta.yaml", "run_01.parquet"]
    assert not list(folder.parent.glob("*truth*"))
    return {"verdict": "nothing_missing", "effects": []}


def refuses_and_fails(folder: Path, out: Path):
    """Stand-in: an input error for even seeds, a programming error for odd ones."""
    if int(folder.name[-1]) % 2:
        raise ZeroDivisionError("a bug")
    raise InputError("this is not good")


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PYTHONPATH", str(Path(__file__).parent))
        yield _finish(tmp_path_factory)


def _finish(tmp_path_factory):
    plan = gap.Plan(tmp_path_factory.mktemp("blind"), sets=2, processes=1, runs=(6,), keep_data=True)
    said: list[str] = []
    report = gap.run_blind_test(plan, "test_blind_bench:answers_nothing", said.append)
    return plan, report, said


def test_progress_tells_the_time_left_and_no_truth(finished):
    _, report, said = finished
    assert report["sets"] == 2
    assert any("about" in line and "to go" in line for line in said)
    truth = case(0).effects[0]["name"]
    assert not any(truth in line for line in said)


def test_truths_are_sealed_away_from_the_data(finished):
    plan, _, said = finished
    sealed = list((plan.out / "sealed").iterdir())
    assert len(sealed) == 1
    truths = yaml.safe_load(sealed[0].read_text())
    assert truths["set_2000"]["effects"][0]["name"] == case(0).effects[0]["name"]
    assert any("sha256" in line for line in said)
    text = "".join(file.read_text() for file in (plan.out / "data").rglob("*.yaml"))
    assert truths["set_2000"]["effects"][0]["name"] not in text


def test_data_are_valid_measured_runs(finished):
    plan, _, _ = finished
    runs = read_dataset(plan.out / "data" / "set_2001").runs
    assert len(runs) == 1
    assert {finding.kind for finding in runs[0].findings} <= {"gap"}


def test_goes_on_where_it_stopped(finished):
    plan, report, _ = finished
    said: list[str] = []
    assert gap.run_blind_test(plan, "test_blind_bench:refuses_and_fails", said.append) == report
    assert not any("to go" in line for line in said)


def test_errors_of_the_workflow_are_its_answers(tmp_path):
    plan = gap.Plan(tmp_path, sets=1, runs=(6,))
    for index, verdict in ((0, "refused"), (1, "failed")):
        gap.make_output_folder(tmp_path / "results")
        gap.run_case(plan, case(index), refuses_and_fails)
        result = json.loads((tmp_path / "results" / f"{case(index).name}.json").read_text())
        assert result["verdict"] == verdict
        assert not (tmp_path / "data" / case(index).name).exists(), "data are not kept unless asked for"


def test_a_process_that_dies_has_failed(tmp_path):
    report = gap.run_blind_test(gap.Plan(tmp_path, sets=1, processes=1, runs=(6,)), "no_such_module:analyse", lambda line: None)
    assert report["failed"] == ["set_2000"]
    assert "No module named 'no_such_module'" in (tmp_path / "results" / "set_2000.json").read_text()


def test_report_reads_as_a_table(finished):
    _, report, _ = finished
    text = gap.markdown(report)
    assert "| false alarms, parameters only | 0/1 = 0% (at most 95%)" in text
    assert "| parameters only | nothing_missing 1 |" in text
    assert len(gap.lines(report)) == 15


def test_same_seed_same_bits_whatever_else_runs(tmp_path):
    first, again = tmp_path / "a", tmp_path / "b"
    gap.make_data(first, case(3), (6,))
    gap.make_data(tmp_path / "other", case(0), (6,))
    gap.make_data(again, case(3), (6,))
    pd.testing.assert_frame_equal(
        pd.read_parquet(first / "run_01.parquet"), pd.read_parquet(again / "run_01.parquet"), check_exact=True
    )


@pytest.mark.parametrize("numbers", [{"sets": 0}, {"sets": 1, "processes": 0}])
def test_impossible_plans_are_refused(tmp_path, numbers):
    with pytest.raises(InputError, match="expected 1 or more"):
        gap.Plan(tmp_path, **numbers)


def test_other_truths_in_the_same_folder_are_refused(tmp_path):
    plan = gap.Plan(tmp_path, sets=1)
    gap.make_output_folder(tmp_path / "sealed")
    (tmp_path / "sealed" / "truths_2000_1.yaml").write_text("something else")
    with pytest.raises(InputError, match="other truths"):
        gap.seal(plan, plan.cases())


def test_command_asks_for_what_it_needs(tmp_path, capsys):
    assert main(["bench", "gap"]) == 2
    assert "--out" in capsys.readouterr().err
    assert main(["bench", "gap", "engine", "--out", str(tmp_path)]) == 2
    assert "alone" in capsys.readouterr().err
