"""Find what the model lacks: compare it with measured runs, name the missing effect, validate it on held-out runs.

Writes report.html, result.json, patch.yaml (the effects found, for --effects), plots, config.yaml and provenance.yaml.
docs/gap.md says how to read the report. --until-decided has further runs driven, and analyses again; then each round has a
folder of its own.
"""

from __future__ import annotations

import json
import math
import os
from collections.abc import Iterator
from dataclasses import dataclass, fields
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import tyro

from wlr_gym.base.errors import InputError, unknown_name
from wlr_gym.base.progress import progress
from wlr_gym.cli import FAILED, OK
from wlr_gym.cli.gap_decide import DecideOptions, print_rounds, recorder_of
from wlr_gym.cli.options import ForceOption, JsonOption, PatchOption, require_counts, settings_of
from wlr_gym.cli.results import print_json

if TYPE_CHECKING:
    from rich.console import Console

    from wlr_gym.gap.analysis import Analysis
    from wlr_gym.physics.effects import Patch


@dataclass(frozen=True)
class GapOptions(DecideOptions, JsonOption, ForceOption, PatchOption):
    data: tyro.conf.Positional[Path]
    """Folder of measured runs; with --rig, of recordings of the rig."""
    out: Path
    """Folder for the results; made if it is not there."""
    rig: str | None = None
    """Runs of something else than the robot: pendulum (one servo that swings a weight), or a Python file that describes a
    system of your own (docs/own_rig.md)."""
    robot: str | None = None
    """Robot file, or name in configs/robot/; default: the one that meta.yaml names, else the nominal one."""
    backend: str = "gibbs_appell"
    """Simulator of the robot: gibbs_appell or mujoco."""
    heldout: tuple[str, ...] = ()
    """Runs to hold out for validation; default: chosen by how informative the other runs are."""
    threads: int | None = None
    """Worker threads; default: one per core."""


def run(options: GapOptions) -> int:
    """Analyse, print, write; 0 for every verdict but ``bad_data``, which is 1.

    Raises:
        InputError: no such data, unknown effect, rig, backend or run, an output folder that cannot be used.
    """
    from rich.console import Console

    from wlr_gym.base.files import refuse_existing
    from wlr_gym.base.provenance import record_provenance
    from wlr_gym.gap.analysis import BAD_DATA
    from wlr_gym.gap.report.page import check_folder
    from wlr_gym.gap.report.result import RESULT_FILE
    from wlr_gym.gap.workflow import analyse

    _check(options)
    known = _known(options)
    console = Console(soft_wrap=True, highlight=False)
    if options.until_decided:
        return _decide(options, known, console)
    refuse_existing(options.out / RESULT_FILE, options.force)
    check_folder(options.out)
    with progress(console) as tell:
        analysis = analyse(
            options.data,
            options.out,
            known=known,
            rig=options.rig,
            robot=options.robot,
            backend=options.backend,
            heldout=options.heldout,
            threads=options.threads or os.cpu_count() or 1,
            tell=partial(tell, ""),
        )
    record_provenance(options.out, settings_of(options) | {"effects": known.content()["effects"]})
    if options.json:
        print_json(json.loads((options.out / RESULT_FILE).read_text(encoding="utf-8")))
    else:
        _print(analysis, options.out, console)
    return FAILED if analysis.verdict == BAD_DATA else OK


def _decide(options: GapOptions, known: Patch, console: Console) -> int:
    """Have runs driven until it is decided; 1 where the last analysis could not be made."""
    from wlr_gym.data.read import read_dataset
    from wlr_gym.data.replay import robot_of
    from wlr_gym.gap.analysis import BAD_DATA
    from wlr_gym.gap.decision import Budget, decide
    from wlr_gym.gap.report.page import REPORT_FILE
    from wlr_gym.gap.report.result import RESULT_FILE

    budget = Budget(options.budget_runs, math.inf if options.budget_seconds is None else options.budget_seconds)
    robot = robot_of(read_dataset(options.data).runs[0], options.robot)
    with progress(console) as tell:
        decision = decide(
            options.data,
            options.out,
            recorder_of(options, robot, options.backend, options.out, console),
            budget,
            known=known,
            robot=options.robot,
            backend=options.backend,
            threads=options.threads or os.cpu_count() or 1,
            tell=partial(tell, ""),
        )
    print_rounds(decision, console)
    if decision.result is None:
        return FAILED
    if options.json:
        print_json(json.loads((decision.folder / RESULT_FILE).read_text(encoding="utf-8")))
    console.print(decision.result.summary, markup=False)
    console.print(f"report: {decision.folder / REPORT_FILE}", markup=False)
    return FAILED if decision.result.verdict == BAD_DATA else OK


