"""An emulated robot behind the real control loop, in emulated time: shared by the tests of loop, limiter and faults."""

from __future__ import annotations

import os
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import yaml

from wlr_gym.data.format import RunMeta
from wlr_gym.hardware import loop as loop_module
from wlr_gym.hardware.config import ImuPort, load_hardware, with_ports
from wlr_gym.hardware.emulator import Machine, MachineOptions
from wlr_gym.hardware.emulator.line import NO_TIME
from wlr_gym.hardware.emulator.link import MemoryDevice, emulated_link
from wlr_gym.hardware.imu import ImuStream
from wlr_gym.hardware.loop import ControlLoop, Phase, StoppedError
from wlr_gym.physics.plants.base import RobotOptions
from wlr_gym.robot import JOINTS, load_robot

loop_module.TIMED_READS = 20  # in emulated time they all take the same

ROBOT = load_robot("emanual")
HARDWARE = load_hardware()
PERIOD = 0.02
DRIVE = np.array([1.5, 1.6, 1.5, 1.6, 3.0, 3.0, 3.0, 3.0])

#: Safety limits for real time: a busy computer must not fail a test that is about something else than deadlines.
PATIENT = {
    "patience": 1.0, "read_time": 1.0, "late": 250, "late_share": 1.0, "silence": 3.0, "coast": 1.0, "imu_silence": 3.0,
    "watchdog": 2.5, "heartbeat": 10.0,
}  # fmt: skip


def hardware_with(**safety):
    """The nominal hardware with other safety limits."""
    return HARDWARE.model_copy(update={"safety": HARDWARE.safety.model_copy(update=safety)})


def hardware_file(folder: Path, ports: dict[str, str], **safety) -> Path:
    """Write a hardware file with these ports and patient safety limits."""
    description = with_ports(hardware_with(**PATIENT | safety), ports)
    path = folder / "hardware.yaml"
    path.write_text(yaml.safe_dump(description.model_dump(mode="json")), encoding="utf-8")
    return path


@contextmanager
def jabbering_port() -> Iterator[tuple[str, Callable[[], bytes]]]:
    """A serial device on which something talks every 5 ms, for 30 s; yields its path, and what takes bytes sent to it."""
    import tty  # not on Windows

    master, slave = os.openpty()
    tty.setraw(slave)
    os.set_blocking(master, False)
    over = threading.Event()

    def talk() -> None:
        for _ in range(6000):
            if over.wait(0.005):
                return
            with suppress(BlockingIOError):
                os.write(master, b"\x55jabber")

    def take() -> bytes:
        with suppress(BlockingIOError):
            return os.read(master, 65536)
        return b""

    talker = threading.Thread(target=talk, daemon=True)
    talker.start()
    try:
        yield os.ttyname(slave), take
    finally:
        over.set()
        talker.join()
        os.close(master)
        os.close(slave)


def machine_of(core: Any) -> Any:
    """The emulated robot that a core drives: its clock, or behind it."""
    clock = core.plant.loop.clock
    return getattr(clock, "machine", clock)


def emulated_imu(link: Any, port: ImuPort) -> ImuStream:
    """The IMU of an emulated robot's link, read with other ranges or another calibration."""
    return ImuStream(port, link.clock.now, lambda *_: MemoryDevice(link.clock, "imu"))


def imu_that_reads(*counts):
    """The IMU of an emulated robot whose accelerometer gives nothing but these counts (x, y, z), and that does not turn."""
    return SimpleNamespace(counts=lambda accelerometer, gyro: (counts, (0, 0, 0)))


#: Rigs of the test that is going on; they are closed when it is over.
RIGS: list[Any] = []


class Rig:
    """A robot and its loop.

    Attributes:
        machine: the emulated robot. loop: drives it.
    """

    def __init__(
        self, log: Path | None = None, options=None, machine=None, dry_run: bool = False, profile=None, **safety: Any
    ) -> None:
        hardware = hardware_with(**safety)
        self.machine = machine or Machine(ROBOT, hardware, options or MachineOptions(timing=NO_TIME))
        self.link = emulated_link(self.machine)
        meta = None if profile is None else RunMeta(robot=ROBOT.name, profile=profile)
        self.loop = ControlLoop(ROBOT, hardware, self.link, PERIOD, RobotOptions(log=log, dry_run=dry_run), meta)
        RIGS.append(self)

    def start(self, seconds, setpoints=DRIVE):
        """Start, and drive for so long."""
        self.loop.start()
        self.drive(seconds, setpoints)

    def drive(self, seconds, setpoints=DRIVE):
        for _ in range(round(seconds / PERIOD)):
            self.loop.tick(setpoints)

    def stops(self, match, seconds=1.0):
        """Drive until the robot stops for this reason; torque is off then, or the power has to be cut."""
        with pytest.raises(StoppedError, match=match) as stopped:
            self.drive(seconds)
        assert not self.torque().any() or "CUT THE POWER" in str(stopped.value)

    def torque(self):
        """(8,) which motors are on."""
        return np.array([bool(servo["torque_enable"]) and not servo.dead for servo in self.machine.servos.values()])

    def goal_counts(self):
        """(8,) setpoints the servos hold."""
        return np.array(
            [self.machine.servos[joint]["goal_position" if k < 4 else "goal_velocity"] for k, joint in enumerate(JOINTS)]
        )

    def hear(self, line, answers):
        """Let ``answers(data, those there would be)`` take the place of a line's answers."""
        line, receive = self.machine.lines[line], self.machine.lines[line].receive
        line.receive = lambda data, now, baud_rate=None: answers(data, receive(data, now, baud_rate))

    def inject(self, text):
        self.machine.inject(text)


__all__ = [
    "DRIVE", "HARDWARE", "JOINTS", "PATIENT", "PERIOD", "ROBOT", "Phase", "Rig", "StoppedError", "emulated_imu",
    "hardware_file", "hardware_with", "imu_that_reads", "jabbering_port", "machine_of",
]  # fmt: skip
