"""docs/gap.md says what the code does."""

import re
from pathlib import Path

from gap_examples import EFFECT_FOUND
from toy_problem import Toy

from wlr_gym.gap.report.result import Result, result_of
from wlr_gym.gap.report.text import TITLES
from wlr_gym.gap.validation.data_split import informative_split
from wlr_gym.gap.validation.held_out import LEAST_FOR_INTERVAL

PAGE = (Path(__file__).parents[2] / "docs" / "gap.md").read_text(encoding="utf-8")


def test_verdicts():
    table = PAGE.partition("<!-- verdicts")[2].partition("<!-- end of verdicts")[0]
    assert dict(re.findall(r"^\| `(\w+)` \| ([^|]+) \|", table, re.MULTILINE)) == TITLES


def test_keys_of_the_result():
    table = PAGE.partition("## The result file")[2]
    keys = {key for row in re.findall(r"^\| (`[^|]+) \|", table, re.MULTILINE) for key in re.findall(r"`(\w+)`", row)}
    assert keys == set(result_of(EFFECT_FOUND).model_dump())
    assert keys >= set(Result.model_fields)


def test_outcomes():
    explained = set(re.findall(r"^- \*([a-z -]+)\*", PAGE, re.MULTILINE))
    assert explained == {
        "selected",
        "equivalent",
        "worse fit",
        "too little",
        "inconsistent",
        "fails cross-validation",
        "implausible",
        "within tolerance",
        "removed",
        "rejected at screening",
    }
    assert {one.outcome for one in EFFECT_FOUND.evidence} <= explained


def test_runs_that_give_an_interval():
    held_out = {runs: len(informative_split(Toy(runs=runs, rows=30))[1]) for runs in (6, 7)}
    assert held_out[6] < LEAST_FOR_INTERVAL <= held_out[7]
    assert "(seven runs in all, or `--heldout`)" in " ".join(PAGE.split())
