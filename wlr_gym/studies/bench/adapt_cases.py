"""Cases of ``wlr bench adapt``, fixed beforehand: faults of the blind test's tables, on two copies of the robot each.

Places, signs and sizes are those of the blind test, which shares no code with what names them; so are the three laws that no
library names, written here as formulas. What acts in the emulated robot is the library's own implementation of each effect, on
another simulator and at another step than the training's: analyser and fault share the law. ``shared`` says so, case by case.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from wlr_gym.base.errors import unknown_name
from wlr_gym.envs.tasks.randomization import load_randomization
from wlr_gym.robot import Robot
from wlr_gym.robot.parameters import Parameters
from wlr_gym.studies.bench.blind.cases import named, strange

#: Named effects: what cost the shipped policy most in a sweep of the library on the emulated robot, and others that did not.
NAMED = (
    "joint_zero_offset", "friction_asymmetry", "gyro_bias", "weak_motor", "command_delay", "wheel_radius_error",
    "external_force", "tyre_creep", "payload", "backlash", "com_offset", "coulomb_friction",
)  # fmt: skip
#: Severities of the blind test: all at the first, the first six at the second, too.
SEVERITIES = (4.0, 2.0)
SECOND = NAMED[:6]
PAIRS = (("joint_zero_offset", "command_delay"), ("friction_asymmetry", "gyro_bias"))
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
        name: of the case. kind: ``named``, ``pair`` or ``outside``. severity: of the blind test.
        effects: what is hidden, as a patch says it.
        copy: number of the copy. shared: the law that acts is the one that the analyser tries.
    """

    name: str
    kind: str
    severity: float
    effects: tuple[Mapping[str, Any], ...]
    copy: int
    shared: bool

    def parameters(self, robot: Robot) -> Parameters:
        """Return the parameters of the copy, without the fault."""
        seeds = np.array([5000 + self.copy], np.uint64)
        return load_randomization(COPY, robot).parameters(seeds, seeds)


def cases() -> tuple[AdaptCase, ...]:
    """Return all cases: copy by copy, so that a part of them is a sample of all."""
    faults = [("named", name, SEVERITIES[0], (name,)) for name in NAMED]
    faults += [("pair", " + ".join(both), 2.0, both) for both in PAIRS]
    faults += [("outside", name, SEVERITIES[0], (name,)) for name in OUTSIDE]
    faults += [("named", name, SEVERITIES[1], (name,)) for name in SECOND]
    return tuple(
        AdaptCase(
            f"{title.replace(' + ', '+')}_{severity:g}_{copy}",
            kind,
            severity,
            tuple(_effect(kind, name, severity, number) for name in names),
            copy,
            kind != "outside",
        )
        for copy in range(COPIES)
        for number, (kind, title, severity, names) in enumerate(faults)
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


def _effect(kind: str, name: str, severity: float, number: int) -> Mapping[str, Any]:
    draw = np.random.default_rng([27, number])
    if kind != "outside":
        return named(name, severity, draw)
    drawn, (where, formula, units) = strange(name, severity, draw), OUTSIDE[name]
    place = [where] if where is not None else drawn["where"]
    return {
        "name": "unknown_effect",
        "where": place,
        "formula": formula,
        "parameters": dict(drawn["parameters"]),
        "units": dict(units),
    }
