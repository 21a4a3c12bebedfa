"""Distributions and tolerances that randomisation events draw from: quantile functions of one uniform number."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wlr_gym.base.errors import InputError
from wlr_gym.robot import Robot
from wlr_gym.robot.parameter_table import spec_of

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


def tolerance_of(robot: Robot, element: str) -> tuple[str, float]:
    """Return how well the robot file says an element is known: operation (``scale`` or ``add``) and 1 sigma."""
    spec = spec_of(element)
    stated = robot.tolerances.get(spec.tolerance)
    if stated is None:
        raise InputError(
            f"robot '{robot.name}' states no tolerance for parameter '{spec.name}'; known: {', '.join(robot.tolerances)}"
        )
    return "scale" if stated.unit is None else "add", stated.of(element)


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
