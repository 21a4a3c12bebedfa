"""Emulate the robot's eight servos and its IMU on pseudo-terminals; any Dynamixel tool can connect to them.

Prints the ports and runs until Ctrl-C. Type a fault (``drop wheels probability=0.01``, ``dead leg_lf after=2``), ``status``,
``faults``, ``clear`` or ``help``; the same lines are taken by --fault and by the --control socket.
"""

from __future__ import annotations

import contextlib
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from wlr_gym.base.errors import InputError, Interval
from wlr_gym.cli import OK
from wlr_gym.cli.options import FloorOption, HardwareOption, PatchOption, Seconds, Seed, refuse_given
from wlr_gym.robot import load_robot

if TYPE_CHECKING:
    from wlr_gym.hardware.emulator import Machine, Server


@dataclass(frozen=True)
class EmulateOptions(HardwareOption, PatchOption, FloorOption):
    backend: str = "gibbs_appell"
    """Simulator behind the servos."""
    links: Path | None = None
    """Folder for links to the ports with fixed names (one per bus, imu, and flow); made if it is not there."""
    control: Path | None = None
    """Path of a Unix socket that takes command lines."""
    fault: tuple[str, ...] = ()
    """Faults to start with, each in quotes."""
    stand: bool = False
    """On a stand, wheels off the floor, for wlr calibrate joints; on the floor it collapses where motors are off."""
    stepped: bool = False
    """Time passes only by the command ``step SECONDS``; answers then come at once."""
    tick: Seconds = 0.001
    """Emulated time per step, s."""
    usb_latency: Annotated[float, Interval("s", least=0.0)] = 0.001
    """How long the adapter holds back unfilled packets, s (16 ms as an FTDI adapter comes, 1 ms as advised)."""
    wire_time: bool = True
    """Let bytes take their time on the wire."""
    factory: bool = False
    """Servos as out of the box: id 1, 57600 bit/s. They then answer all at once, as real ones do."""
    firmware: Annotated[int, Interval(least=0, most=255)] = 45
    """Version the servos report; fast reads need 45."""
    seed: Seed = 0
    """Seed of sensor noise and faults."""
    seconds: Annotated[float, Interval("s", least=0.0)] = 0.0
    """Stop after this long; 0 = run until Ctrl-C."""
    poses: Path | None = None
    """File that the true pose goes into, for a camera that films by rendering (wlr deploy --camera)."""


def run(options: EmulateOptions) -> int:
    """Emulate until Ctrl-C; 0 then.

    Raises:
        InputError: unknown robot, hardware, backend or fault; ports that cannot be made.
    """
    from wlr_gym.hardware.emulator import Server
    from wlr_gym.hardware.emulator.camera import FeedWriter

    machine = machine_of(options)
    with Server(machine, real_time=not options.stepped, links=options.links, control=options.control) as server:
        if options.poses is not None:
            machine.watchers.append(FeedWriter(machine, options.poses, lambda: server.origin))
        for name, path in server.ports.items():
            bus, sensor = machine.hardware.buses.get(name), "the IMU" if name == "imu" else name
            text = f"{bus.model}, {bus.baud_rate} bit/s: {', '.join(bus.joints)}" if bus else f"frames of {sensor}"
            print(f"{name:8} {options.links / name if options.links else path}  {text}", flush=True)
        try:
            _take_commands(server, options.seconds)
        except KeyboardInterrupt:
            print("stopped")
    machine.close()
    if server.failure is not None:
        raise server.failure
    if server.slipped > 0.0:
        print(f"this computer was too busy: emulated time fell behind by {server.slipped:.2f} s", file=sys.stderr)
    return OK


def machine_of(options: EmulateOptions) -> Machine:
    """Return the emulated robot.

    Raises:
        InputError: unknown robot, hardware, backend or fault; numbers out of range.
    """
    from wlr_gym.hardware.config import load_hardware
    from wlr_gym.hardware.emulator import Machine, MachineOptions
    from wlr_gym.hardware.emulator.line import NO_TIME, LineTiming
    from wlr_gym.hardware.emulator.link import with_flow_port
    from wlr_gym.hardware.emulator.stand import EmulatedStand
    from wlr_gym.physics.plants import check_simulator

    check_simulator(options.backend, "--backend")
    timing = NO_TIME if options.stepped else LineTiming(wire=options.wire_time, usb_latency=options.usb_latency)
    machine_options = MachineOptions(
        backend=options.backend,
        tick=options.tick,
        seed=options.seed,
        firmware=options.firmware,
        factory=options.factory,
        timing=timing,
    )
    hardware, effects = load_hardware(options.hardware), options.patch()
    robot = load_robot(options.robot or hardware.robot or "nominal")
    hardware = with_flow_port(robot, hardware)
    if options.stand:
        refuse_given(options, ("floor",), "on a stand no wheel touches it; leave --stand out")
        machine = EmulatedStand(robot, hardware, effects, options=machine_options).machine
    else:
        machine = Machine(robot, hardware, machine_options, effects=effects, floor=options.load_floor(robot))
    for fault in options.fault:
        machine.inject(fault)
    return machine


def _take_commands(server: Server, seconds: float) -> None:
    """Read command lines from the terminal or a pipe until the time is over; at the end of input, wait."""
    import math
    import os
    import select
    import signal
    import time

    end = time.monotonic() + seconds if seconds > 0.0 else math.inf
    source = None
    with contextlib.suppress(AttributeError, OSError, ValueError):  # there may be no standard input
        source = sys.stdin.fileno()
    text = b""
    signal.signal(signal.SIGTERM, signal.default_int_handler)  # so that links are removed then too
    while (left := end - time.monotonic()) > 0.0 and server.failure is None:
        wait = min(left, 0.5)
        if source is None:
            time.sleep(wait)
        elif select.select([source], [], [], wait)[0]:
            data = os.read(source, 4096)
            *lines, text = (text + data).split(b"\n")
            for line in filter(None, map(bytes.strip, lines)):
                try:
                    said = server.command(line.decode("utf-8", "replace"))
                except InputError as error:
                    said = f"error: {error}"
                print(said, flush=True)
            source = source if data else None
