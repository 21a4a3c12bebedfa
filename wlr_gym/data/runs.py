"""Measured runs on disk: read, written and converted, with the robot they are of and the record of their simulation.

What is not a run in the format is refused, naming file, row and column. Beside the runs of a folder stand ``meta.yaml``, and
``robot.yaml`` where no shipped robot was driven; beside a simulated run its record, ``run_01.simulation.yaml``. That is not in
the run: what a robot could not measure is no part of the format: a workflow that has to identify it must not read it there.
"""

from __future__ import annotations

import csv
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import yaml
from numpy.typing import ArrayLike, NDArray
from pydantic import Field

from wlr_gym.base.errors import InputError, check_folder, unknown_name
from wlr_gym.base.files import make_output_folder, replace_file, write_text
from wlr_gym.base.paths import as_path, data_directory, named_in
from wlr_gym.base.settings import SettingsModel, parse_config, read_yaml
from wlr_gym.base.text import row_words
from wlr_gym.data.format import COLUMNS, META_FILE, ROBOT_FILE, SUFFIXES, Finding, RunMeta, check_names, check_table
from wlr_gym.physics.floor import Floor, FloorSource, load_floor
from wlr_gym.physics.plants.base import PlantState
from wlr_gym.robot import Robot, load_robot, robot_content, robot_hash
from wlr_gym.robot.parameter_table import ELEMENTS

if TYPE_CHECKING:
    import pandas

Array = NDArray[np.float64]

