"""Measure speed and accuracy on this machine, paired and interleaved with the peer: medians and the spread of the ratio."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import tyro
from rich.console import Console

from studies.bench.measure import Measurement, Size, machine
from wlr_gym.base.errors import InputError, unknown_name
from wlr_gym.base.files import refuse_existing, require_ending, write_json
from wlr_gym.base.progress import progress
from wlr_gym.base.text import tally
from wlr_gym.cli import OK, run_program
from wlr_gym.cli.options import ForceOption, JsonOption, ray_address
from wlr_gym.cli.terminal import print_json, print_table

if TYPE_CHECKING:
    from studies.bench.engine import EngineReport
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
    "convergence": "studies.bench.speed:measure_convergence",
    "vision": "studies.bench.vision:measure_vision",
    "bus": "studies.bench.bus:measure_bus",
    "perception": "studies.bench.bus:measure_perception",
    "camera": "studies.bench.camera_chain:measure_camera",
}
#: Take long or need packages that few have: only made when named.
_ON_REQUEST = ("vision", "bus", "camera", "perception", "learning")
#: Its own kind: hours, resumable, with a folder of results. See docs/gap_benchmark.md.
BLIND_TEST = "gap"
#: Another: what a hidden fault costs a policy, and how much of it is won back. See docs/adapt.md.
ADAPT_STUDY = "adapt"
#: Another: how soon, and how rightly, the gap workflow decides when it chooses the runs. See docs/gap.md.
DECIDE_STUDY = "decide"
_ALONE = (ADAPT_STUDY, BLIND_TEST, DECIDE_STUDY)
#: Another: films of a lab, as ``vision`` has them with ``--out``.
LAB_FILMS = "vision with --out"
#: Option -> those of the above that take it.
_TAKEN_BY = {
    **dict.fromkeys(("cases", "contenders"), (ADAPT_STUDY, DECIDE_STUDY)),
    **dict.fromkeys(("ray", "answers", "classifier"), (BLIND_TEST,)),
    "sets": (BLIND_TEST, LAB_FILMS),
    "seed": (LAB_FILMS,),
    "processes": (BLIND_TEST, DECIDE_STUDY),
}
SCHEMA = 1


@dataclass(frozen=True)
class BenchOptions(JsonOption, ForceOption):
    what: tyro.conf.Positional[tuple[str, ...]] = ()
    """Measurements to make, as with --only."""
    only: tuple[str, ...] = ()
    """Some of engine, mujoco, env_step, ppo, import, start, batch, convergence; on request: learning, bus, camera, perception,
    vision. gap (the blind test of the gap workflow), adapt (what adaptation wins back), decide (gap --until-decided):
    alone, with --out."""
    save: Path | None = None
    """File (.json) for all numbers; the picture of the engine is written beside it."""
    rounds: int = 5
    """Rounds of every pair."""
    quick: bool = False
    """Tiny sizes: shows that it runs; the numbers mean nothing."""
    out: Path | None = None
    """gap, adapt, decide: folder for results; an interrupted test resumes from it.
    vision: instead of the table, film a lab that is not perfect and keep every film's result here; resumes likewise."""
    cases: tuple[str, ...] = ()
    """adapt: names of cases, or how many of them; default: all. decide: how many; default: 31."""
    contenders: tuple[str, ...] = ()
    """adapt: none, truth, wide, ours, calibrated; default: all. decide: chosen, random, eight."""
    sets: int | None = None
    """gap: data sets; default: 400, 240 of all kinds and 160 more without an effect. vision with --out: films; default: 60."""
    seed: int | None = None
    """vision: with --out, of the films; default: 28; another one gives other films."""
    processes: int = 2
    """gap: data sets at a time; decide: contenders."""
    ray: tuple[str, ...] | None = None
    """gap: run on Ray: alone, it is started on this machine; with an address (auto, 10.0.0.1:6379), that cluster is used."""
    answers: Path | None = None
    """gap: answers.json of another folder; its sets are not analysed again, but for those that failed."""
    classifier: int = 0
    """gap: afterwards train the baseline, a classifier on the scores of the first screening, on so many sets of the engine
    (kept in --out; half a minute each), and score its answers to the same data sets."""


