"""Clocks; control steps against absolute deadlines, and statistics of what they took; real-time scheduling."""

from __future__ import annotations

import contextlib
import ctypes
import math
import os
import sys
import time
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Protocol

import numpy as np

from wlr_gym.base.errors import InputError

#: Parts of a control step that are timed; latency is from the readings to the setpoints that answer them.
PARTS = ("read", "think", "write", "slack", "latency")


class Clock(Protocol):
    """Time as the robot sees it."""

    def now(self) -> float:
        """Return s since any start; never goes back."""
        ...

    def wait_until(self, moment: float) -> None:
        """Return at ``moment`` (s), or at once when it is later."""
        ...


class MonotonicClock:
    """This computer's monotonic clock."""

    def now(self) -> float:
        """Return s."""
        return time.monotonic()

    def wait_until(self, moment: float) -> None:
        """Sleep until then."""
        if (left := moment - time.monotonic()) > 0.0:
            time.sleep(left)


def time_asleep() -> float:
    """Return for how many s this computer has been suspended since it booted; 0 where the system does not tell (not Linux)."""
    boot = getattr(time, "CLOCK_BOOTTIME", None)  # goes on while CLOCK_MONOTONIC stands
    return 0.0 if boot is None else time.clock_gettime(boot) - time.monotonic()


def percentiles(milliseconds: np.ndarray) -> dict[str, float]:
    """Return what 50, 95, 99 and 100 % of the times (ms, one or more) do not exceed: ``p50``, ``p95``, ``p99`` and ``max``."""
    points = np.percentile(milliseconds, (50, 95, 99, 100)).round(3).tolist()
    return dict(zip(("p50", "p95", "p99", "max"), points, strict=True))


class Pacer:
    """Starts control steps at ``origin + k * period``: lateness never adds up, and steps that were missed are left out.

    Args:
        clock: of the run.
        period: s.

    Attributes:
        missed: ticks left out because the ones before took too long.
        late_ticks: ticks in a row, up to now, with some left out before them.
    """

    def __init__(self, clock: Clock, period: float) -> None:
        self.clock, self.period = clock, period
        self.missed = 0
        self.late_ticks = 0
        self._deadline = clock.now()
        self._recent: deque[int] = deque(maxlen=max(1, round(1.0 / period)))
        self._times: dict[str, list[float]] = {name: [] for name in ("jitter", "period", *PARTS)}
        self._woke = math.nan

    @property
    def late_share(self) -> float:
        """Share of the last second's ticks that were left out; 0 in the first second.

        The longest gap does not count: one hiccup is no computer that does not keep up, and the servos' watchdog judges it.
        """
        recent = self._recent
        left_out = sum(recent) - max(recent, default=0)
        return left_out / (len(recent) + left_out) if len(recent) == recent.maxlen else 0.0

    def start(self) -> None:
        """Count from now; statistics go on."""
        self._deadline = self._woke = self.clock.now()
        self._recent.clear()
        self.late_ticks = 0

    def wait(self) -> None:
        """Return at the next deadline; at once when it has passed, and with the ticks in between left out."""
        self._deadline += self.period
        slack = self._deadline - self.clock.now()
        left_out = math.floor(-slack / self.period + 1e-9) if slack < 0.0 else 0
        self._deadline += left_out * self.period
        self.clock.wait_until(self._deadline)
        now = self.clock.now()
        self._times["slack"].append(slack)
        self._times["jitter"].append(now - self._deadline)
        self._times["period"].append(now - self._woke)
        self._woke = now
        self.missed += left_out
        self._recent.append(left_out)
        self.late_ticks = self.late_ticks + 1 if left_out else 0

    @contextmanager
    def timed(self, part: str) -> Iterator[None]:
        """Time a part of a tick."""
        start = self.clock.now()
        try:
            yield
        finally:
            self.note(part, self.clock.now() - start)

    def note(self, part: str, seconds: float) -> None:
        """Take the time of a part of a tick (s)."""
        self._times[part].append(seconds)

    def statistics(self) -> dict[str, float | dict[str, float]]:
        """Return ticks, missed ones, and percentiles (ms) of period, jitter (start after the deadline) and parts of a tick."""
        times = {name: np.array(values) * 1e3 for name, values in self._times.items()}
        found: dict[str, float | dict[str, float]] = {"ticks": len(times["jitter"]), "missed": self.missed}
        return found | {name: percentiles(values) for name, values in times.items() if len(values)}


# ---- real-time scheduling (Linux) ----


#: Arguments of mlockall (sys/mman.h): what is mapped now, and what will be.
_CURRENT, _FUTURE = 1, 2


@contextlib.contextmanager
def real_time(priority: int) -> Iterator[None]:
    """Run under SCHED_FIFO with all memory locked; threads and programs started meanwhile run as usual.

    Args:
        priority: 1 to 99; that of an interrupt's thread is 50.

    Raises:
        InputError: not on this system, a priority that there is not, or the system refuses it; says how to be granted it.
    """
    require_priority("real-time priority", priority)
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO | os.SCHED_RESET_ON_FORK, os.sched_param(priority))
    except PermissionError as error:
        raise _refused(f"SCHED_FIFO, priority {priority}", error, priority) from None
    try:
        if ctypes.CDLL(None, use_errno=True).mlockall(_CURRENT | _FUTURE) != 0:
            number = ctypes.get_errno()
            raise _refused("mlockall", OSError(number, os.strerror(number)), priority)
        yield
    finally:
        ctypes.CDLL(None).munlockall()
        os.sched_setscheduler(0, os.SCHED_OTHER | os.SCHED_RESET_ON_FORK, os.sched_param(0))


def require_priority(name: str, priority: int) -> None:
    """Raise :class:`InputError` where this system has no such priority; the message begins with ``name``."""
    if sys.platform != "linux":
        raise InputError("real-time scheduling: on Linux only")
    lowest, highest = os.sched_get_priority_min(os.SCHED_FIFO), os.sched_get_priority_max(os.SCHED_FIFO)
    if not lowest <= priority <= highest:
        raise InputError(f"{name} {priority}: expected {lowest} to {highest}")


def _refused(what: str, error: OSError, priority: int) -> InputError:
    grant = (
        f"printf '%s - rtprio {priority}\\n%s - memlock unlimited\\n' $USER $USER | sudo tee /etc/security/limits.d/wlr.conf"
    )
    return InputError(f"{what} is refused ({error.strerror}); to be granted it, once, then log in anew: {grant}")
