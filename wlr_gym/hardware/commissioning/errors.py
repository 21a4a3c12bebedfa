"""How a commissioning test may end before its end."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from wlr_gym.hardware.commissioning.contract import Reading


class TroubleError(RuntimeError):
    """A test cannot go on; the message says why. Torque goes off."""


class TrippedError(TroubleError):
    """The Bus Watchdog stopped a motor that a test drives: what was measured says nothing about the servo."""


class SlippedError(TroubleError):
    """A joint that was to be held gave way."""


class PartlyError(TroubleError):
    """A test could not be made at some joints; ``readings`` are of the others."""

    def __init__(self, message: str, readings: Sequence[Reading]) -> None:
        super().__init__(message)
        self.readings = list(readings)


class SkippedError(Exception):
    """The person does not want this test."""


class QuitError(Exception):
    """The person does not want to go on."""


class PowerError(Exception):
    """Torque is not confirmed off: nothing more is tried."""