def run(options: BenchOptions) -> int:
    """Measure, print, write."""
    asked = (*options.what, *options.only)
    for name in asked:
        if name not in (*MEASUREMENTS, *_ALONE):
            raise unknown_name("measurement", name, (*MEASUREMENTS, *_ALONE))
    if options.rounds < 1:
        raise InputError(f"--rounds {options.rounds}: expected 1 or more")
    if options.save is not None:
        if not options.save.parent.is_dir():
            raise InputError(f"--save {options.save}: folder {options.save.parent} does not exist")
        require_ending(options.save, (".json",), "--save")
        refuse_existing(options.save, options.force, "--save")
    for name in _ALONE:
        if name in asked and len(asked) > 1:
            raise InputError(f"{name} takes hours and is run alone, not with {', '.join(set(asked) - {name})}")
    study = next((name for name in asked if name in _ALONE), "" if options.out is None else LAB_FILMS)
    for one in fields(options):
        if study not in _TAKEN_BY.get(one.name, (study,)) and getattr(options, one.name) != one.default:
            raise InputError(f"--{one.name}: for {' or '.join(_TAKEN_BY[one.name])}; got {', '.join(asked) or 'nothing'}")
    if ADAPT_STUDY in asked:
        return _adapt_study(options)
    if DECIDE_STUDY in asked:
        return _decide_study(options)
    if BLIND_TEST in asked:
        return _blind_test(options)
    if options.out is not None:
        return _lab_films(options, asked)
    console = Console()
    here = machine()
    report: dict[str, Any] = {"schema": SCHEMA, "machine": here, "rounds": options.rounds, "quick": options.quick}
    report |= {"measurements": [], "convergence": [], "vision": []}
    console.print(f"{here['processor']}, {here['cores']} cores, {here['system']}; {tally(here['versions'])}")
    names = asked or tuple(name for name in MEASUREMENTS if name not in _ON_REQUEST)
    for name, rows in _measured(names, Size(options.rounds, options.quick), console):
        if name == "engine":
            rows = _engine_pairs(rows, report, console, options.save)
        report[name if name in _TABLES else "measurements"] += [row.as_dict() for row in rows]
        _TABLES.get(name, _print_speed)(rows, console)
    if options.json:
        print_json(report)
    if options.save is not None:
        write_json(options.save, report)
        print(f"written: {options.save}")
    return OK


def _measured(names: Sequence[str], size: Size, console: Console) -> Iterator[tuple[str, Any]]:
    """Yield each measurement and what came of it, under a bar with the remaining time."""
    with progress(console) as tell:
        for done, name in enumerate(names):

            def told(share: float, done: int = done, name: str = name) -> None:
                tell("", f"measuring {name}", (done + share) / len(names))

            told(0.0)
            module, _, function = MEASUREMENTS[name].partition(":")
            yield name, getattr(importlib.import_module(module), function)(replace(size, tell=told))


def _engine_pairs(found: EngineReport, report: dict[str, Any], console: Console, save: Path | None) -> list[Measurement]:
    """Put accuracy and speed of all settings into the report, print them, draw them beside it; return the ratios."""
    from studies.bench import engine

    report["engine"] = found.as_dict()
    console.print(engine.reference_text(report["engine"]), markup=False, highlight=False)
    print_table(console, *engine.settings_table(report["engine"]), "all settings")
    if save is not None:
        picture = save.with_name(f"{save.stem}_engine.png")
        engine.save_picture(report["engine"], picture)
        print(f"written: {picture}")
    return engine.pairs(found.results)


def _folder(options: BenchOptions, study: str, kept: str) -> Path:
    if options.out is None:
        raise InputError(f"{study} needs --out DIR: finished {kept} are kept there, so that it can be interrupted")
    return options.out


def _write(path: Path, text: str, console: Console) -> None:
    """Write a report, and show it."""
    path.write_text(text, encoding="utf-8")
    console.print(text, markup=False, highlight=False)


def _end(options: BenchOptions, found: Any, console: Console, *names: str) -> int:
    """Print what was found as JSON, if asked, and the names of the files in the folder."""
    if options.json:
        print_json(found)
    assert options.out is not None
    console.print(f"written: {', '.join(str(options.out / name) for name in names)}")
    return OK


def _blind_test(options: BenchOptions) -> int:
    """Test the gap workflow on data sets with hidden truths; print and write its score."""
    from studies.bench import gap

    out, console = _folder(options, BLIND_TEST, "data sets"), Console(soft_wrap=True)
    plan = gap.Plan(out, gap.ALL_SETS if options.sets is None else options.sets, options.processes)
    report = gap.run_blind_test(plan, say=console.print, answers=options.answers, ray=ray_address(options.ray))
    _write(out / "score.md", gap.markdown(report), console)
    if options.classifier:
        found = gap.score_classifier(plan, options.classifier, console.print)
        _write(out / "score_classifier.md", gap.markdown(found), console)
    if options.save is not None:
        write_json(options.save, report)
    return _end(options, report, console, "score.json", "score.md", "answers.json")


def _adapt_study(options: BenchOptions) -> int:
    """Adapt a policy to robots with hidden faults, and others beside it; print and write the table."""
    from studies.bench import adapt

    out, console = _folder(options, ADAPT_STUDY, "cases"), Console(soft_wrap=True, highlight=False)
    for name in options.contenders:
        if name not in adapt.CONTENDERS:
            raise unknown_name("contender", name, adapt.CONTENDERS)
    contenders = options.contenders or tuple(adapt.CONTENDERS)
    study = adapt.AdaptStudy(out, adapt.chosen_cases(options.cases), contenders=contenders)
    lines = adapt.run_adapt_study(study.quick() if options.quick else study, console.print)
    _write(out / "adapt.md", adapt.markdown(lines), console)
    return _end(options, lines, console, adapt.LINES_FILE, "adapt.md")


