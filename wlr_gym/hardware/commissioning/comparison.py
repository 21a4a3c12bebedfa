"""Compare what a robot showed with what the emulated one of the same hardware file shows; keep it in the hardware file."""

from __future__ import annotations

import datetime
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from wlr_gym.hardware.commissioning.contract import Reading, StandQuantity, StandTest
from wlr_gym.hardware.config import Hardware
from wlr_gym.hardware.measured import Measured, MeasuredValue


@dataclass(frozen=True)
class StandFinding:
    """A measured value beside the expected one.

    Attributes:
        test: name of the test.
        quantity: what was measured.
        where: joint, bus, or ``imu``.
        measured, expected: in the quantity's unit.
    """

    test: str
    quantity: StandQuantity
    where: str
    measured: float
    expected: float

    @property
    def room(self) -> float:
        """By how much the value may differ."""
        return self.quantity.tolerance + self.quantity.relative * abs(self.expected)

    @property
    def is_expected(self) -> bool:
        """Whether it differs by no more; a value that is no number differs."""
        return abs(self.measured - self.expected) <= self.room

    @property
    def verdict(self) -> str:
        """In words."""
        return "as expected" if self.is_expected else "differs"


def compare(test: StandTest, measured: Sequence[Reading], expected: Sequence[Reading]) -> list[StandFinding]:
    """Return what was measured beside what the emulated robot showed, in the order it was measured."""
    quantities = {quantity.name: quantity for quantity in test.quantities}
    known = {(reading.quantity, reading.where): reading.value for reading in expected}
    return [
        StandFinding(test.name, quantities[one.quantity], one.where, one.value, known[one.quantity, one.where])
        for one in measured
    ]


def with_measurements(hardware: Hardware, findings: Iterable[StandFinding], earlier: Measured | None = None) -> Hardware:
    """Return the hardware with what was measured; values that were not stay, its own or ``earlier`` ones: the later of two."""
    kept = {name: dict(getattr(hardware.measured, name)) for name in Measured.model_fields}
    for name, values in kept.items():
        for where, value in getattr(earlier or Measured(), name).items():
            if where not in values or value.date >= values[where].date:
                values[where] = value
    today = datetime.datetime.now().astimezone().date().isoformat()
    for one in findings:
        if one.quantity.name in kept:
            value = float(f"{one.measured:.4g}")
            kept[one.quantity.name][one.where] = MeasuredValue(value=value, unit=one.quantity.unit, date=today)
    return hardware.model_copy(update={"measured": Measured(**{name: values for name, values in kept.items() if values})})
