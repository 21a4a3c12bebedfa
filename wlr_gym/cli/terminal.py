"""What commands print and ask: the one table of all commands, results as JSON, questions to whoever is there."""

from __future__ import annotations

import contextlib
import dataclasses
import json
import math
import re
import sys
import textwrap
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextvars import ContextVar
from pathlib import Path
from typing import TYPE_CHECKING, Any, TextIO

import numpy as np

from wlr_gym.base.errors import InputError

if TYPE_CHECKING:
    from rich.console import Console
    from rich.table import Table

    from wlr_gym.data.excitations import Motion
    from wlr_gym.hardware.config import Hardware
    from wlr_gym.robot import Robot

#: Columns between two columns of a table, where there is room and where there is little.
_GAPS = (2, 1)
#: A column of a text is made no narrower than this to have another beside it.
_LEAST_TEXT = 14
_HARD_SPACE = "\N{NO-BREAK SPACE}"
_SIZE = r"[-+]?[\d.,]*\d(e[-+]\d+)?%?"
_UNIT = r"[^\W\d][^\s,;:.)]{0,4}(?![^\s,;:.)])"
_ERROR = r"(±|\+-) ?[\d.]+"
#: What stays together in a text: a little in brackets, a number with its unit and its error.
_TOGETHER = re.compile(rf"\[[^][]{{0,40}}\]|{_SIZE}( {_UNIT})?( {_ERROR})?( {_UNIT})?|{_ERROR}")
#: A cell of a column of numbers.
_NUMBER = re.compile(rf"-?|([<>=]+ )?{_SIZE}( \.\. {_SIZE})?( {_UNIT})?( {_ERROR})?( {_UNIT})?( \[[^][]*\])?( !)?")


class _Words(textwrap.TextWrapper):
    """Breaks a text between words."""

    wordsep_simple_re = re.compile(r"( +)")


class _Names(textwrap.TextWrapper):
    """Breaks a heading between words, and a name in it after an underscore, a comma or an equals sign."""

    wordsep_simple_re = re.compile(r"( +|(?<=[_,=])(?=\w))")


def print_table(
    console: Console, headings: Sequence[str], rows: Iterable[Sequence[str]], title: str = "", styles: Sequence[str] = ()
) -> None:
    """Print a table in the width of the console.

    Where all columns do not fit beside each other, those that are left follow below, each time with the first column.

    Args:
        console: where to.
        headings: of the columns.
        rows: of cells; a cell with line breaks has several lines.
        title: above the table.
        styles: of each row; none = plain.
    """
    table = [[str(cell).replace("\n", " ") for cell in headings], *([str(cell) for cell in row] for row in rows)]
    columns = [list(column) for column in zip(*table, strict=True)]
    if title:
        console.print(title, style="bold", markup=False, highlight=False)
    while columns:
        count, gap = _fitting(columns, console.width)
        _print_lines(console, _drawn(columns[:count], gap, console.width, styles))
        console.print()
        columns = [columns[0], *columns[count:]] if count < len(columns) else []


def _print_lines(console: Console, table: Table) -> None:
    """Print a table without the spaces that fill its last column."""
    from rich.text import Text

    with console.capture() as drawn:
        console.print(table)
    for line in Text.from_ansi(drawn.get()).split():
        line.rstrip()
        console.print(line, soft_wrap=True)


def _fitting(columns: Sequence[Sequence[str]], width: int) -> tuple[int, int]:
    """Return how many of the columns fit beside each other, two at least, and the gap between them."""
    least = [_least(column) for column in columns]
    for gap in _GAPS:
        if sum(least) + gap * (len(columns) - 1) <= width:
            return len(columns), gap
    fitting = [k for k in range(2, len(columns)) if sum(least[:k]) + _GAPS[0] * (k - 1) <= width]
    return max(fitting, default=min(2, len(columns))), _GAPS[0]


def _drawn(columns: Sequence[Sequence[str]], gap: int, width: int, styles: Sequence[str]) -> Table:
    from rich.table import Table
    from rich.text import Text

    table = Table(box=None, padding=(0, gap, 0, 0), pad_edge=False)
    widths = _widths(columns, width - gap * (len(columns) - 1))
    for index, (column, wide) in enumerate(zip(columns, widths, strict=True)):
        justify = "right" if index and _is_number(column[1:]) else "left"
        heading = Text("\n".join(_lines(column[0], wide, _Names)))
        table.add_column(heading, justify=justify, vertical="top", overflow="fold", width=wide)
    for index, row in enumerate(list(zip(*columns, strict=True))[1:]):
        cells = (Text("\n".join(_lines(cell, wide, _Words))) for cell, wide in zip(row, widths, strict=True))
        table.add_row(*cells, style=styles[index] if styles else "")
    return table


def _widths(columns: Sequence[Sequence[str]], room: int) -> list[int]:
    """Return the widths of columns: one upper bound for all, as large as there is room; none below its least, if all fit."""
    natural = [max(len(line) for cell in column for line in cell.split("\n")) for column in columns]
    least = [min(_least(column), most) for column, most in zip(columns, natural, strict=True)]
    cap = next((c for c in range(max(least), 1, -1) if sum(min(few, c) for few in least) <= room), 1)
    found = least = [min(few, cap) for few in least]  # a word that is wider than the terminal is broken
    for bound in range(max(natural) + 1):
        tried = [min(most, max(few, bound)) for most, few in zip(natural, least, strict=True)]
        if sum(tried) > room:
            break
        found = tried
    return found


