"""Read tables as recordings: CSV and Parquet with any columns, one of them the time, and LeRobot data sets of version 3.

CSV is read as other programs write it: whatever separates, whichever encoding, wherever the names of the columns are.
"""

from __future__ import annotations

import codecs
import csv
import json
import re
from collections.abc import Collection, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from wlr_gym.base.errors import InputError
from wlr_gym.data.logs.topics import LONGEST, Log, Share, Topic, cannot_read

if TYPE_CHECKING:
    import pandas

#: Name of the topic that a table's columns make.
TABLE = "table"
#: Columns that hold the time, by what is looked for first; the unit by ending, else by how far rows are apart.
TIME_NAMES = ("t", "time", "timestamp", "stamp", "times", "clock", "seconds", "log_time", "elapsed")
_ENDINGS = {"_ns": 1, "_us": 1_000, "_ms": 1_000_000, "_s": 1_000_000_000, "_sec": 1_000_000_000, "_nsec": 1}
_UNITS = {10**9: "s", 10**6: "ms", 10**3: "us", 1: "ns"}
#: ns; how far rows of a recording are apart: where the size says the unit, and where the name does.
_BY_SIZE, _BY_NAME = (5e5, 5e8), (1e4, 1e10)


def read_table(path: Path, wanted: Collection[str] | None = None, most: int | None = None) -> Log:
    """Read a CSV or Parquet file: one topic, whose fields are the columns that hold numbers.

    Args:
        path: the file.
        wanted: columns that are kept; None = all.
        most: rows that are read; None = all.

    Raises:
        InputError: not such a file, no column of times, or times that go back.
    """
    notes: list[str] = []
    frame, decimal = _csv(path, most, notes) if path.suffix.lower() == ".csv" else (_parquet(path, most), ".")
    name = _time_column([str(column) for column in frame.columns], path)
    if len(frame):
        frame, times = _with_times(frame, name, decimal, path, notes)
    if len(frame) < 2:
        raise InputError(f"{path}: {len(frame)} rows; a recording has at least 2")
    if (back := np.diff(times) < 0).any():
        raise InputError(f"{path}: row {frame.index[int(np.argmax(back)) + 1]}, column '{name}': times must increase")
    topic = numeric_topic(_with_numbers(frame.drop(columns=name), decimal, notes), times, wanted)
    return Log(path, {TABLE: topic}, tuple(notes), known=frozenset([TABLE]))


def _parquet(path: Path, most: int | None) -> pandas.DataFrame:
    import pandas
    import pyarrow

    try:
        frame = pandas.read_parquet(path)
    except (OSError, ValueError, pyarrow.ArrowException) as error:
        raise cannot_read(path, "parquet", error) from None
    if frame.index.name is not None:
        frame = frame.reset_index()
    frame.columns = [str(column).strip() for column in frame.columns]
    return frame[:most].reset_index(drop=True)


def numeric_topic(frame: pandas.DataFrame, times: NDArray[np.int64], wanted: Collection[str] | None) -> Topic:
    """Return a table's columns that hold numbers as fields; of times (ns) that are given."""
    import pandas

    rows = np.arange(len(frame), dtype=np.int64)
    fields = {}
    names = [str(name) for name in frame.columns if pandas.api.types.is_numeric_dtype(frame[name])]
    for name in names if wanted is None else [name for name in names if name in wanted]:
        values = frame[name].to_numpy(np.float64, na_value=np.nan)
        known = np.isfinite(values)
        fields[name] = (rows, values) if known.all() else (rows[known], values[known])
    return Topic(TABLE, TABLE, np.asarray(times, np.int64), None, fields, known=frozenset(names))


# ---- texts of a table: times and numbers -----------------------------------------------------------------------------


def _with_numbers(frame: pandas.DataFrame, decimal: str, notes: list[str]) -> pandas.DataFrame:
    """Return a table whose texts are numbers where they can be; note which columns hold others."""
    import pandas

    changed: dict[str, Any] = {}
    texts, mixed = [], []
    for name in map(str, frame.columns):
        if _is_read(frame[name]):
            continue
        numbers: Any = pandas.to_numeric(_texts(frame[name], decimal), errors="coerce")
        if not numbers.notna().any():
            texts += [name] if name.lower() not in TIME_NAMES else []
            continue
        changed[name] = numbers
        if (numbers.isna() & frame[name].notna()).any():
            mixed.append(name)
    notes += [f"columns that hold no numbers: {', '.join(texts)}; left out"] if texts else []
    notes += [f"columns that hold texts beside numbers: {', '.join(mixed)}; the texts are left out"] if mixed else []
    return frame.assign(**changed)


