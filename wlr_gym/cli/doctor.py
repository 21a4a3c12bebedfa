"""Look at a robot before it drives: ports, adapters, servos, bus speed, sensors, and whether a policy fits. Moves nothing.

Names the first thing that is wrong and what to do about it. Exit code 0: nothing stands against driving; 1: something does.
"""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from contextlib import closing
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated

import tyro
from rich.console import Console
from rich.text import Text

from wlr_gym.base.errors import InputError
from wlr_gym.base.text import counted
from wlr_gym.cli import FAILED, OK
from wlr_gym.cli.options import CameraOption, JsonOption
from wlr_gym.cli.terminal import print_json, wait_for_enter
from wlr_gym.hardware.dynamixel.protocol import BusGoneError
from wlr_gym.policy import camera_share, check_contract, contract_of, environment_for, find_policy, misses_camera
from wlr_gym.robot import Robot

if TYPE_CHECKING:
    from wlr_gym.hardware.config import Hardware
    from wlr_gym.hardware.link import Link
    from wlr_gym.hardware.safety.preflight import Check


@dataclass(frozen=True)
class DoctorOptions(JsonOption, CameraOption):
    policy: Annotated[str | None, tyro.conf.Positional] = None
    """Policy file or folder, run folder or shipped policy that is to drive it: does it fit this robot?"""
    mend: bool = False
    """Write the register values that mend what is wrong; says which, and asks first (servos' torque must be off)."""
    scan: bool = False
    """Search every bus at every baud rate for servos, whatever their ids."""
    verbose: bool = False
    """Show every check of every joint."""


def run(options: DoctorOptions) -> int:
    """Look and print; 0 when nothing stands against driving.

    Raises:
        InputError: unknown robot, hardware or policy, nothing to scan.
    """
    if options.policy is not None:
        find_policy(options.policy)
    if options.scan and options.emulated:
        raise InputError("--scan: the emulated robot of this process has no ports; name those of wlr emulate")
    console = Console(soft_wrap=True, highlight=False)
    robot, hardware = options.load()
    with closing(options.link()) as link:
        checks = examine(link, robot, hardware, options, console)
    if options.policy is not None:
        checks += check_policy(options.policy, options.robot_name(), options.camera is not None)
    if options.json:
        print_json([check._asdict() for check in checks])
    else:
        _print(checks, console, options)
    return FAILED if any(check.is_fatal and not check.ok for check in checks) else OK


def examine(link: Link, robot: Robot, hardware: Hardware, options: DoctorOptions, console: Console) -> list[Check]:
    """Return all checks of ports, adapters, servos, buses, IMU and camera; mends and scans where that was asked for."""
    from wlr_gym.hardware.imu import ImuStream
    from wlr_gym.hardware.loop import TIMED_READS
    from wlr_gym.hardware.safety import preflight
    from wlr_gym.hardware.safety.preflight import check_camera

    ports = preflight.open_ports(link.servos, link.imu, hardware, link.flow)
    found = ports if options.emulated else ports + preflight.check_latency_timers(hardware)
    open_here = {check.where for check in ports if check.ok}
    buses = [name for name in hardware.buses if name in open_here]
    joints = [joint for name in buses for joint in hardware.buses[name].joints]
    try:
        if options.scan:
            _scan(link, hardware, buses, console)
        servos = preflight.check_servos(link.servos, robot, hardware, joints)
        for _ in range(2 if options.mend else 0):  # of a servo that answered nothing before, more is seen afterwards
            if not _mend(link, servos, console):
                break
            servos = preflight.check_servos(link.servos, robot, hardware, joints)
        found += servos
        if len(buses) == len(hardware.buses) and all(check.ok for check in servos if check.what == "answer"):
            link.servos.set_patience(hardware.safety.patience)  # as while driving
            found.append(preflight.check_bus_speed(link.servos, TIMED_READS, hardware.safety.read_time, link.clock.now))
    except BusGoneError as error:
        found.append(preflight.Check("robot", "bus", False, str(error), "a bus that stays", "Check plugs and supply."))
    if "imu" in open_here:
        found += preflight.check_imu(link.imu, hardware.imu, link.clock)
        if isinstance(link.imu, ImuStream):
            found += preflight.check_board(link.imu, hardware.imu, link.clock)
    if "flow" in open_here and link.flow is not None and hardware.flow is not None:
        found += preflight.check_flow(link.flow, hardware.flow, link.clock)
    if link.camera is not None and (file := options.camera_file()) is not None:
        found += check_camera(link.camera, file, link.clock)
    return found


