"""Commands from the arrow keys or a gamepad, and from a written schedule."""

from __future__ import annotations

import math
import threading
from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import Any

from wlr_gym.base.errors import InputError, unknown_name

# Key codes of GLFW, which the viewer reports.
UP = 265
DOWN = 264
LEFT = 263
RIGHT = 262
SPACE = 32
RESET = 82  # R
#: A tap changes a command by this share of its range on the named side, of the other where it has none there.
TAP = 0.1
#: What the arrow keys and sticks steer: command -> (more, less).
KEYS = {"linear_velocity_x": (UP, DOWN), "yaw_rate": (LEFT, RIGHT)}
HELP = "arrows: speed and turning; space: stop; R: start anew; close the window to end"
#: Sticks of a gamepad: command -> (axis, sign); a stick within the dead zone is at rest.
AXES = {"linear_velocity_x": (1, -1.0), "yaw_rate": (0, -1.0)}
DEAD_ZONE = 0.12

Ranges = Mapping[str, tuple[float, float]]


class Script:
    """A written schedule: ``0.1,0`` for good, or ``0:0.1,0; 3:0.05,0.3`` from the named times (s) on.

    Args:
        text: values in the order of ``names``, the commands of the task.

    Raises:
        InputError: not a schedule, or times that do not rise from 0.
    """

    def __init__(self, text: str, names: Sequence[str]) -> None:
        parts = [part for part in text.split(";") if part.strip()]
        if not parts:
            raise InputError(_expected(text, names))
        self._steps = [_step(part, text, names) for part in parts]
        times = [time for time, _ in self._steps]
        if times[0] != 0.0 or any(later <= earlier for earlier, later in pairwise(times)):
            raise InputError(f"--command '{text}': times {times} s: expected rising times from 0")

    def command(self, time: float) -> Mapping[str, float]:
        """Return the commands of the last step that has begun."""
        return [values for start, values in self._steps if start <= time + 1e-9][-1]

    def outside(self, ranges: Ranges) -> dict[str, float]:
        """Return the first value of each command that is outside its range."""
        found: dict[str, float] = {}
        for name, value in [item for _, values in self._steps for item in values.items()]:
            if not ranges[name][0] <= value <= ranges[name][1]:
                found.setdefault(name, value)
        return found

    def wants_reset(self) -> bool:
        """Return False: a schedule plays through."""
        return False


def _step(part: str, text: str, names: Sequence[str]) -> tuple[float, dict[str, float]]:
    before, colon, after = part.rpartition(":")
    try:
        time, values = (float(before) if colon else 0.0), [float(value) for value in after.split(",")]
    except ValueError:
        raise InputError(_expected(text, names)) from None
    if len(values) != len(names) or not all(map(math.isfinite, [time, *values])):
        raise InputError(_expected(text, names))
    return time, dict(zip(names, values, strict=True))


def _expected(text: str, names: Sequence[str]) -> str:
    form = ",".join(names)
    return f"--command '{text}': expected {form} (such as 0.1,0), or TIME:{form}; TIME:... (such as 0:0.1,0; 3:0.05,0.3)"


class Keyboard:
    """Commands by key; :meth:`press` may be called from the window's thread."""

    def __init__(self, ranges: Ranges) -> None:
        self._ranges = steered(ranges, KEYS, "the arrow keys")
        self._lock = threading.Lock()
        self._values = dict.fromkeys(self._ranges, 0.0)
        self._reset = False

    def press(self, key: int) -> None:
        """Take one key."""
        with self._lock:
            if key in (SPACE, RESET):
                self._values = dict.fromkeys(self._ranges, 0.0)
                self._reset = self._reset or key == RESET
            for name, (low, high) in self._ranges.items():
                more, less = KEYS[name]
                change = TAP * ((key == more) * (high or -low) + (key == less) * (low or -high))
                self._values[name] = round(min(max(self._values[name] + change, low), high), 9)

    def command(self, time: float) -> Mapping[str, float]:
        """Return the present commands."""
        with self._lock:
            return dict(self._values)

    def wants_reset(self) -> bool:
        """Return whether R was pressed since the last call."""
        with self._lock:
            asked, self._reset = self._reset, False
            return asked


class Gamepad:
    """Commands from the left stick of the first gamepad; its first button stops, its second starts anew.

    Args:
        ranges: name -> (low, high). joystick: GLFW's joystick functions (tests pass their own).

    Raises:
        InputError: no gamepad is plugged in.
    """

    def __init__(self, ranges: Ranges, joystick: Any = None) -> None:
        self._ranges = steered(ranges, AXES, "a gamepad")
        self._joystick = joystick or _glfw()
        if not self._joystick.joystick_present(0):
            raise InputError("no gamepad found: plug one in, or leave --gamepad out and use the keyboard")
        self._pressed = False

    def command(self, time: float) -> Mapping[str, float]:
        """Return the commands of the stick's position: full deflection is the end of the range."""
        buttons = self._buttons()
        if buttons and buttons[0]:
            return dict.fromkeys(self._ranges, 0.0)
        pointer, count = self._joystick.get_joystick_axes(0)
        return stick_commands(self._ranges, [float(pointer[index]) for index in range(count)])

    def wants_reset(self) -> bool:
        """Return whether the second button went down since the last call."""
        buttons = self._buttons()
        before, self._pressed = self._pressed, bool(len(buttons) > 1 and buttons[1])
        return self._pressed and not before

    def _buttons(self) -> Sequence[int]:
        pointer, count = self._joystick.get_joystick_buttons(0)
        return [int(pointer[index]) for index in range(count)]


def stick_commands(ranges: Ranges, sticks: Sequence[float]) -> dict[str, float]:
    """Return the commands of a gamepad's sticks: position of each axis, -1 to 1; up and left are negative.

    ``ranges`` are those of :func:`steered` commands.
    """
    values = {}
    for name, (low, high) in ranges.items():
        axis, sign = AXES[name]
        share = sign * sticks[axis] if axis < len(sticks) else 0.0
        share = math.copysign(max(0.0, abs(share) - DEAD_ZONE) / (1.0 - DEAD_ZONE), share)
        values[name] = min(max(share * high if share >= 0 else -share * low, low), high)
    return values


def _glfw() -> Any:
    import warnings

    import glfw

    with warnings.catch_warnings(action="ignore", category=glfw.GLFWError):  # said below
        has_started = glfw.init()
    if not has_started:
        raise InputError("GLFW does not start, so there is no gamepad: use the keyboard, or a display")
    return glfw


def steered(ranges: Ranges, known: Mapping[str, object], what: str) -> dict[str, tuple[float, float]]:
    """Return the ranges that can be steered, each as far as standing still: who drives must be able to stop.

    Raises:
        InputError: none can; names ``what`` steers.
    """
    steered = {name: (min(low, 0.0), max(high, 0.0)) for name, (low, high) in ranges.items() if name in known}
    if not steered:
        raise unknown_name("command", ", ".join(ranges), known, f"{what} steer others")
    return steered
