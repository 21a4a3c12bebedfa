"""Write and convert runs: the same format that is read, checked before and moved into place when complete."""

from __future__ import annotations

import csv
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import yaml
from numpy.typing import ArrayLike, NDArray

from wlr_gym.base.errors import InputError
from wlr_gym.base.files import replace_file, write_text
from wlr_gym.data.check import check_table
from wlr_gym.data.format import COLUMNS, META_FILE, SUFFIXES, RunMeta
from wlr_gym.data.read import read_dataset, read_meta, read_run
from wlr_gym.data.robot_file import note_robot, own_robot
from wlr_gym.data.simulation_record import Simulation, write_simulation

if TYPE_CHECKING:
    import pandas

    from wlr_gym.robot import Robot


def write_run(
    path: str | Path,
    table: pandas.DataFrame | Mapping[str, ArrayLike],
    meta: RunMeta | None = None,
    simulation: Simulation | None = None,
    robot: Robot | None = None,
) -> Path:
    """Write one run as CSV or Parquet, by the suffix of ``path``; with ``meta`` also the ``meta.yaml`` beside it.

    With ``robot`` the meta data say which robot it is; see :func:`wlr_gym.data.robot_file.note_robot`.

    A simulated run also gets its record, ``<run>.simulation.yaml``; the record of a run that was there before goes with it.

    Parquet keeps every bit; CSV holds the shortest text that reads back as the same float64.

    Raises:
        InputError: another suffix, a table that a reader would refuse, or a ``meta.yaml`` that says something else.
    """
    path = Path(path)
    if path.suffix.lower() not in SUFFIXES:
        raise InputError(f"{path}: a run is written as {' or '.join(SUFFIXES)}")
    columns = {str(name): np.asarray(table[name], dtype=np.float64) for name in table}
    check_table(columns, str(path))
    columns = {name: columns[name] for name in COLUMNS if name in columns}
    path.parent.mkdir(parents=True, exist_ok=True)
    if meta is not None:
        write_meta(path.parent, meta if robot is None else note_robot(path.parent, robot, meta))
    write = write_csv if path.suffix.lower() == ".csv" else _write_parquet
    replace_file(path, lambda temporary: write(temporary, columns))
    write_simulation(path, simulation)
    return path


def write_meta(folder: str | Path, meta: RunMeta) -> Path:
    """Write ``meta.yaml``, a servo profile only where it was stated; one that is there and says the same is left alone.

    Raises:
        InputError: the one that is there says something else (it holds for all runs of the folder).
    """
    path = Path(folder) / META_FILE
    check_meta(folder, meta)
    if not path.is_file():
        write_text(path, yaml.safe_dump(meta.content(), sort_keys=False, allow_unicode=True))
    return path


def check_meta(folder: str | Path, meta: RunMeta) -> None:
    """Refuse to write meta data where there are others.

    Raises:
        InputError: the ``meta.yaml`` that is there says something else (it holds for all runs of the folder).
    """
    path = Path(folder) / META_FILE
    there = read_meta(folder) if path.is_file() else meta
    differ = [key for key in RunMeta.model_fields if getattr(there, key) != getattr(meta, key)]
    if differ:
        told = "; ".join(f"{key} is {_said(there, key)} there, {_said(meta, key)} for the new run" for key in differ)
        raise InputError(f"{path}: says something else than the meta data of the new run: {told}; write it to another folder")


def _said(meta: RunMeta, key: str) -> str:
    """A value of meta data as its file says it."""
    value = meta.model_dump(mode="json")[key]
    return "not stated" if value is None else repr(value)


def write_csv(path: Path, columns: Mapping[str, NDArray[np.float64]]) -> None:
    """Write columns as CSV; NaN is an empty cell, and numbers read back as the same float64."""
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(columns)
        rows = zip(*(values.tolist() for values in columns.values()), strict=True)
        writer.writerows(["" if value != value else value for value in row] for row in rows)


def _write_parquet(path: Path, columns: dict[str, NDArray[np.float64]]) -> None:
    import pyarrow
    import pyarrow.parquet

    pyarrow.parquet.write_table(pyarrow.table(columns), path, compression="zstd")


# ---- the other format ------------------------------------------------------------------------------------------------


def convert(source: str | Path, target: str | Path, suffix: str | None = None) -> list[Path]:
    """Convert a run (``target`` is a file) or a data set (``target`` is a folder) and return the files written.

    Args:
        source: a run or a folder of runs.
        target: file whose suffix says the format, or folder.
        suffix: format of the files in the folder: ``.csv`` or ``.parquet``.

    Raises:
        InputError: unreadable source, or a format that is not known.
    """
    source, target = Path(source), Path(target)
    if source.is_file():
        run = read_run(source)
        meta = _moved(run.meta, source.parent, target.parent) if (source.parent / META_FILE).is_file() else None
        return [write_run(target, run.table, meta, run.simulation)]
    if suffix not in SUFFIXES:
        raise InputError(f"convert {source}: the format of a data set is {' or '.join(SUFFIXES)}, not {suffix!r}")
    data = read_dataset(source)
    written = [write_run(target / f"{run.name}{suffix}", run.table, simulation=run.simulation) for run in data.runs]
    if (source / META_FILE).is_file():
        write_meta(target, _moved(data.meta, source, target))
    return written


def _moved(meta: RunMeta, source: Path, target: Path) -> RunMeta:
    """Return meta data for another folder; a robot file that stands beside the runs goes with them."""
    robot = own_robot(meta, source) if target.resolve() != source.resolve() else None
    return meta if robot is None else note_robot(target, robot, meta)