def _mend(link: Link, checks: Sequence[Check], console: Console) -> bool:
    """Say which registers will be written, ask, write; return whether any were."""
    from wlr_gym.hardware.safety.preflight import mend, mendable

    registers = [(check.where, check.found, *check.fix) for check in mendable(checks) if check.fix]
    if not registers:
        return False
    for joint, found, item, count in registers:
        console.print(f"{joint}: {item}, now {found}, will be {count}")
    wait_for_enter(console, "Nothing moves. Write it?", "write it", "")
    left = mend(link.servos, checks)
    console.print(f"mended: {sum(not check.ok for check in checks) - len(left)}, left: {len(left)}")
    for check in (unkept := mendable(left)):
        console.print(f"{check.where}: {check.what} was written and did not stick: the servo is worn or locked: exchange it")
    return len(unkept) < len(registers)


def check_policy(source: str, robot: str, has_camera: bool = False) -> list[Check]:
    """Return whether a policy was made for this robot, its observations and its control period, and for its sensors."""
    from wlr_gym.hardware.safety.preflight import Check
    from wlr_gym.learning.evaluation.rollout import make_core

    remedy = "Choose another policy, train it for this robot, or name the robot file it was trained with (--robot)."
    try:
        policy = contract_of(source)
        environment = policy.get("training", {}).get("environment", "WLR-Velocity-v0")
        with closing(make_core(environment, 1, environment_for(source, {"robot": robot}))) as core:
            check_contract(policy["environment"], core.contract(), source)
    except InputError as error:
        return [Check("policy", "contract", False, str(error), "one that fits", remedy)]
    checks = [Check("policy", "contract", True, f"{policy['agent']}, {policy['environment']['task']}", "", "")]
    share = camera_share(policy["environment"])
    if has_camera or not share:
        return checks
    if misses_camera(policy["environment"]):
        expected = f"one, as in {share:.0%} of its training"
        remedy = "Its slip observer goes by wheels and IMU alone: expect worse tracking. Name the camera (--camera FILE)."
        checks.append(Check("policy", "camera", False, "none on this robot", expected, remedy, False))
    else:
        found = f"none; the policy had one in {share:.0%} of its training (docs/policies.md: what each task loses without)"
        checks.append(Check("policy", "camera", True, found, "", ""))
    return checks


def _scan(link: Link, hardware: Hardware, buses: Sequence[str], console: Console) -> None:
    """Print who answers on the buses; raise ``BusGoneError`` where a port is gone."""
    from wlr_gym.hardware.servos import find_servos

    for name in buses:
        link.servos.groups[name].close()
        try:
            for servo in find_servos(name, hardware.buses[name].port):
                console.print(f"{name}: {servo}")
            link.servos.groups[name].open()
        except InputError as error:
            raise BusGoneError(str(error)) from None


# ---- the report ------------------------------------------------------------------------------------------------------


def _print(checks: Sequence[Check], console: Console, options: DoctorOptions) -> None:
    from wlr_gym.hardware.safety.preflight import mendable

    for line, style in _lines(checks, options.verbose):
        console.print(Text(line, style))
    wrong = sorted((check for check in checks if not check.ok), key=lambda check: not check.is_fatal)
    if not wrong:
        console.print(Text(f"All {len(checks)} checks passed.", "bold green"))
        return
    faults = sum(check.is_fatal for check in wrong)
    counts = f"{counted(faults, 'fault')}, {counted(len(wrong) - faults, 'warning')} in {len(checks)} checks."
    console.print(Text(counts, "bold red" if faults else "bold yellow"))
    first = wrong[0]
    console.print(Text(f"Look first at {first.where}, {first.what}: its line above says what to do.", "bold"))
    if registers := mendable(checks):
        words = ["wlr", "doctor"]
        words += ["--robot", options.robot] if options.robot else []
        words += ["--hardware", options.hardware] if options.hardware != "nominal" else []
        words += ["--port", *options.port] if options.port else []
        words += ["--emulated"] if options.emulated else []
        words += ["--camera", options.camera] if options.camera else []
        command = shlex.join([*words, "--mend"])
        many = counted(len(registers), "register")
        console.print(Text(f"{many} can be written, after a question: {command}", "bold"))


def _lines(checks: Sequence[Check], verbose: bool) -> list[tuple[str, str]]:
    """One line per kind of check that all joints pass, one per joint that fails it, in the order they were made."""
    lines: dict[str, str] = {}
    for check in checks:
        alike = [other for other in checks if other.what == check.what]
        if verbose or not check.ok or len(alike) == 1:
            lines[str(check)] = "" if check.ok else "red" if check.is_fatal else "yellow"
        else:
            found = list(dict.fromkeys(other.found for other in alike if other.ok))
            passed = sum(other.ok for other in alike)
            lines[f"ok      {passed} of {len(alike):<5} {check.what}: {', '.join(found)}"] = ""
    return list(lines.items())
