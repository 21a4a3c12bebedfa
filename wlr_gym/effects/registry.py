"""Named effects: what each one does to the parameter table. One entry per effect.

Names, parameters and ``where`` are the fixed vocabulary of the project (``docs/run_format.md`` lists what is available).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from wlr_gym.errors import InputError
from wlr_gym.parameters import Parameters
from wlr_gym.robot import JOINTS, LEGS, WHEELS

Values = Mapping[str, float]
Apply = Callable[[Parameters, Sequence[str], Values], None]


@dataclass(frozen=True)
class EffectParameter:
    """One number of an effect: unit, bounds, and the value it has when it is left out (None = it must be given)."""

    unit: str
    low: float
    high: float
    default: float | None = None


@dataclass(frozen=True)
class Effect:
    """One effect of the library.

    Attributes:
        name: as in a patch file.
        doc: what is missing in the nominal model.
        parameters: its numbers by name.
        where: every place it can act on.
        apply: writes it into a batch of parameters, in place.
    """

    name: str
    doc: str
    parameters: Mapping[str, EffectParameter]
    where: tuple[str, ...]
    apply: Apply


def _add(target: str, parameter: str) -> Apply:
    """Add the effect's parameter to ``target`` of the named joints or wheels."""

    def apply(parameters: Parameters, where: Sequence[str], values: Values) -> None:
        for place in where:
            parameters[f"{target}[{place}]"] += values[parameter]

    return apply


def _add_vector(target: str, names: Sequence[str]) -> Apply:
    """Add the effect's parameters ``names`` to the elements of ``target``."""

    def apply(parameters: Parameters, where: Sequence[str], values: Values) -> None:
        parameters[target] += np.array([values[name] for name in names])

    return apply


def _set_friction(parameters: Parameters, where: Sequence[str], values: Values) -> None:
    for wheel in WHEELS if "ground" in where else where:
        parameters[f"ground.mu_x[{wheel}]"] = values["mu"]
        parameters[f"ground.mu_y[{wheel}]"] = values["mu"]


def _set_anisotropy(parameters: Parameters, where: Sequence[str], values: Values) -> None:
    parameters["ground.mu_y"] = values["ratio"] * parameters["ground.mu_x"]


def _scale_radius(parameters: Parameters, where: Sequence[str], values: Values) -> None:
    for wheel in where:
        parameters[f"wheel.radius[{wheel}]"] *= values["scale"]


def _add_payload(parameters: Parameters, where: Sequence[str], values: Values) -> None:
    if parameters["payload.mass"].any():
        raise InputError("the model holds one payload, and the robot carries one already")
    parameters["payload.mass"] = values["mass"]
    parameters["payload.position"] = [values[axis] for axis in "xyz"]


def _add_camera_delay(parameters: Parameters, where: Sequence[str], values: Values) -> None:
    parameters["camera.delay"] += values["delay"]


def _turn_camera(parameters: Parameters, where: Sequence[str], values: Values) -> None:
    if values["scale"] != 1.0:
        raise InputError(f"scale = {values['scale']:g}: only yaw acts on a parameter of the simulators; leave scale at 1")
    parameters["camera.mount_yaw"] += values["yaw"]


def _xyz(unit: str, bound: float) -> dict[str, EffectParameter]:
    return {axis: EffectParameter(unit, -bound, bound, 0.0) for axis in "xyz"}


