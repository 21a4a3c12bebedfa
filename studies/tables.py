"""Tables in Markdown, and how a study that is done hands over its lines."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from rich.console import Console

from wlr_gym.base.files import write_text
from wlr_gym.cli import OK
from wlr_gym.cli.terminal import print_json

#: Prints progress and tables as they are, on lines of any length.
plain_console = Console(soft_wrap=True, markup=False, highlight=False)


def markdown_table(headings: Sequence[str], rows: Iterable[Sequence[object]]) -> list[str]:
    """Return the lines of a table in Markdown; cells are put down as they are."""
    first, *others = (f"| {' | '.join(map(str, cells))} |" for cells in (headings, *rows))
    return [first, f"|{'---|' * len(headings)}", *others]


def hand_over(page: Path, text: str, results: Any, as_json: bool, *others: Path) -> int:
    """Write a study's tables to ``page`` and print them, its results as JSON where asked, and which files were written."""
    write_text(page, text)
    plain_console.print(text)
    if as_json:
        print_json(results)
    plain_console.print(f"written: {', '.join(map(str, (*others, page)))}")
    return OK
