"""What a data set hides, as numbers for the simulator: effects of the vocabulary, and strange laws that are in no library."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from studies.bench.blind.copies import JOINTS, LEGS, WHEELS, Copy

Array = NDArray[np.float64]


@dataclass
class Hidden:
    """Numbers of every law, neutral at first. SI units; joints in the order of ``JOINTS``, wheels and legs lf, rf, lr, rr."""

    coulomb: Array = field(default_factory=lambda: np.zeros(8))
    viscous: Array = field(default_factory=lambda: np.zeros(8))
    stick_extra: Array = field(default_factory=lambda: np.zeros(8))
    stick_speed: Array = field(default_factory=lambda: np.ones(8))
    load_ratio: Array = field(default_factory=lambda: np.zeros(8))
    play: Array = field(default_factory=lambda: np.zeros(8))
    ripple: Array = field(default_factory=lambda: np.zeros((3, 8)))  # amplitude, order, phase
    motor_scale: Array = field(default_factory=lambda: np.ones(8))
    supply_resistance: float = 0.0
    delay: Array = field(default_factory=lambda: np.zeros(8))
    zero: Array = field(default_factory=lambda: np.zeros(4))
    wheel_mu: Array = field(default_factory=lambda: np.full(4, np.nan))  # instead of the floor's own
    mu_ratio: float = 1.0
    patch: Array = field(default_factory=lambda: np.array([np.nan, 0.0, 0.0, 0.0, 0.0]))  # mu, x and y limits
    weak_slip: Array = field(default_factory=lambda: np.array([np.nan, 1.0]))  # mu_k, speed
    creep_speed: Array = field(default_factory=lambda: np.zeros(4))
    rolling: Array = field(default_factory=lambda: np.zeros(4))
    radius_scale: Array = field(default_factory=lambda: np.ones(4))
    payload: Array = field(default_factory=lambda: np.zeros(4))  # kg, x, y, z
    com: Array = field(default_factory=lambda: np.zeros(3))
    slope: Array = field(default_factory=lambda: np.zeros(2))
    force: Array = field(default_factory=lambda: np.zeros(2))
    tether: Array = field(default_factory=lambda: np.zeros(3))  # N/m, x, y
    gyro_bias: Array = field(default_factory=lambda: np.zeros(3))
    imu: Array = field(default_factory=lambda: np.zeros(3))  # roll, pitch, yaw
    camera_yaw: float = 0.0
    camera_scale: float = 1.0
    camera_delay: float = 0.0
    # laws that no library names
    leg_spring: Array = field(default_factory=lambda: np.zeros((2, 4)))  # N m/rad, rest angle
    drag: float = 0.0  # N s2/m2 along the body's x
    cross_ratio: Array = field(default_factory=lambda: np.zeros(2))  # front and rear axle
    pull: Array = field(default_factory=lambda: np.zeros(3))  # N along the floor's x, Hz, phase
    out_of_round: Array = field(default_factory=lambda: np.zeros(4))  # share of the radius
    elastic: Array = field(default_factory=lambda: np.zeros((2, 4)))  # Dahl hysteresis in the legs: N m, N m/rad
    veer: float = 0.0  # N s/m: sideways force per forward speed


def _each(joints: Sequence[str], names: Sequence[str]) -> list[int]:
    return [names.index(joint) for joint in joints]


Numbers = Mapping[str, float]
Law = Callable[[Hidden, list[str], Numbers, Copy], None]


def _at(field_name: str, parameter: str, names: Sequence[str] = JOINTS, *, add: bool = True) -> Law:
    """Write one parameter into the places' elements of a field."""

    def write(hidden: Hidden, where: list[str], numbers: Numbers, copy: Copy) -> None:
        values = getattr(hidden, field_name)
        places = _each(where, names)
        values[places] = numbers[parameter] + (values[places] if add else 0.0)

    return write


def _times(field_name: str, parameter: str, names: Sequence[str]) -> Law:
    def write(hidden: Hidden, where: list[str], numbers: Numbers, copy: Copy) -> None:
        getattr(hidden, field_name)[_each(where, names)] *= numbers[parameter]

    return write


def _vector(field_name: str, *parameters: str) -> Law:
    def write(hidden: Hidden, where: list[str], numbers: Numbers, copy: Copy) -> None:
        setattr(hidden, field_name, np.array([numbers.get(name, 0.0) for name in parameters]))

    return write


def _scalar(field_name: str, parameter: str) -> Law:
    return lambda hidden, where, numbers, copy: setattr(hidden, field_name, float(numbers[parameter]))