#: Tables beside a run that are none: what a policy was asked and answered; all samples of a log, as older imports wrote them.
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
        InputError: not a run in the format (see :func:`wlr_gym.data.format.check_table`).
    """
    import pandas

    path = as_path(path)
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
    folder = as_path(folder)
    paths = some_runs(folder)
    for before, after in pairwise(paths):
        if before.stem == after.stem:
            raise InputError(f"{folder}: {before.name} and {after.name} are the same run; keep one of them")
    return DataSet(tuple(read_run(path) for path in paths), read_meta(folder), folder)


def some_runs(folder: Path) -> list[Path]:
    """Return the runs of a folder; one without any is refused."""
    check_folder(folder, of="runs")
    paths = run_files(folder)
    if not paths:
        inside = sorted(child.name for child in folder.iterdir() if child.is_dir() and run_files(child))
        hint = f"; its folders {', '.join(inside)} have some: name one" if inside else ""
        raise InputError(f"{folder}: no run_*.csv or run_*.parquet{hint}")
    return paths


def read_runs(path: str | Path) -> tuple[Run, ...]:
    """Read a run, or every run of a folder."""
    path = as_path(path)
    if not path.exists():
        raise InputError(f"{path}: no such file or folder; expected a run (CSV or Parquet) or a folder of runs")
    return read_dataset(path).runs if path.is_dir() else (read_run(path),)


def run_files(folder: Path) -> list[Path]:
    """Return the runs of a folder, ``run_2`` before ``run_10``; what else is known of a run lies beside it (:data:`BESIDE`)."""
    files = [path for path in folder.glob("run_*") if path.suffix.lower() in SUFFIXES and not path.stem.endswith(BESIDE)]
    return sorted(files, key=lambda path: [int(part) if part.isdigit() else part for part in re.split(r"(\d+)", path.name)])


def next_run(folder: Path, suffix: str = ".parquet") -> Path:
    """Return the path of the next run of a folder: ``run_01.parquet``, ``run_02.parquet``, ..."""
    numbers = [int(found[1]) for path in folder.glob("run_*") if (found := re.match(r"run_(\d+)\.", path.name))]
    return folder / f"run_{max(numbers, default=0) + 1:02d}{suffix}"


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
    table = np.full((len(rows) - 1, len(header)), np.nan)
    for index, row in enumerate(rows[1:]):
        for column, cell in enumerate(row):
            try:
                table[index, column] = float(cell) if cell.strip() else np.nan
            except ValueError:
                place = f"{path}: {row_words(path, index)}, column '{header[column]}'"
                raise InputError(f"{place}: '{cell}' is not a number") from None
    return dict(zip(header, table.T.copy(), strict=True))


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


# ---- writing ---------------------------------------------------------------------------------------------------------


def write_run(
    path: str | Path,
    table: pandas.DataFrame | Mapping[str, ArrayLike],
    meta: RunMeta | None = None,
    simulation: Simulation | None = None,
    robot: Robot | None = None,
) -> Path:
    """Write one run as CSV or Parquet, by the suffix of ``path``; with ``meta`` also the ``meta.yaml`` beside it.

    With ``robot`` the meta data say which robot it is; see :func:`wlr_gym.data.runs.note_robot`.

    A simulated run also gets its record, ``<run>.simulation.yaml``; the record of a run that was there before goes with it.

    Parquet keeps every bit; CSV holds the shortest text that reads back as the same float64.

    Raises:
        InputError: another suffix, a table that a reader would refuse, or a ``meta.yaml`` that says something else.
    """
    path = as_path(path)
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
    """Write ``meta.yaml``, a servo profile only where it was stated; one that is there must say the same."""
    path = Path(folder) / META_FILE
    check_meta(folder, meta)
    if not path.is_file():
        write_text(path, yaml.safe_dump(meta.content(), sort_keys=False, allow_unicode=True))
    return path


def check_meta(folder: str | Path, meta: RunMeta) -> None:
    """Refuse to write meta data where there are others: a ``meta.yaml`` holds for all runs of its folder."""
    path = Path(folder) / META_FILE
    there = read_meta(folder) if path.is_file() else meta
    told = []
    for key in (key for key in RunMeta.model_fields if getattr(there, key) != getattr(meta, key)):
        values = (one.model_dump(mode="json")[key] for one in (there, meta))
        old, new = ("not stated" if value is None else repr(value) for value in values)
        told.append(f"{key} is {old} there, {new} for the new run")
    if told:
        what = "says something else than the meta data of the new run"
        raise InputError(f"{path}: {what}: {'; '.join(told)}; write it to another folder")


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


# ---- conversion ------------------------------------------------------------------------------------------------------


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
        here, there, paths = source.parent, target.parent, [target]
    elif suffix in SUFFIXES:
        here, there, paths = source, target, [target / f"{path.stem}{suffix}" for path in some_runs(source)]
    else:
        raise InputError(f"convert {source}: the format of a data set is {' or '.join(SUFFIXES)}, not {suffix!r}")
    runs = read_runs(source)
    meta = runs[0].meta if (here / META_FILE).is_file() else None
    robot = own_robot(meta, here) if meta is not None and there.resolve() != here.resolve() else None
    return [write_run(path, run.table, meta, run.simulation, robot) for path, run in zip(paths, runs, strict=True)]


# ---- the robot of runs -----------------------------------------------------------------------------------------------


def shipped_robots() -> dict[str, Path]:
    """Return name inside the file, and name of the file -> path, of the robots that ship."""
    paths = sorted((data_directory("configs") / "robot").glob("*.yaml"))
    return {str((read_yaml(path) or {}).get("name")): path for path in paths} | {path.stem: path for path in paths}


def is_shipped(robot: Robot) -> bool:
    """Whether a robot is, number for number, the one that ships under its name."""
    path = shipped_robots().get(robot.name)
    return path is not None and load_robot(path, check=False) == robot


def write_robot(path: Path, robot: Robot) -> None:
    """Write a robot as a file that :func:`wlr_gym.robot.load_robot` reads, every number in it; another one is not replaced."""
    if path.is_file():
        if load_robot(path, check=False) != robot:
            raise InputError(f"{path}: holds another robot than '{robot.name}'; write to another folder")
        return
    text = yaml.safe_dump(robot_content(robot), sort_keys=False, allow_unicode=True)
    write_text(path, f"# Every number of the robot of this folder; fingerprint {robot_hash(robot)}\n{text}")


def noted(robot: Robot, meta: RunMeta) -> RunMeta:
    """Return the meta data that :func:`note_robot` returns; nothing is written."""
    if is_shipped(robot):
        return meta.model_copy(update={"robot": robot.name, "robot_hash": None})
    return meta.model_copy(update={"robot": ROBOT_FILE, "robot_hash": robot_hash(robot)})


def note_robot(folder: Path, robot: Robot, meta: RunMeta) -> RunMeta:
    """Return the meta data of runs in ``folder`` so that they find their robot wherever the folder goes.

    A robot that ships is named. Another one is written beside the runs, as ``robot.yaml``, and its fingerprint noted.
    """
    found = noted(robot, meta)
    if found.robot == ROBOT_FILE:
        make_output_folder(folder)
        write_robot(folder / ROBOT_FILE, robot)
    return found


def names_file(robot: str | None) -> bool:
    """Whether meta data name their robot by a file; its fingerprint may be noted or not."""
    return robot is not None and Path(robot).suffix in {".yaml", ".yml"}


def own_robot(meta: RunMeta, folder: Path) -> Robot | None:
    """Return the robot that has to go with meta data to another folder; None = they name one that ships, or none."""
    return robot_of_meta(meta, folder) if names_file(meta.robot) else None


def robot_of_meta(meta: RunMeta, folder: Path, file: str = META_FILE) -> Robot:
    """Return the robot that meta data name: a file (relative to them), a config, or the ``name`` inside one; None = nominal.

    ``file`` in ``folder`` has them, for messages.

    Raises:
        InputError: no such robot (the message lists the shipped ones), or a file that changed since the runs were recorded.
    """
    if meta.robot is None:
        return load_robot()
    if not names_file(meta.robot):
        shipped = shipped_robots()
        if meta.robot not in shipped:
            error = unknown_name("robot", meta.robot, shipped, str(folder / file))
            raise InputError(f"{error}; a robot of your own is named by its file (a path from {file} on), or with --robot")
        return load_robot(shipped[meta.robot])
    path = folder / meta.robot
    robot = load_robot(path)
    if meta.robot_hash not in (None, found := robot_hash(robot)):
        raise InputError(
            f"{path}: its fingerprint is {found}, {file} says {meta.robot_hash}: it is not the robot of these runs any "
            "more; name the one to use with --robot"
        )
    return robot


def robot_of(run: Run, robot: Robot | str | Path | None = None) -> Robot:
    """Return the robot a run is of: ``robot`` if given, else the one its meta data name, else the nominal one."""
    return robot_of_meta(run.meta, run.path.parent) if robot is None else load_robot(robot)


def floor_of(run: Run, floor: FloorSource = None, robot: Robot | None = None) -> Floor:
    """Return the floor of a run, nothing left to be drawn: ``floor`` if given, else the one its meta data name, else a plane.

    What is drawn follows from the seed of the run's simulation; of a measured run from seed 0. ``robot`` is as for
    :func:`wlr_gym.physics.floor.load_floor`.
    """
    found = floor_of_meta(run.meta, run.path.parent, robot) if floor is None else load_floor(floor, robot)
    return found.drawn(0 if run.simulation is None else run.simulation.seed)


def floor_of_meta(meta: RunMeta, folder: Path, robot: Robot | None = None) -> Floor:
    """Return the floor that meta data in ``folder`` name or describe; what of it is drawn is still open."""
    file = folder / META_FILE
    return load_floor(named_in(file, meta.floor) if isinstance(meta.floor, str) else meta.floor, robot, f"{file}: floor")


# ---- the record of a simulation --------------------------------------------------------------------------------------


SUFFIX = ".simulation.yaml"


class ParameterChange(SettingsModel):
    """Parameters that changed after the sensors of ``row`` were read: they act from that row's setpoints on."""

    row: int = Field(ge=0)
    parameters: dict[str, float]


