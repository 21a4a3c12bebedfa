"""The numbers in docs/gap_benchmark.md are those of docs/data/gap_answers.json."""

from __future__ import annotations

import pytest
from blocks import ROOT, site_script

from wlr_gym.studies.bench.blind.cases import case
from wlr_gym.studies.bench.gap import make_data, read_answers

ANSWERS = ROOT / "docs" / "data" / "gap_answers.json"


#: Sets whose data are made again, of those that have a hash of theirs: so many, spread over all.
MADE_AGAIN = 4


def first_seed(answers):
    return min(int(name.removeprefix("set_")) for name in answers)


def test_the_page_shows_numbers_of_the_score():
    page = (ROOT / "docs" / "gap_benchmark.md").read_text(encoding="utf-8").partition("\n## Result")[2]
    shown = [line for line in page.splitlines() if line.startswith("| ")]
    assert len(shown) > 10
    assert set(shown) <= set(site_script("tables").blind_test_table())


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
