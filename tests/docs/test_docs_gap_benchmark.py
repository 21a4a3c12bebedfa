"""The result in docs/gap_benchmark.md is the score of docs/data/gap_answers.json."""

from __future__ import annotations

import pytest
from blocks import ROOT

from wlr_gym.studies.bench.blind.cases import FIRST_SCORED_SEED, case
from wlr_gym.studies.bench.gap import Plan, make_data, read_answers, run_blind_test
from wlr_gym.studies.bench.gap_score_table import markdown

ANSWERS = ROOT / "docs" / "data" / "gap_answers.json"


#: Sets whose data are made again, of those that have a hash of theirs: so many, spread over all.
MADE_AGAIN = 4


def first_seed(answers):
    return min(int(name.removeprefix("set_")) for name in answers)


def test_the_page_shows_the_score_of_the_answers(tmp_path):
    answers = read_answers(ANSWERS)
    first = first_seed(answers)
    before = first < FIRST_SCORED_SEED  # all sets had eight runs
    plan = Plan(tmp_path, sets=len(answers), first_seed=first, runs=tuple(range(8)) if before else ())
    said: list[str] = []
    report = run_blind_test(plan, "no_module:nothing_is_analysed", said.append, ANSWERS)
    assert f"{plan.sets} of {plan.sets} results are there already" in said
    assert markdown(report) in (ROOT / "docs" / "gap_benchmark.md").read_text(encoding="utf-8")


@pytest.mark.slow
def test_the_seeds_of_the_answers_give_the_data_they_are_about(tmp_path):
    answers = read_answers(ANSWERS)
    first = first_seed(answers)
    hashed = sorted(name for name, answer in answers.items() if "data_sha256" in answer["blind_test"])
    if not hashed:
        pytest.skip("the answers are of a version that kept no hash of the data")
    for name in hashed[:: max(1, len(hashed) // MADE_AGAIN)]:
        one = case(int(name.removeprefix("set_")) - first, first)
        assert make_data(tmp_path / name, one) == answers[name]["blind_test"]["data_sha256"], name