_ALL = (
    Effect(
        "coulomb_friction",
        "dry friction in a joint on top of its own",
        {"torque": EffectParameter("N m", 0, 50)},
        JOINTS,
        _add("servo.coulomb_friction", "torque"),
    ),
    Effect(
        "viscous_friction",
        "friction proportional to speed, beyond back-EMF, on top of the joint's own",
        {"coefficient": EffectParameter("N m s/rad", 0, 10)},
        JOINTS,
        _add("servo.viscous_friction", "coefficient"),
    ),
    Effect(
        "command_delay",
        "goals act later than written, on top of the robot's own delay",
        {"delay": EffectParameter("s", 0, 0.2)},
        JOINTS,
        _add("command.delay", "delay"),
    ),
    Effect(
        "joint_zero_offset",
        "encoder reading = true angle + angle",
        {"angle": EffectParameter("rad", -0.5, 0.5)},
        LEGS,
        _add("joint.zero_offset", "angle"),
    ),
    Effect(
        "friction_level",
        "friction coefficient of the floor, all wheels",
        {"mu": EffectParameter("-", 0, 5)},
        ("ground",),
        _set_friction,
    ),
    Effect(
        "friction_asymmetry",
        "friction coefficient of the named wheels; the others keep theirs",
        {"mu": EffectParameter("-", 0, 5)},
        WHEELS,
        _set_friction,
    ),
    Effect(
        "friction_anisotropy",
        "ratio mu_y/mu_x of lateral to longitudinal friction",
        {"ratio": EffectParameter("-", 0, 5)},
        ("ground",),
        _set_anisotropy,
    ),
    Effect(
        "rolling_resistance",
        "torque c N a opposing the wheel's spin over the floor",
        {"coefficient": EffectParameter("-", 0, 1)},
        WHEELS,
        _add("ground.rolling_resistance", "coefficient"),
    ),
    Effect(
        "wheel_radius_error", "factor on the wheel's radius", {"scale": EffectParameter("-", 0.5, 2)}, WHEELS, _scale_radius
    ),
    Effect(
        "payload",
        "point-like mass fixed to the body",
        {"mass": EffectParameter("kg", 0, 20), **_xyz("m", 0.5)},
        ("body",),
        _add_payload,
    ),
    Effect(
        "com_offset",
        "body's centre of mass displaced; IMU and marker stay",
        _xyz("m", 0.2),
        ("body",),
        _add_vector("body.com_offset", "xyz"),
    ),
    Effect(
        "floor_slope",
        "floor inclined; positive = uphill along floor x (pitch) and y (roll)",
        {"pitch": EffectParameter("rad", -1.2, 1.2, 0.0), "roll": EffectParameter("rad", -1.2, 1.2, 0.0)},
        ("ground",),
        _add_vector("ground.slope", ("pitch", "roll")),
    ),
    Effect(
        "external_force",
        "constant force on the body in the floor frame",
        {"fx": EffectParameter("N", -1e3, 1e3, 0.0), "fy": EffectParameter("N", -1e3, 1e3, 0.0)},
        ("body",),
        _add_vector("external_force", ("fx", "fy")),
    ),
    Effect(
        "gyro_bias",
        "constant rate offset beyond specification",
        _xyz("rad/s", 1.0),
        ("sensor",),
        _add_vector("imu.gyro_bias", "xyz"),
    ),
    Effect(
        "camera_delay",
        "vision pose older than its row",
        {"delay": EffectParameter("s", 0, 0.5)},
        ("sensor",),
        _add_camera_delay,
    ),
    Effect(
        "camera_misalignment",
        "camera's floor frame turned by +yaw against the start heading",
        {"yaw": EffectParameter("rad", -0.5, 0.5, 0.0), "scale": EffectParameter("-", 0.1, 10, 1.0)},
        ("sensor",),
        _turn_camera,
    ),
)

#: The effects this version can apply, by name.
EFFECTS: dict[str, Effect] = {effect.name: effect for effect in _ALL}

#: Names of the vocabulary whose effect takes more than a value of the parameter table.
BEYOND_PARAMETERS = (
    "stribeck_friction",
    "load_dependent_friction",
    "backlash",
    "torque_ripple",
    "weak_motor",
    "supply_sag",
    "friction_patch",
    "slip_weakening",
    "tyre_creep",
    "tether",
    "imu_misalignment",
    "unknown_effect",
)

#: What is applied first: levels of the whole floor, then of single wheels, then ratios and scales. All others add, last.
STAGES = (("friction_level",), ("friction_asymmetry",), ("friction_anisotropy", "wheel_radius_error"))


def stage(name: str) -> int:
    """Return the place of an effect in the order of application."""
    return next((place for place, names in enumerate(STAGES) if name in names), len(STAGES))
