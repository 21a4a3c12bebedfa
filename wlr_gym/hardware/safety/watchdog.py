"""A second process that switches the motors off when the one that drives the robot dies or hangs (``kill -9``, SIGSTOP).

``python -m wlr_gym.hardware.safety.watchdog`` reads one line of JSON (buses and ids), answers ``ready`` and waits. Then each
line is a sign of life: the seconds within which the next one comes. The control step gives it, never a thread of its own: a
process whose control loop hangs gives none. ``done`` ends it. When the other process is gone instead, it opens the ports and
switches torque off until every servo has confirmed; one that hangs it kills first, for the ports are held exclusively. Until it
is that far, the servos' Bus Watchdog has stopped the motion.
"""

from __future__ import annotations

import contextlib
import json
import math
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
#: s that a killed process may take to be gone.
KILL_TIME = 5.0
#: s between looks at whether its parent lives.
LOOK_TIME = 0.05
#: s an answer may take: nothing else waits, and an adapter that answers late is no servo that refuses.
PATIENCE = 0.05
#: s between tries to switch off.
_PAUSE = 0.05


class Guard:
    """The watchdog process, seen from the driving one: from its start until torque is off.

    Args:
        robot, hardware: ids and ports.
        is_wanted: False = there is none, and nothing here does anything.

    Attributes:
        process: None = it does not run.
        trouble: why it takes no signs of life; empty = it does, or there is none.
    """

    def __init__(self, robot: Robot, hardware: Hardware, is_wanted: bool = True) -> None:
        self.process: subprocess.Popen[bytes] | None = None
        self.trouble = ""
        self._robot, self._hardware, self._is_wanted = robot, hardware, is_wanted

    def start(self, log: Path | None = None) -> None:
        """Start the process, if it does not run; it notes what it did in ``guard.jsonl`` in the folder ``log``.

        Raises:
            InputError: the process does not start.
        """
        if not self._is_wanted or self.process is not None:
            return
        ids = self._robot.dynamixel_ids
        buses = [
            [name, bus.port, bus.baud_rate, bus.model, [ids[joint] for joint in bus.joints]]
            for name, bus in self._hardware.buses.items()
        ]
        spec = {"buses": buses, "log": None if log is None else str((log / "guard.jsonl").resolve())}
        command, pipe = [sys.executable, "-m", "wlr_gym.hardware.safety.watchdog"], subprocess.PIPE
        # in a session of its own: a Ctrl-C at the terminal is for the driving process
        process = subprocess.Popen(command, stdin=pipe, stdout=pipe, bufsize=0, start_new_session=True)
        assert process.stdin is not None
        assert process.stdout is not None
        with contextlib.suppress(OSError):
            process.stdin.write(json.dumps(spec).encode() + b"\n")
        is_up = select.select([process.stdout], [], [], START_TIME)[0]
        if not is_up or process.stdout.readline() != b"ready\n":
            process.kill()
            process.wait()
            raise InputError("the watchdog process does not start; without it nothing is driven")
        os.set_blocking(process.stdin.fileno(), False)  # a control step waits for nobody
        self.process = process

    def expect(self, seconds: float) -> None:
        """Give a sign of life: the next one comes within ``seconds``, or this process hangs; inf = there may be none."""
        if self.process is None:
            return
        assert self.process.stdin is not None
        try:
            os.write(self.process.stdin.fileno(), f"{seconds:g}\n".encode())
        except OSError as error:
            self.trouble = f"the watchdog process is gone: {error}"

    def release(self) -> None:
        """Report that torque is off, and let the process end."""
        if self.process is None:
            return
        assert self.process.stdin is not None
        with contextlib.suppress(OSError):
            self.process.stdin.write(b"done\n")
            self.process.stdin.close()
        with contextlib.suppress(subprocess.TimeoutExpired):
            self.process.wait(2.0)
        self.process, self.trouble = None, ""


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
                left[group.name] = group.torque_off(1, left[group.name])
            group.close()
        if not any(left.values()) or time.monotonic() > end:
            return {name: ids for name, ids in left.items() if ids}
        time.sleep(_PAUSE)


def _wait_for_the_end(parent: int) -> str:
    """Return why motors must be switched off, once they must: ``gone`` or ``hangs``; empty = it said ``done``."""
    rest, end = b"", math.inf
    while os.getppid() == parent:
        if select.select([0], [], [], LOOK_TIME)[0]:
            data = os.read(0, 4096)
            *lines, rest = (rest + data).split(b"\n")
            if b"done" in lines:
                return ""
            if not data:
                return "gone"
            if lines:
                end = time.monotonic() + float(lines[-1])
        elif time.monotonic() > end:
            return "hangs"
    return "gone"


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
        BusGroup(name, port, baud_rate, dict.fromkeys(ids, load_table(model)), PATIENCE)
        for name, port, baud_rate, model, ids in spec["buses"]
    ]
    os.write(1, b"ready\n")
    why = _wait_for_the_end(parent)
    if not why:
        return 0
    if why == "hangs":
        with contextlib.suppress(ProcessLookupError):
            os.kill(parent, signal.SIGKILL)
        end = time.monotonic() + KILL_TIME
        while os.getppid() == parent and time.monotonic() < end:  # until then its ports are not free
            time.sleep(0.001)
    left = switch_off(groups, TRY_TIME)
    if spec["log"] is not None:
        unconfirmed = {name: sorted(ids) for name, ids in left.items()}
        event = {"t": round(time.monotonic(), 6), "event": "torque off", "driver": why, "unconfirmed": unconfirmed}
        with contextlib.suppress(OSError), open(spec["log"], "ab") as file:
            file.write((json.dumps(event) + "\n").encode())
    return 1 if left else 0


if __name__ == "__main__":
    sys.exit(main())
