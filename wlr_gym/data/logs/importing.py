"""Import logs as runs: read, map, check, write, and say how each channel came about."""

from __future__ import annotations

import itertools
import os
import re
import shutil
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import yaml

from wlr_gym.base.errors import InputError, check_number
from wlr_gym.base.files import make_output_folder, write_text
from wlr_gym.base.paths import as_path
from wlr_gym.base.settings import parse_config, read_yaml
from wlr_gym.base.text import quoted
from wlr_gym.data.format import COLUMNS, REQUIRED, Finding, ImpossibleError, RunMeta, check_speeds, check_table
from wlr_gym.data.logs.map import (
    CURRENTS,
    NO_PROFILE,
    LogMap,
    Resolved,
    check_effort,
    content,
    decided,
    is_effort,
    open_places,
    parse_map,
    read_map,
    resolve,
)
from wlr_gym.data.logs.messages import RUN, read_exported
from wlr_gym.data.logs.readers import TABLE, first_messages, quiet, read_logs
from wlr_gym.data.logs.rows import ChannelFact, MadeRun, make_run, part_of, split_run, wanted_fields
from wlr_gym.data.logs.suggest import MOST, Proposal, propose
from wlr_gym.data.logs.topics import Share
from wlr_gym.data.runs import check_meta, next_run, note_robot, noted, own_robot, robot_of_meta, write_meta, write_run
from wlr_gym.robot import Robot, load_robot, robot_hash

MAP_FILE, RECORD_FILE = "map.yaml", "import.yaml"


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
    """Return a proposed map for a log; what ``given`` (a map's content) says is taken as it is."""
    known = parse_config(LogMap, decided(given or {}), "map")
    return propose(next(read_logs(log, most=MOST, tell=tell, time=known.time)), _robot_of(known.meta, robot), given)


def import_log(
    log: str | Path,
    out: str | Path,
    map: LogMap | Mapping[str, Any] | str | Path | None = None,
    robot: str | None = None,
    split: float | None = None,
    suffix: str = ".parquet",
    tell: Share = quiet,
    keep_going: bool = False,
) -> list[ImportedRun]:
    """Import a log into a folder of runs, after those that are in it; the map is written beside them.

    Args:
        log: what was recorded.
        out: folder of runs; made if it is not there.
        map: what topics and fields mean: a map, what a map file says, or its path. None = the one in ``out``, else the proposed
            one, where names decide all of it; a run of ours needs none.
        robot: that the runs are of: name or file; None = as the map's ``meta`` says (a path from the map file on, of a map
            that is no file from here), else the nominal one. It goes with the runs.
        split: s; a recording becomes runs of about this length, cut where the robot is quietest. None = one run, of long
            recordings several (:data:`wlr_gym.data.logs.rows.LONGEST`).
        suffix: format of the runs.
        tell: called with the share that was read.
        keep_going: import what comes before the first row that cannot be true; else such a recording is refused.

    Raises:
        InputError: an unreadable log, a map that is not complete, does not fit or names another robot, a run that a reader
            would refuse, another map in ``out``; the message names file, topic and field, and nothing is written.
    """
    log, out = as_path(log), as_path(out)
    if split is not None:
        check_number("split", split, "s", above=0.0)
    if map is None and is_own(log):
        if split is not None or robot is not None:
            raise InputError(f"{log}: a run that this library wrote comes back as it was: it takes neither split nor robot")
        return [_import_own(log, out, suffix, tell)]
    found = _map_of(map, log, out, robot)
    chosen = _robot_of(found.meta, robot)
    meta = noted(chosen, found.meta)
    resolved = resolve(found, chosen, "map")
    check_map_file(out / MAP_FILE, content(found))
    check_meta(out, meta)
    record, made = _read_record(out), []
    general = () if meta.states_profile else (NO_PROFILE,)
    units = sorted({source.unit for name, source in resolved.items() if is_effort(name) and source.unit in CURRENTS})
    if units and robot is None and found.meta.robot is None:
        by = f"by the torque constants of '{chosen.name}': name your robot (--robot)"
        general += (f"efforts in {', '.join(units)} become N m {by}",)
    with _beside(out) as folder:
        for recording in read_logs(log, wanted_fields(resolved), tell=tell, time=found.time):
            _check_new(recording.name, record, out)
            whole = _possible_part(make_run(recording, found, resolved), recording.name, resolved, chosen, keep_going)
            for one in split_run(whole, split):
                findings = _check(one, recording.name, resolved, chosen)
                path = write_run(folder / f"{len(made)}{suffix}", one.table)
                notes = (*recording.notes, *one.notes, *general)
                made.append(ImportedRun(path, recording.name, one.origin, one.facts, findings, notes))
        if not made:
            raise InputError(f"{log}: nothing in it")
        write_meta(out, note_robot(out, chosen, meta))
        write_map(out / MAP_FILE, found)
        for k, run in enumerate(made):
            path = next_run(out, suffix)
            os.replace(run.path, path)
            made[k] = replace(run, path=path)
            _add_to_record(out, record, made[k])  # with each run: whatever stops this, it knows all that are there
    return made