def _least(column: Sequence[str]) -> int:
    """Return the least width of a column: its longest word or number; of texts, what can still be read."""
    natural = max(len(line) for cell in column[1:] for line in cell.split("\n")) if column[1:] else 0
    heading = max((len(line) for line in _lines(column[0], 1, _Names)), default=0)
    words = max((len(line) for cell in column[1:] for line in _lines(cell, 1, _Words)), default=0)
    return max(heading, words, min(natural, _LEAST_TEXT) if not _is_number(column[1:]) else 0)


def _lines(text: str, width: int, wrapper: type[textwrap.TextWrapper]) -> list[str]:
    """Return a cell's lines; numbers stay together, and what is indented stays so."""
    found = []
    for line in text.split("\n"):
        kept = _TOGETHER.sub(lambda one: one[0].replace(" ", _HARD_SPACE), line)
        indent = line[: len(line) - len(line.lstrip())]
        broken = wrapper(max(width, 1), subsequent_indent=indent, break_long_words=False, break_on_hyphens=False)
        found += [part.replace(_HARD_SPACE, " ") for part in broken.wrap(kept) or [""]]
    return found


def _is_number(cells: Sequence[str]) -> bool:
    """Tell whether a column holds numbers, some of which may be missing."""
    return all(_NUMBER.fullmatch(cell) for cell in cells)


# ---- results as JSON, alone on the standard output: what else is printed goes to the standard error meanwhile ----------


#: The standard output, while only results may be printed on it.
_OUTPUT: ContextVar[TextIO | None] = ContextVar("output", default=None)


@contextlib.contextmanager
def only_results(wanted: bool) -> Iterator[None]:
    """Keep everything but :func:`print_json` from the standard output, where that is wanted."""
    if not wanted:
        yield
        return
    token = _OUTPUT.set(sys.stdout)
    try:
        with contextlib.redirect_stdout(sys.stderr):
            yield
    finally:
        _OUTPUT.reset(token)


def print_json(content: Any) -> None:
    """Print results as JSON; a number that is not finite is null, a dataclass an object of its fields."""
    print(json.dumps(plain(content), indent=2, allow_nan=False), file=_OUTPUT.get() or sys.stdout, flush=True)


def plain(value: Any) -> Any:
    """Return a value of what JSON has."""
    match value:
        case float() if not math.isfinite(value):
            return None
        case None | bool() | int() | float() | str():
            return value
        case np.generic() | np.ndarray():
            return plain(value.tolist())
        case Mapping():
            return {str(key): plain(one) for key, one in value.items()}
        case list() | tuple() | set() | frozenset():
            return [plain(one) for one in value]
        case Path():
            return str(value)
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {field.name: plain(getattr(value, field.name)) for field in dataclasses.fields(value)}
    raise TypeError(f"{type(value).__name__}: JSON has no such value")


# ---- questions -------------------------------------------------------------------------------------------------------


def confirm(motion: Motion, robot: Robot, hardware: Hardware, console: Console) -> None:
    """Say what the robot is about to do, and wait for Enter; before every motion: after one it lies elsewhere, torque off.

    Raises:
        InputError: a port is not there, or nobody is.
    """
    from wlr_gym.hardware.operator import KEYS_SAID
    from wlr_gym.hardware.safety.preflight import require_ports

    require_ports(hardware)
    travel = motion.travel(robot.wheel.radius)
    rolled = f"{travel[-1]:+.1f} m in all, from {travel.min():+.1f} to {travel.max():+.1f} m on the way (+ is forward)"
    console.print(f"The robot will stand up and drive {motion.name}: {motion.duration:.0f} s; it rolls {rolled}.")
    console.print(KEYS_SAID, style="dim")
    wait_for_enter(console, "Free floor, or wheels off the ground? Hand on the switch?")


def wait_for_enter(console: Console, question: str, action: str = "start the robot", otherwise: str = ", or say --yes") -> None:
    """Ask the operator, and wait for Enter.

    Args:
        console: to ask on.
        question: what is asked.
        action: what Enter does.
        otherwise: what else can be done where nobody is there.

    Raises:
        InputError: nobody there.
        KeyboardInterrupt: anything else was typed, such as "n".
    """
    try:
        answer = console.input(f"[bold]{question} Enter to {action}, Ctrl-C not to. ")
    except EOFError:
        raise InputError(f"nobody there to {action}: run it on a terminal{otherwise}") from None
    if answer.strip().lower() not in ("", "y", "yes"):
        raise KeyboardInterrupt(f"asked not to {action}")


class NobodyThereError(InputError):
    """Questions cannot be answered."""


def ask_terminal(text: str, what: str = "calibration") -> str:
    """Ask on the terminal; ``what`` is the dialogue that the question is of.

    Raises:
        NobodyThereError: the input is at its end.
    """
    try:
        return input(text + " ")
    except EOFError:
        raise NobodyThereError(f"{what} is a dialogue: run it on a terminal, or pipe its answers in") from None
