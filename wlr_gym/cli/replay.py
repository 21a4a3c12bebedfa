"""Drive a simulator, or the robot, with the commands of measured runs and report where the two diverge.

``--backend dynamixel`` is the robot (with ``--emulated`` an emulated one): setpoints go through the command limiter, and its
log is compared with the run.

Writes errors.json (run, channel: errors in units and in sensor noise), overlay plots, config.yaml and provenance.yaml.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from rich.console import Console
from tyro.conf import Positional

from wlr_gym.base.errors import InputError, check_number
from wlr_gym.base.files import make_output_folder, refuse_existing, write_json
from wlr_gym.base.progress import tracked
from wlr_gym.base.provenance import record_provenance
from wlr_gym.base.text import counted
from wlr_gym.cli import FAILED, OK
from wlr_gym.cli.options import FloorOption, ForceOption, JsonOption, PatchOption, RobotOption, settings_of
from wlr_gym.cli.terminal import confirm, print_json, print_table
from wlr_gym.render.video import check_video
from wlr_gym.robot import CORNERS, JOINTS

if TYPE_CHECKING:
    from wlr_gym.data import Run
    from wlr_gym.data.replay import ReplayResult
    from wlr_gym.physics.effects import Patch

ERRORS_FILE = "errors.json"


@dataclass(frozen=True)
class ReplayOptions(JsonOption, ForceOption, RobotOption, PatchOption, FloorOption):
    runs: Positional[Path]
    """A run (CSV or Parquet) or a folder of runs."""
    out: Path
    """Folder for errors.json, plots and provenance; made if it is not there."""
    backend: str = "gibbs_appell"
    """Simulator, or dynamixel for the robot."""
    robot: str | None = field(default=None, kw_only=True)
    """Robot file, or name in configs/robot/; default: the one that meta.yaml names, else the nominal one; of a real robot the
    one that its hardware file names."""
    segment: float = 1.0
    """Time between the points at which a segment starts anew from the measured state, s."""
    plots: bool = True
    """Write overlay plots."""
    video: Path | None = None
    """File (.webp, .gif, .png, .mp4) for a film of the run beside its simulation; with several runs, one film each, named
    FILE_<run>."""
    yes: bool = False
    """Do not ask before every motion of the robot."""


def run(options: ReplayOptions) -> int:
    """Replay, print the tables, write the files; 0 when done, 1 when something stopped the robot."""
    from wlr_gym.data.replay import LEAD, prepare, save_plots
    from wlr_gym.data.runs import floor_of, read_runs
    from wlr_gym.physics.plants import REAL, check_backend

    console = Console()
    check_backend(options.backend)
    on_robot = options.backend in REAL
    if not on_robot:
        options.refuse_robot_options("add --backend dynamixel")
    check_number("--segment", options.segment, "s", above=LEAD)
    if (path := options.video) is not None:
        if on_robot:
            raise InputError("--video: a film needs a simulator; --backend dynamixel has none")
        check_video(path)
    runs, films = read_runs(options.runs), [] if path is None else [path]
    if path is not None and len(runs) > 1:
        films = [path.with_name(f"{path.stem}_{one.name}{path.suffix}") for one in runs]
    patch = options.patch()
    options.refuse_results(options.out, ERRORS_FILE)
    for film in films:
        refuse_existing(film, options.force, "--video")
    for measured in runs:  # a refusal leaves no folder behind
        prepare(measured, options.robot, effects=patch, segment=options.segment, floor=options.floor)
    make_output_folder(options.out)
    results = []
    for result in (_repeat_all if on_robot else _replay_all)(options, runs, patch, console):
        results.append(result)
        if options.plots:
            save_plots(result, options.out)
    if not results:
        return FAILED
    errors = {result.run.name: {name: error.as_dict() for name, error in result.errors.items()} for result in results}
    if options.json:
        print_json(errors)
    else:
        _print(results, patch, console, "repeated" if on_robot else "simulated")
    write_json(options.out / ERRORS_FILE, errors)
    first, driven = results[0], [str(result.run.path) for result in results]
    found = {"robot": first.robot.name, "clock": first.clock, "physics_step": first.physics_step, "runs": driven}
    found |= {"effects": patch.content()["effects"], "floor": floor_of(first.run, options.floor).content()}
    record_provenance(options.out, settings_of(options) | found)
    console.print(f"errors, plots and provenance: {options.out}")
    for result, film in zip(results, films, strict=False):
        _draw_film(options, result, patch, film, console)
    return OK if len(results) == len(runs) else FAILED


def _draw_film(options: ReplayOptions, result: ReplayResult, patch: Patch, target: Path, console: Console) -> None:
    from wlr_gym.data.replay import prepare
    from wlr_gym.data.watch import FPS, film_length, replay_film
    from wlr_gym.render import write_video

    _, parameters = prepare(result.run, options.robot, effects=patch, segment=options.segment, floor=options.floor)
    count, pictures = film_length(result.run), replay_film(result, parameters, options.backend)
    write_video(target, tracked(pictures, count, f"drawing {result.run.name}", console), FPS, count)
    console.print(f"video: {target}")


def _replay_all(options: ReplayOptions, runs: Sequence[Run], patch: Patch, console: Console) -> Iterator[ReplayResult]:
    from wlr_gym.data.replay import replay

    for measured in tracked(runs, len(runs), f"replaying on {options.backend}", console):
        yield replay(measured, options.backend, options.robot, effects=patch, segment=options.segment, floor=options.floor)


def _repeat_all(options: ReplayOptions, runs: Sequence[Run], patch: Patch, console: Console) -> Iterator[ReplayResult]:
    """Drive the robot with each run's commands, log to ``out/robot``, compare; ends with the first run that is stopped."""
    from wlr_gym.data import read_run
    from wlr_gym.data.format import RunMeta
    from wlr_gym.data.record import meta_of, motion_of
    from wlr_gym.data.replay import compare_repeat
    from wlr_gym.data.runs import floor_of, robot_of
    from wlr_gym.hardware.deployment import drive_robot
    from wlr_gym.physics.floor import floor_noted

    motions = [motion_of(measured) for measured in runs]
    chosen = options.robot or options.load_hardware().robot
    for measured, motion in zip(runs, motions, strict=True):
        robot = robot_of(measured, chosen)
        if not (options.emulated or options.yes):
            confirm(motion, robot, options.load_hardware(), console)
        folder = options.out / "robot" / measured.name
        noted = RunMeta(floor=floor_noted(floor_of(measured, options.floor, robot)))
        with closing(options.plant_of(robot, folder, meta_of(motion, robot, noted), patch)) as plant:
            drive = drive_robot(plant, motion)
        interventions = drive.statistics["interventions"]
        changed = ", ".join(f"{rule} in {count} steps" for rule, count in interventions.items()) or "nothing changed"
        console.print(f"{measured.name}: {drive.ticks} of {len(motion.setpoints)} steps driven; command limiter: {changed}")
        if drive.reason or drive.run is None:
            console.print(f"stopped: {drive.reason or 'nothing was logged'}", style="red")
            return
        yield compare_repeat(measured, read_run(drive.run), chosen, options.segment)


