"""Which numbers of the robot calibration may move: those its file gives a tolerance, and the biases of its IMU."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from wlr_gym.base.errors import InputError, unknown_name
from wlr_gym.gap.problem import Quantity
from wlr_gym.physics.plants.simulator import most_damping
from wlr_gym.robot import LEGS, Robot
from wlr_gym.robot.parameters import SPECS, TABLE, Parameters

Array = NDArray[np.float64]

#: Tolerances that move several numbers as one: a floor is one floor, a host's latency one latency.
SHARED = {"ground.mu": ("ground.mu_x", "ground.mu_y"), "command.delay": ("command.delay",)}
#: Numbers of the contact spring, of which the robot's file has a guess and no tolerance: one sigma, relative, all wheels alike.
GUESSED = {"ground.normal_stiffness": 0.2, "ground.normal_damping": 0.5}
#: Tolerances by which calibration may move a number; what needs more is a missing effect. Biases of the IMU are drawn each time
#: it is switched on, and from no one's workshop: they get more room.
REACH, REACH_OF_BIAS = 2.5, 4.0
#: m/s; one sigma of the creep that any tyre has, all wheels alike: an effect is what goes beyond.
CREEP = 0.001
#: A leg's own inertia is a hundredth of its rotor's: no run shows it.
UNSEEN = ("leg.inertia",)
_AMOUNT = re.compile(r"\s*(\d+(?:\.\d*)?(?:[eE][-+]?\d+)?|\.\d+)\s*([^(,\d]+?)\s*(?:\((legs|wheels)\))?\s*(?:,|$)")
_UNITS = {
    "m": 1.0,
    "mm": 1e-3,
    "s": 1.0,
    "ms": 1e-3,
    "rad": 1.0,
    "deg": math.radians(1.0),
    "kg": 1.0,
    "N m": 1.0,
    "N m s/rad": 1.0,
    "V": 1.0,
}


@dataclass(frozen=True)
class Knob:
    """A quantity, and the elements of the parameter table that it sets.

    Attributes:
        quantity: what is fitted.
        elements: what it sets.
        shares: of the quantity that each element gets; a robot's floor may grip less across than along.
    """

    quantity: Quantity
    elements: tuple[str, ...]
    shares: tuple[float, ...] = ()


#: Share of the contact damping that the physics step still resolves to which calibration may go.
RESOLVED = 0.8


def knobs(robot: Robot, physics_step: float) -> tuple[Knob, ...]:
    """Return what calibration may move, from the robot's tolerances.

    Args:
        robot: the robot.
        physics_step: s, with which it will be simulated.

    Raises:
        InputError: a tolerance that cannot be read, or of no number.
    """
    known = {spec.tolerance for spec in TABLE if spec.tolerance} | SHARED.keys()
    for key in robot.tolerances:
        if key not in known:
            raise unknown_name("tolerance", key, known, f"robot '{robot.name}'")
    nominal = Parameters.nominal(robot)
    found: list[Knob] = []
    for key, elements in SHARED.items():
        if key in robot.tolerances:
            targets = tuple(element for name in elements for element in SPECS[name].elements)
            found.append(_knob(key, targets, nominal, robot))
    for spec in TABLE:
        if spec.tolerance in robot.tolerances and spec.tolerance not in (*UNSEEN, *SHARED):
            found += [_knob(spec.tolerance, (element,), nominal, robot) for element in spec.elements]
    resolved = RESOLVED * most_damping(nominal, physics_step)
    for name, share in GUESSED.items():
        spec, value = SPECS[name], float(nominal[name].mean())
        quantity = _quantity(name, name, value, share * value)
        if name == "ground.normal_damping":
            quantity = replace(quantity, high=max(min(quantity.high, resolved), value))
        found.append(Knob(quantity, tuple(spec.elements)))
    creep = SPECS["ground.creep_speed"]
    found.append(Knob(_quantity(creep.name, creep.name, 0.0, CREEP), tuple(creep.elements)))
    imu = robot.sensors.imu
    for name, sigma in (("imu.gyro_bias", imu.gyro_bias), ("imu.accel_bias", imu.accel_bias)):
        spec = SPECS[name]
        found += [Knob(replace(_quantity(e, name, 0.0, sigma, REACH_OF_BIAS), drifts=True), (e,)) for e in spec.elements]
    return tuple(knob for knob in found if knob.quantity.sigma > 0.0)  # what is known exactly does not move


def _knob(key: str, elements: tuple[str, ...], nominal: Parameters, robot: Robot) -> Knob:
    name = elements[0] if len(elements) == 1 else key
    spec = SPECS[elements[0].partition("[")[0]]
    value = float(nominal[elements[0]][0])
    label = elements[0].partition("[")[2].rstrip("]")
    sigma = tolerance(
        robot.tolerances[key], value, "legs" if label in LEGS else "wheels", f"robot '{robot.name}': tolerances.{key}"
    )
    shares = tuple(float(nominal[element][0]) / value if value else 1.0 for element in elements)
    return Knob(_quantity(name, spec.name, value, sigma), elements, shares)


def _quantity(name: str, parameter: str, nominal: float, sigma: float, reach: float = REACH) -> Quantity:
    spec = SPECS[parameter]
    return Quantity(
        name, spec.unit, nominal, sigma, max(spec.low, nominal - reach * sigma), min(spec.high, nominal + reach * sigma)
    )


def tolerance(entry: float | str, nominal: float, kind: str, place: str) -> float:
    """Return one sigma: a number is relative; a text has a unit, and may differ between legs and wheels.

    Raises:
        InputError: neither, or less than 0.
    """
    if not isinstance(entry, str) and entry >= 0.0:
        return float(entry) * abs(nominal)
    for amount, unit, group in _AMOUNT.findall(str(entry)):
        if group in ("", kind) and unit in _UNITS:
            return float(amount) * _UNITS[unit]
    raise InputError(f"{place} = {entry!r}: expected a number of 0 or more, or a number with its unit ({', '.join(_UNITS)})")


def write(knobs: Sequence[Knob], values: Array, parameters: Parameters) -> None:
    """Write quantities (settings, len(knobs)) into a batch of parameters."""
    for knob, column in zip(knobs, values.T, strict=True):
        for element, share in zip(knob.elements, knob.shares or [1.0] * len(knob.elements), strict=True):
            parameters[element] = column * share
