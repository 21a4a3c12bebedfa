"""How the numbers of a task follow the robot: rules of its file, applied to another robot than the one it is written for.

A rule names a number of the task and what it is proportional to: a product or quotient of :data:`QUANTITIES`, such as
``top_speed / track_width``. The number is multiplied by what that is for the robot over what it is for the task's own robot,
and rounded to three digits. For the task's own robot every number stays as it is written. ``leg_limits`` is a rule of its
own: leg angles keep their place between the lower and the upper limit.

Changes that a user lays over a task hold as they are given: they speak of the robot that they were written for.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from wlr_gym.base.errors import InputError, unknown_name
from wlr_gym.robot import Robot

#: What leg angles follow instead of a product.
LEG_LIMITS = "leg_limits"
#: Significant digits of a number that was scaled.
DIGITS = 3


@dataclass(frozen=True)
class RobotQuantity:
    """One number of a robot that tasks are scaled by: what it is, and how it follows from the robot."""

    unit: str
    doc: str
    of: Callable[[Robot], float]


def _drive(robot: Robot) -> float:
    """Acceleration (m/s2) that the stalled motors of all wheels would give."""
    return 4.0 * robot.servo.wheel.stall_torque / (robot.wheel.radius * robot.total_mass)


def _top_speed(robot: Robot) -> float:
    return robot.servo.wheel.no_load_speed * robot.wheel.radius


QUANTITIES: dict[str, RobotQuantity] = {
    "wheel_speed": RobotQuantity("rad/s", "no-load speed of the wheels", lambda r: r.servo.wheel.no_load_speed),
    "top_speed": RobotQuantity("m/s", "no-load speed times wheel radius", _top_speed),
    "leg_speed": RobotQuantity("rad/s", "no-load speed of the legs", lambda r: r.servo.leg.no_load_speed),
    "leg_torque": RobotQuantity("N m", "stall torque of the legs", lambda r: r.servo.leg.stall_torque),
    "wheel_torque": RobotQuantity("N m", "stall torque of the wheels", lambda r: r.servo.wheel.stall_torque),
    "leg_reach": RobotQuantity("m", "length of a leg", lambda r: r.leg.length),
    "leg_range": RobotQuantity("rad", "upper minus lower leg limit", lambda r: r.leg_limits[1] - r.leg_limits[0]),
    "track_width": RobotQuantity("m", "distance of left and right wheels", lambda r: 2.0 * r.hip_position.y),
    "wheelbase": RobotQuantity("m", "distance of front and rear hips", lambda r: 2.0 * r.hip_position.x),
    "grip": RobotQuantity(
        "m/s2",
        "largest acceleration: friction of the robot's own floor times gravity, or all motors' stall torque, whichever is less",
        lambda r: min(r.ground.mu_x * r.gravity, _drive(r)),
    ),
    "weight": RobotQuantity("N", "mass times gravity", lambda r: r.total_mass * r.gravity),
    "power": RobotQuantity("W", "weight times top speed", lambda r: r.total_mass * r.gravity * _top_speed(r)),
}


@dataclass(frozen=True)
class Scaled:
    """A number of a task that follows the robot.

    Attributes:
        place: keys, with dots between them. rule: of the task's file.
        before, after: number, or low and high, as written and for the robot.
    """

    place: str
    rule: str
    before: Any
    after: Any


def check_rule(place: str, rule: str, where: str) -> None:
    """Refuse a rule that is no product or quotient of quantities."""
    for name in _factors(place, rule, where):
        if name != "1" and name not in QUANTITIES:
            raise unknown_name("quantity of a robot", name, [*QUANTITIES, LEG_LIMITS], f"{where}: scaling.{place}")


def _factors(place: str, rule: str, where: str) -> dict[str, int]:
    """Return name -> exponent of a product such as ``top_speed / track_width``."""
    words = str(rule).replace("*", " * ").replace("/", " / ").split()
    names, signs = words[::2], words[1::2]
    if not names or len(names) != len(signs) + 1 or any(sign not in "*/" for sign in signs):
        raise InputError(f"{where}: scaling.{place} = {rule!r}: expected a product such as 'top_speed / track_width'")
    if names == [LEG_LIMITS]:
        return {}
    exponents: dict[str, int] = {}
    for name, sign in zip(names, ["*", *signs], strict=True):
        exponents[name] = exponents.get(name, 0) + (1 if sign == "*" else -1)
    return exponents


def quantities_of(rule: str) -> set[str]:
    """Return the names of the quantities that a checked rule goes by."""
    return set(_factors("", rule, "")) & set(QUANTITIES)


def ratio(rule: str, robot: Robot, reference: Robot) -> float:
    """Return by how much what a rule says is larger for ``robot`` than for ``reference``; 1 exactly where nothing differs."""
    factor = 1.0
    for name, exponent in _factors("", rule, "").items():
        if name != "1":
            factor *= (_positive(name, robot) / _positive(name, reference)) ** exponent
    return factor


def _positive(name: str, robot: Robot) -> float:
    """Return a quantity of a robot; of one without gravity or grip, some tell nothing of how a task's numbers follow."""
    value, unit = QUANTITIES[name].of(robot), QUANTITIES[name].unit
    if not value > 0.0:
        raise InputError(f"robot '{robot.name}': {name} = {value:g} {unit}: expected more than 0, as the task scales with it")
    return value


def scaled_numbers(
    data: Mapping[str, Any], rules: Mapping[str, str], robot: Robot, reference: Robot, where: str = "task"
) -> list[Scaled]:
    """Return every number that has a rule, as written for ``reference`` and for ``robot``."""
    found = []
    for place, rule in rules.items():
        before = _value_at(data, place)
        numbers = before if isinstance(before, list) else [before]
        if not all(isinstance(number, int | float) for number in numbers):
            raise InputError(f"{where}: scaling.{place}: the task has no number there: expected one, or a range")
        after = [_scale(number, rule, robot, reference) for number in numbers]
        found.append(Scaled(place, rule, before, after if isinstance(before, list) else after[0]))
    return found


def _scale(number: float, rule: str, robot: Robot, reference: Robot) -> float:
    if rule.strip() == LEG_LIMITS:
        (low, high), (old_low, old_high) = robot.leg_limits, reference.leg_limits
        if (low, high) == (old_low, old_high):
            return number
        return _rounded(low + (number - old_low) * (high - low) / (old_high - old_low))
    factor = ratio(rule, robot, reference)
    return number if factor == 1.0 else _rounded(factor * number)


def _rounded(number: float) -> float:
    return float(f"{number:.{DIGITS}g}")


def scaled(data: Mapping[str, Any], rules: Mapping[str, str], robot: Robot, reference: Robot, where: str) -> dict[str, Any]:
    """Return the content of a task file with its numbers for another robot; see the module."""
    result = dict(data)
    for number in scaled_numbers(data, rules, robot, reference, where):
        result = _with_value(result, number.place.split("."), number.after)
    return result


def _value_at(data: Any, place: str) -> Any:
    for key in place.split("."):
        data = data.get(key) if isinstance(data, Mapping) else None
    return list(data) if isinstance(data, list | tuple) else data


def _with_value(data: Mapping[str, Any], keys: list[str], value: Any) -> dict[str, Any]:
    first, *rest = keys
    return {**data, first: _with_value(data[first], rest, value) if rest else value}
