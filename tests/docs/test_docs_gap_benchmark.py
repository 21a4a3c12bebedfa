"""The answers in docs/data/gap_answers.json are about data that their seeds make; test_docs_tables.py: their score."""

from __future__ import annotations

import pytest
from blocks import ROOT

from studies.bench.blind.cases import case
from studies.bench.gap import make_data, read_answers

ANSWERS = ROOT / "docs" / "data" / "gap_answers.json"


#: Sets whose data are made again: so many, spread over all.
MADE_AGAIN = 4


@pytest.mark.slow
def test_the_seeds_of_the_answers_give_the_data_they_are_about(tmp_path):
    answers = read_answers(ANSWERS)
    names = sorted(answers)
    first = int(names[0].removeprefix("set_"))  # of the version that was scored
    for name in names[:: max(1, len(names) // MADE_AGAIN)]:
        one = case(int(name.removeprefix("set_")) - first, first)
        assert make_data(tmp_path / name, one) == answers[name]["blind_test"]["data_sha256"], name
