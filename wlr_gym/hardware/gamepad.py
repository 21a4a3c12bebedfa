"""A gamepad that steers the robot: Linux's joystick interface (``/dev/input/js0``), read without waiting for it."""

from __future__ import annotations

import errno
import os
import struct

from wlr_gym.base.errors import InputError
from wlr_gym.hardware.config import PadButtons
from wlr_gym.hardware.operator import Operator
from wlr_gym.render.teleop import AXES, Ranges, steered, stick_commands

#: An event (linux/joystick.h): ms, value, kind, number of the button or axis.
_EVENT = struct.Struct("<IhBB")
_BUTTON = 1
_AXIS = 2
#: Bit of the kind: how things stood when the device was opened.
_AT_START = 0x80
#: Value of an axis at its end.
_END = 32767


class DrivingPad:
    """Steers while its dead-man button is held: full deflection is the end of a command's range. Use as a context manager.

    Args:
        device: such as ``/dev/input/js0``.
        buttons: their numbers.
        ranges: command -> (low, high).

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
        """Take what has happened, and pass it on: signs of the operator, requests.

        Raises:
            OSError: the gamepad is gone.
        """
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
            self._rest += self._read()
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

    def _read(self) -> bytes:
        """Return what has come in since the last look."""
        found = b""
        try:
            while data := os.read(self._file, 64 * _EVENT.size):
                found += data
        except BlockingIOError:
            return found
        raise OSError(errno.ENODEV, f"gamepad {self._device} is gone")
