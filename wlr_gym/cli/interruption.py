"""Ctrl-C ends a command at any moment, also while it starts."""

from __future__ import annotations

import _thread
import contextlib
import signal
import sys
import threading
import time
from collections.abc import Iterator
from types import FrameType
from typing import Any

#: s after which an interruption that could not end the command comes again.
_AGAIN = 0.05
#: s for which an import may hold one up.
_PATIENCE = 10.0


@contextlib.contextmanager
def interruptible() -> Iterator[None]:
    """Raise KeyboardInterrupt for Ctrl-C in here, but after an import: some packages catch it there, and callbacks lose it."""
    is_main = threading.current_thread() is threading.main_thread()
    if not is_main or signal.getsignal(signal.SIGINT) is not signal.default_int_handler:
        yield
        return
    waiting: list[threading.Timer] = []
    before, since = sys.unraisablehook, 0.0

    def come_again() -> None:
        waiting[:] = [threading.Timer(_AGAIN, _interrupt_main)]
        waiting[0].daemon = True
        waiting[0].start()

    def interrupt(_: int, frame: FrameType | None) -> None:
        nonlocal since
        since = since or time.monotonic()
        if not _imports(frame) or time.monotonic() > since + _PATIENCE:
            raise KeyboardInterrupt
        come_again()

    def note(lost: Any) -> None:
        if lost.exc_type is KeyboardInterrupt:  # in a callback, where Python can only complain
            come_again()
        else:
            before(lost)

    sys.unraisablehook = note
    signal.signal(signal.SIGINT, interrupt)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, signal.default_int_handler)
        sys.unraisablehook = before
        for timer in waiting:
            timer.cancel()


def _interrupt_main() -> None:
    """Interrupt the main thread, also where it waits in a system call."""
    if hasattr(signal, "pthread_kill") and (main := threading.main_thread().ident) is not None:
        signal.pthread_kill(main, signal.SIGINT)
    else:
        _thread.interrupt_main()


def _imports(frame: FrameType | None) -> bool:
    """Whether a module is being imported in this command."""
    while frame is not None and frame.f_globals.get("__name__") != "wlr_gym.cli":
        if frame.f_globals.get("__name__") == "importlib._bootstrap":
            return True
        frame = frame.f_back
    return False
