"""The result in docs/gap_benchmark.md is the score of docs/data/gap_answers.json."""

from __future__ import annotations

from blocks import ROOT

from wlr_gym.studies.bench.gap import Plan, read_answers, run_blind_test
from wlr_gym.studies.bench.gap_score_table import markdown

ANSWERS = ROOT / "docs" / "data" / "gap_answers.json"


def test_the_page_shows_the_score_of_the_answers(tmp_path):
    plan = Plan(tmp_path, sets=len(read_answers(ANSWERS)), first_seed=4000, runs=tuple(range(8)))
    said: list[str] = []
    report = run_blind_test(plan, "no_module:nothing_is_analysed", said.append, ANSWERS)
    assert f"{plan.sets} of {plan.sets} results are there already" in said
    assert markdown(report) in (ROOT / "docs" / "gap_benchmark.md").read_text(encoding="utf-8")
