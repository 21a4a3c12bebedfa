"""Read tables as recordings: CSV and Parquet with any columns, one of them the time, and LeRobot data sets of version 3.

CSV is read as other programs write it: whatever separates, whichever encoding, wherever the names of the columns are.
"""

from __future__ import annotations

import codecs
import json
import re
from collections.abc import Collection, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from wlr_gym.base.errors import InputError
from wlr_gym.data.logs.topics import LONGEST, Share, Topic, TopicStore, cannot_read

if TYPE_CHECKING:
    import pandas
if TYPE_CHECKING:
    import pandas
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


# ---- tables ----------------------------------------------------------------------------------------------------------


#: Name of the topic that a table's columns make.
TABLE = "table"
#: Columns that hold the time, by what is looked for first; the unit by ending, else by how far rows are apart.
TIME_NAMES = ("t", "time", "timestamp", "stamp", "times", "clock", "seconds", "log_time", "elapsed")
_ENDINGS = {"_ns": 1, "_us": 1_000, "_ms": 1_000_000, "_s": 1_000_000_000, "_sec": 1_000_000_000, "_nsec": 1}
_UNITS = {10**9: "s", 10**6: "ms", 10**3: "us", 1: "ns"}
#: ns; how far rows of a recording are apart: where the size says the unit, and where the name does.
_BY_SIZE, _BY_NAME = (5e5, 5e8), (1e4, 1e10)
#: ``step`` of times that are dates.
_DATES = 0


def read_table(path: Path, wanted: Collection[str] | None, most: int | None, tell: Share) -> TopicStore:
    """Read a CSV or Parquet file: one topic, whose fields are the columns that hold numbers.

    Args:
        path: the file.
        wanted: columns that are kept; None = all.
        most: rows that are kept, at least, where there are more; None = all.
        tell: called with the share that has been read.

    Raises:
        InputError: not such a file, no column of times, or times that go back.
    """
    recording = TopicStore(path)
    recording.known.add(TABLE)
    reading = _Reading(path)
    try:
        frames = csv_frames(path, recording.notes, tell) if path.suffix.lower() == ".csv" else _parquet_frames(path, tell)
        for frame, decimal in frames:
            topic = reading.topic(frame, decimal, wanted)
            if len(topic.received):
                recording.add(topic)
            if most is not None and reading.kept >= most:
                break
        if reading.kept < 2:
            raise InputError(f"{path}: {reading.kept} rows; a recording has at least 2")
    except BaseException:
        recording.close()
        raise
    recording.notes += reading.notes()
    return recording


def _parquet_frames(path: Path, tell: Share) -> Iterator[tuple[pandas.DataFrame, str]]:
    import pyarrow
    import pyarrow.parquet

    try:
        with pyarrow.parquet.ParquetFile(path) as file:
            done, total = 0, max(file.metadata.num_rows, 1)
            for batch in file.iter_batches(batch_size=ROWS):
                frame = batch.to_pandas()
                frame = frame.reset_index() if frame.index.name is not None else frame
                frame.index = range(done, done + len(frame))
                frame.columns = [str(column).strip() for column in frame.columns]
                done += len(frame)
                yield frame, "."
                tell(done / total)
    except (OSError, ValueError, pyarrow.ArrowException) as error:
        raise error if isinstance(error, InputError) else cannot_read(path, "parquet", error) from None


