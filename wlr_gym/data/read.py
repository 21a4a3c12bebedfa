"""Read runs and data sets. What is not a run in the format is refused, naming file, row and column."""

from __future__ import annotations

import csv
import re
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from wlr_gym.base.errors import InputError
from wlr_gym.base.settings import parse_config, read_yaml
from wlr_gym.base.text import row_words
from wlr_gym.data.check import Finding, check_names, check_table
from wlr_gym.data.format import META_FILE, SUFFIXES, RunMeta
from wlr_gym.data.simulation_record import Simulation, read_simulation

if TYPE_CHECKING:
    import pandas

Array = NDArray[np.float64]

#: Tables beside a run that are none: what a policy was asked and answered, all samples of a log that was imported.
BESIDE = (".policy", ".samples")


@dataclass(frozen=True, eq=False)
class Run:
    """One measured run.

    Attributes:
        table: one row per control step, columns of :data:`wlr_gym.data.format.COLUMNS`, float64.
        meta: what ``meta.yaml`` beside the file says; defaults where there is none.
        path: the file it came from.
        findings: what is odd about it (gaps, dead channels, ...).
        simulation: how it was simulated, where the record of that stands beside it; replays do not look at it unless asked.
    """

    table: pandas.DataFrame
    meta: RunMeta
    path: Path
    findings: tuple[Finding, ...] = field(default=())
    simulation: Simulation | None = None

    @property
    def name(self) -> str:
        """File name without suffix."""
        return self.path.stem

    def __getitem__(self, column: str) -> Array:
        """Return one column as an array (rows,)."""
        return self.table[column].to_numpy(np.float64)

    def __contains__(self, column: str) -> bool:
        return column in self.table.columns


@dataclass(frozen=True, eq=False)
class DataSet:
    """All runs of one folder, and the meta data they share."""

    runs: tuple[Run, ...]
    meta: RunMeta
    path: Path


def read_run(path: str | Path) -> Run:
    """Read one run from CSV or Parquet, with the ``meta.yaml`` beside it.

    Raises:
        InputError: not a run in the format (see :func:`wlr_gym.data.check.check_table`).
    """
    import pandas

    path = Path(path)
    if not path.is_file():
        raise InputError(f"{path}: no such file; expected a run (CSV or Parquet)")
    if path.suffix.lower() not in SUFFIXES:
        raise InputError(f"{path}: a run is a {' or '.join(SUFFIXES)} file")
    meta = read_meta(path.parent)
    columns = _read_csv(path) if path.suffix.lower() == ".csv" else _read_parquet(path)
    findings = check_table(columns, str(path))
    return Run(pandas.DataFrame(columns), meta, path, tuple(findings), read_simulation(path))


def read_dataset(folder: str | Path) -> DataSet:
    """Read every ``run_*.csv`` and ``run_*.parquet`` of a folder, in the order of their numbers.

    Raises:
        InputError: no runs in the folder, the same run in both formats, or a run that is refused.
    """
    folder = Path(folder)
    paths = some_runs(folder)
    for before, after in pairwise(paths):
        if before.stem == after.stem:
            raise InputError(f"{folder}: {before.name} and {after.name} are the same run; keep one of them")
    return DataSet(tuple(read_run(path) for path in paths), read_meta(folder), folder)


def some_runs(folder: Path) -> list[Path]:
    """Return the runs of a folder.

    Raises:
        InputError: there are none.
    """
    if not folder.is_dir():
        raise InputError(f"{folder}: no such folder")
    paths = run_files(folder)
    if not paths:
        inside = sorted(child.name for child in folder.iterdir() if child.is_dir() and run_files(child))
        hint = f"; its folders {', '.join(inside)} have some: name one" if inside else ""
        raise InputError(f"{folder}: no run_*.csv or run_*.parquet{hint}")
    return paths


def read_runs(path: str | Path) -> tuple[Run, ...]:
    """Read a run, or every run of a folder.

    Raises:
        InputError: no such file or folder; see :func:`read_run` and :func:`read_dataset`.
    """
    path = Path(path)
    if not path.exists():
        raise InputError(f"{path}: no such file or folder; expected a run (CSV or Parquet) or a folder of runs")
    return read_dataset(path).runs if path.is_dir() else (read_run(path),)


def run_files(folder: Path) -> list[Path]:
    """Return the runs of a folder, ``run_2`` before ``run_10``; what else is known of a run lies beside it (:data:`BESIDE`)."""
    files = [path for path in folder.glob("run_*") if path.suffix.lower() in SUFFIXES and not path.stem.endswith(BESIDE)]
    return sorted(files, key=lambda path: [int(part) if part.isdigit() else part for part in re.split(r"(\d+)", path.name)])


def read_meta(folder: str | Path) -> RunMeta:
    """Read ``meta.yaml`` of a folder; defaults where there is none.

    Raises:
        InputError: broken YAML, unknown key, value of the wrong kind, or a marker offset that can only be millimetres.
    """
    path = Path(folder) / META_FILE
    if not path.is_file():
        return RunMeta()
    meta = parse_config(RunMeta, read_yaml(path) or {}, str(path))
    if max(abs(value) for value in meta.marker_offset) > 1.0:
        raise InputError(f"{path}: marker_offset = {list(meta.marker_offset)}: expected metres; these look like millimetres")
    return meta


def _read_csv(path: Path) -> dict[str, Array]:
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:
            rows = [row for row in csv.reader(file) if row]
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise InputError(f"{path}: cannot be read as CSV: {error}") from None
    if not rows:
        raise InputError(f"{path}: empty file; expected a header and rows")
    header = [name.strip() for name in rows[0]]
    check_names(header, str(path))
    for index, row in enumerate(rows[1:]):
        if len(row) != len(header):
            raise InputError(f"{path}: {row_words(path, index)} has {len(row)} values, the header {len(header)} columns")
    cells = zip(*rows[1:], strict=True) if len(rows) > 1 else ([] for _ in header)
    return {name: _numbers(column, name, path) for name, column in zip(header, cells, strict=True)}


def _numbers(cells: tuple[str, ...] | list[str], name: str, path: Path) -> Array:
    numbers = []
    for row, cell in enumerate(cells):
        try:
            numbers.append(float(cell) if cell.strip() else np.nan)
        except ValueError:
            raise InputError(f"{path}: {row_words(path, row)}, column '{name}': '{cell}' is not a number") from None
    return np.array(numbers, np.float64)


def _read_parquet(path: Path) -> dict[str, Array]:
    import pyarrow
    import pyarrow.parquet

    try:
        table = pyarrow.parquet.ParquetFile(path).read()
    except (OSError, pyarrow.ArrowException) as error:
        raise InputError(f"{path}: cannot be read as Parquet: {error}") from None
    check_names(table.column_names, str(path))
    for name, kind in zip(table.column_names, table.schema.types, strict=True):
        if not (pyarrow.types.is_floating(kind) or pyarrow.types.is_integer(kind)):
            raise InputError(f"{path}: column '{name}' holds {kind}, expected numbers")
    return {name: np.array(table[name].to_numpy(), dtype=np.float64) for name in table.column_names}
