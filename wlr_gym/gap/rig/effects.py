"""The effects that may act in the rig, one entry each: law, parameters, and where the search for it starts."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from wlr_gym.physics.effects.effect import Change, EffectParameter, Guess, one_step
from wlr_gym.physics.effects.library import EFFECTS

Numbers = dict[str, float]
Apply = Callable[[Numbers, Mapping[str, float]], None]

#: N m; a limit that no torque reaches.
NO_TORQUE_LIMIT = 10.0


def _add(target: str, parameter: str) -> Apply:
    def apply(numbers: Numbers, values: Mapping[str, float]) -> None:
        numbers[target] += values[parameter]

    return apply


def _multiply(target: str, parameter: str) -> Apply:
    def apply(numbers: Numbers, values: Mapping[str, float]) -> None:
        numbers[target] *= values[parameter]

    return apply


def _put(**targets: str) -> Apply:
    def apply(numbers: Numbers, values: Mapping[str, float]) -> None:
        numbers.update({target: values[parameter] for target, parameter in targets.items()})

    return apply


@dataclass(frozen=True)
class RigEffect:
    """An effect as the rig knows it.

    Attributes:
        doc: what is missing without it, and its law.
        parameters: as in the effect library, ``prior`` being the plausible range.
        apply: writes it into the numbers of a model.
        guesses: ways to a first guess; several where its response is not linear.
        refines: effect that must be in the model before this one is looked for; empty = none.
        least: below these values of its parameters it is another effect.
    """

    doc: str
    parameters: Mapping[str, EffectParameter]
    apply: Apply
    guesses: tuple[Guess, ...]
    refines: str = ""
    least: Mapping[str, float] = field(default_factory=dict)


def _library(name: str, apply: Apply, guesses: tuple[Guess, ...], **more: Any) -> RigEffect:
    return RigEffect(EFFECTS[name].doc, EFFECTS[name].parameters, apply, guesses, **more)


def _steps(parameter: str, *sizes: float, neutral: float = 0.0) -> tuple[Guess, ...]:
    return tuple(one_step(parameter, size, neutral) for size in sizes)


def _limit(torque: float) -> Guess:
    """A limit grows as less of its response is wanted."""
    return Guess(((Change({"torque": torque}),),), lambda a: (min(torque / max(float(a[0]), 1e-3), NO_TORQUE_LIMIT),))


def _stribeck(speed: float, torque: float = 0.02) -> Guess:
    change = Change({"extra_static_torque": torque, "stribeck_speed": speed})
    return Guess(((change,),), lambda a: (torque * float(a[0]), speed))


def _ripple(order: float, amplitude: float = 0.02) -> Guess:
    """A sine and a cosine."""
    phases = (0.0, 0.5 * math.pi)
    return Guess(
        tuple((Change({"amplitude": amplitude, "order": order, "phase": phase}),) for phase in phases),
        lambda a: (amplitude * float(np.hypot(a[0], a[1])), order, float(np.arctan2(a[1], a[0]))),
    )


#: Slower than this, a ripple does not repeat within the swing and is an error of the load or of its zero.
_LEAST_ORDER = 6.0
#: Effects by name. Those of the library have its law and parameters; the others are the rig's own. Of equally good ones the
#: first is selected.
RIG_EFFECTS: dict[str, RigEffect] = {
    "coulomb_friction": _library("coulomb_friction", _add("coulomb_friction", "torque"), _steps("torque", 0.03)),
    "viscous_friction": _library("viscous_friction", _add("viscous_friction", "coefficient"), _steps("coefficient", 0.005)),
    "load_dependent_friction": _library("load_dependent_friction", _add("load_friction", "ratio"), _steps("ratio", 0.1, 0.3)),
    "backlash": _library("backlash", _add("play", "angle"), _steps("angle", 0.01, 0.03, 0.06)),
    "weak_motor": _library("weak_motor", _multiply("torque_scale", "scale"), _steps("scale", -0.1, neutral=1.0)),
    "command_delay": _library("command_delay", _add("delay", "delay"), _steps("delay", 0.01, 0.03)),
    "torque_saturation": RigEffect(
        "torque falls behind the current: K I / (1 + coefficient |I|)",
        {"coefficient": EffectParameter("1/A", "loss per current", 0, 10, 0.0, (0, 2), 0.3)},
        _add("saturation", "coefficient"),
        _steps("coefficient", 0.2, 0.6),
    ),
    "quadratic_load_friction": RigEffect(
        "gear friction growing with the square of the motor torque: -coefficient torque^2 sign(rate)",
        {"coefficient": EffectParameter("1/(N m)", "friction per torque squared", 0, 20, 0.0, (0, 2), 0.3)},
        _add("quadratic_friction", "coefficient"),
        _steps("coefficient", 0.2),
        refines="load_dependent_friction",  # the next term in the load
    ),
    "warm_winding": RigEffect(
        "resistance grows with the temperature the servo reports: R (1 + coefficient (T - 25 deg C)); copper: 0.0039/K",
        {"coefficient": EffectParameter("1/K", "relative, per degree", -0.01, 1, 0.0, (0, 0.0045), 0.0039)},
        _add("thermal", "coefficient"),
        _steps("coefficient", 0.0039),
    ),
    "torque_limit": RigEffect(
        "motor torque stays below a limit: |motor torque| <= torque; the data sheet's stall torque is reached, within 15 %",
        {"torque": EffectParameter("N m", "the limit", 0.01, NO_TORQUE_LIMIT, NO_TORQUE_LIMIT, (0.45, NO_TORQUE_LIMIT), 0.6)},
        _put(torque_limit="torque"),
        tuple(_limit(torque) for torque in (0.5, 0.6, 0.75)),
    ),
    "stribeck_friction": _library(
        "stribeck_friction",
        _put(stribeck_torque="extra_static_torque", stribeck_speed="stribeck_speed"),
        tuple(_stribeck(speed) for speed in (0.05, 0.2, 0.8)),
        refines="coulomb_friction",  # more of it at rest than in motion
    ),
    "torque_ripple": _library(
        "torque_ripple",
        _put(ripple_amplitude="amplitude", ripple_order="order", ripple_phase="phase"),
        tuple(_ripple(float(order)) for order in (6, 8, 12, 16, 24, 32, 48, 64)),
        least={"order": _LEAST_ORDER},
    ),
}
