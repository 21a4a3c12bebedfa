"""Waiting for events of other processes: as long as it takes on a busy machine, not longer than they can still happen."""

import subprocess
import time
from collections.abc import Callable

#: s after which what should have happened never will: a test that hangs must end. No test is about this time.
LONGEST = 600.0


def wait_until(happened: Callable[[], object], process: subprocess.Popen | None = None) -> None:
    """Wait until ``happened()``; the process that makes it happen, if it is given, must live as long."""
    deadline = time.monotonic() + LONGEST
    while not happened():
        assert process is None or process.poll() is None or happened(), "the process ended before"
        assert time.monotonic() < deadline, "it never happened"
        time.sleep(0.02)
