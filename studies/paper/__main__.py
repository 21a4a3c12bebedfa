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
from typing import Annotated

from rich.console import Console

from studies.paper import claims, experiments, report, slip_search
from wlr_gym.base.errors import InputError, Interval, check_name
from wlr_gym.base.files import alone_in
from wlr_gym.base.progress import progress
from wlr_gym.base.provenance import record_provenance
from wlr_gym.cli import FAILED, OK, run_program
from wlr_gym.cli.options import ForceOption, JsonOption, RobotOption, settings_of
from wlr_gym.cli.terminal import confirm, print_json, print_table
from wlr_gym.data.format import RunMeta
from wlr_gym.data.record import write_commands
from wlr_gym.hardware.deployment import refuse_deadman
from wlr_gym.hardware.loop import StoppedError
from wlr_gym.hardware.operator import stop_on_request
from wlr_gym.physics.effects import load_patch
from wlr_gym.physics.plants import BACKENDS, REAL
from wlr_gym.robot import Robot, load_robot
from wlr_gym.robot.parameters import Parameters

#: Share of the work that is done after each part, about.
_SHARES = {"tests": 0.15, "claims": 0.2, "search": 0.85, "decided": 0.9}


@dataclass(frozen=True)
class PaperOptions(JsonOption, ForceOption, RobotOption):
    out: Path
    """Folder for the report; made if it is not there."""
    plant: tuple[str, ...] = ("gibbs_appell", "mujoco")
    """Models to run the tests on: gibbs_appell, mujoco, dynamixel (a robot)."""
    yes: bool = False
    """Do not ask before the robot moves."""
    robot: str | None = field(default=None, kw_only=True)
    """Robot file, or name in configs/robot/; default: the nominal one."""
    draws: Annotated[int, Interval(least=0, most=10_000)] = 8
    """Search for what could explain the paper's slip: draws per combination at first; 0 = no search."""
    levels: Annotated[int, Interval(least=1, most=3)] = 2
    """Most departures from the nominal robot at once in the search: 1 to 3."""
    seed: int = 0
    """Seed of the search."""
    threads: Annotated[int, Interval(least=1, most=256)] = 2
    """Worker threads of the engine."""
    plots: bool = True
    """Write figures."""
    progress: bool = True
    """Show progress and the remaining time."""


def run(options: PaperOptions) -> int:
    """Drive, check, search, write; 0 when done, 1 when a robot had to stop.

    Raises:
        InputError: unknown model or robot, ports that cannot be opened, nobody there to start a robot.
    """
    if not options.plant:
        raise InputError("--plant: expected at least one model")
    for model in options.plant:
        check_name("model", model, BACKENDS)
    if set(REAL) & set(options.plant):
        options.load_hardware()
    else:
        options.refuse_robot_options("add dynamixel to --plant")
    robot = load_robot(options.robot or "nominal")
    options.refuse_results(options.out, "report.md")
    console, records = Console(), {}
    with alone_in(options.out), progress(console, shown=options.progress) as tell:
        try:
            for done, model in enumerate(options.plant):
                tell("", f"both tests: {model}", _SHARES["tests"] * done / len(options.plant))
                is_real = model in REAL
                records[model] = _drive_robot(options, console) if is_real else experiments.drive_both(model, robot)
        except StoppedError as error:
            console.print(f"the robot has stopped: {error}", style="red")
            return FAILED
        reference = records.get("gibbs_appell") or experiments.drive_both("gibbs_appell", robot)
        tell("", "claims", _SHARES["tests"])
        evidence = claims.gather(robot, reference, options.threads)
        checked, findings = claims.check_all(evidence), []
        if options.draws:

            def told(share: float) -> None:
                begin, end = _SHARES["claims"], _SHARES["search"]
                tell("", "open question: what slips as the paper's robot did?", begin + (end - begin) * share)

            told(0.0)
            size = options.draws, options.levels, options.seed
            findings = slip_search.search(robot, *size, threads=options.threads, tell=told)
        tell("", "what would decide it", _SHARES["search"])
        decisive = report.what_would_decide(robot, findings, options.threads)
        if options.plots:
            tell("", "figures", _SHARES["decided"])
            report.write_figures(options.out, records, evidence, findings)
    for test in experiments.TESTS.values():  # for wlr record --commands
        write_commands(options.out / "commands", test.motion())
    report.write_report(options.out, robot, records, checked, findings, decisive)
    record_provenance(options.out, settings_of(options) | {"robot": robot.name}, options.seed)
    if options.json:
        print_json(checked)
    else:
        rows = [(str(one.number), one.text, one.paper, one.ours, one.verdict) for one in checked]
        styles = ["red" if one.verdict == claims.FAILS else "" for one in checked]
        print_table(console, ("#", "claim", "paper", "here", "verdict"), rows, "The paper's claims", styles)
    console.print(f"report: {options.out / 'report.md'}", soft_wrap=True)
    return OK


def _drive_robot(options: PaperOptions, console: Console) -> dict[str, experiments.Record]:
    """Guarded and logged; between the tests the operator carries the robot back."""
    robot: Robot = load_robot(options.robot_name())
    meta, records = RunMeta(robot=robot.name, profile=experiments.PROFILE, notes="the paper's tests"), {}
    for name, test in experiments.TESTS.items():
        if not (options.emulated or options.yes):
            confirm(test.motion(), robot, options.load_hardware(), console)
        plant = options.plant_of(robot, options.out / "runs", meta, load_patch(None))
        refuse_deadman(plant)
        with stop_on_request(plant.loop.operator), contextlib.closing(plant):
            records[name] = experiments.drive_plant(plant, test, Parameters.nominal(robot))
            plant.loop.finish("the test is over")
    return records


def main(arguments: Sequence[str] | None = None) -> int:
    """Run ``python -m studies.paper`` and return its exit code."""
    return run_program("python -m studies.paper", PaperOptions, run, __doc__ or "", arguments)


if __name__ == "__main__":
    sys.exit(main())
