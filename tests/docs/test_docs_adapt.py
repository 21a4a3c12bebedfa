"""docs/adapt.md has the table that its data file gives."""

from pathlib import Path

import pytest

pytest.importorskip("torch")
pytest.importorskip("dynamixel_sdk")

from wlr_gym.studies.bench.adapt_study import read_lines
from wlr_gym.studies.bench.adapt_table import markdown

DOCS = Path(__file__).resolve().parents[2] / "docs"


def test_the_table_is_that_of_the_data():
    table = markdown(read_lines(DOCS / "data" / "adapt.jsonl")).strip()
    assert table in (DOCS / "adapt.md").read_text(encoding="utf-8")
