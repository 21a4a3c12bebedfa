"""How well a number of the robot is known: the tolerances of a robot file, read and checked once, for all who use them.

A tolerance is 1 sigma: relative (``0.05``, ``5 %``) or with a unit of the parameter's dimension (``0.2 deg``, ``3 mm``,
``2 mN m``); one for all, or one each for legs and wheels (``0.01 N m s/rad (legs), 2e-3 N m s/rad (wheels)``).
"""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from wlr_gym.base.errors import InputError, nearest, unknown_name
from wlr_gym.robot.joints import JOINTS, LEGS
from wlr_gym.robot.parameter_table import TABLE

#: Symbol -> its size in SI, and the SI symbol of that dimension.
UNITS = {
    "m": (1.0, "m"),
    "cm": (1e-2, "m"),
    "mm": (1e-3, "m"),
    "s": (1.0, "s"),
    "ms": (1e-3, "s"),
    "rad": (1.0, "rad"),
    "mrad": (1e-3, "rad"),
    "deg": (math.radians(1.0), "rad"),
    "kg": (1.0, "kg"),
    "g": (1e-3, "kg"),
    "N": (1.0, "N"),
    "mN": (1e-3, "N"),
    "V": (1.0, "V"),
    "mV": (1e-3, "V"),
}
#: Unit of an amount that is relative -> what it is divided by.
RELATIVE = {"": 1.0, "%": 100.0}
#: Tolerances of a robot file, and the rows of the parameter table that each is about.
KEYS = {spec.tolerance: [row for row in TABLE if row.tolerance == spec.tolerance] for spec in TABLE if spec.tolerance}
_PART = re.compile(r"\s*([-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)\s*([^(,]*?)\s*(?:\(\s*(\w*)\s*\))?\s*")
_SYMBOL = re.compile(r"([A-Za-z]+)([2-9]?)")


@dataclass(frozen=True)
class ParameterTolerance:
    """One tolerance.

    Attributes:
        legs: 1 sigma of a number of a leg or its servo.
        wheels: 1 sigma of all other numbers; the same as ``legs`` unless the file states one each.
        unit: SI unit of both; None = they are relative.
    """

    legs: float
    wheels: float
    unit: str | None

    def of(self, element: str) -> float:
        """Return 1 sigma of an element of the parameter table, such as ``servo.kp[leg_lf]``."""
        return self.legs if element.partition("[")[2].rstrip("]") in LEGS else self.wheels

    def sigma(self, element: str, nominal: float) -> float:
        """Return 1 sigma of an element in its SI unit."""
        return self.of(element) * (abs(nominal) if self.unit is None else 1.0)

    def share(self, element: str, nominal: float) -> float:
        """Return 1 sigma of an element over its nominal value."""
        return self.of(element) / (1.0 if self.unit is None else abs(nominal))

    def __str__(self) -> str:
        """Return the text of a robot file."""
        unit = f" {self.unit}" if self.unit else ""
        one = f"{self.wheels!r}{unit}"
        return one if self.legs == self.wheels else f"{self.legs!r}{unit} (legs), {one} (wheels)"


def read_tolerances(stated: Any) -> dict[str, ParameterTolerance]:
    """Return the tolerances of a robot file by key.

    Raises:
        InputError: unknown key or unit, another dimension than the parameter's, a negative or infinite amount, or a form that
            is none; the message names key, value, what is expected and the nearest valid name.
    """
    if not isinstance(stated, Mapping):
        raise InputError(f"tolerances = {stated!r}: expected a mapping of {', '.join(KEYS)}")
    return {key: value if isinstance(value, ParameterTolerance) else _read(key, value) for key, value in stated.items()}


def _read(key: Any, value: Any) -> ParameterTolerance:
    if key not in KEYS:
        raise unknown_name("tolerance", str(key), KEYS)
    place = f"tolerances.{key} = {value!r}"
    if isinstance(value, bool) or not isinstance(value, int | float | str):
        raise InputError(f"{place}: expected {_expected(key)}")
    texts = value.split(",") if isinstance(value, str) else [repr(value)]
    parts = [_part(key, text, place) for text in texts]
    if len({relative for _, relative, _ in parts}) > 1:
        raise InputError(f"{place}: expected both relative, or both with a unit")
    amounts = {group: amount for amount, _, group in parts}
    if len(amounts) < len(parts) or set(amounts) not in ({""}, {"legs", "wheels"}):
        raise InputError(f"{place}: expected one amount for all, or one each: A (legs), B (wheels)")
    if len(amounts) > 1 and any(row.labels != JOINTS for row in KEYS[key]):
        raise InputError(f"{place}: expected one amount: legs and wheels do not both have a {key}")
    relative = parts[0][1]
    legs, wheels = (amounts[""],) * 2 if "" in amounts else (amounts["legs"], amounts["wheels"])
    return ParameterTolerance(legs, wheels, None if relative else KEYS[key][0].unit)


def _part(key: str, text: str, place: str) -> tuple[float, bool, str]:
    """Return the amount (SI, or a share), whether it is relative, and whom it is of: ``legs``, ``wheels`` or all ('')."""
    found = _PART.fullmatch(text)
    if found is None:
        raise InputError(f"{place}: expected {_expected(key)}")
    number, unit, group = float(found[1]), found[2], found[3] or ""
    if not math.isfinite(number) or number < 0.0:
        raise InputError(f"{place}: expected a finite amount of 0 or more, {_expected(key)}")
    if unit in RELATIVE:
        return number / RELATIVE[unit], True, group
    return number * _size(key, unit, place), False, group


def _size(key: str, unit: str, place: str) -> float:
    """Return the size in SI of a unit that has the dimension of the parameter."""
    expected = KEYS[key][0].unit
    try:
        size, dimension = _parsed(unit)
    except KeyError as error:
        symbol = error.args[0]
        raise InputError(f"{place}: unknown unit '{symbol}'{nearest(symbol, UNITS)}; expected {_expected(key)}") from None
    if dimension != _parsed(expected)[1]:
        raise InputError(f"{place}: '{unit}' is not a unit of {key}; expected {_expected(key)}")
    return size


def _parsed(unit: str) -> tuple[float, Counter[str]]:
    """Return the size in SI and the dimension (symbol -> exponent) of a unit such as ``mN m s/rad``; "-" is a pure number.

    Raises:
        KeyError: a symbol that is none.
    """
    size = 1.0
    dimension: Counter[str] = Counter()
    for place, half in enumerate([] if unit == "-" else unit.split("/")):
        for symbol in half.split() or [unit]:
            found = _SYMBOL.fullmatch(symbol)
            if found is None or found[1] not in UNITS:
                raise KeyError(symbol)
            exponent = int(found[2] or 1) * (-1 if place else 1)
            factor, base = UNITS[found[1]]
            size *= factor**exponent
            dimension[base] += exponent
    return size, dimension


def _expected(key: str) -> str:
    unit = KEYS[key][0].unit
    first = unit.split("/")[0].split()[0]
    units = [unit, *(symbol + unit.removeprefix(first) for symbol, (_, base) in UNITS.items() if base == first != symbol)]
    return f"a relative number (0.05 or '5 %'), or one with its unit ({', '.join(units)})"
