"""Options of ``wlr deploy``, and what it refuses before anything else: before an operator is asked or a robot started."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import tyro

from wlr_gym.base.errors import InputError
from wlr_gym.base.files import require_ending, require_output_place
from wlr_gym.base.text import pairs
from wlr_gym.cli.options import JsonOption, PatchOption
from wlr_gym.cli.robot_options import read_camera


@dataclass(frozen=True)
class DeployOptions(JsonOption, PatchOption):
    policy: tyro.conf.Positional[str]
    """Policy file or folder, run folder, or name of an agent or shipped policy."""
    env: str | None = None
    """Environment id, see: wlr envs; default: the one the policy was trained in, else WLR-Velocity-v0."""
    robot: str | None = None
    """Robot file, or name in configs/robot/; default: that of the hardware file, else the policy's."""
    hardware: str = "nominal"
    """Hardware file (wiring, mounting, safety limits), or name in configs/hardware/."""
    port: tuple[str, ...] = ()
    """Other ports than the hardware file's, such as legs=/dev/ttyUSB1 imu=/dev/ttyACM0."""
    emulated: bool = False
    """Drive an emulated robot, which is started for the purpose."""
    stepped: bool = False
    """With --emulated: in emulated time, without ports: faster, and the same bits each time."""
    camera: str | None = None
    """Camera above the floor: file or name in configs/camera/; over an emulated robot, its frames are rendered."""
    dry_run: bool = False
    """Do everything but write to the servos: nothing moves."""
    fault: tuple[str, ...] = ()
    """With --emulated: what goes wrong, as in wlr emulate: "drop legs after=3"."""
    seconds: float = 10.0
    """How long to drive."""
    command: tuple[str, ...] = ()
    """What to follow: linear_velocity_x=0.1 yaw_rate=0; default: drawn anew every few seconds, as in training."""
    seed: int = 0
    """Seed of the drawn commands, and of an emulated robot's noise."""
    deadman: float | None = None
    """Stop the wheels when no key was pressed for so many seconds (10 at most); with --gamepad: its dead-man button (0.2)."""
    gamepad: str | None = None
    """Steer with a gamepad, such as /dev/input/js0, while its dead-man button is held; buttons: the hardware file's gamepad."""
    realtime: int | None = None
    """Run at this real-time priority (1 to 99, SCHED_FIFO) with all memory locked; Linux."""
    out: Path = Path("robot_runs")
    """Folder for the logs."""
    mcap: Path | None = None
    """Write the run into this new MCAP file, too, while it goes on, for Foxglove and PlotJuggler."""
    yes: bool = False
    """Do not ask before the robot moves."""
    status: bool = True
    """Show a live status."""


def checked_command(options: DeployOptions) -> dict[str, float]:
    """Return the held command, from options that make sense.

    Raises:
        InputError: the first option that does not.
    """
    from wlr_gym.hardware.config import require_deadman
    from wlr_gym.hardware.timing import require_priority

    if not 0.0 < options.seconds < float("inf"):
        raise InputError(f"--seconds {options.seconds:g}: expected more than 0")
    if options.deadman is not None:
        require_deadman("--deadman", options.deadman)
    if options.realtime is not None:
        require_priority("--realtime", options.realtime)
    _check_emulation(options)
    _check_training(options)
    read_camera(options.camera, options.emulated)
    options.patch()  # a bad one is refused before a robot is started for it
    _check_faults(options)
    require_output_place(options.out)
    if options.mcap is not None:
        if options.mcap.exists():
            raise InputError(f"--mcap {options.mcap}: is there already; a stream goes into a new file")
        require_ending(options.mcap, (".mcap",), "--mcap")
    return _command(options)


def _check_emulation(options: DeployOptions) -> None:
    if not options.emulated and (options.stepped or options.fault):
        raise InputError("--stepped and --fault are for the emulated robot: add --emulated")
    if options.stepped and options.realtime is not None:
        raise InputError("--realtime: emulated time is not real time; leave out --stepped")
    if options.effects and not options.emulated:
        raise InputError("--effects: a real robot has its own; add --emulated")
    if options.emulated and options.port:
        raise InputError("--port: the emulated robot brings its own ports")


def _check_training(options: DeployOptions) -> None:
    from wlr_gym.policy import untrained

    words = untrained(options.policy)
    if words and not (options.emulated or options.dry_run):
        raise InputError(f"{words}; a real robot moves with one of these, or with your own")


def _check_faults(options: DeployOptions) -> None:
    if not options.fault:
        return
    from wlr_gym.hardware.config import load_hardware
    from wlr_gym.hardware.emulator import parse_fault
    from wlr_gym.robot import JOINTS

    places = (*JOINTS, *load_hardware(options.hardware).buses, "imu", "flow", "camera")
    for fault in options.fault:
        try:
            parse_fault(fault, places)
        except InputError as error:
            raise InputError(f"--fault: {error}") from None


def _command(options: DeployOptions) -> dict[str, float]:
    commands = pairs("--command", options.command, "yaw_rate=0.1")
    try:
        numbers = {name: float(text) for name, text in commands.items()}
    except ValueError:
        numbers = {"": float("nan")}
    if not all(map(math.isfinite, numbers.values())):
        raise InputError(f"--command {' '.join(options.command)}: expected name=number")
    return numbers