def _check(options: GapOptions) -> None:
    from wlr_gym.data.read import run_files
    from wlr_gym.gap.rig.own import load_rig
    from wlr_gym.gap.workflow import OWN_RIG, RIGS
    from wlr_gym.physics.plants import check_simulator
    from wlr_gym.robot import load_robot

    if not options.data.is_dir():
        what = "is a file" if options.data.exists() else "no such folder"
        raise InputError(f"{options.data}: {what}; expected a folder of runs")
    check_simulator(options.backend, "--backend")
    if options.rig is not None and options.rig not in RIGS and not options.rig.endswith(OWN_RIG):
        raise unknown_name("rig", options.rig, RIGS)
    if options.rig is not None and (options.backend != GapOptions.backend or options.robot is not None):
        raise InputError(f"--rig {options.rig}: the rig has a simulator of its own: leave --backend and --robot out")
    if options.rig is not None and options.rig.endswith(OWN_RIG):
        load_rig(options.rig)
    if options.robot is not None:
        load_robot(options.robot)
    for name in options.effects:
        if Path(name).resolve().parent == options.out.resolve() and Path(name).is_file():
            raise InputError(f"--effects {name}: the results would replace it: give another --out")
    if options.until_decided and (options.rig is not None or options.heldout):
        raise InputError("--until-decided: runs of the robot, held out anew in every round: leave --rig and --heldout out")
    given = [one.name for one in fields(DecideOptions) if getattr(options, one.name) != one.default]
    if given and not options.until_decided:
        raise InputError(f"--{given[0].replace('_', '-')}: it is for --until-decided")
    runs = [path.stem for path in run_files(options.data)] if options.rig is None else []
    for name in options.heldout:
        if runs and name not in runs:
            raise unknown_name("run", name, runs, "--heldout")
    require_counts(options, "threads")
    require_counts(options, "budget_runs", "budget_seconds", least=0)


def _known(options: GapOptions) -> Patch:
    """The effects given as known, in the vocabulary of the robot or of the rig."""
    from wlr_gym.gap.workflow import known_patch

    try:
        return options.patch() if options.rig is None else known_patch(list(options.effects), options.rig)
    except InputError as error:
        raise InputError(f"--effects: {error}") from None


# ---- the summary -----------------------------------------------------------------------------------------------------


def _print(analysis: Analysis, out: Path, console: Console) -> None:
    from wlr_gym.gap.analysis import BAD_DATA
    from wlr_gym.gap.report.page import REPORT_FILE
    from wlr_gym.gap.report.result import PATCH_FILE, RESULT_FILE
    from wlr_gym.gap.report.text import closure, made_worse, sentence, title

    colours = {"bad_data": "red", "not_excited": "yellow", "nothing_missing": "green"}
    console.print(title(analysis), style=f"bold {colours.get(analysis.verdict, 'blue')}")
    said = [sentence(analysis), *filter(None, [made_worse(analysis), closure(analysis)])]
    for line in (*said, *_findings(analysis), *_numbers(analysis), *_advice(analysis)):
        console.print(line, markup=False)
    files = [("report", REPORT_FILE), ("result", RESULT_FILE)]
    if analysis.verdict != BAD_DATA:
        files.append(("patch", PATCH_FILE))
    for label, name in files:
        console.print(f"{label}: {out / name}", markup=False)


def _findings(analysis: Analysis) -> Iterator[str]:
    for finding in analysis.intake:
        place = f"{finding.place}: " if finding.place else ""
        yield f"  {'FATAL' if finding.fatal else 'data'}: {place}{finding.said}"


def _numbers(analysis: Analysis) -> Iterator[str]:
    from wlr_gym.gap.report.text import error, estimate, percent, places, plain, removed

    for effect in analysis.effects:
        values = ", ".join(f"{name} {estimate(found)}" for name, found in effect.parameters.items())
        told = [effect.formula, values, f"selection frequency {percent(effect.confidence)}"]
        yield f"  {plain(effect.name)} at {places(effect.where)}: {'; '.join(filter(None, told))}"
    gap = analysis.gap
    if gap is not None:
        steps = [f"{error(gap.heldout_before)} as given", f"{error(gap.heldout_calibrated)} calibrated"]
        steps += [f"{error(gap.heldout_after)} with the effects"] if analysis.added else []
        yield f"  error of the held-out runs, 1 = sensor noise: {', '.join(steps)}; noise floor {error(gap.noise_floor)}"
        if analysis.added:
            yield f"  removed of the avoidable error: {removed(analysis)}"


def _advice(analysis: Analysis) -> Iterator[str]:
    from wlr_gym.gap.report.text import listed, plain

    for group in analysis.equivalent:
        names = listed([plain(name) for name in group.names])
        yield f"  not distinguishable: {names}; discriminating experiment: {group.separating_run}"
    for one in analysis.recommendations:
        yield f"  record next: {one.excitation}: {one.why}"