@dataclass
class _Reading:
    """What is known of a table while its rows come in: its column of times and the ns of one unit of it."""

    path: Path
    time: str = ""
    step: int = -1
    kept: int = 0
    last: int | None = None
    timeless: int = 0
    first_timeless: str = ""
    texts: dict[str, int] = field(default_factory=dict)

    def topic(self, frame: pandas.DataFrame, decimal: str, wanted: Collection[str] | None) -> Topic:
        """Return some rows as messages.

        Raises:
            InputError: no column of times, one in no unit that is known, or times that go back.
        """
        if not self.time:
            self.time = _time_column([str(column) for column in frame.columns], self.path)
        frame, times = self._times(frame, decimal)
        if len(times):
            steps = np.diff(times, prepend=times[0] if self.last is None else self.last)
            if (steps < 0).any():
                row = int(frame.index[int(np.argmax(steps < 0))])
                raise InputError(f"{self.path}: row {row}, column '{self.time}': times must increase")
            self.last = int(times[-1])
        self.kept += len(times)
        return numeric_topic(self._numbers(frame.drop(columns=self.time), decimal), times, wanted)

    def notes(self) -> list[str]:
        """Return what was left out."""
        texts = [name for name, numbers in self.texts.items() if not numbers and name.lower() not in TIME_NAMES]
        mixed = [name for name, numbers in self.texts.items() if numbers]
        return [
            *([f"{self.timeless} rows without a time are left out ({self.first_timeless})"] if self.timeless else []),
            *([f"columns that hold no numbers: {', '.join(texts)}; left out"] if texts else []),
            *([f"columns that hold texts beside numbers: {', '.join(mixed)}; the texts are left out"] if mixed else []),
        ]

    def _times(self, frame: pandas.DataFrame, decimal: str) -> tuple[pandas.DataFrame, NDArray[np.int64]]:
        """Return the rows that have a time, and their times in ns: comments and repeated names of columns have none."""
        import pandas

        column: Any = _texts(frame[self.time], decimal)
        numbers: Any = pandas.to_numeric(column, errors="coerce")
        if pandas.api.types.is_datetime64_any_dtype(column) or (self.step < 0 and numbers.isna().mean() > 0.5):
            self.step = _DATES
        found: Any = _dates(column) if self.step == _DATES else numbers
        known: Any = found.notna()
        if not known.any():
            text = f"'{str(column.iloc[0])[:40]}' is neither a number nor a date"
            raise InputError(f"{self.path}: row {frame.index[0]}, column '{self.time}': {text}")
        if not known.all():
            row = known.index[int(np.argmin(known))]
            self.first_timeless = self.first_timeless or f"first row {row}: '{self.time}' is '{str(column[row])[:40]}'"
            self.timeless += int((~known).sum())
            frame, column, found = frame.loc[known], column[known], found[known]
        if self.step == _DATES:
            return frame, found.astype("datetime64[ns]").astype("int64").to_numpy()
        column = pandas.to_numeric(column)  # whole numbers stay whole
        if self.step < 0 and len(column) > 1:
            self.step = _step(self.time, column, self.path)
        return frame, _nanoseconds(column, max(self.step, 1))

    def _numbers(self, frame: pandas.DataFrame, decimal: str) -> pandas.DataFrame:
        """Return the columns with their texts as numbers, where they are."""
        import pandas

        changed: dict[str, Any] = {}
        for name in frame.columns:
            if pandas.api.types.is_numeric_dtype(frame[name]) or pandas.api.types.is_datetime64_any_dtype(frame[name]):
                continue
            numbers: Any = pandas.to_numeric(_texts(frame[name], decimal), errors="coerce")
            some = int(numbers.notna().sum())
            if some:
                changed[name] = numbers
            if (numbers.isna() & frame[name].notna()).any() or not some:
                self.texts[str(name)] = self.texts.get(str(name), 0) + some
        return frame.assign(**changed) if changed else frame


def _time_column(columns: list[str], path: Path) -> str:
    lowered = {column.lower().split("[")[0].split("(")[0].strip(" _"): column for column in reversed(columns)}
    for wanted in TIME_NAMES:
        for ending in ("", *_ENDINGS):
            if wanted + ending in lowered:
                return lowered[wanted + ending]
    raise InputError(f"{path}: no column of times: expected one of {', '.join(TIME_NAMES)}; it has {', '.join(columns[:12])}")


def _texts(column: Any, decimal: str) -> Any:
    """Return a column whose texts are as they are where a point is the decimal one; one of numbers or dates as it is."""
    import pandas

    if pandas.api.types.is_numeric_dtype(column) or pandas.api.types.is_datetime64_any_dtype(column):
        return column
    text = column.astype(str).str.strip()
    return text.str.replace(",", ".", regex=False) if decimal == "," else text


def _dates(column: pandas.Series) -> Any:
    import pandas

    return pandas.to_datetime(column, utc=True, format="ISO8601", errors="coerce").dt.tz_localize(None)


