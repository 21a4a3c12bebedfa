"""Distributions and tolerances that randomisation events draw from: quantile functions of one uniform number."""

from __future__ import annotations

import re
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wlr_gym.base.errors import InputError
from wlr_gym.robot import LEGS, Robot
from wlr_gym.robot.parameters import spec_of

Array = NDArray[np.float64]


def uniform(u: Array, low: Array, high: Array, cut: Array) -> Array:
    """Evenly spread between ``low`` and ``high``."""
    return low + (high - low) * u


def loguniform(u: Array, low: Array, high: Array, cut: Array) -> Array:
    """Evenly spread in the logarithm between ``low`` and ``high`` (both positive)."""
    return low * (high / low) ** u


def normal(u: Array, mean: Array, sigma: Array, cut: Array) -> Array:
    """Normal with ``mean`` and ``sigma``, cut off ``cut`` sigmas from the mean (the rest is renormalised)."""
    from scipy.special import ndtr, ndtri

    tail = ndtr(-cut)
    return mean + sigma * ndtri(tail + (1.0 - 2.0 * tail) * u)


def half_normal(u: Array, mean: Array, sigma: Array, cut: Array) -> Array:
    """Normal folded at its mean: never below it."""
    return mean + np.abs(normal(u, np.zeros_like(mean), sigma, cut))


#: Distribution -> quantile function of (u, first parameter, second parameter, cut).
DISTRIBUTIONS: dict[str, Callable[[Array, Array, Array, Array], Array]] = {
    "uniform": uniform,
    "loguniform": loguniform,
    "normal": normal,
    "half_normal": half_normal,
}

_TOLERANCE = re.compile(r"\s*([-+0-9.eE]+)\s*([^,(]*?)\s*(?:\((legs|wheels)\))?\s*(?:,|$)")
_DEGREE = np.pi / 180.0


def tolerance_of(robot: Robot, element: str) -> tuple[str, float]:
    """Return how well an element of the parameter table is known: operation (``scale`` or ``add``) and 1 sigma.

    The robot file gives a relative number, a number with a unit (``0.5 deg``, ``0.003 m``), or one each for legs and wheels.
    """
    spec = spec_of(element)
    if not spec.tolerance or spec.tolerance not in robot.tolerances:
        raise InputError(
            f"robot '{robot.name}' states no tolerance for parameter '{spec.name}'; known: {', '.join(robot.tolerances)}"
        )
    stated = robot.tolerances[spec.tolerance]
    if not isinstance(stated, str):
        return "scale", float(stated)
    group = "legs" if element.partition("[")[2].rstrip("]") in LEGS else "wheels"
    for number, unit, where in _TOLERANCE.findall(stated):
        if where in ("", group):
            return "add", float(number) * (_DEGREE if unit == "deg" else 1.0)
    raise InputError(f"robot '{robot.name}': tolerance {spec.tolerance} = {stated!r} says nothing about {group}")


def number_of(value: float | str, robot: Robot, where: str) -> float:
    """Return a number given as such or as a dotted path into the robot's file (``sensors.imu.gyro_bias``)."""
    if not isinstance(value, str):
        return float(value)
    found: Any = robot
    for part in value.split("."):
        found = getattr(found, part, None)
    if not isinstance(found, (int, float)):
        raise InputError(f"{where} = {value!r}: neither a number nor the path of a number in robot '{robot.name}'")
    return float(found)