def _is_read(column: Any) -> bool:
    """Whether a column holds numbers or dates already."""
    import pandas

    return pandas.api.types.is_numeric_dtype(column) or pandas.api.types.is_datetime64_any_dtype(column)


def _texts(column: Any, decimal: str) -> Any:
    """Return a column's texts with a decimal point; a column that is read already as it is."""
    if _is_read(column):
        return column
    text = column.astype(str).str.strip()
    return text.str.replace(",", ".", regex=False) if decimal == "," else text


def _time_column(columns: list[str], path: Path) -> str:
    lowered = {column.lower().split("[")[0].split("(")[0].strip(" _"): column for column in reversed(columns)}
    for wanted in TIME_NAMES:
        for ending in ("", *_ENDINGS):
            if wanted + ending in lowered:
                return lowered[wanted + ending]
    raise InputError(f"{path}: no column of times: expected one of {', '.join(TIME_NAMES)}; it has {', '.join(columns[:12])}")


def _with_times(
    frame: pandas.DataFrame, name: str, decimal: str, path: Path, notes: list[str]
) -> tuple[pandas.DataFrame, NDArray[np.int64]]:
    """Return the rows that have a time, and their times in ns: comments and repeated names of columns have none."""
    import pandas

    column: Any = _texts(frame[name], decimal)
    found: Any = pandas.to_numeric(column, errors="coerce")
    are_dates = pandas.api.types.is_datetime64_any_dtype(column) or found.isna().mean() > 0.5
    if are_dates:
        found = pandas.to_datetime(column, utc=True, format="ISO8601", errors="coerce").dt.tz_localize(None)
    known = found.notna()
    if not known.any():
        text = f"'{str(column.iloc[0])[:40]}' is neither a number nor a date"
        raise InputError(f"{path}: row {frame.index[0]}, column '{name}': {text}")
    if not known.all():
        row = known.index[int(np.argmin(known))]
        first = f"first row {row}: '{name}' is '{str(column[row])[:40]}'"
        notes.append(f"{(~known).sum()} rows without a time are left out ({first})")
    if are_dates:
        return frame[known], found[known].astype("datetime64[ns]").astype("int64").to_numpy()
    times: Any = pandas.to_numeric(column[known])  # whole numbers stay whole
    step = _step(name, times.to_numpy(np.float64), path) if len(times) > 1 else 1
    if pandas.api.types.is_integer_dtype(times):
        return frame[known], times.to_numpy(np.int64) * step
    whole, part = np.divmod(times.to_numpy(np.float64), 1.0)
    return frame[known], whole.astype(np.int64) * step + np.round(part * step).astype(np.int64)


def _step(name: str, times: NDArray[np.float64], path: Path) -> int:
    """Return how many ns a unit of a column of times is: by its name's ending, else as rows are 0.5 ms to 0.5 s apart.

    Rows that are so far apart, or so close, that it is another unit are refused.
    """
    lowered = name.lower().replace("[", "_").replace("(", "_").rstrip("])")
    by_name = next((step for ending, step in _ENDINGS.items() if lowered.endswith(ending)), None)
    apart = float(np.median(np.abs(np.diff(times))))
    if apart == 0.0:  # most times repeat: what is left of them says more
        apart = float(np.diff(np.unique(times)).min(initial=np.inf))
    low, high = _BY_SIZE if by_name is None else _BY_NAME
    step = next((one for one in ([by_name] if by_name else _UNITS) if low <= apart * one < high), None)
    if step is None:
        unit = f"read as {_UNITS[by_name]}" if by_name else "in no unit of time that is known"
        hint = "name the column by its unit: t_s, t_ms, t_us or t_ns"
        raise InputError(f"{path}: column '{name}': rows are {apart:g} apart, {unit}; {hint}")
    return step


# ---- CSV as other programs write it ----------------------------------------------------------------------------------


#: First bytes of a file -> its encoding.
_MARKS = (
    (codecs.BOM_UTF8, "utf-8-sig"), (codecs.BOM_UTF32_LE, "utf-32"),
    (codecs.BOM_UTF16_LE, "utf-16"), (codecs.BOM_UTF16_BE, "utf-16"),
)  # fmt: skip
#: What comment lines begin with.
_COMMENTS = ("#", "%", "//")
#: Bytes at the beginning and at the end that are looked at.
_ENDS = 2**16
#: As Excel states it.
_SEPARATOR = re.compile(r"\"?sep=(.)\"?")
_NUMBER = re.compile(r"[-+]?[\d.,]+([eE][-+]?\d+)?|nan|NaN|")


