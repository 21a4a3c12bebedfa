"""What may be missing on the rig, and where the search for each starts."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from wlr_gym.gap.problem import Candidate, Probe, Start, Unknown
from wlr_gym.gap.rig.model import JOINT, NO_TORQUE_LIMIT, RIG_EFFECTS, unknowns
from wlr_gym.physics.effects.effect import PatchEffect

Array = NDArray[np.float64]

#: Effect -> parameter, neutral value, sizes at which it is probed. Those without a slope at neutral need several.
_ONE_NUMBER: dict[str, tuple[str, float, tuple[float, ...]]] = {
    "coulomb_friction": ("torque", 0.0, (0.03,)),
    "viscous_friction": ("coefficient", 0.0, (0.005,)),
    "load_dependent_friction": ("ratio", 0.0, (0.1, 0.3)),
    "backlash": ("angle", 0.0, (0.01, 0.03, 0.06)),
    "weak_motor": ("scale", 1.0, (-0.1,)),
    "command_delay": ("delay", 0.0, (0.01, 0.03)),
    "torque_saturation": ("coefficient", 0.0, (0.2, 0.6)),
    "quadratic_load_friction": ("coefficient", 0.0, (0.2,)),
    "warm_winding": ("coefficient", 0.0, (0.0039,)),
}
_TORQUE_LIMITS = (0.5, 0.6, 0.75)
_STRIBECK_SPEEDS = (0.05, 0.2, 0.8)
_STRIBECK_TORQUE = 0.02
#: Slower than this, a ripple does not repeat within the swing and is an error of the load or of its zero.
_LEAST_ORDER = 6.0
_RIPPLE_ORDERS = (6, 8, 12, 16, 24, 32, 48, 64)
_RIPPLE_AMPLITUDE = 0.02
#: Effect -> what it refines: the next term in the load; more dry friction at rest than in motion.
_REFINES = {"quadratic_load_friction": "load_dependent_friction", "stribeck_friction": "coulomb_friction"}


def rig_candidates(present: Collection[str]) -> tuple[list[Probe], list[Candidate]]:
    """Return probes and candidates, but for effects that are ``present`` already.

    What refines another effect is offered once that is there (:data:`_REFINES`).
    """
    probes: list[Probe] = []

    def probe(name: str, note: str, **parameters: float) -> str:
        key = f"{name} {note}"
        probes.append(Probe(key, (PatchEffect(name, (JOINT,), parameters),)))
        return key

    starts = {
        **{
            name: [_one(probe(name, f"{s:g}", **{p: n + s}), s, n) for s in sizes]
            for name, (p, n, sizes) in _ONE_NUMBER.items()
        },
        "torque_limit": [Start(((probe("torque_limit", f"{t:g}", torque=t),),), _limit(t)) for t in _TORQUE_LIMITS],
        "stribeck_friction": [
            Start(
                ((probe("stribeck_friction", f"{s:g}", extra_static_torque=_STRIBECK_TORQUE, stribeck_speed=s),),), _stribeck(s)
            )
            for s in _STRIBECK_SPEEDS
        ],
        "torque_ripple": [
            Start(
                tuple(
                    (probe("torque_ripple", f"{n} {p:.2f}", amplitude=_RIPPLE_AMPLITUDE, order=float(n), phase=p),)
                    for p in (0.0, 0.5 * math.pi)
                ),
                _ripple(float(n)),
            )
            for n in _RIPPLE_ORDERS
        ],
    }
    assert set(starts) == set(RIG_EFFECTS)
    offered = {name for name in starts if name not in present and _REFINES.get(name, name) in (name, *present)}
    candidates = [Candidate(n, (JOINT,), _unknowns(n), tuple(s)) for n, s in starts.items() if n in offered]
    needed = {key for c in candidates for s in c.starts for direction in s.directions for key in direction}
    return [p for p in probes if p.key in needed], candidates


def _unknowns(name: str) -> tuple[Unknown, ...]:
    return tuple(replace(u, low=_LEAST_ORDER) if (name, u.name) == ("torque_ripple", "order") else u for u in unknowns(name))


def _one(key: str, size: float, neutral: float) -> Start:
    return Start(((key,),), lambda a: (neutral + size * float(a[0]),))


def _limit(torque: float) -> Callable[[Array], tuple[float, ...]]:
    """A limit grows as less of its probe is wanted."""
    return lambda a: (min(torque / max(float(a[0]), 1e-3), NO_TORQUE_LIMIT),)


def _stribeck(speed: float) -> Callable[[Array], tuple[float, ...]]:
    return lambda a: (_STRIBECK_TORQUE * float(a[0]), speed)


def _ripple(order: float) -> Callable[[Array], tuple[float, ...]]:
    return lambda a: (_RIPPLE_AMPLITUDE * float(np.hypot(a[0], a[1])), order, float(np.arctan2(a[1], a[0])))
