"""Find what the model lacks: compare it with measured runs, name the missing effect, validate it on held-out runs.

Writes report.html, result.json, patch.yaml (the effects found, for --effects), plots, config.yaml and provenance.yaml.
docs/gap.md says how to read the report. --until-decided has further runs driven, and analyses again; then each round has a
folder of its own.
"""

from __future__ import annotations

import json
import math
import time
from collections.abc import Callable, Iterator
from contextlib import closing
from dataclasses import dataclass, fields
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from rich.console import Console
from tyro.conf import Positional

from wlr_gym.base.errors import InputError, Interval, check_folder, check_name
from wlr_gym.base.files import refuse_existing
from wlr_gym.base.jobs import cores
from wlr_gym.base.progress import progress
from wlr_gym.base.provenance import record_provenance
from wlr_gym.base.text import duration, quoted
from wlr_gym.cli import FAILED, OK
from wlr_gym.cli.options import (
    Count,
    JsonOption,
    OutOption,
    PatchOption,
    RobotOption,
    RunsRobotOption,
    handed,
    noise_seed,
    refuse_given,
    settings_of,
)
from wlr_gym.cli.terminal import print_json, print_table
from wlr_gym.robot import Robot, load_robot

if TYPE_CHECKING:
    from wlr_gym.data.excitations import Motion
    from wlr_gym.gap.analysis import Analysis
    from wlr_gym.gap.decision import Decided, Recorded, Recorder
    from wlr_gym.physics.effects import Patch


#: s between two looks for the run that was asked for.
LOOK = 1.0
#: Folder of the motions that were asked for, in the results' folder.
ASKED = "motions"


@dataclass(frozen=True, kw_only=True)
class DecideOptions:
    """Options of ``--until-decided``."""

    until_decided: bool = False
    """Have further runs driven, each chosen by what it would tell per second, until it is decided; see --record."""
    record: Literal["emulated", "simulator", "ask"] = "ask"
    """Who drives them: an emulated robot, the simulator (--backend), or you: the motion is written and the run waited for."""
    hidden: tuple[str, ...] = ()
    """What the emulated or simulated robot has that its file does not say: patch files or names, to try the workflow."""
    budget_runs: Annotated[int, Interval(least=0)] = 5
    """Most further runs."""
    budget_seconds: Annotated[float, Interval("s", least=0.0)] | None = None
    """Most seconds of driving; default: as many as the runs take."""


@dataclass(frozen=True)
class GapOptions(DecideOptions, JsonOption, OutOption, RunsRobotOption, PatchOption):
    data: Positional[Path]
    """Folder of measured runs; with --rig, of recordings of the rig."""
    rig: str | None = None
    """Runs of something else than the robot: pendulum (one servo that swings a weight), or a Python file that describes a
    system of your own (docs/own_rig.md)."""
    backend: str = "gibbs_appell"
    """Simulator of the robot: gibbs_appell or mujoco."""
    heldout: tuple[str, ...] = ()
    """Runs to hold out for validation; default: chosen by how informative the other runs are."""
    threads: Count | None = None
    """Worker threads; default: one per core that this process may use."""


def run(options: GapOptions) -> int:
    """Analyse, print, write; 0 for every verdict but ``bad_data``, which is 1.

    Raises:
        InputError: no such data, unknown effect, rig, backend or run, an output folder that cannot be used.
    """
    from wlr_gym.gap.analysis import BAD_DATA
    from wlr_gym.gap.report.page import check_folder as check_results
    from wlr_gym.gap.report.result import RESULT_FILE
    from wlr_gym.gap.workflow import analyse

    known, threads = _checked(options), options.threads or cores()
    console = Console(soft_wrap=True, highlight=False)
    if options.until_decided:
        return _decide(options, known, threads, console)
    refuse_existing(options.out / RESULT_FILE, options.force)
    check_results(options.out)
    with progress(console) as tell:
        analysis = analyse(
            options.data,
            options.out,
            known=known,
            rig=options.rig,
            robot=options.robot,
            backend=options.backend,
            heldout=options.heldout,
            threads=threads,
            tell=partial(tell, ""),
        )
    record_provenance(options.out, settings_of(options) | {"effects": known.content()["effects"]})
    if options.json:
        print_json(json.loads((options.out / RESULT_FILE).read_text(encoding="utf-8")))
    else:
        _print(analysis, options.out, console)
    return FAILED if analysis.verdict == BAD_DATA else OK


