"""The numbers of docs/performance.md and README's of the engine: docs/data/bench.json, from ``python -m studies.bench``.

``python -m studies.bench.performance bench.json ...`` takes the rows of the reports over, each with its machine, versions and
date, and writes README's row and the picture anew. What is measured again replaces all of its older rows. .ci/docs/tables.py
prints the tables.
"""

from __future__ import annotations

import json
import re
import sys
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from studies.bench.engine import AT_DEFAULTS, LEVELS, level_name, reference_text, save_picture, settings_table
from studies.bench.measure import short, speed_cells
from studies.tables import markdown_table

ROOT = Path(__file__).resolve().parents[2]
DATA = ROOT / "docs" / "data" / "bench.json"
README = ROOT / "README.md"
PICTURE = ROOT / "docs" / "figures" / "accuracy_speed.png"
#: The engine's ratios that README has.
README_RATIOS = (level_name(LEVELS[0]), AT_DEFAULTS)
TIMES = "\N{MULTIPLICATION SIGN}"
#: Measurements with a table of their own, or none.
APART = ("batch", "camera")
BATCH = re.compile(r"(\d+) robots, (\w+, \d+ threads?)")

Row = dict[str, Any]


def merged(kept: list[Row], report: dict[str, Any]) -> list[Row]:
    """Return the rows with those of a report taken over, each with what it was measured on; refuse a quick report."""
    if report["quick"]:
        raise SystemExit("a report of python -m studies.bench --quick: its numbers mean nothing")
    conditions = {**report["machine"], "rounds": report["rounds"]}
    new = {(row["name"], row["what"]): {**row, "measured": conditions} for row in report["measurements"]}
    old = [row for row in kept if row["name"] not in {name for name, _ in new}]
    return sorted([*old, *new.values()], key=lambda row: _ORDER.index(row["name"]) if row["name"] in _ORDER else len(_ORDER))


_ORDER = ("engine", "mujoco", "env_step", "ppo", "learning", "bus", "import", "start", "batch")


def speed_table(rows: Iterable[Row]) -> list[str]:
    """Return the table of everything that has a peer or a bar, as lines of Markdown."""
    cells = [
        (row["what"], *speed_cells(row), f"`python -m studies.bench {row['name']}`", _condition(row["measured"]))
        for row in rows
        if row["name"] not in APART and (row["peer"] or row["bar"])
    ]
    return markdown_table(("what", "ours", "peer", "ratio [min..max]", "bar", "command", "measured"), cells)


def batch_table(rows: Iterable[Row]) -> list[str]:
    """Return substeps per second by batch size as lines of Markdown; none where they were not measured."""
    found: dict[str, dict[str, str]] = {}
    for row in rows:
        if row["name"] == "batch" and (match := BATCH.fullmatch(row["what"])):
            found.setdefault(match[2], {})[match[1]] = short(row["ours"]["median"])
    counts = sorted({count for one in found.values() for count in one}, key=int)
    return markdown_table(("robots", *counts), [(how, *(one[count] for count in counts)) for how, one in found.items()])


def machine_lines(rows: Iterable[Row]) -> list[str]:
    """Return one line per machine and set of versions that rows were measured on."""
    lines = []
    for row in rows:
        found = row["measured"]
        packages = ", ".join(f"{name} {version}" for name, version in found["versions"].items())
        note = f" {found['note']}" if found.get("note") else ""
        lines.append(f"- {found['date']}: {found['processor']}, {found['cores']} cores, {found['system']}; {packages}.{note}")
    return list(dict.fromkeys(lines))


def _condition(found: Row) -> str:
    load = "" if not found["load_average"] else f", load {found['load_average'][0]:.1f}"
    return f"{found['date']}, {found['rounds']} round{'s' * (found['rounds'] > 1)}{load}"


def engine_lines(engine: dict[str, Any]) -> list[str]:
    """Return when engine and MuJoCo were measured, the limits of the reference, and every setting, as lines of Markdown."""
    found = engine["measured"]
    head = f"Measured {_condition(found)}, {found['processor']}; speed: median [smallest..largest] of the rounds."
    return [head, reference_text(engine), "", *markdown_table(*settings_table(engine))]


def made() -> dict[str, list[str]]:
    """Return every table of the page by its name."""
    kept = json.loads(DATA.read_text(encoding="utf-8"))
    rows = kept["rows"]
    parts = {"speed": speed_table(rows), "batch": batch_table(rows), "machines": machine_lines(rows)}
    return {**parts, "engine": engine_lines(kept["engine"])} if "engine" in kept else parts


def write_readme(text: str, rows: list[Row]) -> str:
    """Return README with the engine's ratios; as it is before they were measured at equal error."""
    engine = [row for row in rows if row["name"] == "engine"]
    ratios = {row["what"].partition(":")[0]: row["ratio"]["median"] for row in engine}
    cells = []
    for what in README_RATIOS:
        if f"float64, {what}" not in ratios:
            return text
        wide, narrow = (f"{ratios[f'{precision}, {what}']:.0f}{TIMES}" for precision in ("float64", "float32"))
        cells.append(f"{what}: {wide} as fast (float64), {narrow} (float32)")
    command = "`python -m studies.bench engine` ([performance](docs/performance.md))"
    error = "rms distance from the engine's contact model"
    what = "engine against MuJoCo (float64), a batch of 320 robots against one"
    head = f"{what}, core of an {engine[0]['measured']['processor']}; error: {error}"
    row = f"| {head} | {'; '.join(cells)} | {command} |"
    return re.sub(r"^\| engine against .*$", lambda _: row, text, flags=re.MULTILINE)


def main(reports: list[str]) -> None:
    """Take reports over, write README's row and the picture."""
    kept: dict[str, Any] = json.loads(DATA.read_text(encoding="utf-8")) if DATA.is_file() else {"rows": []}
    rows, engine = kept["rows"], kept.get("engine")
    for path in reports:
        report = json.loads(Path(path).read_text(encoding="utf-8"))
        rows = merged(rows, report)
        if "engine" in report:
            engine = {**report["engine"], "measured": {**report["machine"], "rounds": report["rounds"]}}
    DATA.write_text(json.dumps({"rows": rows} | ({"engine": engine} if engine else {}), indent=1) + "\n", encoding="utf-8")
    README.write_text(write_readme(README.read_text(encoding="utf-8"), rows), encoding="utf-8")
    if engine:
        save_picture(engine, PICTURE)


if __name__ == "__main__":
    main(sys.argv[1:])
