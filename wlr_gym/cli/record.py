"""Record measured runs: drive the robot, an emulated one or a simulator through a motion, and log it in the run format.

``--list`` shows the excitations: motions that bring out what a robot is made of. A motion may also come from a file
(``--commands``), and be written into one (``--commands-only``). On a robot everything goes through the command limiter; Ctrl-C
stops it in good order.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.console import Console

from wlr_gym.base.errors import InputError
from wlr_gym.base.files import make_output_folder, refuse_existing
from wlr_gym.base.text import counted
from wlr_gym.cli import FAILED, INTERRUPTED, OK
from wlr_gym.cli.options import (
    CameraOption,
    FloorOption,
    ForceOption,
    JsonOption,
    PatchOption,
    Seconds,
    Seed,
    noise_seed,
    refuse_given,
)
from wlr_gym.cli.terminal import confirm, print_json, print_table
from wlr_gym.robot import Robot, load_robot

if TYPE_CHECKING:
    from wlr_gym.data.excitations import Motion
    from wlr_gym.data.format import RunMeta
    from wlr_gym.hardware.deployment import DriveResult


@dataclass(frozen=True)
class RecordOptions(JsonOption, ForceOption, CameraOption, PatchOption, FloorOption):
    excitation: tuple[str, ...] = ()
    """Motions to drive, by name, see: wlr record --list; several make a data set."""
    commands: tuple[Path, ...] = ()
    """Files with setpoints to drive: of --commands-only, or of whole runs."""
    out: Path | None = None
    """Folder for the runs, made if it is not there; needed for all but --list."""
    backend: str = "dynamixel"
    """dynamixel = the robot (with --emulated an emulated one), or a simulator: gibbs_appell, mujoco."""
    seed: Seed | None = None
    """Seed of the motions (default: 0), and of the noise of a simulator or an emulated robot."""
    noise_seed: Seed | None = None
    """Seed of an emulated robot's noise: noise_seed of a run's events repeats it (with the same --seed); default: from --seed
    and the run's number, without --seed drawn anew."""
    seconds: Seconds | None = None
    """Cut each motion off after this long."""
    commands_only: bool = False
    """Write the setpoints only, one file per motion."""
    list: bool = False
    """Show the excitations."""
    ground: str | None = None
    """What the floor is like, for meta.yaml."""
    notes: str | None = None
    """Free text for meta.yaml."""
    yes: bool = False
    """Do not ask before every motion of the robot."""


def run(options: RecordOptions) -> int:
    """Record; 0 when every motion was driven to its end, 1 when something stopped the robot, 130 when it was interrupted."""
    from wlr_gym.data.excitations import excite
    from wlr_gym.data.format import RunMeta
    from wlr_gym.data.record import meta_of, read_commands, same_profile, write_commands
    from wlr_gym.physics.plants import REAL, check_backend

    console = Console(soft_wrap=True, highlight=False)
    check_backend(options.backend)
    chosen = options.robot_name() if options.backend in REAL else options.robot or "nominal"
    robot = load_robot(chosen)
    if options.list:
        _list(console, robot, options.json)
        return OK
    if not options.emulated:
        refuse_given(options, ("noise_seed",), "it is for the emulated robot: add --emulated")
    if options.backend not in REAL:
        options.refuse_robot_options(f"leave --backend {options.backend} out")
    if options.out is None:
        raise InputError("--out: expected a folder for the runs")
    motions = [excite(name, options.seed or 0, robot, seconds=options.seconds) for name in options.excitation]
    motions += [read_commands(path).cut(options.seconds) for path in options.commands]
    if not motions:
        raise InputError("nothing to drive: name excitations (--excitation straight turns; see --list) or files (--commands)")
    same_profile(motions)
    noted = RunMeta(ground=options.ground, notes=options.notes, floor=_floor(options, robot))
    meta = meta_of(motions[0], robot, noted)
    code = OK
    if options.commands_only:
        for motion in motions:
            refuse_existing(options.out / f"{motion.name}.csv", options.force)
        found = [{"motion": motion.name, "commands": write_commands(options.out, motion)} for motion in motions]
        for one in found:
            console.print(f"written: {one['commands']}")
    elif options.backend in REAL:
        found, code = _record_robot(options, options.out, motions, robot, meta, console)
    else:
        found = _record_simulations(options, options.out, motions, robot, meta, console)
    if options.json:
        print_json(found)
    return code


