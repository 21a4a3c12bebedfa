"""Runs of a system of one's own: a folder of CSV or Parquet tables with its columns."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from wlr_gym.base.errors import InputError, nearest
from wlr_gym.base.text import row_words
from wlr_gym.gap.rig.own import CLOCK, Rig

Array = NDArray[np.float64]

#: Rows of a run, at least.
LEAST_ROWS = 20
#: Table files by their endings.
_READERS = {".csv": pd.read_csv, ".parquet": pd.read_parquet}


@dataclass(frozen=True, eq=False)
class RigRun:
    """One run: name, times (rows,) s, inputs (rows, inputs), measured columns (rows, columns), NaN where not measured."""

    name: str
    t: Array
    inputs: Array
    measured: Array


def read_rig_runs(folder: str | Path, rig: Rig) -> list[RigRun]:
    """Read every table of a folder, in the order of their names.

    Raises:
        InputError: no folder, no tables, a column missing, or values that cannot be: naming file, column and row.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise InputError(f"{folder}: no such folder: expected one of runs of '{rig.name}'")
    paths = sorted(path for path in folder.iterdir() if path.suffix.lower() in _READERS)
    if not paths:
        raise InputError(f"{folder}: holds no *.csv or *.parquet: expected runs of '{rig.name}', one file each")
    for before, after in pairwise(paths):
        if before.stem == after.stem:
            raise InputError(f"{folder}: {before.name} and {after.name} are the same run; keep one of them")
    return [_run(path, rig) for path in paths]


def _run(path: Path, rig: Rig) -> RigRun:
    try:
        table = _READERS[path.suffix.lower()](path)
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: cannot be read as a table: {error}") from error
    columns = [column.name for column in rig.columns]
    for name in (CLOCK, *rig.inputs, *columns):
        if name not in table:
            raise InputError(f"{path}: has no column '{name}'{nearest(name, list(table))}")
        if not pd.api.types.is_numeric_dtype(table[name].dtype):
            raise InputError(f"{path}: column '{name}' holds {table[name].dtype}: expected numbers")
    if len(table) < LEAST_ROWS:
        raise InputError(f"{path}: {len(table)} rows: expected {LEAST_ROWS} or more")
    t, inputs, measured = (table[names].to_numpy(np.float64) for names in ([CLOCK], list(rig.inputs), columns))
    for name, values in ((CLOCK, t), *zip(rig.inputs, inputs.T, strict=True)):
        if not np.isfinite(values).all():
            row = int(np.argmin(np.isfinite(values.ravel())))
            raise InputError(
                f"{path}: column '{name}', {row_words(path, row)}: expected a finite number, as it drives the simulation"
            )
    if (np.diff(t[:, 0]) <= 0.0).any():
        row = int(np.argmax(np.diff(t[:, 0]) <= 0.0)) + 1
        raise InputError(
            f"{path}: column '{CLOCK}', {row_words(path, row)}: expected times that rise, "
            f"got {t[row, 0]:g} after {t[row - 1, 0]:g}"
        )
    for name, values in zip(columns, measured.T, strict=True):
        if np.isinf(values).any():
            raise InputError(
                f"{path}: column '{name}', {row_words(path, int(np.argmax(np.isinf(values))))}: infinite; "
                "expected a finite number"
            )
        if not np.isfinite(values).any():
            raise InputError(f"{path}: column '{name}' holds no number")
    return RigRun(path.stem, t[:, 0], inputs, measured)
