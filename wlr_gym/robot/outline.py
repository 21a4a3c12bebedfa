"""A new robot from a few numbers: what is asked for, and what follows from the answers and a base robot."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from operator import attrgetter
from typing import Any

from wlr_gym.base.errors import InputError, check_name, nearest
from wlr_gym.base.settings import nested
from wlr_gym.robot.description import Motor, Robot
from wlr_gym.robot.parameter_table import UNITS

Answers = dict[str, Any]

#: Units of an answer, those of tolerances and more: symbol -> size in SI, SI unit.
_UNITS = UNITS | {
    "N m": (1.0, "N m"),
    "mN m": (1e-3, "N m"),
    "N cm": (1e-2, "N m"),
    "rad/s": (1.0, "rad/s"),
    "rpm": (2.0 * math.pi / 60.0, "rad/s"),
    "deg/s": (math.radians(1.0), "rad/s"),
}


@dataclass(frozen=True)
class Question:
    """One number that a new robot is made of.

    Attributes:
        key: of the robot file.
        words: what it is.
        unit: SI.
        default: of the answers so far and the base.
        count: how many numbers it is.
        positive: 0 and less are refused.
    """

    key: str
    words: str
    unit: str
    default: Callable[[Answers, Robot], Any]
    count: int = 1
    positive: bool = True

    def read(self, text: str) -> Any:
        """Return an answer in SI units: a number, or a list of ``count``, with a unit or without (SI).

        Raises:
            InputError: no number, another dimension, or not positive; names key, text and what is expected.
        """
        words, values = text.replace(",", " ").split(), []
        while words:
            try:
                values.append(float(words[0]))
            except ValueError:
                break
            words.pop(0)
        unit = " ".join(words)
        if unit and unit not in _UNITS:
            raise InputError(f"{self.key} = '{text}': unknown unit '{unit}'{nearest(unit, _UNITS)}; expected {self.expected}")
        size, dimension = _UNITS[unit] if unit else (1.0, self.unit)
        if len(values) != self.count or dimension != self.unit or not all(map(math.isfinite, values)):
            raise InputError(f"{self.key} = '{text}': expected {self.expected}")
        if self.positive and min(values) <= 0.0:
            raise InputError(f"{self.key} = '{text}': expected more than 0 {self.unit}")
        scaled = [float(f"{value * size:.12g}") for value in values]
        return scaled if self.count > 1 else scaled[0]

    @property
    def expected(self) -> str:
        """What is expected, in words."""
        units = [unit for unit, (_, dimension) in _UNITS.items() if dimension == self.unit]
        return f"{'a number' if self.count == 1 else f'{self.count} numbers'} in {', '.join(units)}"

    def shown(self, value: Any) -> str:
        """Return a value as it is typed."""
        values = value if isinstance(value, list | tuple) else [value]
        return f"{' '.join(f'{one:.4g}' for one in values)} {self.unit}"


def _of_base(key: str) -> Callable[[Answers, Robot], Any]:
    def default(_: Answers, base: Robot) -> Any:
        value = attrgetter(key)(base)
        return list(value) if isinstance(value, tuple) else value

    return default


def _share_of_body(key: str) -> Callable[[Answers, Robot], float]:
    """As heavy beside the body as the base's."""
    return lambda answers, base: _neat(_of_base(key)(answers, base) * answers["body.mass"] / base.body.mass)


def _limits(answers: Answers, base: Robot) -> list[float]:
    """Those of the base, narrowed to where front and rear wheels stay apart by a fifth of their radius."""
    room = (answers["hip_position.x"] - 1.1 * answers["wheel.radius"]) / answers["leg.length"]
    least = math.acos(min(max(room, 0.0), 1.0))
    low, high = max(base.leg_limits[0], least), min(base.leg_limits[1], math.pi - least)
    return [math.ceil(100.0 * low) / 100.0, math.floor(100.0 * high) / 100.0]


def _neat(value: float) -> float:
    return float(f"{value:.3g}")


QUESTIONS: tuple[Question, ...] = (
    Question("body.mass", "mass of the body, without legs and wheels", "kg", _of_base("body.mass")),
    Question("body.size", "length, width and height of the body", "m", _of_base("body.size"), count=3),
    Question("hip_position.x", "hips ahead of and behind the body's middle", "m", lambda a, _: _neat(a["body.size"][0] / 2)),
    Question("hip_position.y", "hips left and right of the body's middle", "m", lambda a, _: _neat(a["body.size"][1] / 2)),
    Question("hip_position.z", "hips above the body's middle", "m", lambda a, b: b.hip_position.z, positive=False),
    Question("leg.length", "length of a leg, hip to wheel axle", "m", _of_base("leg.length")),
    Question("leg.mass", "mass of one leg, without its wheel", "kg", _share_of_body("leg.mass")),
    Question("wheel.radius", "radius of a wheel", "m", _of_base("wheel.radius")),
    Question("wheel.width", "width of a wheel", "m", lambda a, b: _neat(b.wheel.width * a["wheel.radius"] / b.wheel.radius)),
    Question("wheel.mass", "mass of one wheel", "kg", _share_of_body("wheel.mass")),
    Question("leg_limits", "lowest and highest leg angle, 0 ahead, pi/2 down", "rad", _limits, count=2, positive=False),
    Question("servo.supply_voltage", "supply voltage", "V", _of_base("servo.supply_voltage")),
    Question("servo.leg.stall_torque", "stall torque of a leg servo", "N m", _of_base("servo.leg.stall_torque")),
    Question("servo.leg.no_load_speed", "its speed without load", "rad/s", _of_base("servo.leg.no_load_speed")),
    Question("servo.wheel.stall_torque", "stall torque of a wheel servo", "N m", _of_base("servo.wheel.stall_torque")),
    Question("servo.wheel.no_load_speed", "its speed without load", "rad/s", _of_base("servo.wheel.no_load_speed")),
)
_BY_KEY = {question.key: question for question in QUESTIONS}