def _decide(options: GapOptions, known: Patch, threads: int, console: Console) -> int:
    """Have runs driven until it is decided; 1 where the last analysis could not be made."""
    from wlr_gym.data.runs import read_dataset, robot_of
    from wlr_gym.gap.analysis import BAD_DATA
    from wlr_gym.gap.decision import Budget, decide
    from wlr_gym.gap.report.page import REPORT_FILE
    from wlr_gym.gap.report.result import RESULT_FILE

    budget = Budget(options.budget_runs, math.inf if options.budget_seconds is None else options.budget_seconds)
    robot = robot_of(read_dataset(options.data).runs[0], options.robot)
    with progress(console) as tell:
        record = recorder_of(options, robot, options.backend, options.out, console)
        own = {"record": record, "budget": budget, "known": known, "threads": threads, "tell": partial(tell, "")}
        decision = decide(**handed(options, decide, **own))
    print_rounds(decision, console)
    if decision.result is None:
        return FAILED
    if options.json:
        print_json(json.loads((decision.folder / RESULT_FILE).read_text(encoding="utf-8")))
    console.print(decision.result.summary, markup=False)
    console.print(f"report: {decision.folder / REPORT_FILE}", markup=False)
    return FAILED if decision.result.verdict == BAD_DATA else OK


def _checked(options: GapOptions) -> Patch:
    """Refuse what cannot be analysed; return the effects given as known, in the vocabulary of the robot or of the rig."""
    from wlr_gym.data.runs import run_files
    from wlr_gym.gap.rig.own import load_rig
    from wlr_gym.gap.workflow import OWN_RIG, RIGS, known_patch
    from wlr_gym.physics.plants import check_simulator

    check_folder(options.data, of="runs")
    check_simulator(options.backend, "--backend")
    if options.rig is None:
        runs = [path.stem for path in run_files(options.data)]
        for name in options.heldout if runs else ():  # of an empty folder, the analysis says more
            check_name("run", name, runs, "--heldout")
    else:
        refuse_given(options, ("backend", "robot"), f"--rig {options.rig} has a simulator of its own: leave it out")
        load_rig(options.rig) if options.rig.endswith(OWN_RIG) else check_name("rig", options.rig, RIGS)
    if options.robot is not None:
        load_robot(options.robot)
    if options.until_decided:
        why = "--until-decided drives the robot, and holds out anew in every round: leave it out"
        refuse_given(options, ("rig", "heldout"), why)
    else:
        refuse_given(options, [one.name for one in fields(DecideOptions)], "it is for --until-decided")
    for name in options.effects:
        if Path(name).resolve().parent == options.out.resolve() and Path(name).is_file():
            raise InputError(f"--effects {name}: the results would replace it: give another --out")
    try:
        return known_patch(list(options.effects), options.rig)
    except InputError as error:
        raise InputError(f"--effects: {error}") from None


# ---- the summary -----------------------------------------------------------------------------------------------------


def _print(analysis: Analysis, out: Path, console: Console) -> None:
    from wlr_gym.gap.analysis import BAD_DATA
    from wlr_gym.gap.report.page import REPORT_FILE
    from wlr_gym.gap.report.result import PATCH_FILE, RESULT_FILE
    from wlr_gym.gap.report.text import title

    colours = {"bad_data": "red", "not_excited": "yellow", "nothing_missing": "green"}
    console.print(title(analysis), style=f"bold {colours.get(analysis.verdict, 'blue')}")
    for line in _summary(analysis):
        console.print(line, markup=False)
    for label, name in (("report", REPORT_FILE), ("result", RESULT_FILE), ("patch", PATCH_FILE)):
        if name != PATCH_FILE or analysis.verdict != BAD_DATA:
            console.print(f"{label}: {out / name}", markup=False)


def _summary(analysis: Analysis) -> Iterator[str]:
    """Yield the verdict, what was noticed about the data, the effects, the errors, and what to record next."""
    from wlr_gym.gap.report.text import closure, error, estimate, listed, made_worse, percent, places, plain, removed, sentence

    yield from filter(None, [sentence(analysis), made_worse(analysis), closure(analysis)])
    for finding in analysis.intake:
        said = ": ".join(filter(None, [finding.place, finding.said]))
        yield f"  {'FATAL' if finding.fatal else 'data'}: {said}"
    for effect in analysis.effects:
        values = ", ".join(f"{name} {estimate(found)}" for name, found in effect.parameters.items())
        told = [effect.formula, values, f"selection frequency {percent(effect.confidence)}"]
        yield f"  {plain(effect.name)} at {places(effect.where)}: {'; '.join(filter(None, told))}"
    if (gap := analysis.gap) is not None:
        steps = [f"{error(gap.heldout_before)} as given", f"{error(gap.heldout_calibrated)} calibrated"]
        steps += [f"{error(gap.heldout_after)} with the effects"] if analysis.added else []
        yield f"  error of the held-out runs, 1 = sensor noise: {', '.join(steps)}; noise floor {error(gap.noise_floor)}"
        if analysis.added:
            yield f"  removed of the avoidable error: {removed(analysis)}"
    for group in analysis.equivalent:
        names = listed([plain(name) for name in group.names])
        yield f"  not distinguishable: {names}; discriminating experiment: {group.separating_run}"
    for one in analysis.recommendations:
        yield f"  record next: {one.excitation}: {one.why}"


