"""Adapt a policy to a robot: drive, find what the model lacks, train on with it, test, drive again; one page.

Each step has a folder in --out. Ctrl-C anywhere: the same command goes on. Every step is an ordinary command, and the page
names it. See docs/adapt.md.
"""

from __future__ import annotations

import json
import sys
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import tyro
from rich.console import Console

from wlr_gym.base.errors import InputError
from wlr_gym.base.jobs import cores
from wlr_gym.base.progress import progress
from wlr_gym.base.text import duration, pairs
from wlr_gym.cli import OK
from wlr_gym.cli.options import PORT, Count, FloorOption, JsonOption, PatchOption, Seed, SensorsOption, refuse_given
from wlr_gym.cli.terminal import print_json, print_table, wait_for_enter
from wlr_gym.policy import policy_environment
from wlr_gym.robot import load_robot

if TYPE_CHECKING:
    from wlr_gym.learning.adaptation import Adapted
    from wlr_gym.learning.adaptation.driving import RealRobot


@dataclass(frozen=True)
class AdaptOptions(JsonOption, PatchOption, FloorOption, SensorsOption):
    policy: tyro.conf.Positional[str]
    """Policy that PPO trained: shipped, a file, or a policy or run folder."""
    robot_runs: Path | None = None
    """Measured runs of the robot. Without --hardware nothing is driven: before and after are left out."""
    emulated: bool = False
    """An emulated robot, in emulated time; --effects is what it has that its file does not say."""
    hardware: str | None = None
    """A real robot: hardware file (wiring, mounting, safety limits), or name in configs/hardware/. You are asked before every
    drive."""
    port: tuple[str, ...] = ()
    """Other ports than the hardware file's, such as legs=/dev/ttyUSB1 imu=/dev/ttyACM0."""
    yes: bool = False
    """Do not ask before the robot moves."""
    env: str | None = None
    """Environment id; default: the one that the policy was trained in."""
    robot: str | None = None
    """Robot file, or name in configs/robot/; default: the policy's."""
    backend: str = "gibbs_appell"
    """Simulator behind the emulated robot: gibbs_appell or mujoco."""
    out: Path = Path("out/adapt")
    """Folder for all steps, the page and its numbers."""
    excitation: tuple[str, ...] = ("straight", "turns", "stop_and_go", "posture")
    """First runs, see: wlr record --list."""
    budget_runs: int = 2
    """Most further runs, until it is decided."""
    budget_seconds: float | None = None
    """Most seconds of driving them; default: as many as they take."""
    drives: int = 6
    """Episodes of the task before and after, each."""
    drive_seconds: float = 10.0
    """Length of such an episode."""
    steps: int = 7_500_000
    """Environment steps of the training."""
    learning_rate: float = 5e-4
    """Its learning rate at the start."""
    episodes: int = 256
    """Episodes of every family of the acceptance test."""
    seed: Seed = 0
    """Seed of everything random."""
    threads: Count | None = None
    """Worker threads; default: one per core that this process may use."""


def run(options: AdaptOptions) -> int:
    """Adapt; 0 = done, whichever policy is kept.

    Raises:
        InputError: bad options, runs of another robot, a policy that does not fit, a folder of another command.
    """
    from wlr_gym.learning.adaptation import Asked, adapt
    from wlr_gym.learning.adaptation.state import NUMBERS_FILE

    _check(options)
    console = Console(soft_wrap=True, highlight=False, file=sys.stderr if options.json else None)
    real = _real(options, console) if options.hardware is not None else None
    try:
        with progress(console) as tell:
            own = {name: getattr(options, name) for name in Asked.model_fields if hasattr(options, name)} | {
                "driven": real, "effects": options.patch() if options.emulated else None, "environment": options.env,
                "floor": options.load_floor(),
                "excitations": options.excitation, "sensors": options.present() or (),
                "threads": options.threads or cores(), "tell": partial(tell, ""),
            }  # fmt: skip
            found = adapt(out=options.out, **own)
    except KeyboardInterrupt:
        raise KeyboardInterrupt("interrupted; the same command goes on where it was") from None
    content = json.loads((found.page.parent / NUMBERS_FILE).read_text(encoding="utf-8"))
    if options.json:
        print_json(content)
    else:
        _print(found, content, console)
    return OK


def _check(options: AdaptOptions) -> None:
    if not (options.robot_runs or options.emulated or options.hardware):
        robots = "measured runs (--robot-runs DATA), an emulated robot (--emulated), or --hardware FILE"
        raise InputError(f"nothing to adapt to: give {robots}")
    if options.emulated and (options.robot_runs or options.hardware):
        raise InputError("--emulated: an emulated robot, a real one (--hardware) or its runs (--robot-runs): one of them")
    if not options.emulated:
        refuse_given(options, ("effects", "floor"), "it is for the emulated robot: a real one has its own")
    if options.hardware is None:
        refuse_given(options, ("port",), "it goes with --hardware")


def _real(options: AdaptOptions, console: Console) -> RealRobot:
    from wlr_gym.hardware.config import load_hardware, with_ports
    from wlr_gym.hardware.safety.preflight import require_ports
    from wlr_gym.learning.adaptation import RealRobot

    hardware, ports = options.hardware or "nominal", pairs("--port", options.port, PORT)

    def ask(text: str) -> None:
        if not options.yes:
            require_ports(with_ports(load_hardware(hardware), ports))
            wait_for_enter(console, f"{text} Free floor? Hand on the switch?")

    own = load_robot(options.robot or policy_environment(options.policy).get("robot") or "nominal")
    return RealRobot(own, hardware, ports, ask)


def _print(found: Adapted, content: dict[str, Any], console: Console) -> None:
    from wlr_gym.learning.adaptation.state import headline

    rows = [
        (name, duration(one.driving), duration(one.computing), one.said[0] if one.said else "")
        for name, one in found.steps.items()
    ]
    print_table(console, ("step", "driving", "computing", "found"), rows)
    console.print(headline(content), markup=False)
    console.print(f"policy: {found.policy}", markup=False)
    console.print(f"page: {found.page}", markup=False)