def _map_of(map: LogMap | Mapping[str, Any] | str | Path | None, log: Path, out: Path, robot: str | None) -> LogMap:
    """Return the map of an import, see :func:`import_log`."""
    if isinstance(map, LogMap):
        return map
    if isinstance(map, Mapping):
        return parse_map(map, "map")
    if map is not None or (out / MAP_FILE).is_file():
        path = Path(map or out / MAP_FILE)
        return parse_map(read_map(path), str(path))
    proposal = suggest_map(log, robot=robot)
    if proposal.open:
        hint = f"wlr import {quoted(log)} --suggest writes the map that is proposed, and what the log shows of each"
        raise InputError(f"{log}: needs a map: its names leave open {', '.join(proposal.open)}; {hint}")
    return proposal.map


def check_map_file(path: Path, data: Mapping[str, Any]) -> None:
    """Refuse to write a map's content where there is another one."""

    def meant(data: Mapping[str, Any]) -> object:
        """What a map says, to be compared: a robot file that it names stands beside it."""
        found = parse_config(LogMap, decided(data), str(path))
        robot = own_robot(found.meta, Path())
        meta = found.meta if robot is None else noted(robot, found.meta)
        return found.model_copy(update={"meta": meta}), data if open_places(data) else None

    if path.exists() and meant(read_map(path)) != meant(data):
        hint = f"import with it (--map {path}), move it away, or name another folder (--out)"
        raise InputError(f"{path}: is there already, and is another map: {hint}")


def write_map(path: Path, map: LogMap | Proposal) -> None:
    """Write a map, and a robot file that it names beside it; one that is there must say the same."""
    proposal = map if isinstance(map, Proposal) else Proposal(content(map), (), ())
    check_map_file(path, proposal.content)
    if path.exists():
        return
    meta = parse_config(RunMeta, decided(proposal.content).get("meta", {}), "map: meta")
    robot = own_robot(meta, Path())
    if robot is not None:
        named = note_robot(path.parent, robot, meta)
        of_map = {**proposal.content["meta"], "robot": named.robot, "robot_hash": named.robot_hash}
        proposal = replace(proposal, content={**proposal.content, "meta": of_map})
    write_text(path, proposal.text)


def _robot_of(meta: RunMeta, robot: str | None) -> Robot:
    """Return the robot of an import, as a map's meta data or ``robot`` says; refuse different ones."""
    named = robot_of_meta(meta, Path(), "map")
    chosen = load_robot(robot) if robot else named
    if meta.robot is not None and chosen != named:  # whole: the fingerprint leaves out what makes torques of currents
        names = [f"'{one.name}' ({robot_hash(one)})" for one in (named, chosen)]
        raise InputError(f"map: meta.robot = {meta.robot}: {names[0]}, and --robot {robot}: {names[1]}; expected one robot")
    return chosen


def is_own(log: Path) -> bool:
    """Whether a log holds a run that this library wrote."""
    return any(message.topic == RUN for message in itertools.islice(first_messages(log), 20))


def require_own(log: Path) -> None:
    """Raise :class:`InputError` for what cannot be imported without a map: as unreadable, as a measured run, or as foreign."""
    if is_own(log):
        return
    table = next(read_logs(log, most=MOST)).topics.get(TABLE)
    if table is not None and {*REQUIRED} <= {*table.known, "t"} <= {*COLUMNS}:
        raise InputError(f"{log}: is a measured run already: every command that takes runs reads it as it is")
    raise InputError(f"{log}: another program's log: give --map, or --suggest to have one proposed")


