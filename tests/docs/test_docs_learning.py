"""docs/data/learning.json has every row that is promised, and README's numbers of Velocity are among them."""

from __future__ import annotations

from blocks import ROOT

from studies import learning


def test_every_row_that_is_promised_is_there():
    for task, found in learning.read_data().items():
        wanted = [(sensors, floors if isinstance(floors, str) else floors["name"]) for sensors, floors in learning.ROWS[task]]
        assert [(row["sensors"], row["floors"]) for row in found["rows"]] == wanted


def test_the_readme_has_the_numbers_of_velocity():
    rows = {(row["sensors"], row["floors"]): row for row in learning.read_data()["velocity"]["rows"]}
    error, low, high = rows["none", "slippery"]["tracking_error"]
    assert f"{error:.3f} [{low:.3f}, {high:.3f}]" in (ROOT / "README.md").read_text(encoding="utf-8")
