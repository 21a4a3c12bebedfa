"""Read LeRobot data sets of version 3: each episode is a recording, each feature some fields."""

from __future__ import annotations

import json
from collections.abc import Collection, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from wlr_gym.base.errors import InputError
from wlr_gym.data.logs.tables import TABLE, numeric_topic
from wlr_gym.data.logs.topic_store import TopicStore
from wlr_gym.data.logs.topics import LONGEST, Share, cannot_read

if TYPE_CHECKING:
    import pandas

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
