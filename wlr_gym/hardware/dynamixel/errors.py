"""What can go wrong on a bus."""

from __future__ import annotations


class BusGoneError(ConnectionError):
    """The port does not work any more: unplugged adapter, dead driver."""


class NoAnswerError(TimeoutError):
    """A servo did not answer."""


class RestlessLineError(NoAnswerError):
    """A servo did not answer, or was not heard: the line never falls quiet."""


class RefusedError(RuntimeError):
    """A servo refused an instruction."""
