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
from typing import TYPE_CHECKING

from rich.console import Console
from tyro.conf import Positional

from wlr_gym.base.errors import InputError, check_number
from wlr_gym.base.files import make_output_folder, refuse_existing, write_json
from wlr_gym.base.progress import tracked
from wlr_gym.base.provenance import record_provenance
from wlr_gym.base.text import counted
from wlr_gym.cli import FAILED, OK
from wlr_gym.cli.options import ForceOption, JsonOption, PatchOption, RobotOption, settings_of
from wlr_gym.cli.terminal import confirm, print_json, print_table
from wlr_gym.render.video import check_video
from wlr_gym.robot import CORNERS, JOINTS

if TYPE_CHECKING:
    from wlr_gym.data import Run
    from wlr_gym.data.replay import ChannelError, ReplayResult
    from wlr_gym.physics.effects import Patch

ERRORS_FILE = "errors.json"


@dataclass(frozen=True)
class ReplayOptions(JsonOption, ForceOption, RobotOption, PatchOption):
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
    """Replay, print the tables, write the files; 0 when done, 1 when something stopped the robot.

    Raises:
        InputError: unreadable runs, patch, robot or backend.
    """
    from wlr_gym.data.replay import LEAD, prepare, save_plots
    from wlr_gym.data.runs import read_runs
    from wlr_gym.physics.plants import REAL, check_backend

    console = Console()
    check_backend(options.backend)
    on_robot = options.backend in REAL
    if not on_robot:
        options.refuse_robot_options("add --backend dynamixel")
    if on_robot and options.video is not None:
        raise InputError("--video: a film needs a simulator; --backend dynamixel has none")
    if options.video is not None:
        check_video(options.video)
    check_number("--segment", options.segment, "s", above=LEAD)
    runs = read_runs(options.runs)
    patch = options.patch()
    options.refuse_results(options.out, ERRORS_FILE)
    for film in _films(options, [one.name for one in runs]):
        refuse_existing(film, options.force, "--video")
    for measured in runs:  # a refusal leaves no folder behind
        prepare(measured, options.robot, effects=patch, segment=options.segment)
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
    record_provenance(options.out, settings_of(options) | found | {"effects": patch.content()["effects"]})
    console.print(f"errors, plots and provenance: {options.out}")
    if options.video is not None:
        _film(options, results, patch, console)
    return OK if len(results) == len(runs) else FAILED


def _films(options: ReplayOptions, names: Sequence[str]) -> list[Path]:
    """Return a film for each run that is named; none without --video."""
    if (path := options.video) is None:
        return []
    return [path] if len(names) == 1 else [path.with_name(f"{path.stem}_{name}{path.suffix}") for name in names]


def _film(options: ReplayOptions, results: Sequence[ReplayResult], patch: Patch, console: Console) -> None:
    from wlr_gym.data.replay import prepare
    from wlr_gym.data.watch import FPS, film_length, replay_film
    from wlr_gym.render import write_video

    for result, target in zip(results, _films(options, [result.run.name for result in results]), strict=True):
        _, parameters = prepare(result.run, options.robot, effects=patch, segment=options.segment)
        count = film_length(result.run)
        pictures = replay_film(result, parameters, options.backend)
        write_video(target, tracked(pictures, count, f"drawing {result.run.name}", console), FPS, count)
        console.print(f"video: {target}")


def _replay_all(options: ReplayOptions, runs: Sequence[Run], patch: Patch, console: Console) -> Iterator[ReplayResult]:
    from wlr_gym.data.replay import replay

    for measured in tracked(runs, len(runs), f"replaying on {options.backend}", console):
        yield replay(measured, options.backend, options.robot, effects=patch, segment=options.segment)


