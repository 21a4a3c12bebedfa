"""Convert runs between CSV and Parquet, one file or a whole data set."""

from __future__ import annotations

from pathlib import Path

from wlr_gym.base.errors import InputError
from wlr_gym.data.format import META_FILE, SUFFIXES, RunMeta
from wlr_gym.data.read import read_dataset, read_run
from wlr_gym.data.robot_file import note_robot, own_robot
from wlr_gym.data.write import write_meta, write_run


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
