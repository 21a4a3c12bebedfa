"""Forces that no effect of the library describes: short formulas on single coordinates, tried beside the named effects.

Each is a sum of terms with one constant per term, so that it vanishes with its constants and its response is linear in them.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from wlr_gym.effects import UNKNOWN_EFFECT, PatchEffect
from wlr_gym.gap.problem import Candidate, Probe, Start, Unknown
from wlr_gym.robot import LEGS, WHEELS

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Term:
    """One constant of a formula: its name, unit, the size it is probed with, and its plausible range (either sign)."""

    name: str
    unit: str
    probe: float
    bound: float


@dataclass(frozen=True)
class Law:
    """A formula and where it may act."""

    formula: str
    terms: tuple[Term, ...]
    where: tuple[str, ...]


def _other(name: str) -> str:
    """The same joint on the other side."""
    return name[:-2] + {"l": "r", "r": "l"}[name[-2]] + name[-1]


_LAWS: tuple[Law, ...] = (
    *(Law("c - k * angle", (Term("c", "N m", 0.1, 3.0), Term("k", "N m/rad", 0.2, 5.0)), (leg,)) for leg in LEGS),
    *(Law("a * cos(angle) + b * sin(angle)", (Term("a", "N m", 0.1, 3.0), Term("b", "N m", 0.1, 3.0)), (leg,)) for leg in LEGS),
    *(Law("-d * rate * abs(rate)", (Term("d", "N m s2/rad2", 0.1, 3.0),), (leg,)) for leg in LEGS),
    *(Law("c", (Term("c", "N m", 0.02, 0.5),), (wheel,)) for wheel in WHEELS),
    *(Law("-d * rate * abs(rate)", (Term("d", "N m s2/rad2", 0.002, 0.1),), (wheel,)) for wheel in WHEELS),
    *(Law(f"-k * leg_rate_{_other(leg)[4:]}", (Term("k", "N m s/rad", 0.05, 3.0),), (leg,)) for leg in LEGS),
    *(Law(f"-k * wheel_rate_{_other(wheel)[6:]}", (Term("k", "N m s/rad", 0.004, 0.2),), (wheel,)) for wheel in WHEELS),
    Law("-d * velocity_x", (Term("d", "N s/m", 2.0, 50.0),), ("body_force_x",)),
    Law("-d * velocity_x * abs(velocity_x)", (Term("d", "N s2/m2", 10.0, 200.0),), ("body_force_x",)),
    Law("-d * velocity_y", (Term("d", "N s/m", 4.0, 100.0),), ("body_force_y",)),
    Law("-d * yaw_rate", (Term("d", "N m s/rad", 0.2, 5.0),), ("body_torque_yaw",)),
    Law("-d * yaw_rate * abs(yaw_rate)", (Term("d", "N m s2/rad2", 0.4, 10.0),), ("body_torque_yaw",)),
)


def formula_candidates() -> tuple[list[Probe], list[Candidate]]:
    """Return probes and candidates of all formulas."""
    probes, candidates = [], []
    for law in _LAWS:
        units = {term.name: term.unit for term in law.terms}
        keys = []
        for term in law.terms:
            values = {other.name: term.probe * (other is term) for other in law.terms}
            effect = PatchEffect(UNKNOWN_EFFECT, law.where, values, law.formula, units)
            keys.append(" ".join([UNKNOWN_EFFECT, *law.where, law.formula, term.name]))
            probes.append(Probe(keys[-1], (effect,)))
        unknowns = tuple(Unknown(t.name, t.unit, 0.0, -t.bound, t.bound, 0.5 * t.probe) for t in law.terms)
        start = Start(tuple((key,) for key in keys), _values([term.probe for term in law.terms]))
        candidates.append(Candidate(UNKNOWN_EFFECT, law.where, unknowns, (start,), law.formula, units))
    return probes, candidates


def _values(sizes: Sequence[float]) -> Callable[[Array], tuple[float, ...]]:
    return lambda amplitude: tuple(float(size * a) for size, a in zip(sizes, amplitude, strict=True))