def _floor(options: RecordOptions, robot: Robot) -> dict[str, Any] | None:
    """Return what ``meta.yaml`` says of the floor: one for all runs of the folder, drawn by ``--seed``."""
    from wlr_gym.physics.floor import floor_noted
    from wlr_gym.physics.plants import REAL

    floor = options.load_floor(robot)
    if floor is None:
        return None
    is_real = options.backend in REAL and not options.emulated
    return floor_noted(floor if is_real else floor.drawn(options.seed or 0))


# ---- the robot -------------------------------------------------------------------------------------------------------


def _record_robot(
    options: RecordOptions, out: Path, motions: Sequence[Motion], robot: Robot, meta: RunMeta, console: Console
) -> tuple[list[dict[str, object]], int]:
    """Limited and logged; between the motions the operator carries the robot back."""
    from wlr_gym.hardware.deployment import drive_robot

    found: list[dict[str, object]] = []
    code = OK
    for motion in motions:
        if not (options.emulated or options.yes):
            confirm(motion, robot, options.load_hardware(), console)
        seed = noise_seed(out, options.seed) if options.noise_seed is None else options.noise_seed
        with closing(options.plant_of(options.load()[0], out, meta, options.patch(), seed)) as plant:
            drive = drive_robot(plant, motion)
        _report(motion, drive, console)
        ended = {"reason": drive.reason, "well": drive.well, "steps": drive.ticks}
        found.append({"motion": motion.name, "run": drive.run, **ended})
        if drive.reason or not drive.well:
            code = INTERRUPTED if drive.well else FAILED
            break
    if left := [motion.name for motion in motions[len(found) :]]:
        console.print(f"not driven: {', '.join(left)}", style="red")
    found += [{"motion": name, "run": None, "reason": "not driven", "well": False, "steps": 0} for name in left]
    return found, code


def _report(motion: Motion, drive: DriveResult, console: Console) -> None:
    from wlr_gym.data import read_run

    driven = f"{drive.ticks} of {len(motion.setpoints)} steps driven"
    console.print(f"{motion.name}: {driven}; {drive.reason or 'to its end'}", style="red" if drive.reason else "")
    if changed := drive.statistics["interventions"]:
        limited = ", ".join(f"{rule} in {counted(count, 'step')}" for rule, count in changed.items())
        console.print(f"  command limiter: {limited}")
    if drive.run is not None:
        console.print(f"  written: {drive.run}")
        for finding in read_run(drive.run).findings if drive.ticks > 1 else ():
            console.print(f"  {finding.kind} in '{finding.column}': {finding.message}", style="yellow")


# ---- simulators ------------------------------------------------------------------------------------------------------


def _record_simulations(
    options: RecordOptions, out: Path, motions: Sequence[Motion], robot: Robot, meta: RunMeta, console: Console
) -> list[dict[str, object]]:
    from wlr_gym.base.random import spawn_seeds
    from wlr_gym.data.record import record_simulation
    from wlr_gym.data.runs import next_run

    patch, found = options.patch(), []
    make_output_folder(out)
    for motion in motions:
        path = next_run(out)
        seed = int(spawn_seeds(options.seed or 0, 1, path.stem)[0])  # no two runs of a folder have the same noise
        record_simulation(path, motion, robot, options.backend, seed, patch, meta)
        console.print(f"{motion.name}: {motion.duration:.1f} s on {options.backend}; written: {path}")
        found.append({"motion": motion.name, "run": path})
    return found


def _list(console: Console, robot: Robot, as_json: bool) -> None:
    from wlr_gym.data.excitations import EXCITATIONS, excite

    lengths = {name: excite(name, robot=robot).duration for name in EXCITATIONS}
    kinds = EXCITATIONS.items()
    if as_json:
        print_json([{"name": name, "seconds": lengths[name], "does": one.doc, "shows": one.shows} for name, one in kinds])
        return
    rows = [(name, f"{lengths[name]:.0f}", one.doc, one.shows) for name, one in kinds]
    print_table(console, ("excitation", "seconds", "what the robot does", "what it shows"), rows)
