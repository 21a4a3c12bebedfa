"""Read tables as logs: CSV and Parquet with any columns, and the episodes of a LeRobot data set (version 3)."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

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
#: Rows of a CSV file that are read at a time.
_ROWS = 50_000
LEROBOT_INFO = Path("meta") / "info.json"
_LEROBOT_INDEX = {"timestamp", "frame_index", "episode_index", "index", "task_index"}


def read_table(path: Path, tell: Share) -> Log:
    """Read a CSV or Parquet file: one topic, whose fields are the columns that hold numbers.

    Raises:
        InputError: not such a file, no column of times, or times that do not increase.
    """
    import pandas

    frame, notes = _read_frame(path, tell)
    if len(frame) < 2:
        raise InputError(f"{path}: {len(frame)} rows; a recording has at least 2")
    name = _time_column([str(column) for column in frame.columns], path)
    times = _nanoseconds(pandas.Series(frame[name]), name, path)
    if (np.diff(times) <= 0).any():
        row = int(np.argmax(np.diff(times) <= 0)) + 1
        raise InputError(f"{path}: row {row}, column '{name}': times must increase")
    frame = frame.drop(columns=name)
    return Log(path, {TABLE: _topic(frame, times)}, tuple(notes))


def _read_frame(path: Path, tell: Share) -> tuple[pandas.DataFrame, list[str]]:
    import pandas

    try:
        if path.suffix.lower() == ".parquet":
            frame = pandas.read_parquet(path)
        else:
            parts, done, size = [], 0, max(path.stat().st_size, 1)
            for part in pandas.read_csv(path, chunksize=_ROWS, skipinitialspace=True, encoding="utf-8-sig", **_dialect(path)):
                parts.append(part)
                done += int(part.memory_usage(index=False).sum())
                tell(min(done / size, 1.0))
            frame = pandas.concat(parts, ignore_index=True)
    except (OSError, ValueError, pandas.errors.ParserError, pandas.errors.EmptyDataError) as error:
        raise cannot_read(path, path.suffix.lstrip("."), error) from None
    frame.columns = [str(column).strip() for column in frame.columns]
    repeated = frame.columns[frame.columns.duplicated()]
    if len(repeated):
        raise InputError(f"{path}: column '{repeated[0]}' occurs twice")
    return frame, _columns_left_out(frame)


def _dialect(path: Path) -> dict[str, Any]:
    """Return how a CSV file separates: by comma, semicolon or tab; with the latter two, numbers may have a decimal comma."""
    with path.open(encoding="utf-8-sig") as file:
        header, first = file.readline(), file.readline()
    separator = max(",;\t", key=header.count)
    comma = separator != "," and re.search(r"\d,\d", first) is not None
    return {"sep": separator, "decimal": "," if comma else "."}


def _columns_left_out(frame: pandas.DataFrame) -> list[str]:
    texts = [str(name) for name in frame.columns if frame[name].dtype == object or frame[name].dtype.name in ("str", "string")]
    texts = [name for name in texts if name.lower() not in TIME_NAMES]
    return [f"columns that hold no numbers: {', '.join(texts)}; left out"] if texts else []


def _time_column(columns: list[str], path: Path) -> str:
    lowered = {column.lower().split("[")[0].split("(")[0].strip(): column for column in columns}
    for wanted in TIME_NAMES:
        for ending in ("", *_ENDINGS):
            if wanted + ending in lowered:
                return lowered[wanted + ending]
    raise InputError(f"{path}: no column of times: expected one of {', '.join(TIME_NAMES)}; it has {', '.join(columns[:12])}")


def _nanoseconds(column: pandas.Series, name: str, path: Path) -> Any:
    import pandas

    if not pandas.api.types.is_numeric_dtype(column):
        try:
            stamps = pandas.to_datetime(column, utc=True, format="ISO8601")
        except (ValueError, TypeError) as error:
            raise InputError(f"{path}: column '{name}': neither numbers nor dates: {error}") from None
        return stamps.dt.tz_localize(None).astype("datetime64[ns]").astype("int64").to_numpy()
    if column.isna().any():
        raise InputError(f"{path}: row {int(np.argmax(column.isna()))}, column '{name}': no value")
    step = _step(name, column, path)
    if pandas.api.types.is_integer_dtype(column):
        return column.to_numpy(np.int64) * step
    values = column.to_numpy(np.float64)
    whole = np.floor(values)
    return whole.astype(np.int64) * step + np.round((values - whole) * step).astype(np.int64)


def _step(name: str, column: pandas.Series, path: Path) -> int:
    """Return how many ns a unit of a column of times is: by its name's ending, else as rows are 0.5 ms to 0.5 s apart.

    Raises:
        InputError: rows are so far apart, or so close, that it is another unit.
    """
    lowered = name.lower().replace("[", "_").replace("(", "_").rstrip("])")
    apart = float(np.median(np.abs(np.diff(column.to_numpy(np.float64)))))
    by_name = next((step for ending, step in _ENDINGS.items() if lowered.endswith(ending)), None)
    if apart == 0.0:  # times that do not increase are refused later
        return by_name or 10**9
    low, high = _BY_SIZE if by_name is None else _BY_NAME
    step = next((one for one in ([by_name] if by_name else _UNITS) if low <= apart * one < high), None)
    if step is None:
        unit = f"read as {_UNITS[by_name]}" if by_name else "in no unit of time that is known"
        hint = "name the column by its unit: t_s, t_ms, t_us or t_ns"
        raise InputError(f"{path}: column '{name}': rows are {apart:g} apart, {unit}; {hint}")
    return step


def _topic(frame: pandas.DataFrame, times: Any) -> Topic:
    import pandas

    rows = np.arange(len(frame), dtype=np.int64)
    fields = {}
    for name in frame.columns:
        if pandas.api.types.is_numeric_dtype(frame[name]):
            values = frame[name].to_numpy(np.float64, na_value=np.nan)
            known = np.isfinite(values)
            fields[str(name)] = (rows[known], values[known])
    return Topic(TABLE, "table", np.asarray(times, np.int64), None, fields)


# ---- LeRobot ---------------------------------------------------------------------------------------------------------


def read_lerobot(folder: Path, tell: Share) -> Iterator[Log]:
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
    notes = (f"pictures are not read: {', '.join(videos)}",) if videos else ()
    files = sorted((folder / "data").glob("chunk-*/file-*.parquet"))
    if not files:
        raise InputError(f"{folder}: no data/chunk-*/file-*.parquet")
    for k, file in enumerate(files):
        try:
            frame = pandas.read_parquet(file, columns=None)
        except (OSError, ValueError) as error:
            raise cannot_read(file, "Parquet", error) from None
        missing = {"timestamp", "episode_index"} - set(frame.columns)
        if missing:
            raise InputError(f"{file}: column '{min(missing)}' is missing")
        for episode, rows in frame.groupby("episode_index", sort=True):
            times = np.round(rows["timestamp"].to_numpy(np.float64) * 1e9).astype(np.int64)
            yield Log(folder, {TABLE: _topic(_flat(rows, names), times)}, notes, f"episode {episode}")
        tell((k + 1) / len(files))


def _info(folder: Path) -> dict[str, Any]:
    path = folder / LEROBOT_INFO
    try:
        info = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise cannot_read(path, "the description of a LeRobot data set", error) from None
    version = str(info.get("codebase_version", "?"))
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
        if key in _LEROBOT_INDEX or isinstance(first, str | bytes | dict):
            continue
        if np.ndim(first) == 0:
            columns[key] = rows[key].to_numpy(np.float64)
        elif np.ndim(first) == 1 and len(first) <= LONGEST:
            values = np.stack(rows[key].to_list()).astype(np.float64)
            given = names.get(key)
            labels = given if given and len(given) == values.shape[1] else [str(k) for k in range(values.shape[1])]
            columns |= {f"{key}[{label}]": values[:, k] for k, label in enumerate(labels)}
    return pandas.DataFrame(columns)