# ---- further runs ------------------------------------------------------------------------------------------------------


def recorder_of(options: DecideOptions, robot: Robot, backend: str, out: Path, console: Console) -> Recorder:
    """Return what has a motion driven.

    Raises:
        InputError: ``--hidden`` for a real robot, or a patch that cannot be read.
    """
    from wlr_gym.physics.effects import load_patch

    if options.record == "ask":
        if options.hidden:
            raise InputError("--hidden: a real robot has its own effects; they are for --record emulated and simulator")
        return partial(ask, out=out, console=console)
    hidden = load_patch(list(options.hidden))
    if options.record == "emulated":
        return partial(_emulated, robot=robot, hidden=hidden)
    return partial(_simulated, robot=robot, hidden=hidden, backend=backend)


def ask(motion: Motion, data: Path, *, out: Path, console: Console, wait: Callable[[float], None] = time.sleep) -> Recorded:
    """Write a motion, say how it is driven, and wait until its run is in the folder of the data."""
    from wlr_gym.data.record import write_commands
    from wlr_gym.data.runs import read_run, run_files
    from wlr_gym.gap.decision import Recorded

    there = set(run_files(data))
    path = write_commands(out / ASKED, motion)
    command = f"wlr record --commands {quoted(path)} --out {quoted(data)}"
    console.print(f"drive {motion.name} ({motion.duration:.0f} s): {command}", markup=False)
    console.print("(a real robot: with --hardware FILE) waiting for its run; Ctrl-C: the same command goes on later")
    size = -1
    while True:
        new = [path for path in run_files(data) if path not in there]
        if new and new[0].stat().st_size == size:
            try:
                read_run(new[0])
            except InputError as error:  # it may be half written, or wrong
                console.print(f"not usable yet: {error}", markup=False)
            else:
                return Recorded(new[0])
        size = new[0].stat().st_size if new else -1
        wait(LOOK)


def _simulated(motion: Motion, data: Path, *, robot: Robot, hidden: Patch, backend: str) -> Recorded:
    """Drive the simulator; no two runs of a folder have the same noise."""
    from wlr_gym.base.random import spawn_seeds
    from wlr_gym.data.record import record_simulation
    from wlr_gym.data.runs import next_run, read_meta
    from wlr_gym.gap.decision import Recorded

    path = next_run(data)
    seed = int(spawn_seeds(0, 1, path.stem)[0])
    return Recorded(record_simulation(path, motion, robot, backend, seed, hidden, read_meta(data)))


def _emulated(motion: Motion, data: Path, *, robot: Robot, hidden: Patch) -> Recorded:
    """Drive an emulated robot in emulated time, through the command limiter as a real one; noise as in a simulator."""
    from wlr_gym.data.runs import read_meta
    from wlr_gym.gap.decision import Recorded
    from wlr_gym.hardware.deployment import drive_robot

    meta = read_meta(data).model_copy(update={"profile": motion.profile})
    with closing(RobotOption(emulated=True).plant_of(robot, data, meta, hidden, noise_seed(data, 0))) as plant:
        drive = drive_robot(plant, motion)
    return Recorded(drive.run, drive.reason)


def print_rounds(decision: Decided, console: Console) -> None:
    """Print a row for every round, and how it ended."""
    from wlr_gym.gap.report.text import plain

    history = decision.history
    rows = []
    for one in history.rounds:
        left = ", ".join(f"{plain(name)} {share:.0%}" for name, share in one.names.items()) or plain(one.verdict)
        driven = one.excitation and f"{one.excitation}{f' ({one.run})' if one.run else ''}"
        why = "; ".join(filter(None, [one.why, one.stopped]))
        rows.append((str(one.number), str(len(one.runs)), left, driven or "", f"{one.seconds:.0f}" if one.run else "", why))
    print_table(console, ("round", "runs", "names left", "drive next", "seconds", "why"), rows)
    console.print(f"{history.ended}, after {len(history.driven)} further runs, {duration(history.seconds)} of driving")