class _Dialect(NamedTuple):
    """How a CSV file is written: encoding, separator, decimal sign, lines before the rows, and the names of the columns."""

    encoding: str
    separator: str
    decimal: str
    skipped: int
    names: list[str]


def _csv(path: Path, most: int | None, notes: list[str]) -> tuple[pandas.DataFrame, str]:
    """Return a CSV file's rows, texts as they are, and its decimal sign.

    Commas, semicolons, tabs or blanks separate; with all but the first, numbers may have a decimal comma. Comment lines before
    the names are left out, and so is a last row that was cut off.
    """
    import pandas

    try:
        dialect = _dialect(path)
        separator = r"\s+" if dialect.separator == " " else dialect.separator
        frame = pandas.read_csv(
            path, nrows=most, skipinitialspace=True, encoding=dialect.encoding, sep=separator, decimal=dialect.decimal,
            header=None, names=dialect.names, skiprows=dialect.skipped, index_col=False, low_memory=False,
        )  # fmt: skip
        if (most is None or len(frame) < most) and len(frame) and _is_cut(path, dialect):
            notes.append(f"the last row was cut off: left out (row {len(frame) - 1})")
            frame = frame[:-1]
    except (OSError, ValueError, pandas.errors.ParserError, pandas.errors.EmptyDataError) as error:
        raise error if isinstance(error, InputError) else cannot_read(path, "csv", error) from None
    return frame, dialect.decimal


def _dialect(path: Path) -> _Dialect:
    with path.open("rb") as file:
        head = file.read(_ENDS)
    encoding, text = _decoded(head)
    if "\0" in text:
        raise InputError(f"{path}: holds bytes that are no text")
    lines = text.splitlines()
    skipped = next((k for k, line in enumerate(lines) if _may_hold_names(line.strip())), None)
    if skipped is None:
        raise InputError(f"{path}: no row in it")
    stated = [said[1] for line in lines[:skipped] if (said := _SEPARATOR.fullmatch(line.strip()))]
    found = max(",;\t", key=lines[skipped].count)
    separator = stated[-1] if stated else found if found in lines[skipped] else " "
    names = _split(lines[skipped], separator)
    first = next(filter(None, names), "")
    if skipped and first and _all_numbers([first]):  # names in the last comment, as numpy and rostopic write them
        comment = _split(lines[skipped - 1].lstrip("#%/ "), separator)
        if len(comment) == len(names):
            names, skipped = comment, skipped - 1
    if _all_numbers(names):
        raise InputError(f"{path}: its first line holds numbers, not the names of columns: '{lines[skipped][:60]}'")
    names = [name or f"column {k}" for k, name in enumerate(names)]
    if repeated := [name for name in names if names.count(name) > 1]:
        raise InputError(f"{path}: column '{repeated[0]}' occurs twice")
    decimal = "." if separator == "," else _decimal(lines[skipped + 1 :], separator)
    return _Dialect(encoding, separator, decimal, skipped + 1, names)


def _may_hold_names(line: str) -> bool:
    return bool(line) and not line.startswith(_COMMENTS) and _SEPARATOR.fullmatch(line) is None


def _decoded(head: bytes) -> tuple[str, str]:
    """Return a file's encoding, by its mark or its first bytes, and its beginning as a text."""
    encoding = next((name for mark, name in _MARKS if head.startswith(mark)), "utf-8")
    if encoding == "utf-8" and head[:200].count(0) > 50:
        encoding = "utf-16-le" if head[1:200:2].count(0) > head[0:200:2].count(0) else "utf-16-be"
    try:
        return encoding, codecs.getincrementaldecoder(encoding)().decode(head)
    except UnicodeDecodeError:
        if encoding != "utf-8":
            raise
        return "cp1252", head.decode("cp1252", errors="replace")


def _decimal(rows: list[str], separator: str) -> str:
    """Return the sign that more fields of some rows have in a number; a row of whole numbers, or a remark, says nothing."""
    cells = [cell for row in rows for cell in _split(row, separator)]
    found = [number[1] for cell in cells if (number := re.fullmatch(r"[-+]?\d*([.,])\d+([eE][-+]?\d+)?", cell))]
    return max(".,", key=found.count)