def _repeat_all(options: ReplayOptions, runs: Sequence[Run], patch: Patch, console: Console) -> Iterator[ReplayResult]:
    """Drive the robot with each run's commands, log to ``out/robot``, compare; ends with the first run that is stopped."""
    from wlr_gym.data import read_run
    from wlr_gym.data.format import RunMeta
    from wlr_gym.data.record import meta_of, motion_of
    from wlr_gym.data.replay import compare_repeat
    from wlr_gym.data.runs import robot_of
    from wlr_gym.hardware.deployment import drive_robot

    motions = [motion_of(measured) for measured in runs]
    chosen = options.robot or options.load_hardware().robot
    for measured, motion in zip(runs, motions, strict=True):
        robot = robot_of(measured, chosen)
        if not (options.emulated or options.yes):
            confirm(motion, robot, options.load_hardware(), console)
        folder = options.out / "robot" / measured.name
        with closing(options.plant_of(robot, folder, meta_of(motion, robot, RunMeta()), patch)) as plant:
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
    for result in results:
        for finding in result.run.findings:
            line = f"{result.run.name}: {finding.kind} in '{finding.column}': {finding.message}"
            console.print(line, style="yellow", highlight=False, soft_wrap=True)
    errors = [pair for result in results for pair in result.errors.items()]
    runs = counted(len(results), "run")
    _print_errors(errors, f"Measured minus {other}, rms ({runs}, effects added: {patch.summary()})", console)
    _print_joints(errors, console)
    if len(results) > 1:
        _print_runs(results, console)


def _grouped(errors: Sequence[tuple[str, ChannelError]]) -> dict[str, list[ChannelError]]:
    """Put the errors of a joint group (``pos_leg``) together, and those of every other channel by themselves."""
    from wlr_gym.data.format import CHANNELS, COLUMNS

    groups: dict[str, list[ChannelError]] = {}
    for name, error in sorted(errors, key=lambda pair: CHANNELS.index(pair[0])):
        key = COLUMNS[name].group if name.partition("_")[2] in JOINTS else name
        groups.setdefault(key, []).append(error)
    return groups


def _in_noise_units(errors: Sequence[ChannelError]) -> str:
    from wlr_gym.data.replay import pooled

    return f"{pooled(errors, lambda error: error.segment_rms / error.noise):.1f}" if errors else "-"


def _print_errors(errors: Sequence[tuple[str, ChannelError]], title: str, console: Console) -> None:
    from wlr_gym.data.replay import pooled

    rows = []
    for group, members in _grouped(errors).items():
        noise, unit = members[0].noise, members[0].unit
        segment, full = pooled(members, lambda e: e.segment_rms), pooled(members, lambda e: e.full_run_rms)
        ratios = (f"{segment / noise:.1f}", f"{full / noise:.1f}")
        rows.append((group, unit, f"{noise:.2g}", f"{segment:.3g}", f"{full:.3g}", *ratios))
    headings = ("channel", "unit", "noise", "segment", "full run", "segment / noise", "full run / noise")
    print_table(console, headings, rows, title)


def _print_joints(errors: Sequence[tuple[str, ChannelError]], console: Console) -> None:
    from wlr_gym.data.format import COLUMNS

    rows = [
        (group, *(_in_noise_units([e for name, e in errors if name == f"{group}_{corner}"]) for corner in CORNERS))
        for group in ("pos_leg", "vel_leg", "eff_leg", "pos_wheel", "vel_wheel", "eff_wheel")
        if any(COLUMNS[name].group == group for name, _ in errors)
    ]
    print_table(console, ("channel", *CORNERS), rows, "Segment error of each joint, in units of sensor noise")


def _print_runs(results: Sequence[ReplayResult], console: Console) -> None:
    from wlr_gym.data.format import COLUMNS

    def kind(name: str) -> str:
        group = COLUMNS[name].group
        return group.partition("_")[0] if group.startswith("cam") else group

    kinds = list(dict.fromkeys(kind(name) for result in results for name in result.errors if name != "volt"))
    rows = []
    for result in results:
        members = [[error for name, error in result.errors.items() if kind(name) == wanted] for wanted in kinds]
        rows.append((result.run.name, *map(_in_noise_units, members)))
    print_table(console, ("run", *kinds), rows, "Segment error of each run, in units of sensor noise")
