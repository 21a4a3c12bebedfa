"""Import logs as runs: read, map, check, write, and say how each channel came about."""

from __future__ import annotations

import itertools
import re
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from wlr_gym.base.errors import InputError
from wlr_gym.base.files import make_output_folder, replace_file, write_text
from wlr_gym.base.settings import parse_config, read_yaml
from wlr_gym.data.check import Finding, check_table
from wlr_gym.data.format import RunMeta
from wlr_gym.data.logs.exported import read_exported
from wlr_gym.data.logs.map import LogMap, Resolved, map_text, read_map, resolve
from wlr_gym.data.logs.messages import RUN
from wlr_gym.data.logs.open import first_messages, quiet, read_logs
from wlr_gym.data.logs.rows import ChannelFact, MadeRun, Samples, make_run, wanted_fields
from wlr_gym.data.logs.suggest import MOST, Proposal, propose
from wlr_gym.data.logs.topics import Log, Share
from wlr_gym.data.record import next_run
from wlr_gym.data.write import write_run
from wlr_gym.robot import JOINTS, WHEELS, load_robot

MAP_FILE, RECORD_FILE = "map.yaml", "import.yaml"
#: Share of a part's length by which a cut may be moved to where the robot is quieter.
_PLAY = 0.25
#: Usual steps, and s, from which on what is between two rows is a hole; s below which a piece between holes is no run.
_HOLE, _LEAST_HOLE, _LEAST_PIECE = 5.0, 0.5, 1.0


@dataclass(frozen=True, eq=False)
class ImportedRun:
    """A run that was imported.

    Attributes:
        path: of the run.
        source: the log, and which part of it.
        origin: ns on the log's clock where the run's ``t`` is 0.
        facts: how its channels came about; empty for a run of ours.
        findings: what is odd about it.
        notes: what was odd about the log.
    """

    path: Path
    source: str
    origin: int
    facts: tuple[ChannelFact, ...]
    findings: tuple[Finding, ...]
    notes: tuple[str, ...]


def suggest_map(
    log: str | Path, given: Mapping[str, Any] | None = None, robot: str | None = None, tell: Share = quiet
) -> Proposal:
    """Return a proposed map for a log; what ``given`` says is taken as it is.

    Raises:
        InputError: a log that cannot be read, or that holds nothing known; see :func:`wlr_gym.data.logs.suggest.propose`.
    """
    found = next(read_logs(log, most=MOST, tell=tell))
    return propose(found, load_robot(robot) if robot else load_robot(), given)


def import_log(
    log: str | Path,
    out: str | Path,
    map: LogMap | Mapping[str, Any] | str | Path | None = None,
    robot: str | None = None,
    split: float | None = None,
    suffix: str = ".parquet",
    tell: Share = quiet,
) -> list[ImportedRun]:
    """Import a log into a folder of runs, after those that are in it; the map is written beside them.

    Args:
        log: what was recorded.
        out: folder of runs; made if it is not there.
        map: what topics and fields mean: a map, what a map file says, or its path. None = the one in ``out``, else proposed; a
            run of ours needs none.
        robot: that the runs are of: name or file; None = as the map's ``meta`` says, else the nominal one.
        split: s; a long recording becomes runs of about this length, cut where the robot is quietest.
        suffix: format of the runs.
        tell: called with the share that was read.

    Raises:
        InputError: an unreadable log, a map that does not fit, a run that a reader would refuse, another map in ``out``; the
            message names file, topic and field, and nothing is written.
    """
    log, out = Path(log), Path(out)
    if split is not None and not split > 0.0:
        raise InputError(f"split {split:g}: expected more than 0 s")
    if map is None and is_own(log):
        if split is not None or robot is not None:
            raise InputError(f"{log}: a run that this library wrote comes back as it was: it takes neither split nor robot")
        return [_import_own(log, out, suffix, tell)]
    if map is None and (out / MAP_FILE).is_file():
        map = out / MAP_FILE
    if map is None:
        map = suggest_map(log, robot=robot).map
    elif not isinstance(map, LogMap):
        data = read_map(map) if isinstance(map, str | Path) else dict(map)
        map = parse_config(LogMap, data, str(map) if isinstance(map, str | Path) else "map")
    entry = robot or map.meta.robot
    chosen = load_robot(entry) if entry else load_robot()
    meta = map.meta.model_copy(update={"robot": map.meta.robot or robot or chosen.name})
    resolved = resolve(map, chosen, "map")
    check_map_file(out / MAP_FILE, map)
    record, made = _read_record(out), list[_Made]()
    for found in read_logs(log, wanted_fields(resolved), tell=tell):
        _check_new(found, record, out)
        whole = make_run(found, map, resolved)
        findings = [_check(part, found.name, resolved) for part in _parts(whole, split)]
        made.append(_Made(Log(found.path, {}, found.notes, found.part), whole, findings))
        del found  # what was read goes before the next is
    if not made:
        raise InputError(f"{log}: nothing in it")
    make_output_folder(out)
    write_map(out / MAP_FILE, map)
    imported = []
    for one in made:
        for part, findings in zip(_parts(one.whole, split), one.findings, strict=True):  # cut again: parts are not kept
            imported.append(_write(one.log, part, findings, meta, out, suffix))
            record[imported[-1].path.stem] = _entry(imported[-1])
            _write_record(out, record)  # with each run: whatever stops this, it knows all that are there
    return imported


