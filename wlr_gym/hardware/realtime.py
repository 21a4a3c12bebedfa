"""Real-time scheduling (Linux): the program that drives goes before all others, and its memory is not swapped out."""

from __future__ import annotations

import contextlib
import ctypes
import os
import sys
from collections.abc import Iterator

from wlr_gym.base.errors import InputError

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
