"""A second process that switches the motors off when the one that drives the robot dies without doing it (``kill -9``).

``python -m wlr_gym.hardware.safety.watchdog`` reads one line of JSON (buses and ids), answers ``ready`` and waits. ``done``
ends it. When the other process is gone instead, it opens the ports and switches torque off until every servo has confirmed.
Until it is that far, the servos' Bus Watchdog has stopped the motion.
"""

from __future__ import annotations

import contextlib
import json
import os
import select
import signal
import subprocess
import sys
import time
from pathlib import Path

from wlr_gym.base.errors import InputError
from wlr_gym.hardware.config import Hardware
from wlr_gym.hardware.dynamixel.bus import BusGroup
from wlr_gym.hardware.dynamixel.tables import load_table
from wlr_gym.robot import Robot

#: s the process may take to start.
START_TIME = 30.0
#: s to go on trying to reach a servo.
TRY_TIME = 60.0
#: s between looks at whether its parent lives.
LOOK_TIME = 0.05
#: s between tries to switch off.
_PAUSE = 0.05


class WatchdogProcess:
    """The watchdog process, seen from the driving one.

    Args:
        robot, hardware: ids and ports.
        log: folder in which the process notes what it did (``guard.jsonl``); None = nowhere.

    Raises:
        InputError: the process does not start.
    """

    def __init__(self, robot: Robot, hardware: Hardware, log: Path | None = None) -> None:
        buses = [
            {
                "name": name,
                "port": bus.port,
                "baud_rate": bus.baud_rate,
                "model": bus.model,
                "ids": [robot.dynamixel_ids[joint] for joint in bus.joints],
            }
            for name, bus in hardware.buses.items()
        ]
        self.process = subprocess.Popen(
            [sys.executable, "-m", "wlr_gym.hardware.safety.watchdog"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            start_new_session=True,  # a Ctrl-C at the terminal is for the driving process
        )
        spec = {"buses": buses, "log": None if log is None else str((log / "guard.jsonl").resolve())}
        assert self.process.stdin is not None
        assert self.process.stdout is not None
        with contextlib.suppress(OSError):
            self.process.stdin.write(json.dumps(spec).encode() + b"\n")
            self.process.stdin.flush()
        is_up = select.select([self.process.stdout], [], [], START_TIME)[0]
        if not is_up or self.process.stdout.readline() != b"ready\n":
            self.process.kill()
            self.process.wait()
            raise InputError("the watchdog process does not start; without it nothing is driven")

    def release(self) -> None:
        """Report that torque is off, and let the process end."""
        assert self.process.stdin is not None
        with contextlib.suppress(OSError):
            self.process.stdin.write(b"done\n")
            self.process.stdin.close()
        with contextlib.suppress(subprocess.TimeoutExpired):
            self.process.wait(2.0)


def switch_off(groups: list[BusGroup], seconds: float) -> dict[str, set[int]]:
    """Open the ports and switch off every servo, as long as it takes; return bus -> ids that never confirmed it."""
    end = time.monotonic() + seconds
    left = {group.name: set(group.servos) for group in groups}
    while True:
        for group in groups:
            with contextlib.suppress(InputError, ConnectionError):
                group.open()
                group.write_all("torque_enable", dict.fromkeys(group.servos, 0))
        for group in groups:
            with contextlib.suppress(InputError, ConnectionError):
                left[group.name] = group.torque_off(1)
            group.close()
        if not any(left.values()) or time.monotonic() > end:
            return {name: ids for name, ids in left.items() if ids}
        time.sleep(_PAUSE)


def _wait_for_the_end(parent: int) -> bool:
    """Return whether the driving process is gone without having said ``done``."""
    text = b""
    while os.getppid() == parent:
        if select.select([0], [], [], LOOK_TIME)[0]:
            data = os.read(0, 4096)
            text += data
            if b"done" in text:
                return False
            if not data:
                return True
    return True


def main() -> int:
    """Watch the driving process; 1 = servos were left that did not confirm."""
    parent = os.getppid()
    for name in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(name, signal.SIG_IGN)
    text = b""
    while not text.endswith(b"\n"):  # byte by byte: what follows is for _wait_for_the_end
        data = os.read(0, 1)
        if not data:
            return 0
        text += data
    spec = json.loads(text)
    groups = [
        BusGroup(bus["name"], bus["port"], bus["baud_rate"], dict.fromkeys(bus["ids"], load_table(bus["model"])))
        for bus in spec["buses"]
    ]
    os.write(1, b"ready\n")
    if not _wait_for_the_end(parent):
        return 0
    left = switch_off(groups, TRY_TIME)
    if spec["log"] is not None:
        event = {
            "t": round(time.monotonic(), 6),
            "event": "torque off",
            "unconfirmed": {name: sorted(ids) for name, ids in left.items()},
        }
        with contextlib.suppress(OSError), open(spec["log"], "ab") as file:
            file.write((json.dumps(event) + "\n").encode())
    return 1 if left else 0


if __name__ == "__main__":
    sys.exit(main())