def check_map_file(path: Path, map: LogMap) -> None:
    """Refuse to write a map where there is another one.

    Raises:
        InputError: the file is there, and says something else.
    """
    if path.exists() and parse_config(LogMap, read_map(path), str(path)) != map:
        hint = f"import with it (--map {path}), move it away, or name another folder (--out)"
        raise InputError(f"{path}: is there already, and is another map: {hint}")


def write_map(path: Path, map: LogMap) -> None:
    """Write a map; one that is there and says the same is left alone.

    Raises:
        InputError: the one that is there says something else.
    """
    check_map_file(path, map)
    if not path.exists():
        write_text(path, map_text(map))


def is_own(log: Path) -> bool:
    """Whether a log holds a run that this library wrote."""
    return any(message.topic == RUN for message in itertools.islice(first_messages(log), 20))


def _import_own(log: Path, out: Path, suffix: str, tell: Share) -> ImportedRun:
    run = read_exported(log, tell)
    make_output_folder(out)
    record = _read_record(out)
    _check_new(Log(log, {}), record, out)
    path = next_run(out, suffix)
    findings = tuple(check_table(run.table, str(log)))
    write_run(path, run.table, run.meta, run.simulation, run.robot)
    imported = ImportedRun(path, str(log), 0, (), findings, run.notes)
    _write_record(out, record | {path.stem: _entry(imported)})
    return imported


# ---- one run ---------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class _Made:
    """A recording that can be written: its log without the messages, and of each part what is odd about it."""

    log: Log
    whole: MadeRun
    findings: list[tuple[Finding, ...]]


def _check(made: MadeRun, name: str, resolved: Mapping[str, Resolved]) -> tuple[Finding, ...]:
    try:
        return tuple(check_table(made.table, name))
    except InputError as error:
        raise InputError(_with_source(str(error), resolved)) from None


def _write(log: Log, made: MadeRun, findings: tuple[Finding, ...], meta: RunMeta, out: Path, suffix: str) -> ImportedRun:
    path = next_run(out, suffix)
    write_run(path, made.table, meta)
    replace_file(path.with_name(f"{path.stem}.samples.parquet"), lambda temporary: _write_samples(temporary, made.samples))
    return ImportedRun(path, log.name, made.origin, made.facts, findings, (*log.notes, *made.notes))


def _with_source(text: str, resolved: Mapping[str, Resolved]) -> str:
    """Return a message about a column with the topic and field that it came from."""
    found = re.search(r"column '(\w+)'", text)
    source = resolved.get(found.group(1)) if found else None
    if source is None:
        return text
    return f"{text} (from topic '{source.topic}', field '{source.field}', read as {source.unit}: check its unit in the map)"


def _write_samples(path: Path, samples: Mapping[str, Samples]) -> None:
    """Write every sample at its own time: channel, t (s, the run's clock), value (SI units)."""
    import pyarrow
    import pyarrow.parquet

    schema = pyarrow.schema([("channel", pyarrow.string()), ("t", pyarrow.float64()), ("value", pyarrow.float64())])
    with pyarrow.parquet.ParquetWriter(path, schema, compression="zstd") as writer:
        for name, one in samples.items():
            columns = [pyarrow.array([name] * len(one.t)), pyarrow.array(one.t), pyarrow.array(one.values)]
            writer.write_table(pyarrow.table(columns, schema=schema))


