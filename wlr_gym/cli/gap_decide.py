"""``wlr gap --until-decided``: who drives the further runs, and the table of the rounds."""

from __future__ import annotations

import time
from contextlib import closing
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from wlr_gym.base.errors import InputError
from wlr_gym.cli.robot_options import RobotOption, noise_seed

if TYPE_CHECKING:
    from collections.abc import Callable

    from rich.console import Console

    from wlr_gym.data.excitations import Motion
    from wlr_gym.gap.decision import Decided, Recorded, Recorder
    from wlr_gym.physics.effects import Patch
    from wlr_gym.robot import Robot

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
    budget_runs: int = 5
    """Most further runs."""
    budget_seconds: float | None = None
    """Most seconds of driving; default: as many as the runs take."""


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
    drive = {"emulated": _emulated, "simulator": _simulated}[options.record]
    return partial(drive, robot=robot, hidden=load_patch(list(options.hidden)), backend=backend)


def ask(motion: Motion, data: Path, *, out: Path, console: Console, wait: Callable[[float], None] = time.sleep) -> Recorded:
    """Write a motion, say how it is driven, and wait until its run is in the folder of the data."""
    from wlr_gym.data.read import read_run, run_files
    from wlr_gym.data.record import write_commands
    from wlr_gym.gap.decision import Recorded

    there = set(run_files(data))
    path = write_commands(out / ASKED, motion)
    console.print(f"drive {motion.name} ({motion.duration:.0f} s): wlr record --commands {path} --out {data}", markup=False)
    console.print(
        "(a real robot: with --hardware FILE) waiting for its run; Ctrl-C: the same command goes on later", markup=False
    )
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
    from wlr_gym.data.read import read_meta
    from wlr_gym.data.record import next_run, record_simulation
    from wlr_gym.gap.decision import Recorded

    path = next_run(data)
    seed = int(spawn_seeds(0, 1, path.stem)[0])
    return Recorded(record_simulation(path, motion, robot, backend, seed, hidden, read_meta(data)))


def _emulated(motion: Motion, data: Path, *, robot: Robot, hidden: Patch, backend: str) -> Recorded:
    """Drive an emulated robot in emulated time, through the command limiter as a real one; noise as in a simulator."""
    from wlr_gym.data.read import read_meta
    from wlr_gym.gap.decision import Recorded
    from wlr_gym.hardware.deployment import drive_robot

    del backend  # it has a simulator of its own
    meta = read_meta(data).model_copy(update={"profile": motion.profile})
    with closing(RobotOption(emulated=True).plant_of(robot, data, meta, hidden, noise_seed(data, 0))) as plant:
        drive = drive_robot(plant, motion)
    return Recorded(drive.run, drive.reason)


def print_rounds(decision: Decided, console: Console) -> None:
    """Print a row for every round, and how it ended."""
    from wlr_gym.base.text import duration
    from wlr_gym.cli.tables import print_table
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
