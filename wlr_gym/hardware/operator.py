"""Keys of the operator, without waiting for any: emergency stop, stop, and the sign that somebody is there."""

from __future__ import annotations

import contextlib
import os
import select
import sys
from types import TracebackType

from wlr_gym.hardware.loop import ControlLoop

EMERGENCY, STOP = " ", "q"
HELP = "space: motors off at once   q: stop   any key: I am here"


class Keys:
    """Reads keys from a terminal, or bytes from a pipe. Use as a context manager.

    Args:
        source: file descriptor; None = the standard input.
    """

    def __init__(self, source: int | None = None) -> None:
        self._source = source
        self._before: list | None = None

    def __enter__(self) -> Keys:
        if self._source is None:
            with contextlib.suppress(AttributeError, OSError, ValueError):
                self._source = sys.stdin.fileno()
        if self._source is not None and os.isatty(self._source):
            import termios
            import tty

            self._before = termios.tcgetattr(self._source)
            tty.setcbreak(self._source)
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None) -> None:
        if self._before is not None and self._source is not None:
            import termios

            termios.tcsetattr(self._source, termios.TCSADRAIN, self._before)

    def pressed(self) -> str:
        """Return the keys pressed since the last call."""
        if self._source is None or not select.select([self._source], [], [], 0.0)[0]:
            return ""
        data = os.read(self._source, 256)
        if not data:
            self._source = None  # end of a pipe
        return data.decode("utf-8", "replace")

    def serve(self, loop: ControlLoop) -> None:
        """Pass the keys on to a loop."""
        keys = self.pressed()
        if keys:
            loop.operator_is_there()
        if EMERGENCY in keys:
            loop.ask_off("emergency stop key")
        elif STOP in keys:
            loop.ask_to_stop("stop key")