def _decide_study(options: BenchOptions) -> int:
    """Let the gap workflow choose what robots with hidden effects drive, and others beside it; print and write the tables."""
    from studies.bench import decide

    out, console = _folder(options, DECIDE_STUDY, "cases"), Console(soft_wrap=True, highlight=False, markup=False)
    if len(options.cases) > 1 or not all(count.isdecimal() for count in options.cases):
        raise InputError(f"--cases {' '.join(options.cases)}: decide takes how many, 1 or more")
    count = int(options.cases[0]) if options.cases else decide.CASES
    contenders = options.contenders or tuple(decide.CONTENDERS)
    lines = decide.run_decide_study(out, count, contenders, options.processes, console.print)
    _write(out / "decide.md", decide.markdown(lines), console)
    return _end(options, lines, console, decide.LINES_FILE, "decide.md")


def _lab_films(options: BenchOptions, asked: tuple[str, ...]) -> int:
    """Film a lab that is not perfect; print and write the score."""
    from studies.bench.lab_films import FILMS, SEED, bars, run_lab_films, score

    if asked != ("vision",) or options.out is None:
        raise InputError(f"--out: for {', '.join(_ALONE)} or vision, alone; got {', '.join(asked) or 'nothing'}")
    console = Console(soft_wrap=True, highlight=False)
    count = FILMS if options.sets is None else options.sets
    if count < 1:
        raise InputError(f"--sets {count}: expected 1 or more")
    seed = SEED if options.seed is None else options.seed
    results = run_lab_films(options.out, count, seed, lambda text: console.print(text, markup=False))
    found = score(results)
    report = {"machine": machine(), "seed": seed, "score": found, "films": [asdict(result) for result in results]}
    for path in (options.out / "score.json", *([] if options.save is None else [options.save])):
        write_json(path, report)
    rows = [(what, value, bar, _YES_NO[met]) for what, value, bar, met in bars(found)]
    print_table(console, ("what", "found", "bar", "met"), rows, f"{count} films of a lab")
    return _end(options, report, console, "score.json")


def _print_speed(rows: Sequence[Measurement], console: Console) -> None:
    """Print what was measured; a peer is named below what it is held against, one unit of all rows in the title."""
    units = {row.unit for row in rows}
    cells = []
    for row in rows:
        found = row.as_dict()
        peer = f"{found['peer']['median']:,.0f}" if row.peer else "-"
        ratio = "{median:.3g} [{min:.3g}..{max:.3g}]".format(**found["ratio"]) if row.peer else "-"
        ratio = f">= {ratio}" if row.at_least else ratio
        bar = "-" if row.bar is None else f">= {row.bar:.3g}" if row.peer else f"< {row.bar:g}"
        what = f"{row.what}\n  peer: {row.peer_name}" if row.peer else row.what
        form = "{median:.2f} [{min:.2f}..{max:.2f}]" if row.unit in ("s", "-") else "{median:,.0f}"
        ours = form.format(**found["ours"])
        cells.append((what, ours if len(units) == 1 else f"{ours} {row.unit}", peer, ratio, bar, _YES_NO[row.met]))
    title = f"{rows[0].name}, {units.pop()}" if len(units) == 1 else rows[0].name
    print_table(console, ("what", "ours", "peer", "ratio [min..max]", "bar", "met"), cells, title)


_YES_NO = {True: "yes", False: "NO", None: "-"}


def _print_convergence(rows: Sequence[Deviation], console: Console) -> None:
    cells = [
        (row.case, row.quantity, str(row.value),
         *(f"{1e3 * value:.2g}" for value in (row.median, row.percentile_90, row.worst))) for row in rows
    ]  # fmt: skip
    title = "convergence: deviation of the position after 1 s, mm (64 robots)"
    print_table(console, ("case", "quantity", "value", "median", "90 %", "worst"), cells, title)


def _print_vision(rows: Sequence[VisionResult], console: Console) -> None:
    cells = []
    for row in rows:
        bar = "-" if row.bar is None else f"{'>=' if row.least else '<='} {row.bar:g}"
        cells.append((row.what, row.method, f"{row.value:.3g} {row.unit}", bar, _YES_NO[row.met], str(row.count)))
    print_table(console, ("what", "method", "value", "bar", "met", "samples"), cells, "vision (rendered)")


#: Measurements with rows of their own kind; each has its list in the report.
_TABLES = {"convergence": _print_convergence, "vision": _print_vision}


def main(arguments: Sequence[str] | None = None) -> int:
    """Run ``python -m studies.bench`` and return its exit code."""
    return run_program("python -m studies.bench", BenchOptions, run, __doc__ or "", arguments)


if __name__ == "__main__":
    sys.exit(main())
