"""Which numbers of the robot calibration may move: those its file gives a tolerance, and the biases of its IMU."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from wlr_gym.gap.problem import Quantity
from wlr_gym.physics.plants.simulator import most_damping
from wlr_gym.robot import Robot
from wlr_gym.robot.parameter_table import SPECS, TABLE
from wlr_gym.robot.parameters import Parameters

Array = NDArray[np.float64]

#: Tolerances that move several numbers as one: a floor is one floor, a host's latency one latency.
SHARED = {"ground.mu": ("ground.mu_x", "ground.mu_y"), "command.delay": ("command.delay",)}
#: Numbers of the contact spring, of which the robot's file has a guess and no tolerance: one sigma, relative, all wheels alike.
#: A stiffness held too near to the guess makes the body heavier, and a payload is named.
GUESSED = {"ground.normal_stiffness": 0.3, "ground.normal_damping": 0.5}
#: Tolerances by which calibration may move a number; what needs more is a missing effect.
REACH = 2.5
#: The same of the biases of the IMU. They are drawn each time it is switched on: they get more room.
REACH_OF_BIAS = 4.0
#: What tyres and gears yield, all alike, of which no robot's file tells: one sigma from none, m/s, rad/s and a share. An effect
#: is what goes beyond.
YIELDS = {"ground.creep_speed": 0.001, "servo.creep_rate": 0.004, "ground.flattening": 0.3}
#: A leg's own inertia is a hundredth of its rotor's: no run shows it.
UNSEEN = ("leg.inertia",)


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
    """
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
    found += [Knob(_quantity(name, name, 0.0, sigma), tuple(SPECS[name].elements)) for name, sigma in YIELDS.items()]
    imu = robot.sensors.imu
    for name, sigma in (("imu.gyro_bias", imu.gyro_bias), ("imu.accel_bias", imu.accel_bias)):
        spec = SPECS[name]
        found += [Knob(replace(_quantity(e, name, 0.0, sigma, REACH_OF_BIAS), drifts=True), (e,)) for e in spec.elements]
    return tuple(knob for knob in found if knob.quantity.sigma > 0.0)  # what is known exactly does not move


def _knob(key: str, elements: tuple[str, ...], nominal: Parameters, robot: Robot) -> Knob:
    name = elements[0] if len(elements) == 1 else key
    spec = SPECS[elements[0].partition("[")[0]]
    value = float(nominal[elements[0]][0])
    sigma = robot.tolerances[key].sigma(elements[0], value)
    shares = tuple(float(nominal[element][0]) / value if value else 1.0 for element in elements)
    return Knob(_quantity(name, spec.name, value, sigma), elements, shares)


def _quantity(name: str, parameter: str, nominal: float, sigma: float, reach: float = REACH) -> Quantity:
    spec = SPECS[parameter]
    return Quantity(
        name, spec.unit, nominal, sigma, max(spec.low, nominal - reach * sigma), min(spec.high, nominal + reach * sigma)
    )


def write(knobs: Sequence[Knob], values: Array, parameters: Parameters) -> None:
    """Write quantities (settings, len(knobs)) into a batch of parameters."""
    for knob, column in zip(knobs, values.T, strict=True):
        for element, share in zip(knob.elements, knob.shares or [1.0] * len(knob.elements), strict=True):
            parameters[element] = column * share