class Simulation(SettingsModel):
    """How a run was simulated.

    Attributes:
        backend, control_period, physics_step, precision, sensor_noise: the plant and its options; s.
        seed: of the sensors' noise.
        parameters: elements of the parameter table that differ from the nominal robot's: randomisation, effects, overrides.
        changes: what changed on the way, in order of rows.
        formulas: effects that are no parameters: formula forces, as in a patch file.
        start: fields of :class:`wlr_gym.physics.plants.base.PlantState` of the first row.
    """

    backend: str
    control_period: float
    physics_step: float
    precision: str = "float64"
    sensor_noise: bool = True
    seed: int = Field(ge=0)
    parameters: dict[str, float] = Field(default_factory=dict)
    changes: tuple[ParameterChange, ...] = ()
    formulas: list[dict[str, Any]] = Field(default_factory=list)
    start: dict[str, float | list[float]]


def simulation_path(run: Path) -> Path:
    """Return where the simulation record of a run stands."""
    return run.with_name(run.stem + SUFFIX)


def read_simulation(run: Path) -> Simulation | None:
    """Read the record beside a run; None where there is none."""
    path = simulation_path(run)
    return parse_config(Simulation, read_yaml(path), str(path)) if path.is_file() else None


def write_simulation(run: Path, simulation: Simulation | None) -> None:
    """Write the record beside a run; None removes one that is there."""
    path = simulation_path(run)
    if simulation is None:
        path.unlink(missing_ok=True)
        return
    text = yaml.safe_dump(simulation.model_dump(mode="json"), sort_keys=False, default_flow_style=None, width=120)
    write_text(path, text)


def departures(values: Array, reference: Array) -> dict[str, float]:
    """Return the elements of one row of the parameter table that differ from ``reference``, with their values."""
    return {ELEMENTS[column]: float(values[column]) for column in np.flatnonzero(values != reference)}


def start_of(state: PlantState, robot: int) -> dict[str, float | list[float]]:
    """Return one robot's state as the record holds it."""
    return {name: value[robot].tolist() for name, value in vars(state).items() if value is not None}