def _nanoseconds(column: pandas.Series, step: int) -> NDArray[np.int64]:
    import pandas

    if pandas.api.types.is_integer_dtype(column):
        return column.to_numpy(np.int64) * step
    values = column.to_numpy(np.float64)
    whole = np.floor(values)
    return whole.astype(np.int64) * step + np.round((values - whole) * step).astype(np.int64)


def _step(name: str, column: pandas.Series, path: Path) -> int:
    """Return how many ns a unit of a column of times is: by its name's ending, else as rows are 0.5 ms to 0.5 s apart.

    Rows that are so far apart, or so close, that it is another unit are refused.
    """
    lowered = name.lower().replace("[", "_").replace("(", "_").rstrip("])")
    apart = float(np.median(np.abs(np.diff(column.to_numpy(np.float64)))))
    by_name = next((step for ending, step in _ENDINGS.items() if lowered.endswith(ending)), None)
    if apart == 0.0:  # most times repeat: what is left of them says more
        apart = float(np.abs(np.diff(np.unique(column.to_numpy(np.float64)))).min(initial=np.inf))
    low, high = _BY_SIZE if by_name is None else _BY_NAME
    step = next((one for one in ([by_name] if by_name else _UNITS) if low <= apart * one < high), None)
    if step is None:
        unit = f"read as {_UNITS[by_name]}" if by_name else "in no unit of time that is known"
        hint = "name the column by its unit: t_s, t_ms, t_us or t_ns"
        raise InputError(f"{path}: column '{name}': rows are {apart:g} apart, {unit}; {hint}")
    return step


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


# ---- LeRobot: each episode is a recording, each feature some fields --------------------------------------------------


INFO = Path("meta") / "info.json"
_INDEX = {"timestamp", "frame_index", "episode_index", "index", "task_index"}


def read_lerobot(folder: Path, wanted: Collection[str] | None, tell: Share) -> Iterator[TopicStore]:
    """Yield the episodes of a LeRobot data set of version 3, each as one table.

    A feature of several numbers gives one field for each: ``action[left_wheel]`` where ``meta/info.json`` names them, else
    ``action[0]``. Videos are left out.

    Raises:
        InputError: no such data set, or of another version.
    """
    import pandas

    info = _info(folder)
    names = {key: _feature_names(feature) for key, feature in info["features"].items()}
    videos = [key for key, feature in info["features"].items() if feature.get("dtype") in ("video", "image")]
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
            recording = TopicStore(folder, f"episode {episode}")
            recording.known.add(TABLE)
            recording.notes += [f"pictures are not read: {', '.join(videos)}"] if videos else []
            times = np.round(rows["timestamp"].to_numpy(np.float64) * 1e9).astype(np.int64)
            recording.add(numeric_topic(_flat(rows, names), times, wanted))
            yield recording
        tell((k + 1) / len(files))


def _info(folder: Path) -> dict[str, Any]:
    path = folder / INFO
    try:
        info = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise cannot_read(path, "the description of a LeRobot data set", error) from None
    version = str(info.get("codebase_version", "?")) if isinstance(info, dict) else "?"
    if not version.startswith("v3"):
        raise InputError(f"{path}: codebase_version = {version}: expected v3.0; LeRobot has a converter")
    if not isinstance(info.get("features"), dict):
        raise InputError(f"{path}: 'features' is missing")
    return info


def _feature_names(feature: dict[str, Any]) -> list[str] | None:
    names = feature.get("names")
    if isinstance(names, dict):  # such as {"motors": [...]}
        names = next((value for value in names.values() if isinstance(value, list)), None)
    return [str(name) for name in names] if isinstance(names, list) else None


def _flat(rows: pandas.DataFrame, names: dict[str, list[str] | None]) -> pandas.DataFrame:
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
            given = names.get(key)
            labels = given if given and len(given) == values.shape[1] else [str(k) for k in range(values.shape[1])]
            columns |= {f"{key}[{label}]": values[:, k] for k, label in enumerate(labels)}
    return pandas.DataFrame(columns)
