"""docs/compare.md lists the excitations as they are."""

from pathlib import Path

from wlr_gym.data.excitations import EXCITATIONS

PAGE = Path(__file__).parents[2] / "docs" / "compare.md"
BEGIN, END = "test_docs_compare.py -->\n", "<!-- end of motions -->"


def test_motions_are_listed():
    rows = [f"| `{name}` | {excitation.doc} | {excitation.shows} |" for name, excitation in EXCITATIONS.items()]
    table = "\n".join(["| motion | what the robot does | what it shows |", "|---|---|---|", *rows, ""])
    assert PAGE.read_text(encoding="utf-8").partition(BEGIN)[2].partition(END)[0] == table
