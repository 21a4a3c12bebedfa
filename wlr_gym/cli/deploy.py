"""Drive the robot with a policy: check, ramp to the start pose, run at 50 Hz through the command limiter, stop, torque off.

Space switches the motors off at once, q stops, and so do Ctrl-C, SIGTERM and SIGHUP. Try it without a robot: --emulated. Wheels
off the ground the first time; see docs/robot.md.
"""

from __future__ import annotations

import contextlib
import math
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import tyro
from rich.console import Console

from wlr_gym.base.errors import InputError
from wlr_gym.cli import FAILED, IMPORTED, OK
from wlr_gym.cli.options import PatchOption, environment_of, pairs
from wlr_gym.cli.robot_options import port_pairs, wait_for_enter

if TYPE_CHECKING:
    from wlr_gym.envs.core import Core
    from wlr_gym.hardware.deployment import Deployment
    from wlr_gym.hardware.emulator.machine import Machine
    from wlr_gym.hardware.loop import ControlLoop

#: Steps between two looks of the live status.
_STATUS_TICKS = 10


@dataclass(frozen=True)
class DeployOptions(PatchOption):
    policy: tyro.conf.Positional[str]
    """Policy file or folder, run folder, or name of an agent or shipped policy."""
    env: str | None = None
    """Environment id, see: wlr envs; default: the one the policy was trained in, else WLR-Velocity-v0."""
    hardware: str = "nominal"
    """Hardware file, or name in configs/hardware/: ports, mounting, safety limits."""
    port: tuple[str, ...] = ()
    """Other ports than the file's: legs=/dev/ttyUSB0 wheels=/dev/ttyUSB1 imu=/dev/ttyACM0."""
    emulated: bool = False
    """Drive an emulated robot, which is started for the purpose."""
    stepped: bool = False
    """With --emulated: in emulated time, without ports: faster, and the same bits each time."""
    dry_run: bool = False
    """Do everything but write to the servos: nothing moves."""
    fault: tuple[str, ...] = ()
    """With --emulated: what goes wrong, as in wlr emulate: "drop legs after=3"."""
    seconds: float = 10.0
    """How long to drive."""
    command: tuple[str, ...] = ()
    """What to follow: linear_velocity_x=0.1 yaw_rate=0; default: drawn anew every few seconds, as in training."""
    seed: int = 0
    """Seed of the drawn commands."""
    deadman: float | None = None
    """Stop the wheels when no key was pressed for so many seconds."""
    out: Path = Path("robot_runs")
    """Folder for the logs."""
    yes: bool = False
    """Do not ask before the robot moves."""
    status: bool = True
    """Show a live status."""


def run(options: DeployOptions) -> int:
    """Deploy; 0 = ended as it was asked to, 1 = something stopped the robot.

    Raises:
        InputError: bad options, a policy that does not fit, ports that cannot be opened.
    """
    from wlr_gym.hardware.deployment import deploy, loop_of
    from wlr_gym.hardware.operator import Keys, stop_on_signals
    from wlr_gym.learning.evaluation import make_core
    from wlr_gym.policy import make_policy, policy_environment

    command = _check(options)
    environment = environment_of(options.env, options.policy)
    fed = policy_environment(options.policy)
    console = Console()
    with contextlib.ExitStack() as stack:
        ports = port_pairs(options.port)
        if options.emulated and not options.stepped:
            ports |= stack.enter_context(_emulator(options, console))
        robot_options = {
            "hardware": options.hardware,
            "ports": ports,
            "emulated": options.emulated and options.stepped,
            "effects": options.patch() if options.stepped else None,
            "dry_run": options.dry_run,
            "log": options.out,
            "deadman": options.deadman,
        }
        keywords = {"backend": "dynamixel", "hardware": robot_options, "episode_length": options.seconds} | fed
        core = make_core(environment, 1, keywords)
        stack.callback(core.close)
        policy = make_policy(options.policy, core.contract())
        _say_what_is_not_known(core, console)
        if not (options.yes or options.emulated or options.dry_run):
            wait_for_enter(console, "The robot will move. Wheels off the ground? Hand on the switch?")
        loop = loop_of(core)
        if options.stepped:
            for fault in options.fault:
                _machine_of(loop).inject(fault)
        keys = stack.enter_context(Keys())
        stack.enter_context(stop_on_signals(loop.operator))
        stack.enter_context(_status(loop, core, keys, options.status and console.is_terminal, console))
        result = deploy(core, policy, options.seed, command)
    _report(result, loop, console)
    return OK if result.well else FAILED


def _check(options: DeployOptions) -> dict[str, float]:
    """Return the held command, from options that make sense."""
    if not 0.0 < options.seconds < float("inf"):
        raise InputError(f"--seconds {options.seconds:g}: expected more than 0")
    if options.seed < 0:
        raise InputError(f"--seed {options.seed}: expected 0 or more")
    if options.deadman is not None and not 0.0 < options.deadman < float("inf"):
        raise InputError(f"--deadman {options.deadman:g}: expected more than 0")
    if not options.emulated and (options.stepped or options.fault):
        raise InputError("--stepped and --fault are for the emulated robot: add --emulated")
    if options.effects and not options.emulated:
        raise InputError("--effects: a real robot has its own; add --emulated")
    options.patch()  # a bad one is refused before a robot is started for it
    if options.emulated and options.port:
        raise InputError("--port: the emulated robot brings its own ports")
    commands = pairs("--command", options.command, "yaw_rate=0.1")
    try:
        numbers = {name: float(text) for name, text in commands.items()}
    except ValueError:
        numbers = {"": float("nan")}
    if not all(map(math.isfinite, numbers.values())):
        raise InputError(f"--command {' '.join(options.command)}: expected name=number")
    return numbers


