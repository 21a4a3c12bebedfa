"""Which numbers of a robot file are odd by themselves, or beside a neighbour: units, sizes, inertias. No mechanics."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from operator import attrgetter
from typing import NamedTuple

from wlr_gym.physics.feasibility.findings import RobotFinding, fault, warning
from wlr_gym.robot import Robot
from wlr_gym.robot.parameter_table import TABLE, range_in_words


class Mistake(NamedTuple):
    """A unit that is written by mistake: how many SI units one of it is, and its name."""

    size: float
    unit: str


_LENGTH = (Mistake(1e-3, "mm"), Mistake(1e-2, "cm"))
_MASS = (Mistake(1e-3, "g"),)
_TORQUE = (Mistake(1e-3, "mN m"), Mistake(0.0980665, "kgf cm"))
_RATE = (Mistake(2.0 * math.pi / 60.0, "rpm"), Mistake(math.radians(1.0), "deg/s"))
_ANGLE = (Mistake(math.radians(1.0), "deg"),)
_VOLTAGE = (Mistake(1e-3, "mV"),)


class Usual(NamedTuple):
    """What a number of a robot of this kind usually is: bounds, unit, and units that it is mistaken for."""

    low: float
    high: float
    unit: str
    mistakes: tuple[Mistake, ...] = ()


#: Robots of half a kilogram to some hundred kilograms.
USUAL: dict[str, Usual] = {
    "gravity": Usual(1.0, 25.0, "m/s2", (Mistake(1e-3, "mm/s2"),)),
    "body.mass": Usual(0.2, 300.0, "kg", _MASS),
    "body.size": Usual(0.02, 2.5, "m", _LENGTH),
    "body.com_offset": Usual(-0.5, 0.5, "m", _LENGTH),
    "hip_position.x": Usual(0.03, 1.0, "m", _LENGTH),
    "hip_position.y": Usual(0.03, 1.0, "m", _LENGTH),
    "hip_position.z": Usual(-0.5, 0.5, "m", _LENGTH),
    "leg.length": Usual(0.02, 1.0, "m", _LENGTH),
    "leg.mass": Usual(0.005, 30.0, "kg", _MASS),
    "leg.com_along_leg": Usual(0.0, 1.0, "m", _LENGTH),
    "wheel.radius": Usual(0.01, 0.5, "m", _LENGTH),
    "wheel.width": Usual(0.003, 0.3, "m", _LENGTH),
    "wheel.mass": Usual(0.005, 30.0, "kg", _MASS),
    "leg_limits": Usual(-math.tau, math.tau, "rad", _ANGLE),
    "home.leg_angle": Usual(-math.tau, math.tau, "rad", _ANGLE),
    "servo.supply_voltage": Usual(3.0, 60.0, "V", _VOLTAGE),
    "servo.leg.stall_torque": Usual(0.2, 500.0, "N m", _TORQUE),
    "servo.wheel.stall_torque": Usual(0.05, 300.0, "N m", _TORQUE),
    "servo.leg.no_load_speed": Usual(0.5, 30.0, "rad/s", _RATE),
    "servo.wheel.no_load_speed": Usual(0.5, 150.0, "rad/s", _RATE),
    "ground.mu_x": Usual(0.02, 1.5, "-", (Mistake(1e-2, "%"),)),
    "ground.mu_y": Usual(0.02, 1.5, "-", (Mistake(1e-2, "%"),)),
    "ground.slope": Usual(-0.6, 0.6, "rad", _ANGLE),
    "sensors.control_rate": Usual(10.0, 1000.0, "Hz", (Mistake(1e3, "kHz"),)),
    "sensors.encoder.position": Usual(1e-6, 0.1, "rad", _ANGLE),
    "sensors.encoder.velocity": Usual(0.0, 0.5, "rad/s", _RATE),
    "sensors.imu.gyro_noise": Usual(0.0, 0.1, "rad/s", (Mistake(math.radians(1.0), "deg/s"),)),
    "sensors.imu.accel_noise": Usual(0.0, 2.0, "m/s2", (Mistake(9.81e-3, "mg"),)),
    "sensors.camera.position_noise": Usual(0.0, 0.1, "m", _LENGTH),
}


def odd_numbers(robot: Robot) -> Iterator[RobotFinding]:
    """Yield what no simulator takes, then what is outside the usual, then what does not fit its neighbours."""
    yield from _outside_the_table(robot)
    yield from _unusual(robot)
    yield from _masses(robot)
    yield from _inertias(robot)
    yield from _places(robot)


def _outside_the_table(robot: Robot) -> Iterator[RobotFinding]:
    for spec in TABLE:
        for source in dict.fromkeys(source for source in spec.sources if isinstance(source, str)):
            for value in _stated(robot, source):
                if not spec.low <= value <= spec.high:
                    hint = _mistaken(source, value)
                    text = f"is outside {range_in_words(spec.low, spec.high, spec.unit)}, what simulators take{hint}"
                    yield fault(source, value, spec.unit, text)


def _stated(robot: Robot, key: str) -> list[float]:
    """Return the numbers at a key of the robot file."""
    stated = attrgetter(key)(robot)
    return [value for value in (stated if isinstance(stated, tuple) else (stated,)) if value is not None]


def _unusual(robot: Robot) -> Iterator[RobotFinding]:
    for key in USUAL:
        yield from unusual(key, _stated(robot, key))


def unusual(key: str, values: Sequence[float]) -> Iterator[RobotFinding]:
    """Yield which of the numbers at a key of the robot file are outside the usual."""
    usual = USUAL[key]
    unit = "" if usual.unit == "-" else f" {usual.unit}"
    for value in values:
        if not usual.low <= value <= usual.high:
            text = f"is unusual, expected {usual.low:.3g} to {usual.high:.3g}{unit}{_mistaken(key, value)}"
            yield warning(key, value, usual.unit, text)


def _mistaken(key: str, value: float) -> str:
    """Return the unit in which a number would be a usual one, in words; empty: none."""
    usual = USUAL.get(key)
    for size, unit in usual.mistakes if usual else ():
        if usual and usual.low <= value * size <= usual.high:
            return f"; in {unit}? {value:.6g} {unit} = {value * size:.4g} {usual.unit}"
        if usual and usual.low <= value / size <= usual.high and size in (1e-3, 1e-2):
            return f"; too small by {1 / size:.0f}? {value / size:.4g} {usual.unit} would be usual"
    return ""


def _masses(robot: Robot) -> Iterator[RobotFinding]:
    total = robot.total_mass
    for key, mass in (("leg.mass", robot.leg.mass), ("wheel.mass", robot.wheel.mass)):
        if mass is not None and mass < 1e-4 * total:
            text = f"next to no mass beside the {total:.4g} kg of the robot: expected {1e-4 * total:.2g} kg or more"
            yield warning(key, mass, "kg", text)
    if robot.body.mass < 0.1 * total:
        yield warning("body.mass", robot.body.mass, "kg", f"is less than a tenth of the {total:.4g} kg of the robot")


def _inertias(robot: Robot) -> Iterator[RobotFinding]:
    """Compare with bodies of that size; :func:`wlr_gym.robot.physical_faults` has the platform's lower bound."""
    leg, wheel, body = robot.leg, robot.wheel, robot.body
    x, y, z = body.size
    for axis, value, radius in zip("xyz", body.inertia, (math.hypot(y, z), math.hypot(x, z), math.hypot(x, y)), strict=True):
        yield from _moment(f"body.inertia {axis}", value, body.mass, 0.0, radius, f"a body of {x:g} x {y:g} x {z:g} m")
    rod = leg.length / math.sqrt(12.0)
    for axis, value in zip("xy", leg.inertia, strict=False):
        yield from _moment(f"leg.inertia {axis}", value, leg.mass, 0.2 * rod, leg.length, f"a leg of {leg.length:g} m")
    yield from _moment(
        "leg.inertia about its own axis", leg.inertia[2], leg.mass, 0.0, leg.length, f"a leg of {leg.length:g} m"
    )
    disc = f"a wheel of radius {wheel.radius:g} m"
    yield from _moment("wheel.spin_inertia", wheel.spin_inertia, wheel.mass, 0.3 * wheel.radius, wheel.radius, disc)
    across, reach = wheel.transverse_inertia, math.hypot(wheel.radius, wheel.width)
    yield from _moment("wheel.transverse_inertia", across, wheel.mass, 0.2 * wheel.radius, reach, disc)
    if across is not None and wheel.spin_inertia > 2.0 * across * (1.0 + 1e-9):
        text = f"is more than twice wheel.transverse_inertia, {across:.4g} kg m2: no rigid body has that"
        yield fault("wheel.spin_inertia", wheel.spin_inertia, "kg m2", text)


