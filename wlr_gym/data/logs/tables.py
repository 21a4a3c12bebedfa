"""Read tables as recordings: CSV and Parquet with any columns, one of them the time."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from wlr_gym.base.errors import InputError
from wlr_gym.data.logs.csv_file import ROWS, csv_frames
from wlr_gym.data.logs.topic_store import TopicStore
from wlr_gym.data.logs.topics import Share, Topic, cannot_read

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
