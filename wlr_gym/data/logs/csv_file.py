"""Read CSV files as other programs write them: what separates, which encoding, where the names of the columns are."""

from __future__ import annotations

import codecs
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from wlr_gym.base.errors import InputError
from wlr_gym.data.logs.topics import Share, cannot_read

if TYPE_CHECKING:
    import pandas

#: Rows that are read at a time.
ROWS = 8192
#: First bytes of a file -> its encoding.
_MARKS = (
    (codecs.BOM_UTF8, "utf-8-sig"), (codecs.BOM_UTF32_LE, "utf-32"),
    (codecs.BOM_UTF16_LE, "utf-16"), (codecs.BOM_UTF16_BE, "utf-16"),
)  # fmt: skip
#: What comment lines begin with.
_COMMENTS = ("#", "%", "//")
_HEAD, _TAIL = 2**16, 2**16


@dataclass(frozen=True)
class _Dialect:
    """How a CSV file is written: encoding, separator, decimal point, lines before the rows, and the names of the columns."""

    encoding: str
    separator: str
    decimal: str
    skipped: int
    names: tuple[str, ...]


def csv_frames(path: Path, notes: list[str], tell: Share) -> Iterator[tuple[pandas.DataFrame, str]]:
    """Yield the rows of a CSV file, :data:`ROWS` at a time, with its decimal point; texts stay texts.

    Commas, semicolons, tabs or blanks separate; with all but the first, numbers may have a decimal comma. Comment lines before
    the names are left out, and so is a last row that was cut off.

    Raises:
        InputError: no such file.
    """
    import pandas

    try:
        dialect = _dialect(path)
        separator = r"\s+" if dialect.separator == " " else dialect.separator
        size = max(path.stat().st_size, 1)
        with path.open("rb") as file:
            chunks = pandas.read_csv(
                file, chunksize=ROWS, skipinitialspace=True, encoding=dialect.encoding, sep=separator, decimal=dialect.decimal,
                header=None, names=list(dialect.names), skiprows=dialect.skipped, index_col=False, low_memory=False,
            )  # fmt: skip
            before: pandas.DataFrame | None = None
            for chunk in chunks:
                if before is not None:
                    yield before, dialect.decimal
                before = chunk
                tell(min(file.tell() / size, 1.0))
        if before is not None and _is_cut(path, dialect):
            notes.append(f"the last row was cut off: left out (row {int(before.index[-1])})")
            before = before.iloc[:-1]
        if before is not None and len(before):
            yield before, dialect.decimal
    except (OSError, ValueError, pandas.errors.ParserError, pandas.errors.EmptyDataError) as error:
        raise cannot_read(path, "csv", error) from None


def _dialect(path: Path) -> _Dialect:
    with path.open("rb") as file:
        head = file.read(_HEAD)
    encoding = next((name for mark, name in _MARKS if head.startswith(mark)), "utf-8")
    if encoding == "utf-8" and head[:200].count(0):
        half = "utf-16-le" if head[1:200:2].count(0) > head[0:200:2].count(0) else "utf-16-be"
        encoding = half if head[:200].count(0) > 50 else encoding
    decoder = codecs.getincrementaldecoder(encoding)()
    try:
        text = decoder.decode(head)
    except UnicodeDecodeError:
        if encoding != "utf-8":
            raise
        encoding, text = "cp1252", head.decode("cp1252", errors="replace")
    if "\0" in text:
        raise InputError(f"{path}: holds bytes that are no text")
    lines = text.splitlines()
    skipped, separator = _lines_before(lines)
    if skipped >= len(lines):
        raise InputError(f"{path}: no row in it")
    separator = separator or _separator(lines[skipped])
    fields = _split(lines[skipped], separator)
    first = [field for field in fields if field][:1]
    if skipped and first and _all_numbers(first):  # names in the last comment, as numpy and rostopic write them
        comment = _split(lines[skipped - 1].lstrip("#%/ "), separator)
        if len(comment) == len(fields):
            fields, skipped = comment, skipped - 1
    if _all_numbers(fields):
        raise InputError(f"{path}: its first line holds numbers, not the names of columns: '{lines[skipped][:60]}'")
    decimal = _decimal(lines[skipped + 1 :], separator) if separator != "," else "."
    return _Dialect(encoding, separator, decimal, skipped + 1, tuple(_unique(fields, path)))


def _lines_before(lines: list[str]) -> tuple[int, str]:
    """Return how many lines come before the names, and the separator that one of them says (``sep=;``)."""
    separator = ""
    for k, line in enumerate(lines):
        said = re.fullmatch(r"\"?sep=(.)\"?", line.strip())
        separator = said.group(1) if said else separator
        if not said and line.strip() and not line.lstrip().startswith(_COMMENTS):
            return k, separator
    return len(lines), separator


def _separator(names: str) -> str:
    found = max(",;\t", key=names.count)
    return found if names.count(found) else " "


def _decimal(rows: list[str], separator: str) -> str:
    """Return the sign that more fields of some rows have in a number; a row of whole numbers, or a remark, says nothing."""
    cells = [cell for row in rows for cell in _split(row, separator)]
    found = [number.group(1) for cell in cells if (number := re.fullmatch(r"[-+]?\d*([.,])\d+([eE][-+]?\d+)?", cell))]
    return max(".,", key=found.count)


def _split(line: str, separator: str) -> list[str]:
    import csv

    if separator == " ":
        return line.split()
    return [field.strip() for field in next(csv.reader([line], delimiter=separator, skipinitialspace=True), [])]


def _unique(names: list[str], path: Path) -> list[str]:
    """Return the names of columns, those without one by their place; refuse a name that occurs twice."""
    named = [name or f"column {k}" for k, name in enumerate(names)]
    repeated = next((name for k, name in enumerate(named) if name in named[:k]), None)
    if repeated is not None:
        raise InputError(f"{path}: column '{repeated}' occurs twice")
    return named


def _all_numbers(fields: list[str]) -> bool:
    return all(re.fullmatch(r"[-+]?[\d.,]+([eE][-+]?\d+)?|nan|NaN|", field.strip()) for field in fields)


def _is_cut(path: Path, dialect: _Dialect) -> bool:
    """Whether the last line has no end, and fewer fields than there are columns."""
    with path.open("rb") as file:
        file.seek(max(path.stat().st_size - _TAIL, 0))
        tail = file.read()
    encoding = {"utf-16": "utf-16-be" if tail[:1] == b"\0" else "utf-16-le", "utf-8-sig": "utf-8"}.get(
        dialect.encoding, dialect.encoding
    )
    lines = tail.decode(encoding, errors="ignore").splitlines(keepends=True)
    last = lines[-1] if lines else ""
    return not last.endswith(("\n", "\r")) and len(_split(last, dialect.separator)) < len(dialect.names)
