"""Repeat the paper: its two tests on every model, its equations as printed and corrected, its claims, its open question.

Writes report.md, claims.json, search.json, agreement.json, the paper's figures 7-11 and 13-17 (figure_NN.png), slip and loads
(test_N_slip.png), open_question.png, commands/test_N.csv (for wlr record --commands), config.yaml and provenance.yaml; of a
robot also its runs. docs/paper.md explains them.
"""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from wlr_gym.base.errors import InputError, unknown_name
from wlr_gym.base.progress import Tell, progress
from wlr_gym.cli import run_program
from wlr_gym.cli.options import ForceOption, JsonOption, RobotOption, settings_of
from wlr_gym.cli.terminal import confirm, print_json

if TYPE_CHECKING:
    from rich.console import Console

    from studies.paper.claims import CheckedClaim
    from studies.paper.experiments import Record
    from studies.paper.slip_search import SearchFinding
    from wlr_gym.robot import Robot


#: Share of the work that is done after each part, about.
_SHARES = {"tests": 0.15, "claims": 0.2, "search": 0.85, "decided": 0.9}


@dataclass(frozen=True)
class PaperOptions(JsonOption, ForceOption, RobotOption):
    out: Path
    """Folder for the report; made if it is not there."""
    plant: tuple[str, ...] = ("reduced", "gibbs_appell", "mujoco")
    """Models to run the tests on: reduced (the nine-velocity model), gibbs_appell, mujoco, dynamixel (a robot)."""
    yes: bool = False
    """Do not ask before the robot moves."""
    robot: str | None = field(default=None, kw_only=True)
    """Robot file, or name in configs/robot/; default: the nominal one."""
    draws: int = 8
    """Search for what could explain the paper's slip: draws per combination at first; 0 = no search."""
    levels: int = 2
    """Most departures from the nominal robot at once in the search: 1 to 3."""
    seed: int = 0
    """Seed of the search."""
    threads: int = 2
    """Worker threads of the engine."""
    plots: bool = True
    """Write figures."""
    progress: bool = True
    """Show progress and the remaining time."""


def run(options: PaperOptions) -> int:
    """Drive, check, search, write; 0 when done, 1 when a robot had to stop.

    Raises:
        InputError: unknown model or robot, numbers out of range, ports that cannot be opened, nobody there to start a robot.
    """
    from rich.console import Console

    from studies.paper import report
    from studies.paper.claims import check_all, gather
    from studies.paper.experiments import write_tests
    from wlr_gym.base.files import output_folder
    from wlr_gym.base.provenance import record_provenance
    from wlr_gym.cli import FAILED, OK
    from wlr_gym.hardware.loop import StoppedError
    from wlr_gym.robot import load_robot

    _check(options)
    robot = load_robot(options.robot or "nominal")
    options.refuse_results(options.out, "report.md")
    console, records = Console(), {}
    with output_folder(options.out), progress(console, shown=options.progress) as tell:
        try:
            for done, model in enumerate(options.plant):
                tell("", f"both tests: {model}", _SHARES["tests"] * done / len(options.plant))
                records[model] = _drive(model, robot, options, console)
        except StoppedError as error:
            console.print(f"the robot has stopped: {error}", style="red")
            return FAILED
        reference = records.get("gibbs_appell") or _drive("gibbs_appell", robot, options, console)
        tell("", "claims", _SHARES["tests"])
        evidence = gather(robot, reference, options.threads)
        claims = check_all(evidence)
        findings = _search(robot, options, tell)
        tell("", "what would decide it", _SHARES["search"])
        decisive = report.what_would_decide(robot, findings, options.threads)
        if options.plots:
            tell("", "figures", _SHARES["decided"])
            report.write_figures(options.out, records, evidence, findings)
    write_tests(options.out / "commands")
    report.write_report(options.out, robot, records, claims, findings, decisive)
    record_provenance(options.out, settings_of(options) | {"robot": robot.name}, options.seed)
    if options.json:
        print_json(claims)
    else:
        _show(console, claims)
    console.print(f"report: {options.out / 'report.md'}", soft_wrap=True)
    return OK


def _check(options: PaperOptions) -> None:
    from studies.paper.experiments import MODELS
    from wlr_gym.physics.plants import REAL

    if not options.plant:
        raise InputError("--plant: expected at least one model")
    for model in options.plant:
        if model not in MODELS:
            raise unknown_name("model", model, MODELS)
    if set(REAL) & set(options.plant):
        options.load_hardware()
    else:
        options.refuse_robot_options("add dynamixel to --plant")
    for name, low, high in (("draws", 0, 10_000), ("levels", 1, 3), ("threads", 1, 256)):
        value = getattr(options, name)
        if not low <= value <= high:
            raise InputError(f"--{name} {value}: expected {low} to {high}")


def _drive(model: str, robot: Robot, options: PaperOptions, console: Console) -> dict[str, Record]:
    from studies.paper.experiments import drive_both
    from wlr_gym.physics.plants import REAL

    return _drive_robot(options, console) if model in REAL else drive_both(model, robot)


def _drive_robot(options: PaperOptions, console: Console) -> dict[str, Record]:
    """Guarded and logged; between the tests the operator carries the robot back."""
    from studies.paper.experiments import PROFILE, TESTS, drive_plant
    from wlr_gym.data.format import RunMeta
    from wlr_gym.hardware.deployment import refuse_deadman
    from wlr_gym.hardware.operator import stop_on_request
    from wlr_gym.physics.effects import load_patch
    from wlr_gym.robot import load_robot
    from wlr_gym.robot.parameters import Parameters

    robot = load_robot(options.robot_name())
    meta, records = RunMeta(robot=robot.name, profile=PROFILE, notes="the paper's tests"), {}
    for name, test in TESTS.items():
        if not (options.emulated or options.yes):
            confirm(test.motion(), robot, options.load_hardware(), console)
        plant = options.plant_of(robot, options.out / "runs", meta, load_patch(None))
        refuse_deadman(plant)
        with stop_on_request(plant.loop.operator), contextlib.closing(plant):
            records[name] = drive_plant(plant, test, Parameters.nominal(robot))
            plant.loop.finish("the test is over")
    return records


def _search(robot: Robot, options: PaperOptions, tell: Tell) -> list[SearchFinding]:
    from studies.paper.slip_search import search

    if options.draws == 0:
        return []
    begin, end = _SHARES["claims"], _SHARES["search"]

    def told(share: float) -> None:
        tell("", "open question: what slips as the paper's robot did?", begin + (end - begin) * share)

    told(0.0)
    return search(robot, options.draws, options.levels, options.seed, threads=options.threads, tell=told)


def _show(console: Console, claims: Sequence[CheckedClaim]) -> None:
    from studies.paper.claims import FAILS
    from wlr_gym.cli.terminal import print_table

    rows = [(str(claim.number), claim.text, claim.paper, claim.ours, claim.verdict) for claim in claims]
    styles = ["red" if claim.verdict == FAILS else "" for claim in claims]
    print_table(console, ("#", "claim", "paper", "here", "verdict"), rows, "The paper's claims", styles)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run ``python -m studies.paper`` and return its exit code."""
    return run_program("python -m studies.paper", PaperOptions, run, __doc__ or "", arguments)


if __name__ == "__main__":
    sys.exit(main())
