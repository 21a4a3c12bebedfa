"""What a commissioning test is, and what it hands back."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from wlr_gym.hardware.commissioning.errors import TroubleError
from wlr_gym.hardware.commissioning.person import Person
from wlr_gym.hardware.commissioning.stand import Stand


@dataclass(frozen=True)
class StandQuantity:
    """Something that a test measures.

    Attributes:
        name: goes into the hardware file where its ``measured`` section has a field of this name.
        unit: SI unit; ``-`` is a pure number.
        doc: what it is.
        tolerance: by how much it may differ from what the emulated robot shows, in its unit ...
        relative: ... and beyond that as a part of it.
        remedy: what to do where it differs.
    """

    name: str
    unit: str
    doc: str
    tolerance: float
    remedy: str
    relative: float = 0.0


@dataclass(frozen=True)
class Reading:
    """A measured value.

    Attributes:
        quantity: name of a :class:`StandQuantity` of the test.
        where: joint, bus, or ``imu``.
        value: in the quantity's unit.
    """

    quantity: str
    where: str
    value: float


class PartlyError(TroubleError):
    """A test could not be made at some joints; ``readings`` are of the others."""

    def __init__(self, message: str, readings: Sequence[Reading]) -> None:
        super().__init__(message)
        self.readings: list[Reading] = list(readings)


@dataclass(frozen=True)
class StandTest:
    """A test of a robot on a stand.

    Attributes:
        name: for ``--tests``.
        title: what it shows, in a few words.
        asks: what the person has to do; empty = keep hands off.
        moves: what will move, for the question before the test.
        quantities: what it measures.
        measure: does it; torque may be on when it returns or fails: who calls switches off. Raises
            :class:`PartlyError` with the readings it has where it could not be made at some joints.
    """

    name: str
    title: str
    asks: str
    moves: str
    quantities: tuple[StandQuantity, ...]
    measure: Callable[[Stand, Person], list[Reading]]
