"""One thing that is wrong or odd about a robot: the number, and what was expected."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

Level = Literal["fault", "warning"]


@dataclass(frozen=True)
class RobotFinding:
    """A finding.

    Attributes:
        level: ``fault``: the robot cannot be simulated, stand, drive or turn; ``warning``: it can, but a number is odd.
        key: of the robot file, with dots.
        value: the number, in SI units; None: it stands in the text.
        unit: of it.
        text: what is odd about it, and what was expected.
    """

    level: Level
    key: str
    value: float | None
    unit: str
    text: str

    def __str__(self) -> str:
        unit = "" if self.unit in ("", "-") else f" {self.unit}"
        return self.text if self.value is None else f"{self.key} = {self.value:.6g}{unit}: {self.text}"


def fault(key: str, value: float | None, unit: str, text: str) -> RobotFinding:
    """Return a finding that stands against using the robot."""
    return RobotFinding("fault", key, value, unit, text)


def warning(key: str, value: float | None, unit: str, text: str) -> RobotFinding:
    """Return a finding that is odd."""
    return RobotFinding("warning", key, value, unit, text)