def _import_own(log: Path, out: Path, suffix: str, tell: Share) -> ImportedRun:
    run = read_exported(log, tell)
    make_output_folder(out)
    record = _read_record(out)
    _check_new(str(log), record, out)
    path = next_run(out, suffix)
    findings = tuple(check_table(run.table, str(log)))
    write_run(path, run.table, run.meta, run.simulation, run.robot)
    imported = ImportedRun(path, str(log), 0, (), findings, run.notes)
    _add_to_record(out, record, imported)
    return imported


# ---- one run ---------------------------------------------------------------------------------------------------------


@contextmanager
def _beside(out: Path) -> Iterator[Path]:
    """Yield a folder in which runs wait until all of them are there; of an import that is refused nothing is left."""
    new = not out.exists()
    make_output_folder(out)
    try:
        with tempfile.TemporaryDirectory(dir=out, prefix=".import-") as folder:
            yield Path(folder)
    except BaseException:
        if new:
            shutil.rmtree(out, ignore_errors=True)
        raise


#: s; a shorter part is no run.
_LEAST_PART = 3.0


def _possible_part(made: MadeRun, name: str, resolved: Mapping[str, Resolved], robot: Robot, keep_going: bool) -> MadeRun:
    """Return a recording that can be true; of another what comes before its first impossible row, or it is refused."""
    try:
        _check(made, name, resolved, robot)
    except ImpossibleError as error:
        t, back = made.table["t"], [note for note in made.notes if "times go back" in note]
        text = "; ".join([str(error), *(note for note in back if note.partition(":")[0] in str(error))])
        if t[error.row] < _LEAST_PART:
            raise InputError(text) from None
        if not keep_going:
            raise InputError(f"{text}; --keep-going imports the first {t[error.row]:.1f} s") from None
        note = f"rows from {error.row} on ({t[-1] - t[error.row]:.1f} of {t[-1]:.1f} s) are cut: {error}"
        part = part_of(replace(made, notes=(*made.notes, note)), 0, error.row)
        return _possible_part(part, name, resolved, robot, keep_going)
    return made


def _check(made: MadeRun, name: str, resolved: Mapping[str, Resolved], robot: Robot) -> tuple[Finding, ...]:
    """Return what is odd about a run; a refusal says from which topic and field the column came."""
    try:
        findings = tuple(check_table(made.table, name))
        check_speeds(made.table, robot, name)
        for column in filter(is_effort, made.table):
            check_effort(column, made.table, resolved[column].unit, robot, name)
        return findings
    except InputError as error:
        found = re.search(r"column '(\w+)'", str(error))
        source = resolved.get(found[1]) if found else None
        if source is None:
            raise
        where = f"from topic '{source.topic}', field '{source.field}', read as {source.unit}: check its unit in the map"
        text = f"{error} ({where})"
        raise (ImpossibleError(text, error.row) if isinstance(error, ImpossibleError) else InputError(text)) from None


# ---- the record of what was imported ---------------------------------------------------------------------------------


def _read_record(out: Path) -> dict[str, Any]:
    path = out / RECORD_FILE
    record = (read_yaml(path) or {}) if path.is_file() else {}
    if not isinstance(record, dict):
        raise InputError(f"{path}: expected a mapping of runs")
    return record


def _whole(source: str) -> str:
    """Return a log's name with its whole path."""
    path, comma, part = source.partition(", episode")
    return f"{Path(path).resolve()}{comma}{part}"


def _check_new(source: str, record: Mapping[str, Any], out: Path) -> None:
    for run, entry in record.items():
        if isinstance(entry, dict) and entry.get("log") == _whole(source):
            hint = f"remove it, and its entry in {RECORD_FILE}, or name another folder"
            raise InputError(f"{source}: {out / run} comes from it already: {hint}")


def _add_to_record(out: Path, record: dict[str, Any], run: ImportedRun) -> None:
    facts = {fact.column: asdict(fact) for fact in run.facts}
    channels = {
        column: {key: round(one, 6) if isinstance(one, float) else one for key, one in fact.items() if key != "column"}
        for column, fact in facts.items()
    }
    entry = {"log": _whole(run.source), "origin_ns": run.origin, "notes": list(run.notes), "channels": channels}
    record[run.path.stem] = entry
    write_text(out / RECORD_FILE, yaml.safe_dump(record, sort_keys=False, default_flow_style=None, width=160))
