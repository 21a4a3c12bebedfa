"""What commands print and ask: the one table of all commands, results as JSON, questions to whoever is there."""

from __future__ import annotations

import contextlib
import itertools
import re
import sys
import textwrap
from collections.abc import Iterable, Iterator, Sequence
from contextvars import ContextVar
from typing import TYPE_CHECKING, Any, TextIO

from wlr_gym.base.errors import InputError
from wlr_gym.base.text import json_text

if TYPE_CHECKING:
    from rich.console import Console

    from wlr_gym.data.excitations import Motion
    from wlr_gym.hardware.config import Hardware
    from wlr_gym.robot import Robot

#: Blanks between two columns of a table, where there is room and where there is little.
_GAPS = (2, 1)
#: A column of texts is made no narrower than this to have another beside it.
_LEAST_TEXT = 14
_HARD_SPACE = "\N{NO-BREAK SPACE}"
_SIZE = r"[-+]?[\d.,]*\d(e[-+]\d+)?%?"
_UNIT = r"[^\W\d][^\s,;:.)]{0,4}(?![^\s,;:.)])"
_ERROR = r"(±|\+-) ?[\d.]+"
#: What stays together in a text: a little in brackets, a number with its unit and its error.
_TOGETHER = re.compile(rf"\[[^][]{{0,40}}\]|{_SIZE}( {_UNIT})?( {_ERROR})?( {_UNIT})?|{_ERROR}")
#: A cell of a column of numbers.
_NUMBER = re.compile(rf"-?|([<>=]+ )?{_SIZE}( \.\. {_SIZE})?( {_UNIT})?( {_ERROR})?( {_UNIT})?( \[[^][]*\])?( !)?")


class _Names(textwrap.TextWrapper):
    """Breaks a heading between words, and a name in it after an underscore, a comma or an equals sign."""

    wordsep_simple_re = re.compile(r"( +|(?<=[_,=])(?=\w))")


class _Column:
    """A column of a table: heading, cells, whether these are numbers, its natural and its least width."""

    def __init__(self, heading: str, cells: Sequence[str]) -> None:
        self.is_number = all(_NUMBER.fullmatch(cell) for cell in cells)
        self.cells = [_TOGETHER.sub(lambda one: one[0].replace(" ", _HARD_SPACE), cell) for cell in cells]
        widest = max((len(line) for cell in cells for line in cell.split("\n")), default=0)
        words = [word for cell in self.cells for word in cell.replace("\n", " ").split(" ")]
        words += _Names(1, break_long_words=False, break_on_hyphens=False).wrap(heading)
        self.least = max(1, 0 if self.is_number else min(widest, _LEAST_TEXT), *map(len, words))
        self.heading, self.natural = heading, max(widest, len(heading), self.least)


def print_table(
    console: Console, headings: Sequence[str], rows: Iterable[Sequence[str]], title: str = "", styles: Sequence[str] = ()
) -> None:
    """Print a table in the width of the console.

    Columns that do not fit beside the others follow below, each time with the first column.

    Args:
        console: where to.
        headings: of the columns.
        rows: of cells; a cell with line breaks has several lines.
        title: above the table.
        styles: of each row; none = plain.
    """
    columns = [_Column(str(heading), list(map(str, cells))) for heading, *cells in zip(headings, *rows, strict=True)]
    if title:
        console.print(title, style="bold", markup=False, highlight=False)
    while columns:
        least = list(itertools.accumulate(column.least for column in columns))
        gap = next((gap for gap in _GAPS if least[-1] + gap * (len(columns) - 1) <= console.width), _GAPS[0])
        count = max(2, sum(width + gap * k <= console.width for k, width in enumerate(least)))
        _print_columns(console, columns[:count], gap, styles)
        columns = [columns[0], *columns[count:]] if count < len(columns) else []


def _print_columns(console: Console, columns: Sequence[_Column], gap: int, styles: Sequence[str]) -> None:
    """Print columns beside each other, without the blanks that fill the last one."""
    from rich.table import Table
    from rich.text import Text

    table = Table(box=None, padding=(0, gap, 0, 0), pad_edge=False)
    widths = _widths(columns, console.width - gap * (len(columns) - 1))
    for index, (column, width) in enumerate(zip(columns, widths, strict=True)):
        justify = "right" if index and column.is_number else "left"
        heading = Text(_Names(width, break_on_hyphens=False).fill(column.heading))
        table.add_column(heading, justify=justify, overflow="fold", width=width)
    cells = [[_wrapped(cell, width) for cell in column.cells] for column, width in zip(columns, widths, strict=True)]
    for index, row in enumerate(zip(*cells, strict=True)):
        table.add_row(*map(Text, row), style=styles[index] if styles else "")
    with console.capture() as drawn:
        console.print(table)
    for line in Text.from_ansi(drawn.get().replace(_HARD_SPACE, " ")).split():
        line.rstrip()
        console.print(line, soft_wrap=True)
    console.print()


def _wrapped(cell: str, width: int) -> str:
    """Break the lines of a cell between words; what is indented stays so."""
    lines = []
    for line in cell.split("\n"):
        indent = line[: len(line) - len(line.lstrip())]
        lines += textwrap.wrap(line, width, subsequent_indent=indent, break_on_hyphens=False, break_long_words=False) or [""]
    return "\n".join(lines)


def _widths(columns: Sequence[_Column], room: int) -> list[int]:
    """Return the widths of columns: one upper bound for all, as large as there is room; least widths are kept if all fit."""
    kept = ([min(one.natural, max(one.least, bound)) for one in columns] for bound in range(room, 0, -1))
    broken = ([min(one.least, bound) for one in columns] for bound in range(room, 0, -1))
    return next((widths for widths in itertools.chain(kept, broken) if sum(widths) <= room), [1] * len(columns))


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
    """Print results as JSON; see :func:`wlr_gym.base.text.json_text`."""
    print(json_text(content), file=_OUTPUT.get() or sys.stdout, flush=True)


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
