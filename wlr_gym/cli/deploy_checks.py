"""What ``wlr deploy`` refuses before anything else: an operator has not been asked yet, and no robot started."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING

from wlr_gym.base.errors import InputError
from wlr_gym.base.text import pairs
from wlr_gym.cli.robot_options import read_camera

if TYPE_CHECKING:
    from wlr_gym.cli.deploy import DeployOptions


def checked_command(options: DeployOptions) -> dict[str, float]:
    """Return the held command, from options that make sense.

    Raises:
        InputError: the first option that does not.
    """
    from wlr_gym.hardware.limits import require_deadman
    from wlr_gym.hardware.realtime import require_priority

    if not 0.0 < options.seconds < float("inf"):
        raise InputError(f"--seconds {options.seconds:g}: expected more than 0")
    if options.deadman is not None:
        require_deadman("--deadman", options.deadman)
    if options.realtime is not None:
        require_priority("--realtime", options.realtime)
    _check_emulation(options)
    read_camera(options.camera, options.emulated)
    options.patch()  # a bad one is refused before a robot is started for it
    _check_faults(options)
    _check_places(options.out, options.mcap)
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


def _check_places(out: Path, mcap: Path | None) -> None:
    place = next(parent for parent in (out, *out.absolute().parents) if parent.exists())
    if not place.is_dir():
        raise InputError(f"--out {out}: {place} is a file; expected a folder")
    if mcap is not None and mcap.exists():
        raise InputError(f"--mcap {mcap}: is there already; a stream goes into a new file")


def _command(options: DeployOptions) -> dict[str, float]:
    commands = pairs("--command", options.command, "yaw_rate=0.1")
    try:
        numbers = {name: float(text) for name, text in commands.items()}
    except ValueError:
        numbers = {"": float("nan")}
    if not all(map(math.isfinite, numbers.values())):
        raise InputError(f"--command {' '.join(options.command)}: expected name=number")
    return numbers
