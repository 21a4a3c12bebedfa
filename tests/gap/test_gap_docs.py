"""docs/gap.md says what the code does."""

import re
from pathlib import Path

from gap_examples import EFFECT_FOUND

from wlr_gym.gap.result import Result, result_of
from wlr_gym.gap.words import TITLES

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
    explained = set(re.findall(r"^- \*([a-z ]+)\*", PAGE, re.MULTILINE))
    assert explained == {
        "taken",
        "equivalent",
        "weaker",
        "too little",
        "inconsistent",
        "does not carry over",
        "implausible",
        "within tolerance",
        "screened out",
    }
    assert {one.outcome for one in EFFECT_FOUND.evidence} <= explained