def question_of(key: str) -> Question:
    """Return the question about a key; another key is refused with the nearest."""
    check_name("number of a new robot", key, _BY_KEY, "--set")
    return _BY_KEY[key]


def derived_numbers(answers: Mapping[str, Any], base: Robot) -> tuple[dict[str, Any], dict[str, str]]:
    """Return a robot file's numbers, nested, and dotted key -> comment: how each came about.

    Inertias are those of a uniform box, rods and discs. What a data sheet does not say of a servo, and the floor's contact
    springs, are the base's, scaled so that they mean the same for the robot: friction as a share of the torque, the rotor's
    time to reach its speed, gains by the error that asks for the whole supply, sag of the contacts over the radius.

    Args:
        answers: key of every question -> answer.
        base: robot that has all other numbers.
    """
    flat = dict(answers) | _bodies(answers) | _contacts(answers, base)
    for group, motor in (("leg", base.servo.leg), ("wheel", base.servo.wheel)):
        flat |= _servo(answers, f"servo.{group}", motor, base.servo.supply_voltage)
    comments = {key: f"[given] {question.unit}; {question.words}" for key, question in _BY_KEY.items()}
    comments |= {key: _DERIVED[key.replace("servo.leg", "servo.*").replace("servo.wheel", "servo.*")]
                 for key in flat if key not in answers}  # fmt: skip
    order = sorted(flat, key=lambda key: (_ORDER.index(key.partition(".")[0]), key.count(".")))
    return nested({key: flat[key] for key in order}), comments


#: Groups as in the shipped files; the answers come first in each.
_ORDER = ("body", "hip_position", "leg", "wheel", "leg_limits", "servo", "ground")


#: Why a number that nobody gave is what it is.
_DERIVED = {
    "body.inertia": "[derived] uniform box",
    "leg.com_along_leg": "[derived] mid-leg",
    "leg.inertia": "[derived] uniform rod, a tenth of its length thick",
    "wheel.spin_inertia": "[derived] solid disc",
    "wheel.transverse_inertia": "[derived] solid disc of that width",
    "servo.*.armature": "[derived] kg m2; time to reach its speed as of the base: measure it",
    "servo.*.coulomb_friction": "[derived] N m; share of the torque as of the base: measure it",
    "servo.*.viscous_friction": "[derived] N m s/rad; as of the base, beside torque over speed",
    "servo.*.gear_stiffness": "[derived] N m/rad; beside the torque as of the base",
    "servo.*.kp": "[derived] V/rad; the supply for the same error as of the base",
    "servo.*.kd": "[derived] V s/rad; the supply for the same share of the speed as of the base",
    "servo.*.stall_current": "[derived] unknown: that of the base is of another servo",
    "servo.*.no_load_current": "[derived] unknown: that of the base is of another servo",
    "ground.normal_stiffness": "[derived] N/m; sag over the radius as of the base",
    "ground.normal_damping": "[derived] N s/m; damping ratio as of the base",
}


def _bodies(answers: Mapping[str, Any]) -> dict[str, Any]:
    x, y, z = answers["body.size"]
    body, leg, wheel = (answers[f"{name}.mass"] for name in ("body", "leg", "wheel"))
    length, radius, width = answers["leg.length"], answers["wheel.radius"], answers["wheel.width"]
    thickness = 0.1 * length
    across = leg * (length**2 / 12.0 + thickness**2 / 16.0)
    return {
        "body.inertia": [_digits(body / 12.0 * value) for value in (y * y + z * z, x * x + z * z, x * x + y * y)],
        "leg.com_along_leg": _digits(length / 2.0),
        "leg.inertia": [_digits(across), _digits(across), _digits(leg * thickness**2 / 8.0)],
        "wheel.spin_inertia": _digits(wheel * radius**2 / 2.0),
        "wheel.transverse_inertia": _digits(wheel * (3.0 * radius**2 + width**2) / 12.0),
    }


def _servo(answers: Mapping[str, Any], where: str, base: Motor, base_supply: float) -> dict[str, Any]:
    torque = answers[f"{where}.stall_torque"] / base.stall_torque
    speed = answers[f"{where}.no_load_speed"] / base.no_load_speed
    supply = answers["servo.supply_voltage"] / base_supply
    scaled = {
        "armature": base.armature * torque / speed,
        "coulomb_friction": base.coulomb_friction * torque,
        "viscous_friction": base.viscous_friction * torque / speed,
        "gear_stiffness": base.gear_stiffness * torque,
        "kp": base.kp * supply,
        "kd": base.kd * supply / speed,
    }
    if base.stall_current is not None and (torque, speed, supply) != (1.0, 1.0, 1.0):
        scaled |= {"stall_current": None, "no_load_current": None}
    return {f"{where}.{key}": None if value is None else _digits(value) for key, value in scaled.items()}


def _contacts(answers: Mapping[str, Any], base: Robot) -> dict[str, Any]:
    mass = answers["body.mass"] + 4.0 * (answers["leg.mass"] + answers["wheel.mass"])
    heavier = mass / base.total_mass
    stiffer = heavier * base.wheel.radius / answers["wheel.radius"]
    return {
        "ground.normal_stiffness": _digits(base.ground.normal_stiffness * stiffer),
        "ground.normal_damping": _digits(base.ground.normal_damping * math.sqrt(stiffer * heavier)),
    }


def _digits(value: float) -> float:
    return float(f"{value:.5g}")
