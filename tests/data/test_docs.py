"""The tables of docs/run_format.md say what the code does."""

from __future__ import annotations

from pathlib import Path

from wlr_gym.data.format import COLUMNS
from wlr_gym.robot import JOINTS, LEGS

TEXT = (Path(__file__).parents[2] / "docs" / "run_format.md").read_text(encoding="utf-8")


def table(name: str) -> list[list[str]]:
    """Rows of the table between the two comments, cells stripped."""
    block = TEXT.split(f"<!-- {name}: ")[1].split(f"<!-- end of {name} -->")[0]
    lines = [line for line in block.splitlines() if line.startswith("|")]
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in lines[2:]]


def test_columns():
    documented = {}
    for names, unit, doc, missing in table("columns"):
        for name in names.replace("`", "").split():
            for joint in JOINTS if "<j>" in name else ("",):
                units = unit.replace(" (legs)", "").replace(" (wheels)", "").split(", ")
                documented[name.replace("<j>", joint)] = (units[0] if joint in LEGS else units[-1], doc, missing == "no")
    assert documented == {name: (column.unit, column.doc, column.required) for name, column in COLUMNS.items()}
    assert list(documented) == list(COLUMNS)
