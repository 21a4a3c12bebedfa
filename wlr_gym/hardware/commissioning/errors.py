"""How a commissioning test may end before its end."""

from __future__ import annotations


class TroubleError(RuntimeError):
    """A test cannot go on; the message says why. Torque goes off."""


class TrippedError(TroubleError):
    """The Bus Watchdog stopped a motor that a test drives: what was measured says nothing about the servo."""


class SlippedError(TroubleError):
    """A joint that was to be held gave way."""


class SkippedError(Exception):
    """The person does not want this test."""


class QuitError(Exception):
    """The person does not want to go on."""


class PowerError(Exception):
    """Torque is not confirmed off: nothing more is tried."""
