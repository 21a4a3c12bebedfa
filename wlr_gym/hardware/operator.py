"""The operator: what keys, signals and a gamepad ask for, read without waiting for any."""

from __future__ import annotations

import contextlib
import errno
import math
import os
import select
import signal
import struct
import sys
import threading
from collections.abc import Callable, Iterator

from wlr_gym.base.errors import InputError
from wlr_gym.hardware.config import PadButtons
from wlr_gym.hardware.timing import Clock
from wlr_gym.render.teleop import AXES, Ranges, steered, stick_commands

EMERGENCY_KEY = " "
STOP_KEY = "q"
#: Why a run ended by a key: torque off at once, or in good order.
STOP_KEYS = ("emergency stop key", "stop key")
KEYS_SAID = "space: motors off at once   q: stop"
HELP = f"{KEYS_SAID}   any key: I am here"
#: Signals that stop the robot, where the system has them.
STOP_SIGNALS = ("SIGINT", "SIGTERM", "SIGHUP", "SIGQUIT", "SIGTSTP")


#: An event of a gamepad (linux/joystick.h): ms, value, kind, number of the button or axis.
_EVENT = struct.Struct("<IhBB")
_BUTTON = 1
_AXIS = 2
#: Bit of the kind: how things stood when the device was opened.
_AT_START = 0x80
#: Value of an axis at its end.
_END = 32767


class Operator:
    """Requests of the operator, until the control loop has met them.

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
    """Reads keys from a terminal, or bytes from a pipe (a file descriptor; None = standard input). Use as a context manager."""

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
    before = {number: signal.signal(number, take) for name in STOP_SIGNALS if (number := getattr(signal, name, None))}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
    if heard and operator.asked and not interrupted:
        raise KeyboardInterrupt(operator.asked)


@contextlib.contextmanager
def stop_on_request(operator: Operator) -> Iterator[None]:
    """Let signals stop the robot, and a terminal's keys, which are read in the time that is left in each control step."""
    with stop_on_signals(operator), Keys() as keys:
        if keys.is_terminal:
            operator.spare = lambda: keys.serve(operator)
        yield


class DrivingPad:
    """Steers while its dead-man button is held: full deflection is the end of a command's range. Use as a context manager.

    Args:
        device: such as ``/dev/input/js0``. buttons: their numbers. ranges: command -> (low, high).

    Attributes:
        is_held: the dead-man button is down.

    Raises:
        InputError: the sticks steer none of the commands.
    """

    def __init__(self, device: str, buttons: PadButtons, ranges: Ranges) -> None:
        self.is_held = False
        self._device, self._buttons = device, buttons
        self._ranges = steered(ranges, AXES, "a gamepad")
        self._sticks = [0.0] * (1 + max(axis for axis, _ in AXES.values()))
        self._pressed: set[int] = set()
        self._rest = b""
        self._file = -1

    def __enter__(self) -> DrivingPad:
        try:
            self._file = os.open(self._device, os.O_RDONLY | os.O_NONBLOCK)
        except OSError as error:
            raise InputError(
                f"gamepad {self._device}: cannot be opened: {error.strerror}; ls /dev/input/js* names those here"
            ) from None
        return self

    def __exit__(self, *error: object) -> None:
        os.close(self._file)

    def command(self) -> dict[str, float]:
        """Return the commands of the sticks; all 0 while the dead-man button is not held."""
        return stick_commands(self._ranges, self._sticks if self.is_held else ())

    def serve(self, operator: Operator) -> None:
        """Take what has happened, and pass it on: signs of the operator, requests."""
        self._take_events()
        if self.is_held:
            operator.note_sign()
        pressed, self._pressed = self._pressed, set()
        if self._buttons.motors_off in pressed:
            operator.ask_off("gamepad: motors-off button")
        elif self._buttons.stop in pressed:
            operator.ask_to_stop("gamepad: stop button")

    def _take_events(self) -> None:
        try:
            while data := os.read(self._file, 64 * _EVENT.size):
                self._rest += data
            raise OSError(errno.ENODEV, f"gamepad {self._device} is gone")
        except BlockingIOError:
            pass
        except OSError:
            self.is_held = False
            raise
        whole = len(self._rest) // _EVENT.size * _EVENT.size
        for _, value, kind, number in _EVENT.iter_unpack(self._rest[:whole]):
            kind &= ~_AT_START
            if kind == _AXIS and number < len(self._sticks):
                self._sticks[number] = max(-1.0, value / _END)
            elif kind == _BUTTON and number == self._buttons.deadman:
                self.is_held = bool(value)
            elif kind == _BUTTON and value:
                self._pressed.add(number)
        self._rest = self._rest[whole:]