def _machine_of(loop: ControlLoop) -> Machine:
    """Return the emulated robot that a loop drives."""
    from wlr_gym.hardware.emulator.memory import EmulatedWorld

    assert isinstance(loop.clock, EmulatedWorld)
    return loop.clock.machine


@contextlib.contextmanager
def _emulator(options: DeployOptions, console: Console) -> Iterator[dict[str, str]]:
    """Start ``wlr emulate`` as a process of its own; yield its ports."""
    import subprocess
    import tempfile

    with tempfile.TemporaryDirectory(prefix="wlr-robot-") as folder:
        links = Path(folder) / "ports"
        words = ["--links", str(links), "--hardware", options.hardware]
        for fault in options.fault:
            words += ["--fault", fault]
        if options.effects:
            words += ["--effects", *options.effects]
        modules = [word for module in IMPORTED for word in ("--import", module)]
        main = "import sys; from wlr_gym.cli import main; sys.exit(main())"
        command = [sys.executable, "-c", main, *modules, "emulate", *words]
        process = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, start_new_session=True
        )
        assert process.stdout is not None
        assert process.stderr is not None
        try:
            console.print("starting the emulated robot ...", style="dim")
            ports = {line.split()[0]: line.split()[1] for line in (process.stdout.readline() for _ in range(3)) if line}
            if len(ports) < 3:
                raise InputError(f"the emulated robot does not start: {process.stderr.read().strip()}")
            yield ports
        finally:
            process.terminate()
            process.communicate()


def _say_what_is_not_known(core: Core, console: Console) -> None:
    from wlr_gym.policy import needs_camera

    console.print(f"not measured on a robot, and left out: {', '.join(core.unmeasured)}", style="dim")
    if needs_camera(core.contract()):
        note = "note: the policy's slip observer had a camera in training; this robot has none: expect worse tracking"
        console.print(note, style="yellow")


@contextlib.contextmanager
def _status(loop: ControlLoop, core: Core, keys: Any, show: bool, console: Console) -> Iterator[None]:
    """Serve the keys, and show the status, in the time that is left in each step."""
    from rich.live import Live

    from wlr_gym.hardware.operator import HELP

    console.print(HELP, style="dim")
    live = Live(console=console, auto_refresh=False, transient=True) if show else None
    count = 0

    def spare() -> None:
        nonlocal count
        keys.serve(loop.operator)
        count += 1
        if live is not None and count % _STATUS_TICKS == 0:
            live.update(status_table(loop, core), refresh=True)

    loop.operator.spare = spare
    with live or contextlib.nullcontext():
        try:
            yield
        finally:
            loop.operator.spare = None


def status_table(loop: ControlLoop, core: Core) -> Any:
    """Return what a driver wants to see now."""
    from rich.table import Table

    from wlr_gym.hardware.safety.rules import tilt_of
    from wlr_gym.robot import JOINTS

    table = Table(box=None, title=f"{loop.phase.name.lower().replace('_', ' ')}  {core.time[0]:.1f} s", title_justify="left")
    for name in ("joint", "angle rad", "setpoint", "speed rad/s", "effort N m", "degC", "V"):
        table.add_column(name, justify="left" if name == "joint" else "right")
    status = loop.status
    if status is None:
        return table
    for k, joint in enumerate(JOINTS):
        numbers = (
            status.position[k],
            loop.setpoints[k],
            status.velocity[k],
            status.effort[k],
            status.temperature[k],
            status.voltage[k],
        )
        table.add_row(joint, *(f"{number:.2f}" for number in numbers), style="red" if status.silence[k] > 0 else "")
    command = "  ".join(f"{name} {value:+.2f}" for name, value in zip(core.task.commands, core.command[0], strict=True))
    limited = ", ".join(f"{rule} {count}" for rule, count in loop.interventions.most_common()) or "none"
    table.caption = (
        f"{command}\ntilt {tilt_of(status.up):.2f} rad  steps missed {loop.pacer.missed}\ncommand limiter: {limited}"
    )
    table.caption_justify = "left"
    return table


def _report(result: Deployment, loop: ControlLoop, console: Console) -> None:
    from rich.table import Table
    from rich.text import Text

    colour = "green" if result.well else "red"
    console.print(Text.assemble(("ended: ", "bold"), (result.reason, colour)))
    statistics = result.statistics
    table = Table(box=None, title=f"{statistics['ticks']} steps, {statistics['missed']} missed; ms", title_justify="left")
    for name in ("", "p50", "p95", "p99", "max"):
        table.add_column(name, justify="right")
    for name, values in statistics.items():
        if isinstance(values, dict) and "p50" in values:
            table.add_row(name, *(f"{value:.2f}" for value in values.values()))
    console.print(table)
    limited = ", ".join(f"{rule} {count}" for rule, count in loop.interventions.most_common()) or "none"
    console.print(f"command limiter, steps: {limited}")
    if result.run is not None:
        console.print(f"written: {result.run}", soft_wrap=True)
