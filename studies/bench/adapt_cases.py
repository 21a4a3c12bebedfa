"""Cases of ``python -m studies.bench adapt``, fixed beforehand: faults on two copies of the robot each.

Named faults are as large as the library holds for plausible: smaller ones cost the shipped policy nothing that two dozen
episodes would show. Laws that no library names are drawn by the blind test, which shares no code with what names effects, and
written here as formulas. What acts in the emulated robot is the library's own implementation, on another simulator and at
another step than the training's: analyser and fault share the law of every named effect. ``shared`` says so, case by case.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from studies.bench.blind.cases import strange
from wlr_gym.base.errors import unknown_name
from wlr_gym.envs.tasks.randomization import load_randomization
from wlr_gym.robot import JOINTS, WHEELS, Robot
from wlr_gym.robot.parameters import Parameters

LEFT = ("wheel_lf", "wheel_lr")
#: Effect -> where, parameters, and for six of them the parameters of the second severity.
NAMED: Mapping[str, tuple[tuple[str, ...], Mapping[str, float], Mapping[str, float] | None]] = {
    "joint_zero_offset": (("leg_rr",), {"angle": -0.1}, {"angle": -0.05}),
    "friction_asymmetry": (LEFT, {"mu": 0.12}, {"mu": 0.25}),
    "gyro_bias": (("sensor",), {"z": 0.05}, {"z": 0.02}),
    "weak_motor": (LEFT, {"scale": 0.4}, {"scale": 0.65}),
    "command_delay": (JOINTS, {"delay": 0.06}, {"delay": 0.04}),
    "wheel_radius_error": (LEFT, {"scale": 0.91}, {"scale": 0.96}),
    "external_force": (("body",), {"fx": -3.0, "fy": 2.0}, None),
    "tyre_creep": (WHEELS, {"creep_speed": 0.2}, None),
    "payload": (("body",), {"mass": 1.5, "x": -0.12, "y": 0.1, "z": 0.08}, None),
    "backlash": (WHEELS, {"angle": 0.09}, None),
    "com_offset": (("body",), {"x": -0.045, "y": 0.04, "z": 0.0}, None),
    "coulomb_friction": (LEFT, {"torque": 0.3}, None),
}
PAIRS = (("joint_zero_offset", "command_delay"), ("friction_asymmetry", "gyro_bias"))
#: Severity of the blind test at which its laws are drawn.
STRANGE_SEVERITY = 6.0
#: Laws outside the library: coordinate and formula; ``None`` = the leg at which the law is drawn.
OUTSIDE: Mapping[str, tuple[str | None, str, Mapping[str, str]]] = {
    "leg_spring": (None, "-stiffness * (leg_angle - rest)", {"stiffness": "N m/rad", "rest": "rad"}),
    "body_drag": ("body_force_x", "-coefficient * velocity_x * abs(velocity_x)", {"coefficient": "N s2/m2"}),
    "veer": ("body_force_y", "coefficient * velocity_x", {"coefficient": "N s/m"}),
}
COPIES = 2
#: Of the copies: tolerances of the robot's file, and a floor as it is known.
COPY = {"name": "a copy", "base": "nominal", "events": {"floor_friction": {"low": 0.5, "high": 0.7}}}


@dataclass(frozen=True)
class AdaptCase:
    """One robot with a fault.

    Attributes:
        name: of the case. kind: ``named``, ``second`` (severity), ``pair`` or ``outside``.
        effects: what is hidden, as a patch says it.
        copy: number of the copy. shared: the law that acts is the one that the analyser tries.
    """

    name: str
    kind: str
    effects: tuple[Mapping[str, Any], ...]
    copy: int
    shared: bool

    def parameters(self, robot: Robot) -> Parameters:
        """Return the parameters of the copy, without the fault."""
        seeds = np.array([5000 + self.copy], np.uint64)
        return load_randomization(COPY, robot).parameters(seeds, seeds)


def cases() -> tuple[AdaptCase, ...]:
    """Return all cases: copy by copy, so that a part of them is a sample of all."""
    faults = [("named", name, (_named(name),)) for name in NAMED]
    faults += [("pair", "+".join(both), tuple(_named(name, second=True) for name in both)) for both in PAIRS]
    faults += [("outside", name, (_outside(name),)) for name in OUTSIDE]
    faults += [("second", f"{name}_2", (_named(name, second=True),)) for name in NAMED if NAMED[name][2] is not None]
    return tuple(
        AdaptCase(f"{title}_copy{copy}", kind, effects, copy, kind != "outside")
        for copy in range(COPIES)
        for kind, title, effects in faults
    )


def chosen_cases(names: tuple[str, ...]) -> tuple[AdaptCase, ...]:
    """Return the cases of these names, or the first so many of one number; all without names.

    Raises:
        InputError: an unknown name.
    """
    there = {one.name: one for one in cases()}
    if not names:
        return tuple(there.values())
    if len(names) == 1 and names[0].isdigit():
        return tuple(there.values())[: int(names[0])]
    for name in names:
        if name not in there:
            raise unknown_name("case", name, there)
    return tuple(there[name] for name in names)


def _named(name: str, second: bool = False) -> Mapping[str, Any]:
    where, first, other = NAMED[name]
    return {"name": name, "where": list(where), "parameters": dict(other if second and other else first)}


def _outside(name: str) -> Mapping[str, Any]:
    drawn = strange(name, STRANGE_SEVERITY, np.random.default_rng([27, list(OUTSIDE).index(name)]))
    where, formula, units = OUTSIDE[name]
    return {
        "name": "unknown_effect",
        "where": [where] if where is not None else drawn["where"],
        "formula": formula,
        "parameters": dict(drawn["parameters"]),
        "units": dict(units),
    }
