"""Plausible departures from the nominal robot that could make it slip as the paper reports, and what its numbers may mean.

Each :class:`SlipCandidate` is named effects, each number of them drawn from a range. How the paper's numbers are meant is open
in two ways, so every result is given for each :class:`PaperReading`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wlr_gym.physics.effects import EFFECTS, apply_patch, load_patch
from wlr_gym.robot import LEGS, Robot
from wlr_gym.robot.parameters import Parameters

Array = NDArray[np.float64]


@dataclass(frozen=True)
class PaperReading:
    """What the paper may mean by its errors.

    Attributes:
        name, doc: key, sentence.
        encoder_on_leg: the no-slip prediction counts the wheel angle relative to the leg, as the servo reads it (True), or
            takes it for the absolute angle, as (3) is printed (False).
        sign: +1 the robot falls short of the prediction in both tests, 0 the error is unsigned.
    """

    name: str
    doc: str
    encoder_on_leg: bool
    sign: int


READINGS = (
    PaperReading("short, encoder", "falls short of a prediction that knows the wheel angle is relative to the leg", True, 1),
    PaperReading("short, printed", "falls short of the prediction of (3) as printed", False, 1),
    PaperReading(
        "unsigned, encoder", "differs either way from a prediction that knows the wheel angle is relative to the leg", True, 0
    ),
    PaperReading("unsigned, printed", "differs either way from the prediction of (3) as printed", False, 0),
)


@dataclass(frozen=True)
class Dial:
    """One number of one effect, drawn from [low, high]; ``where`` are its places, of the effect library."""

    effect: str
    where: tuple[str, ...]
    parameter: str
    low: float
    high: float

    @property
    def label(self) -> str:
        """``coulomb_friction[wheel_lr].torque``."""
        return f"{self.effect}[{', '.join(self.where)}].{self.parameter}"

    @property
    def unit(self) -> str:
        """SI unit."""
        return EFFECTS[self.effect].parameters[self.parameter].unit

    def entry(self, value: float) -> dict[str, Any]:
        """Return the effect as a patch holds it."""
        return {"name": self.effect, "where": list(self.where), "parameters": {self.parameter: float(value)}}


@dataclass(frozen=True)
class SlipCandidate:
    """A plausible departure from the nominal robot: what it is, and its dials."""

    name: str
    doc: str
    dials: tuple[Dial, ...]


def _each(effect: str, parameter: str, places: Sequence[str], low: float, high: float) -> tuple[Dial, ...]:
    return tuple(Dial(effect, (place,), parameter, low, high) for place in places)


_FRONT = ("wheel_lf", "wheel_rf")
_REAR = ("wheel_lr", "wheel_rr")
_ALL = (*_FRONT, *_REAR)
CANDIDATES: tuple[SlipCandidate, ...] = (
    SlipCandidate(
        "rear drag", "gears of the free rear wheels, each its own", _each("coulomb_friction", "torque", _REAR, 0.0, 0.2)
    ),
    SlipCandidate("radius", "tyres of the front wheels, each its own", _each("wheel_radius_error", "scale", _FRONT, 0.9, 1.1)),
    SlipCandidate("creep", "tyres that creep under load, each its own", _each("tyre_creep", "creep_speed", _ALL, 0.0, 0.1)),
    SlipCandidate("grip", "wheels on unequal floor or tread", _each("friction_asymmetry", "mu", _ALL, 0.1, 1.0)),
    SlipCandidate(
        "rolling", "rolling resistance, each wheel its own", _each("rolling_resistance", "coefficient", _ALL, 0.0, 0.15)
    ),
    SlipCandidate("zeros", "zeros of the leg encoders", _each("joint_zero_offset", "angle", LEGS, -0.1, 0.1)),
    SlipCandidate(
        "load",
        "centre of mass, and the power source that the paper's 3 kg leave out",
        (
            Dial("com_offset", ("body",), "x", -0.05, 0.05),
            Dial("com_offset", ("body",), "y", -0.05, 0.05),
            Dial("payload", ("body",), "mass", 0.0, 1.0),
        ),
    ),
    SlipCandidate(
        "pull",
        "slope of the floor and pull of cables",
        (
            Dial("external_force", ("body",), "fx", -3.0, 3.0),
            Dial("external_force", ("body",), "fy", -3.0, 3.0),
            Dial("floor_slope", ("ground",), "pitch", -0.03, 0.03),
            Dial("floor_slope", ("ground",), "roll", -0.03, 0.03),
        ),
    ),
    SlipCandidate(
        "servo",
        "delay, play and torque of the front wheels' servos",
        (
            *_each("command_delay", "delay", _FRONT, 0.0, 0.06),
            *_each("backlash", "angle", _FRONT, 0.0, 0.1),
            *_each("weak_motor", "scale", _FRONT, 0.3, 1.0),
        ),
    ),
    SlipCandidate(
        "camera",
        "camera's frame turned against the start heading, and scaled",
        (
            Dial("camera_misalignment", ("sensor",), "yaw", -0.1, 0.1),
            Dial("camera_misalignment", ("sensor",), "scale", 0.9, 1.1),
        ),
    ),
)
#: The paper gives no coefficient of the floor; every draw has one of its own.
FLOOR_DIAL = Dial("friction_level", ("ground",), "mu", 0.3, 0.9)


def scaled(dials: Sequence[Dial], unit: Array) -> Array:
    """Return values of dials (N, dials) for numbers from 0 (low) to 1 (high)."""
    low, high = (np.array([getattr(dial, end) for dial in dials]) for end in ("low", "high"))
    return low + unit * (high - low)


def make_parameters(robot: Robot, dials: Sequence[Dial], values: Array) -> Parameters:
    """Return robots (N) with the dials (N, dials) set, by the effect library."""
    nominal = Parameters.nominal(robot)
    rows = [
        apply_patch(load_patch([dial.entry(value) for dial, value in zip(dials, row, strict=True)]), nominal).values
        for row in values
    ]
    return Parameters(np.concatenate(rows))
