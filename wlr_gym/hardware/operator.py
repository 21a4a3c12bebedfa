"""The operator: what keys and signals ask for, read without waiting for any."""

from __future__ import annotations

import contextlib
import math
import os
import select
import signal
import sys
import threading
from collections.abc import Callable, Iterator

from wlr_gym.hardware.timing import Clock

EMERGENCY_KEY = " "
STOP_KEY = "q"
#: Why a run ended by a key: torque off at once, or in good order.
STOP_KEYS = ("emergency stop key", "stop key")
KEYS_SAID = "space: motors off at once   q: stop"
HELP = f"{KEYS_SAID}   any key: I am here"
#: Signals that stop the robot, where the system has them.
STOP_SIGNALS = ("SIGINT", "SIGTERM", "SIGHUP", "SIGQUIT", "SIGTSTP")


class Operator:
    """Requests of the operator, until the control loop has met them.

    Args:
        clock: of the run.

    Attributes:
        asked_to_stop, asked_off: why a stop was asked for, and why torque is to go off at once; empty = not asked.
        spare: called before torque comes on, and in every control step between writing and waiting, while there is time (keys,
            display).
        trouble: why ``spare`` failed; empty = it did not.
        is_switching_off: torque is being switched off, which nothing may interrupt.
    """

    def __init__(self, clock: Clock) -> None:
        self.asked_to_stop = self.asked_off = ""
        self.spare: Callable[[], object] | None = None
        self.trouble = ""
        self.is_switching_off = False
        self._clock = clock
        self._seen_at = -math.inf

    @property
    def asked(self) -> str:
        """What was asked for and has not happened yet: a key, a signal; empty = nothing."""
        return self.asked_off or self.asked_to_stop

    @property
    def silence(self) -> float:
        """Time since the last sign of the operator, s."""
        return self._clock.now() - self._seen_at

    def ask_to_stop(self, reason: str) -> None:
        """Stop at the next control step, in good order."""
        self.asked_to_stop = self.asked_to_stop or reason

    def ask_off(self, reason: str) -> None:
        """Switch torque off at the next control step (emergency stop)."""
        self.asked_off = self.asked_off or reason

    def note_sign(self) -> None:
        """Take a sign of the operator (deadman)."""
        self._seen_at = self._clock.now()

    def take(self) -> str:
        """Return what was asked for, and forget it: it has happened."""
        if asked := self.asked:  # a signal that comes between these lines, where nothing was asked, must not get lost
            self.asked_to_stop = self.asked_off = ""
        return asked

    def serve(self) -> None:
        """Call ``spare``; a terminal or gamepad that is gone is noted, and not called again."""
        if self.spare is None:
            return
        try:
            self.spare()
        except OSError as error:
            self.spare = None
            self.trouble = f"the operator's terminal or gamepad is gone: {error}"


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

    def __exit__(self, *error: object) -> None:
        if self._before is not None and self._source is not None:
            import termios

            termios.tcsetattr(self._source, termios.TCSADRAIN, self._before)

    @property
    def is_terminal(self) -> bool:
        """Whether a person may be typing them."""
        return self._before is not None

    def pressed(self) -> str:
        """Return the keys pressed since the last call."""
        if self._source is None or not select.select([self._source], [], [], 0.0)[0]:
            return ""
        data = os.read(self._source, 256)
        if not data:
            self._source = None  # end of a pipe
        return data.decode("utf-8", "replace")

    def serve(self, operator: Operator) -> None:
        """Pass the keys on as requests."""
        keys = self.pressed()
        if keys:
            operator.note_sign()
        if EMERGENCY_KEY in keys:
            operator.ask_off(STOP_KEYS[0])
        elif STOP_KEY in keys:
            operator.ask_to_stop(STOP_KEYS[1])


@contextlib.contextmanager
def stop_on_signals(operator: Operator) -> Iterator[None]:
    """Let signals stop the robot in good order at the next control step; the second one interrupts at once.

    Nothing interrupts switching torque off. Ctrl-Z (SIGTSTP) and Ctrl-\\ (SIGQUIT) are stops like Ctrl-C: a program that sleeps
    would leave torque on.

    Raises:
        KeyboardInterrupt: for the second signal, and at the end for one that came when the loop did not look any more.
    """
    heard = interrupted = False

    def take(number: int, _: object) -> None:
        nonlocal heard, interrupted
        name = signal.Signals(number).name
        if (heard or operator.asked) and not operator.is_switching_off:
            interrupted = True
            raise KeyboardInterrupt(name)
        heard = True
        operator.ask_to_stop(name)

    if threading.current_thread() is not threading.main_thread():
        yield
        return
    numbers = [getattr(signal, name) for name in STOP_SIGNALS if hasattr(signal, name)]
    before = {number: signal.signal(number, take) for number in numbers}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
    if heard and operator.asked and not interrupted:
        raise KeyboardInterrupt(operator.asked)


@contextlib.contextmanager
def stop_on_request(operator: Operator) -> Iterator[None]:
    """Let signals stop the robot, and a terminal's keys, which are read in the time that is left in each control step.

    Raises:
        KeyboardInterrupt: as of :func:`stop_on_signals`.
    """
    with stop_on_signals(operator), Keys() as keys:
        if keys.is_terminal:
            operator.spare = lambda: keys.serve(operator)
        yield
