"""Watch measured runs on a page in the browser, beside what a simulator makes of them. Works over ssh, without internet.

The page shows the robot and its replayed ghost, the floor's friction, slip and contact forces, and any channel over time.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from wlr_gym.base.errors import InputError
from wlr_gym.cli import OK
from wlr_gym.cli.options import FloorOption, PatchOption, RunsRobotOption, Seconds, require_simulator
from wlr_gym.render.web.page import HOST, PORT

if TYPE_CHECKING:
    from wlr_gym.data import Run

#: What is plotted until something else is chosen.
FIRST = ("cam_xy", "vel_wheel", "pos_leg")


@dataclass(frozen=True)
class ViewOptions(RunsRobotOption, PatchOption, FloorOption):
    runs: Annotated[tuple[Path, ...], tyro.conf.Positional] = ()
    """Runs (CSV or Parquet), or folders of runs."""
    backend: str = "gibbs_appell"
    """Simulator of the ghost."""
    ghost: bool = True
    """Replay the run, and show that robot, too."""
    segment: float = 10.0
    """Time between the points at which the ghost starts anew from the measured robot, s; inf = never."""
    host: str = HOST
    """Name or address to listen on; localhost = this machine, and ssh to it, only."""
    port: int = PORT
    """Where it is taken, the next free one."""
    seconds: Seconds | None = None
    """End after this time; default: at Ctrl-C."""


def run(options: ViewOptions) -> int:
    """Serve the page until Ctrl-C."""
    import time

    from wlr_gym.data.runs import read_runs
    from wlr_gym.data.watch import open_recordings
    from wlr_gym.render.web.player import Player

    require_simulator(options.backend, "a ghost needs a simulator; a real robot repeats a run with wlr replay")
    if not options.segment > 0.0:
        raise InputError(f"--segment {options.segment:g}: expected more than 0 s")
    if not options.runs:
        raise InputError("expected runs (CSV or Parquet), or folders of runs; wlr import makes runs of other programs' logs")
    runs = [one for path in options.runs for one in read_runs(path)]
    backend = options.backend if options.ghost else None
    opened = open_recordings(runs, options.robot, backend, options.patch(), options.segment, options.floor)
    player = Player(_names(runs), opened, FIRST, host=options.host, port=options.port)
    end = float("inf") if options.seconds is None else time.monotonic() + options.seconds
    player.run(lambda: time.monotonic() >= end)
    return OK


def _names(runs: Sequence[Run]) -> list[str]:
    """Return names that tell the runs apart: with their folders, where they must."""
    names = [one.name for one in runs]
    if len(set(names)) == len(names):
        return names
    names = [f"{one.path.parent.name}/{one.name}" for one in runs]
    return names if len(set(names)) == len(names) else [f"{k + 1}: {one.path}" for k, one in enumerate(runs)]
