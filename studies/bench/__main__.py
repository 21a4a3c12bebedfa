"""Measure speed and accuracy on this machine, paired and interleaved with the peer: medians and the spread of the ratio."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro
from rich.console import Console

from studies.bench.measure import YES_NO, Measurement, Size, machine, speed_cells
from wlr_gym.base.errors import InputError, Interval, check_folder, check_name
from wlr_gym.base.files import refuse_existing, require_ending, write_json
from wlr_gym.base.progress import progress
from wlr_gym.base.text import tally
from wlr_gym.cli import OK, run_program
from wlr_gym.cli.options import ForceOption, JsonOption
from wlr_gym.cli.terminal import print_json, print_table

if TYPE_CHECKING:
    from studies.bench.speed import Deviation
    from studies.bench.vision import VisionResult

#: Measurement -> function. Imported when it is run.
MEASUREMENTS = {
    "engine": "studies.bench.engine:measure_engine",
    "mujoco": "studies.bench.speed:measure_mujoco",
    "env_step": "studies.bench.speed:measure_env_step",
    "ppo": "studies.bench.training:measure_ppo",
    "learning": "studies.bench.training:measure_learning",
    "import": "studies.bench.speed:measure_import",
    "start": "studies.bench.speed:measure_start",
    "batch": "studies.bench.speed:measure_batch",
    "relief": "studies.bench.relief:measure_relief",
    "convergence": "studies.bench.speed:measure_convergence",
    "vision": "studies.bench.vision:measure_vision",
    "bus": "studies.bench.bus:measure_bus",
    "perception": "studies.bench.bus:measure_perception",
    "camera": "studies.bench.camera_chain:measure_camera",
}
#: Take long or need packages that few have: only made when named.
_ON_REQUEST = ("vision", "bus", "camera", "perception", "learning")
#: Studies with options of their own (module:options): they take hours, keep finished parts in --out and resume from it.
STUDIES = {
    "gap": "studies.bench.gap:BlindTestOptions",  # the blind test of the gap workflow, docs/gap_benchmark.md
    "adapt": "studies.bench.adapt:AdaptStudyOptions",  # what adaptation wins back of what a hidden fault costs, docs/adapt.md
    "decide": "studies.bench.decide:DecideStudyOptions",  # wlr gap --until-decided, docs/gap.md
    "films": "studies.bench.lab_films:LabFilmsOptions",  # films of a lab that is not perfect, docs/vision.md
    "fuzz": "studies.bench.fuzz:FuzzOptions",  # robots in random states on every floor
}
SCHEMA = 1


@dataclass(frozen=True)
class BenchOptions(JsonOption, ForceOption):
    what: tyro.conf.Positional[tuple[str, ...]] = ()
    """Measurements to make; default: engine, mujoco, env_step, ppo, import, start, batch, relief,
    convergence. On request: learning,
    bus, camera, perception, vision. Studies with options of their own, each with --help: gap, adapt, decide, films, fuzz."""
    save: Path | None = None
    """File (.json) for all numbers; the picture of the engine is written beside it."""
    rounds: Annotated[int, Interval(least=1)] = 5
    """Rounds of every pair."""
    quick: bool = False
    """Tiny sizes: shows that it runs; the numbers mean nothing."""


def run(options: BenchOptions) -> int:
    """Measure, print, write."""
    for name in options.what:
        if name in STUDIES:
            raise InputError(f"{name}: takes hours and is run alone: python -m studies.bench {name} --out DIR")
        check_name("measurement", name, (*MEASUREMENTS, *STUDIES))
    if options.save is not None:
        check_folder(options.save.parent, "--save")
        require_ending(options.save, (".json",), "--save")
        refuse_existing(options.save, options.force, "--save")
    console, here = Console(), machine()
    report: dict[str, Any] = {"schema": SCHEMA, "machine": here, "rounds": options.rounds, "quick": options.quick}
    report |= {"measurements": [], "convergence": [], "vision": []}
    console.print(f"{here['processor']}, {here['cores']} cores, {here['system']}; {tally(here['versions'])}")
    names = options.what or tuple(name for name in MEASUREMENTS if name not in _ON_REQUEST)
    with progress(console) as tell:
        for done, name in enumerate(names):

            def told(share: float, done: int = done, name: str = name) -> None:
                tell("", f"measuring {name}", (done + share) / len(names))

            told(0.0)
            module, _, function = MEASUREMENTS[name].partition(":")
            rows = getattr(importlib.import_module(module), function)(Size(options.rounds, options.quick, told))
            if name == "engine":
                report["engine"] = rows
                rows = _engine_pairs(rows, console, options.save)
            report[name if name in _TABLES else "measurements"] += [row.as_dict() for row in rows]
            _TABLES.get(name, _print_speed)(rows, console)
    if options.json:
        print_json(report)
    if options.save is not None:
        write_json(options.save, report)
        print(f"written: {options.save}")
    return OK


def _engine_pairs(found: dict[str, Any], console: Console, save: Path | None) -> list[Measurement]:
    """Print accuracy and speed of all settings, draw them beside the report; return the ratios."""
    from studies.bench import engine

    console.print(engine.reference_text(found), markup=False, highlight=False)
    print_table(console, *engine.settings_table(found), "all settings")
    if save is not None:
        picture = save.with_name(f"{save.stem}_engine.png")
        engine.save_picture(found, picture)
        print(f"written: {picture}")
    return engine.pairs(found["settings"])


def _print_speed(rows: Sequence[Measurement], console: Console) -> None:
    cells = [(row.what, *speed_cells(row.as_dict()), YES_NO[row.met]) for row in rows]
    print_table(console, ("what", "ours", "peer", "ratio [min..max]", "bar", "met"), cells, rows[0].name)


def _print_convergence(rows: Sequence[Deviation], console: Console) -> None:
    cells = []
    for row in rows:
        millimetres = (f"{1e3 * value:.2g}" for value in (row.median, row.percentile_90, row.worst))
        cells.append((row.case, row.quantity, str(row.value), *millimetres))
    title = "convergence: deviation of the position after 1 s, mm (64 robots)"
    print_table(console, ("case", "quantity", "value", "median", "90 %", "worst"), cells, title)


def _print_vision(rows: Sequence[VisionResult], console: Console) -> None:
    cells = []
    for row in rows:
        bar = "-" if row.bar is None else f"{'>=' if row.least else '<='} {row.bar:g}"
        cells.append((row.what, row.method, f"{row.value:.3g} {row.unit}", bar, YES_NO[row.met], str(row.count)))
    print_table(console, ("what", "method", "value", "bar", "met", "samples"), cells, "vision (rendered)")


#: Measurements with rows of their own kind; each has its list in the report.
_TABLES = {"convergence": _print_convergence, "vision": _print_vision}


def find_program(words: Sequence[str]) -> tuple[Any, Any]:
    """Return the options, and what runs them, of the study that the first word names, or else of the measurements."""
    if not words or words[0] not in STUDIES:
        return BenchOptions, run
    module, _, kind = STUDIES[words[0]].partition(":")
    study = importlib.import_module(module)
    return getattr(study, kind), study.run


def main(arguments: Sequence[str] | None = None) -> int:
    """Run ``python -m studies.bench`` and return its exit code."""
    words = sys.argv[1:] if arguments is None else list(arguments)
    kind, function = find_program(words)
    if kind is BenchOptions:
        return run_program("python -m studies.bench", kind, function, __doc__ or "", words)
    return run_program(f"python -m studies.bench {words[0]}", kind, function, function.__doc__ or "", words[1:])


if __name__ == "__main__":
    sys.exit(main())