def _split(line: str, separator: str) -> list[str]:
    if separator == " ":
        return line.split()
    return [field.strip() for field in next(csv.reader([line], delimiter=separator, skipinitialspace=True), [])]


def _all_numbers(fields: list[str]) -> bool:
    return all(_NUMBER.fullmatch(field) for field in fields)


def _is_cut(path: Path, dialect: _Dialect) -> bool:
    """Whether the last line has no end, and fewer fields than there are columns."""
    with path.open("rb") as file:
        file.seek(max(path.stat().st_size - _ENDS, 0))
        tail = file.read()
    if dialect.encoding == "utf-16":  # its mark is at the beginning
        encoding = "utf-16-be" if tail[:1] == b"\0" else "utf-16-le"
    else:
        encoding = dialect.encoding.removesuffix("-sig")
    last = tail.decode(encoding, errors="ignore").splitlines(keepends=True)[-1:]
    return not last[0].endswith(("\n", "\r")) and len(_split(last[0], dialect.separator)) < len(dialect.names)


# ---- LeRobot: each episode is a recording, each feature some fields --------------------------------------------------


INFO = Path("meta") / "info.json"
_INDEX = {"timestamp", "frame_index", "episode_index", "index", "task_index"}


def read_lerobot(folder: Path, wanted: Collection[str] | None, tell: Share) -> Iterator[Log]:
    """Yield the episodes of a LeRobot data set of version 3, each as one table.

    A feature of several numbers gives one field for each: ``action[left_wheel]`` where ``meta/info.json`` names them, else
    ``action[0]``. Videos are left out.

    Raises:
        InputError: no such data set, or of another version.
    """
    import pandas

    features = _features(folder / INFO)
    names = {key: _names_of(feature) for key, feature in features.items()}
    videos = [key for key, feature in features.items() if feature.get("dtype") in ("video", "image")]
    notes = (f"pictures are not read: {', '.join(videos)}",) if videos else ()
    files = sorted((folder / "data").glob("chunk-*/file-*.parquet"))
    if not files:
        raise InputError(f"{folder}: no data/chunk-*/file-*.parquet")
    for k, file in enumerate(files):
        try:
            frame = pandas.read_parquet(file)
        except (OSError, ValueError) as error:
            raise cannot_read(file, "Parquet", error) from None
        missing = {"timestamp", "episode_index"} - set(frame.columns)
        if missing:
            raise InputError(f"{file}: column '{min(missing)}' is missing")
        for episode, rows in frame.groupby("episode_index", sort=True):
            times = np.round(rows["timestamp"].to_numpy(np.float64) * 1e9).astype(np.int64)
            topic = numeric_topic(_flat(rows, names), times, wanted)
            yield Log(folder, {TABLE: topic}, notes, f"episode {episode}", frozenset([TABLE]))
        tell((k + 1) / len(files))


def _features(path: Path) -> dict[str, Any]:
    try:
        info = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise cannot_read(path, "the description of a LeRobot data set", error) from None
    version = str(info.get("codebase_version", "?")) if isinstance(info, dict) else "?"
    if not version.startswith("v3"):
        raise InputError(f"{path}: codebase_version = {version}: expected v3.0; LeRobot has a converter")
    if not isinstance(info.get("features"), dict):
        raise InputError(f"{path}: 'features' is missing")
    return info["features"]


def _names_of(feature: dict[str, Any]) -> list[str]:
    """Return the names of a feature's numbers; they may stand below a key, as in ``{"motors": [...]}``."""
    names = feature.get("names")
    if isinstance(names, dict):
        names = next((value for value in names.values() if isinstance(value, list)), None)
    return [str(name) for name in names] if isinstance(names, list) else []


def _flat(rows: pandas.DataFrame, names: dict[str, list[str]]) -> pandas.DataFrame:
    """Return a table with a column for each number of a feature."""
    import pandas

    columns: dict[str, Any] = {}
    for key in rows.columns:
        first = rows[key].iloc[0]
        if key in _INDEX or isinstance(first, str | bytes | dict):
            continue
        if np.ndim(first) == 0:
            columns[key] = rows[key].to_numpy(np.float64)
        elif np.ndim(first) == 1 and len(first) <= LONGEST:
            values = np.stack(rows[key].to_list()).astype(np.float64)
            labels = names.get(key, [])
            labels = labels if len(labels) == values.shape[1] else range(values.shape[1])
            columns |= {f"{key}[{label}]": values[:, k] for k, label in enumerate(labels)}
    return pandas.DataFrame(columns)
