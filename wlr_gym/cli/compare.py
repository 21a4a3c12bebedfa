"""Drive two plants with the same setpoints and parameters, and report where they diverge, in units of sensor noise.

Writes compare.json, report.md, a map of all differences, a figure per motion, config.yaml and provenance.yaml. docs/compare.md
says how to read them.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from rich.console import Console

from wlr_gym.base.errors import InputError, Interval
from wlr_gym.base.files import write_json, write_text
from wlr_gym.base.progress import progress
from wlr_gym.base.provenance import record_provenance
from wlr_gym.cli import FAILED, OK
from wlr_gym.cli.options import (
    Count,
    FloorOption,
    JsonOption,
    OutOption,
    PatchOption,
    RunsRobotOption,
    Seconds,
    Seed,
    settings_of,
)
from wlr_gym.cli.terminal import print_json, print_table
from wlr_gym.robot import Robot, load_robot
from wlr_gym.robot.parameters import Parameters

if TYPE_CHECKING:
    from wlr_gym.data.comparison import ReportTable
    from wlr_gym.data.excitations import Motion
    from wlr_gym.physics.effects import Patch
    from wlr_gym.physics.floor import Floor


@dataclass(frozen=True)
class CompareOptions(JsonOption, OutOption, RunsRobotOption, PatchOption, FloorOption):
    plants: tuple[str, str] = ("gibbs_appell", "mujoco")
    """Two of: BACKEND or BACKEND:option=value,... with the options physics_step (s) and precision; for example
    gibbs_appell gibbs_appell:precision=float32."""
    excitation: tuple[str, ...] = ()
    """Motions to drive: straight, posture, turns, s_curve, stop_and_go, rear_legs, all_legs, random, chirp, steps;
    default: all."""
    runs: Path | None = None
    """Drive the commands of this measured run, or folder of runs, instead."""
    seed: Seed = 0
    """Seed of the excitations: another seed, another motion of the same kind."""
    seconds: Seconds | None = None
    """Cut every motion off after this long."""
    physics_step: Seconds = 0.001
    """Substep of both plants, s."""
    halve: bool = False
    """Repeat at half of both steps: shows whether the difference shrinks, and each plant's own step error."""
    every_effect: bool = False
    """Also compare with each effect of the library at its default severity, one at a time, on top of --effects."""
    threshold: Annotated[float, Interval("units of sensor noise", above=0.0)] = 5.0
    """Two signals have diverged when they differ by more than this many units of sensor noise."""
    threads: Count = 1
    """Worker threads of each plant."""
    plots: bool = True
    """Write figures."""
    strict: bool = False
    """Exit with 1 when the plants agree less than they should: 2 % of the travel and 2 degrees of yaw after 10 s, 5 % rms of
    the joint torques; at half the steps where --halve is given."""


def run(options: CompareOptions) -> int:
    """Compare, print the tables, write the files; 0 when done, with ``--strict`` 1 when a bound is broken."""
    from wlr_gym.data.comparison import compare, markdown, parse_plant, save_map, save_motion_plot, summary_table, tables

    first, second = (parse_plant(text, options.physics_step) for text in options.plants)
    if first == second:
        raise InputError(f"--plants {' '.join(options.plants)}: the same plant twice; expected two that differ")
    motions, robot, floor = _motions(options)
    patches = _patches(options, robot)
    options.refuse_results(options.out, "compare.json")
    console, comparisons = Console(), []
    with progress(console) as tell:
        for done, patch in enumerate(patches):
            of_them = f", effects: {patch.summary()}" if len(patches) > 1 else ""

            def told(doing: str, share: float, done: int = done, of_them: str = of_them) -> None:
                tell("", f"{doing}{of_them}", (done + share) / len(patches))

            found = compare(
                motions, (first, second), robot, None, patch, options.threshold, halve=options.halve, threads=options.threads,
                tell=told, floor=floor,
            )  # fmt: skip
            comparisons.append(found)
            if options.plots:
                told("drawing", 1.0)
                label = re.sub(r"[^\w]+", "_", found.effects)[-120:]  # file systems take names of 255 letters
                for index, motion in enumerate(motions):
                    save_motion_plot(found, index, options.out / f"{label}_{motion.name}.png")
                save_map(found, options.out / f"{label}.png")
            if len(patches) == 1 and not options.json:
                for table in tables(found):
                    _print(console, table)
    content = [comparison.as_dict() for comparison in comparisons]
    if options.json:
        print_json(content)
    elif len(patches) > 1:
        _print(console, summary_table(comparisons))
    write_json(options.out / "compare.json", content)
    write_text(options.out / "report.md", markdown(comparisons, f"{first.label} and {second.label}"))
    driven = {"robot": robot.name, "motions": [motion.name for motion in motions], "effects": patches[0].content()["effects"]}
    driven["floor"] = floor.content()
    record_provenance(options.out, settings_of(options) | driven)
    console.print(f"report: {options.out / 'report.md'}", soft_wrap=True)
    return FAILED if options.strict and any(comparison.broken for comparison in comparisons) else OK


def _motions(options: CompareOptions) -> tuple[list[Motion], Robot, Floor]:
    from wlr_gym.data.excitations import EXCITATIONS, excite
    from wlr_gym.data.record import motion_of
    from wlr_gym.data.runs import floor_of, read_runs, robot_of
    from wlr_gym.physics.floor import load_floor

    if options.runs is None:
        robot = load_robot(options.robot or "nominal")
        names = options.excitation or tuple(EXCITATIONS)
        floor = load_floor(options.floor, robot).drawn(options.seed)
        return [excite(name, options.seed, robot, seconds=options.seconds) for name in names], robot, floor
    if options.excitation:
        raise InputError("--runs and --excitation: expected one of them")
    runs = read_runs(options.runs)
    robot = robot_of(runs[0], options.robot)
    floor = floor_of(runs[0], options.floor, robot)
    return [motion_of(measured).cut(options.seconds) for measured in runs], robot, floor


def _patches(options: CompareOptions, robot: Robot) -> list[Patch]:
    from wlr_gym.data.comparison import severe_patch
    from wlr_gym.physics.effects import EFFECTS, apply_patch, compose

    given = options.patch()
    patches = [given, *(compose(given, severe_patch(name)) for name in EFFECTS if options.every_effect)]
    for patch in patches:  # a refusal leaves no folder behind
        apply_patch(patch, Parameters.nominal(robot))
    return patches


def _print(console: Console, table: ReportTable) -> None:
    styles = ["red" if any(cell.endswith(" !") for cell in row) else "" for row in table.rows]
    print_table(console, table.headings, table.rows, table.title, styles)