def _moment(key: str, value: float | None, mass: float | None, low: float, high: float, what: str) -> Iterator[RobotFinding]:
    """Compare a moment of inertia with a mass at distances ``low`` and ``high`` (m) from the axis."""
    if value is None or not mass:
        return
    least, most = mass * low**2, mass * high**2
    if not least <= value <= most:
        text = f"{mass:.4g} kg in {what} have {least:.2g} to {most:.2g} kg m2{_power_of_ten(value, least, most)}"
        yield warning(key, value, "kg m2", text)


def _power_of_ten(value: float, least: float, most: float) -> str:
    """Say by which power of 1000 a number is off, if that makes it right."""
    for factor in (1e3, 1e6, 1e9):
        for right, words in ((value * factor, "small"), (value / factor, "large")):
            if least <= right <= most:
                return f"; too {words} by {factor:.0f}? {right:.3g} would fit (g or mm in it?)"
    return ""


def _places(robot: Robot) -> Iterator[RobotFinding]:
    body, hip, leg = robot.body, robot.hip_position, robot.leg
    for axis, value, size in (("x", hip.x, body.size[0]), ("y", hip.y, body.size[1])):
        if value > size:
            yield warning(f"hip_position.{axis}", value, "m", f"hips are twice as far out as the body, {size / 2:.4g} m")
    top = body.size[2] / 2
    if abs(hip.z) > top:
        where = "above the top" if hip.z > 0 else "below the bottom"
        text = f"hips are {abs(hip.z) - top:.4g} m {where} of the body, which is from {-top:.4g} to {top:.4g} m"
        yield warning("hip_position.z", hip.z, "m", text)
    for axis, value, size in zip("xyz", body.com_offset, body.size, strict=True):
        if abs(value) > size / 2:
            yield warning(
                f"body.com_offset {axis}", value, "m", f"is outside the body: expected {-size / 2:.4g} to {size / 2:.4g} m"
            )
    if leg.com_along_leg > leg.length:
        yield warning("leg.com_along_leg", leg.com_along_leg, "m", f"is beyond the wheel: the leg is {leg.length:.4g} m long")