# ---- long recordings -------------------------------------------------------------------------------------------------


def _parts(made: MadeRun, split: float | None) -> Iterator[MadeRun]:
    """Yield a recording whole, or in parts of about ``split`` seconds, none of them across a hole."""
    if split is None:
        yield made
        return
    t = made.table["t"]
    holes = np.flatnonzero(np.diff(t) > max(_HOLE * float(np.median(np.diff(t))), _LEAST_HOLE)) + 1
    pieces = list(itertools.pairwise([0, *holes.tolist(), len(t)]))
    kept = [(first, last) for first, last in pieces if t[last - 1] - t[first] >= _LEAST_PIECE] or pieces
    if len(kept) < len(pieces):
        text = f"{len(pieces) - len(kept)} pieces between holes are shorter than {_LEAST_PIECE:g} s and are left out"
        made = replace(made, notes=(*made.notes, text))
    for first, last in kept:
        piece = made if len(pieces) == 1 else _part(made, first, last)
        edges = [0, *_cuts(piece, split), len(piece.table["t"])]
        for begin, end in itertools.pairwise(edges):
            yield piece if len(edges) == 2 else _part(piece, begin, end)


def _cuts(made: MadeRun, split: float) -> list[int]:
    """Return the rows that begin the second part of a recording without holes, and those after it."""
    whole = float(made.table["t"][-1])
    count = max(round(whole / split), 1)
    return [_quiet_row(made, k * whole / count, whole / count) for k in range(1, count)]


def _quiet_row(made: MadeRun, middle: float, length: float) -> int:
    """Return the row near a time at which the joints are asked to move least."""
    t = made.table["t"]
    rows = np.flatnonzero(np.abs(t - middle) <= _PLAY * length)
    motion = np.zeros(len(t))
    for joint in JOINTS:
        motion += np.abs(np.gradient(made.table[f"pos_{joint}"], t))
    width = max(int(0.3 / float(np.median(np.diff(t)))), 1)
    smooth = np.convolve(motion, np.ones(width) / width, mode="same")
    cost = smooth[rows] + 0.01 * np.abs(t[rows] - middle) / length
    return int(rows[np.argmin(cost)])


def _part(made: MadeRun, first: int, last: int) -> MadeRun:
    table = {name: values[first:last].copy() for name, values in made.table.items()}
    begin, end = float(table["t"][0]), float(table["t"][-1])
    samples = {}
    for name, one in made.samples.items():
        inside = (one.t >= begin - 0.1) & (one.t <= end + 0.1)
        samples[name] = Samples(one.t[inside] - begin, one.values[inside])
    for wheel in (f"pos_{wheel}" for wheel in WHEELS):  # wheels count from the run's start
        start = table[wheel][0]
        table[wheel] -= start
        samples[wheel] = Samples(samples[wheel].t, samples[wheel].values - start)
    table["t"] -= begin
    return replace(made, table=table, samples=samples, origin=made.origin + round(begin * 1e9))


# ---- the record of what was imported ---------------------------------------------------------------------------------


def _read_record(out: Path) -> dict[str, Any]:
    path = out / RECORD_FILE
    record = (read_yaml(path) or {}) if path.is_file() else {}
    if not isinstance(record, dict):
        raise InputError(f"{path}: expected a mapping of runs")
    return record


def _check_new(log: Log, record: Mapping[str, Any], out: Path) -> None:
    source = Log(log.path.resolve(), {}, (), log.part).name
    for run, entry in record.items():
        if isinstance(entry, dict) and entry.get("log") == source:
            hint = f"remove it, and its entry in {RECORD_FILE}, or name another folder"
            raise InputError(f"{log.name}: {out / run} comes from it already: {hint}")


def _entry(run: ImportedRun) -> dict[str, Any]:
    path, comma, part = run.source.partition(", episode")
    channels = {
        fact.column: {
            key: round(value, 6) if isinstance(value, float) else value
            for key, value in asdict(fact).items()
            if key != "column"
        }
        for fact in run.facts
    }
    return {
        "log": f"{Path(path).resolve()}{comma}{part}",
        "origin_ns": run.origin,
        "notes": list(run.notes),
        "channels": channels,
    }


def _write_record(out: Path, record: Mapping[str, Any]) -> None:
    write_text(out / RECORD_FILE, yaml.safe_dump(dict(record), sort_keys=False, default_flow_style=None, width=160))