# ---- tables ----------------------------------------------------------------------------------------------------------


def _print(results: Sequence[ReplayResult], patch: Patch, console: Console, other: str) -> None:
    """Print what is odd about the runs, and errors by channel, by joint, and of several runs by run."""
    import pandas

    from wlr_gym.data.format import CHANNELS, COLUMNS

    for result in results:
        for finding in result.run.findings:
            line = f"{result.run.name}: {finding.kind} in '{finding.column}': {finding.message}"
            console.print(line, style="yellow", highlight=False, soft_wrap=True)
    rows = []
    for name in CHANNELS:
        group, corner = COLUMNS[name].group, name.rpartition("_")[2] if name.partition("_")[2] in JOINTS else ""
        channel, kind = group if corner else name, "cam" if group.startswith("cam") else group
        for result in results:
            if (error := result.errors.get(name)) is not None:
                of = error.segment_rms, error.full_run_rms, error.unit, error.noise, error.segment_rms / error.noise
                rows.append((result.run.name, channel, corner, kind, *of))
    columns: Any = ["run", "channel", "corner", "kind", "segment", "full", "unit", "noise", "ratio"]
    errors: Any = pandas.DataFrame(rows, columns=columns)

    def rms(values: Any) -> float:
        return float(np.sqrt(np.mean(np.square(values))))

    def table(of: Any, first: str, second: str) -> list[tuple[str, ...]]:
        """Return the rms error in noise units, a row for each value of the first column, a cell for each of the second."""
        columns = CORNERS if second == "corner" else of[second].unique()
        values = of.groupby([first, second], sort=False)["ratio"].agg(rms).unstack()
        values = values.reindex(index=of[first].unique(), columns=columns)
        return [(str(name), *("-" if cell != cell else f"{cell:.1f}" for cell in row)) for name, *row in values.itertuples()]

    shown = []
    for channel, members in errors.groupby("channel", sort=False):
        unit, noise = members[["unit", "noise"]].iloc[0]
        both = rms(members["segment"]), rms(members["full"])
        sizes = (f"{noise:.2g}", *(f"{one:.3g}" for one in both), *(f"{one / noise:.1f}" for one in both))
        shown.append((str(channel), str(unit), *sizes))
    headings = ("channel", "unit", "noise", "segment", "full run", "segment / noise", "full run / noise")
    runs = counted(len(results), "run")
    print_table(console, headings, shown, f"Measured minus {other}, rms ({runs}, effects added: {patch.summary()})")
    joints = table(errors[errors["corner"] != ""], "channel", "corner")
    print_table(console, ("channel", *CORNERS), joints, "Segment error of each joint, in units of sensor noise")
    if len(results) > 1:
        known = errors[errors["kind"] != "volt"]
        headings = ("run", *known["kind"].unique())
        print_table(console, headings, table(known, "run", "kind"), "Segment error of each run, in units of sensor noise")
