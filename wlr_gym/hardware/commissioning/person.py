"""The person beside the stand: what tests ask for, one method each."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Protocol

from wlr_gym.hardware.commissioning.errors import QuitError, SkippedError
from wlr_gym.robot import LEGS, full_name


class Person(Protocol):
    """Hands and eyes. Nobody is asked anything while a motor is on, but :meth:`watch_supply` wants eyes only."""

    def ready(self, test: str) -> None:
        """Agree to a test, told in words; raises :class:`SkippedError` or :class:`QuitError`."""
        ...

    def turn(self, joint: str, angle: float) -> None:
        """Turn a joint by ``angle`` (rad) in its positive direction, and keep it there."""
        ...

    def straighten(self, leg: str) -> None:
        """Hold a leg straight down."""
        ...

    def tilt(self, seconds: float, **angles: float) -> None:
        """Begin to turn the body to ``roll``, ``pitch`` or ``yaw`` (rad), be there within ``seconds``; none = level again."""
        ...

    def brake(self, joint: str, trouble: str = "") -> None:
        """Hold a wheel or a leg so that it does not turn, until :meth:`release`; ``trouble``: why it is asked for again."""
        ...

    def release(self, joint: str) -> None:
        """Let go of it."""
        ...

    def watch_supply(self) -> None:
        """Look at the current that the supply shows, now."""
        ...

    def supply_current(self) -> float | None:
        """Return what it showed, A; None = not read."""
        ...


class TerminalPerson:
    """Asks a human.

    Args:
        ask: shows a text, waits for Enter, returns what was typed.
        is_asked_before: every test is asked for before it begins.
    """

    def __init__(self, ask: Callable[[str], str], is_asked_before: bool = True) -> None:
        self._ask = ask
        self._is_asked_before = is_asked_before

    def _answer(self, text: str) -> str:
        answer = self._ask(text).strip().lower()
        if answer in ("q", "quit"):
            raise QuitError
        return answer

    def _enter(self, text: str) -> None:
        """Show a text and wait for Enter; whatever else is typed is no consent."""
        if self._answer(text) not in ("", "y", "yes"):
            raise SkippedError

    def ready(self, test: str) -> None:
        """Say what the test is; Enter starts it, ``q`` ends, anything else, such as ``s``, skips it."""
        if self._is_asked_before:
            self._enter(f"{test} Enter starts, s skips, q ends.")

    def turn(self, joint: str, angle: float) -> None:
        """Ask for a turn by hand."""
        if joint in LEGS:
            way = f"swing its foot to the {'back' if angle > 0 else 'front'}"
        else:
            way = f"roll it {'forward' if angle > 0 else 'backward'}"
        self._enter(f"{full_name(joint)}: {way} by about {abs(math.degrees(angle)):.0f} deg, leave it there, then Enter.")

    def straighten(self, leg: str) -> None:
        """Ask for a leg that hangs straight."""
        self._enter(f"{full_name(leg)}: hold it straight down, wheel's centre under the hip, then Enter.")

    def tilt(self, seconds: float, **angles: float) -> None:
        """Ask for a body that is turned."""
        names = {"roll": "right side down", "pitch": "nose down", "yaw": "nose to the left"}
        ways = [f"{names[name]} by about {math.degrees(angle):.0f} deg" for name, angle in angles.items()]
        way = " and ".join(ways) or "level, as it was before"
        self._enter(f"Robot: press Enter, then turn it {way}, smoothly within {seconds:g} s, and keep it still there.")

    def brake(self, joint: str, trouble: str = "") -> None:
        """Ask for a hand on a wheel, or at a leg's end."""
        where = "the tyre firmly, away from gears and leg; watch the supply"
        if joint in LEGS:
            where = "its end firmly, away from the hip; it will push to the back"
        self._enter(f"{trouble}{full_name(joint)}: hold {where}. Then Enter.")

    def release(self, joint: str) -> None:
        """Say that it may be let go."""
        self._answer(f"{full_name(joint)}: its motor is off, let go, then Enter.")

    def watch_supply(self) -> None:
        """Do nothing: a human looks by himself."""

    def supply_current(self) -> float | None:
        """Ask for a number."""
        while answer := self._answer("The supply's current while it was held, less the one before, A (Enter: not read)?"):
            try:
                return float(answer)
            except ValueError:
                continue
        return None
