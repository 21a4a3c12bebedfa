"""The result of a look at the robot before it moves, and what is raised where it must not."""

from __future__ import annotations

from typing import NamedTuple


class NotReadyError(RuntimeError):
    """The robot is not as it must be before it is driven; the message says what is wrong."""


class Check(NamedTuple):
    """One thing that was looked at.

    Attributes:
        where: joint, bus, or ``robot``.
        what: name of the check.
        ok: as it should be.
        found, expected: in words.
        remedy: what to do about it.
        is_fatal: nothing may move while it is not ok; else a warning.
        fix: item and count to write (torque off) that would mend it; None = by hand.
    """

    where: str
    what: str
    ok: bool
    found: str
    expected: str
    remedy: str
    is_fatal: bool = True
    fix: tuple[str, int] | None = None

    def __str__(self) -> str:
        state = "ok" if self.ok else "FAULT" if self.is_fatal else "warning"
        text = f"{state:8}{self.where:10} {self.what}: {self.found}"
        return text if self.ok else f"{text}, expected {self.expected}. {self.remedy}"
