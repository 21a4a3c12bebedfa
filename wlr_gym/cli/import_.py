"""Import logs of other programs as measured runs: MCAP, rosbag2, rosbag1, CSV, Parquet and LeRobot data sets; no ROS needed.

A map says which topics and fields are which channels. --suggest proposes one from names and types, and writes it. What these
leave open (units, signs, mounting, clocks), it asks there, line by line, with what the log shows. Runs are made from a complete
map only. What wlr export --to has written needs no map.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import tyro
from rich.console import Console

from wlr_gym.base.errors import InputError
from wlr_gym.base.files import make_output_folder
from wlr_gym.base.progress import progress
from wlr_gym.base.text import quoted
from wlr_gym.cli import OK
from wlr_gym.cli.options import JsonOption, Seconds
from wlr_gym.cli.terminal import print_json, print_table

if TYPE_CHECKING:
    from wlr_gym.data.logs import ImportedRun, Proposal
    from wlr_gym.data.logs.rows import ChannelFact


@dataclass(frozen=True)
class ImportOptions(JsonOption):
    log: tyro.conf.Positional[tuple[Path, ...]] = ()
    """Logs: .mcap, .db3, .bag, .csv or .parquet files, folders of rosbag2, LeRobot data sets (version 3)."""
    map: Path | None = None
    """What topics and fields mean; with --suggest, what of it is known already, be it one line."""
    suggest: bool = False
    """Propose the map, from the first log, and write it: into --out, else to map.yaml here."""
    out: Path | None = None
    """Folder for the runs; made if it is not there."""
    split: Seconds | None = None
    """Length of a run, about: recordings are cut where the robot is quietest; default: only those over 600 s are cut."""
    robot: str | None = None
    """Robot file, or name in configs/robot/; default: the one that the map's meta names, else the nominal one."""
    keep_going: bool = False
    """Import what comes before the first row that cannot be true; default: such a recording is refused."""
    format: Literal["parquet", "csv"] = "parquet"
    """Format of the runs."""


def run(options: ImportOptions) -> int:
    """Import, and say how each channel came about and what is missing."""
    from wlr_gym.data.logs import import_log, read_map
    from wlr_gym.data.logs.importing import MAP_FILE, require_own

    if not options.log:
        raise InputError("expected logs to import")
    for log in options.log:
        if not log.exists():
            raise InputError(f"{log}: no such file or folder")
    if options.out is None and not options.suggest:
        raise InputError("--out: expected a folder for the runs")
    console = Console(soft_wrap=True, highlight=False)
    given: Path | dict[str, Any] | None = options.map
    if options.suggest:
        found = _suggest(options, read_map(options.map) if options.map is not None else {}, console)
        if options.out is None:
            if options.json:
                print_json({"map": found.content, "open": found.open})
            return OK
        if found.open:
            count = f"{len(found.open)} entries of the map are open" if len(found.open) > 1 else "an entry of the map is open"
            again = f"replace each 'open', then: wlr import {quoted(options.log[0])} --out {quoted(options.out)}"
            raise InputError(f"{options.out / MAP_FILE}: no run is made, {count}: {', '.join(found.open)}; {again}")
        given = found.content
    assert options.out is not None
    if given is None and not (options.out / MAP_FILE).is_file():
        for log in options.log:
            require_own(log)
    runs: list[ImportedRun] = []
    for log in options.log:
        with _reading(console, log) as tell:
            kept = options.robot, options.split, f".{options.format}"
            imported = import_log(log, options.out, given, *kept, tell, options.keep_going)
        _report(imported, console)
        runs += imported
    if options.json:
        print_json({"runs": runs})
    return OK


@contextmanager
def _reading(console: Console, log: Path) -> Iterator[Callable[[float], None]]:
    """Show a bar of how much of a log has been read; yields a function that is told the share."""
    with progress(console) as tell:
        yield partial(tell, "", f"reading {log.name}")


# ---- the proposed map ------------------------------------------------------------------------------------------------


def _suggest(options: ImportOptions, given: dict[str, Any], console: Console) -> Proposal:
    """Propose, print and write a map."""
    from wlr_gym.data.logs import suggest_map
    from wlr_gym.data.logs.importing import MAP_FILE, write_map
    from wlr_gym.data.logs.map import GROUPS

    target = (options.out or Path()) / MAP_FILE
    with _reading(console, options.log[0]) as tell:
        found = suggest_map(options.log[0], given, options.robot, tell)
    rows = [(line.place, "open" if line.asks else "decided", line.why) for line in found.lines]
    styles = ["yellow" if line.asks else "green" for line in found.lines]
    print_table(console, ("of the map", "", "what the log shows"), rows, styles=styles)
    if found.unused:
        console.print(f"not used: {', '.join(found.unused)}", style="dim", markup=False)
    _print_missing({column for key in found.content.get("channels", {}) for column in GROUPS.get(key, (key,))}, console)
    make_output_folder(target.parent)
    write_map(target, found)
    console.print(f"written: {target}", markup=False)
    return found


def _print_missing(columns: set[str], console: Console) -> None:
    from wlr_gym.data.logs.map import GROUPS

    missing = []
    for name in ("vel", "eff", "gyro", "acc", "cam", "volt"):
        group = GROUPS.get(name, (name,))
        missing += [name] if columns.isdisjoint(group) else [column for column in group if column not in columns]
    if missing:
        console.print(f"missing: {', '.join(missing)}", style="yellow", markup=False)


# ---- what was imported -----------------------------------------------------------------------------------------------


def _report(imported: Sequence[ImportedRun], console: Console) -> None:
    first = imported[0]
    for source, note in dict.fromkeys((one.source, note) for one in imported for note in one.notes):
        console.print(f"{source}: {note}", style="yellow", markup=False)
    if first.facts:
        groups: dict[tuple[str, ...], list[ChannelFact]] = {}
        for fact in first.facts:
            groups.setdefault((fact.column.partition("_")[0], fact.topic, fact.unit, fact.how), []).append(fact)
        rows = []
        for (kind, topic, unit, how), facts in groups.items():
            columns = facts[0].column if len(facts) == 1 else f"{kind} ({len(facts)})"
            moved, known = max(fact.moved for fact in facts), min(fact.known for fact in facts)
            rows.append((columns, topic, unit, f"{facts[0].rate:.0f}", how, f"{1e3 * moved:.1f}", f"{100 * known:.0f} %"))
        headings = ("channels", "topic", "unit", "samples/s", "rows", "moved, ms rms", "rows with a value")
        print_table(console, headings, rows)
        _print_missing({fact.column for fact in first.facts}, console)
    for one in imported:
        console.print(f"written: {one.path}", markup=False)
        for finding in one.findings:
            console.print(f"  {finding.kind} in '{finding.column}': {finding.message}", style="yellow", markup=False)