def _stribeck(hidden: Hidden, where: list[str], numbers: Numbers, copy: Copy) -> None:
    places = _each(where, JOINTS)
    hidden.stick_extra[places] = numbers["extra_static_torque"]
    hidden.stick_speed[places] = numbers["stribeck_speed"]


def _ripple(hidden: Hidden, where: list[str], numbers: Numbers, copy: Copy) -> None:
    for place in _each(where, JOINTS):
        hidden.ripple[:, place] = numbers["amplitude"], numbers["order"], numbers.get("phase", 0.0)


def _level(hidden: Hidden, where: list[str], numbers: Numbers, copy: Copy) -> None:
    hidden.wheel_mu[:] = numbers["mu"]


def _patch(hidden: Hidden, where: list[str], numbers: Numbers, copy: Copy) -> None:
    far = 1e6
    hidden.patch = np.array(
        [numbers["mu"], numbers["x_min"], numbers["x_max"], numbers.get("y_min", -far), numbers.get("y_max", far)]
    )


def _camera(hidden: Hidden, where: list[str], numbers: Numbers, copy: Copy) -> None:
    hidden.camera_yaw, hidden.camera_scale = numbers.get("yaw", 0.0), numbers.get("scale", 1.0)


def _pair(field_name: str, first: str, second: str) -> Law:
    def write(hidden: Hidden, where: list[str], numbers: Numbers, copy: Copy) -> None:
        getattr(hidden, field_name)[:, _each(where, LEGS)] = np.array([[numbers[first]], [numbers[second]]])

    return write


def _cross(hidden: Hidden, where: list[str], numbers: Numbers, copy: Copy) -> None:
    for axle in range(2):
        if WHEELS[2 * axle] in where:
            hidden.cross_ratio[axle] = numbers["ratio"]


#: Effects of the vocabulary.
NAMED: Mapping[str, Law] = {
    "coulomb_friction": _at("coulomb", "torque"),
    "viscous_friction": _at("viscous", "coefficient"),
    "stribeck_friction": _stribeck,
    "load_dependent_friction": _at("load_ratio", "ratio"),
    "backlash": _at("play", "angle"),
    "torque_ripple": _ripple,
    "weak_motor": _times("motor_scale", "scale", JOINTS),
    "supply_sag": _scalar("supply_resistance", "resistance"),
    "command_delay": _at("delay", "delay"),
    "joint_zero_offset": _at("zero", "angle", LEGS),
    "friction_level": _level,
    "friction_asymmetry": _at("wheel_mu", "mu", WHEELS, add=False),
    "friction_anisotropy": _scalar("mu_ratio", "ratio"),
    "friction_patch": _patch,
    "slip_weakening": _vector("weak_slip", "mu_k", "slip_speed"),
    "tyre_creep": _at("creep_speed", "creep_speed", WHEELS, add=False),
    "rolling_resistance": _at("rolling", "coefficient", WHEELS),
    "wheel_radius_error": _times("radius_scale", "scale", WHEELS),
    "payload": _vector("payload", "mass", "x", "y", "z"),
    "com_offset": _vector("com", "x", "y", "z"),
    "floor_slope": _vector("slope", "pitch", "roll"),
    "external_force": _vector("force", "fx", "fy"),
    "tether": _vector("tether", "stiffness", "x", "y"),
    "gyro_bias": _vector("gyro_bias", "x", "y", "z"),
    "imu_misalignment": _vector("imu", "roll", "pitch", "yaw"),
    "camera_misalignment": _camera,
    "camera_delay": _scalar("camera_delay", "delay"),
}
#: Laws that no library names, and the coordinate each acts on.
STRANGE: Mapping[str, Law] = {
    "leg_spring": _pair("leg_spring", "stiffness", "rest"),
    "body_drag": _scalar("drag", "coefficient"),
    "cross_friction": _cross,
    "periodic_pull": _vector("pull", "amplitude", "frequency", "phase"),
    "out_of_round": _at("out_of_round", "share", WHEELS),
    "elastic_hysteresis": _pair("elastic", "torque", "stiffness"),
    "veer": _scalar("veer", "coefficient"),
}


def hide(effects: Sequence[Mapping[str, Any]], copy: Copy) -> Hidden:
    """Translate effects, ``{name, where, parameters}``, into the numbers of their laws.

    Raises:
        KeyError: a name that is in neither table.
    """
    hidden = Hidden()
    for effect in sorted(effects, key=lambda one: one["name"] != "friction_level"):  # a level is below what single wheels have
        law = NAMED.get(effect["name"]) or STRANGE[effect["name"]]
        law(hidden, list(effect["where"]), effect["parameters"], copy)
    return hidden
