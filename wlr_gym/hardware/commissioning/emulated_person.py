"""The person beside an emulated robot."""

from __future__ import annotations

from wlr_gym.hardware.emulator.stand import EmulatedStand


class EmulatedPerson:
    """Does with an emulated robot what is asked for, and never asks."""

    def __init__(self, stand: EmulatedStand) -> None:
        self._stand = stand
        self._current = 0.0

    def ready(self, test: str) -> None:
        """Agree."""

    def turn(self, joint: str, angle: float) -> None:
        """Turn it."""
        self._stand.machine.turn(joint, angle)

    def straighten(self, leg: str) -> None:
        """Hold it straight."""
        self._stand.machine.straighten(leg)

    def tilt(self, seconds: float, **angles: float) -> None:
        """Tilt the body; it is there in about 2 s."""
        self._stand.tilt(**angles)

    def brake(self, joint: str, trouble: str = "") -> None:
        """Hold it."""
        self._stand.brake(joint)

    def release(self, joint: str) -> None:
        """Let go."""
        self._stand.release(joint)

    def watch_supply(self) -> None:
        """Note the current."""
        self._current = self._stand.wheel_current()

    def supply_current(self) -> float | None:
        """Return what was noted."""
        return self._current
