"""What may be missing on the rig: every effect of :data:`RIG_EFFECTS`, as its entry says."""

from __future__ import annotations

from collections.abc import Collection

from wlr_gym.gap.problem import Candidate, Probe, Start, Unknown
from wlr_gym.gap.rig.effects import RIG_EFFECTS, RigEffect
from wlr_gym.gap.rig.model import JOINT
from wlr_gym.physics.effects.effect import Change, PatchEffect
from wlr_gym.physics.effects.library import EFFECTS


def rig_candidates(present: Collection[str]) -> tuple[list[Probe], list[Candidate]]:
    """Return probes and candidates, but for effects that are ``present`` already.

    What refines another effect is offered once that is there.
    """
    probes: dict[str, Probe] = {}

    def probe(name: str, change: Change) -> str:
        key = " ".join([name, *(f"{parameter} {value:g}" for parameter, value in change.parameters.items())])
        probes[key] = Probe(key, (PatchEffect(name, (JOINT,), change.parameters),))
        return key

    candidates = []
    for name, effect in RIG_EFFECTS.items():
        if name not in present and (not effect.refines or effect.refines in present):
            starts = tuple(
                Start(tuple(tuple(probe(name, change) for change in changes) for changes in guess.directions), guess.values)
                for guess in effect.guesses
            )
            candidates.append(Candidate(name, (JOINT,), _unknowns(effect), starts, doc="" if name in EFFECTS else effect.doc))
    return list(probes.values()), candidates


def _unknowns(effect: RigEffect) -> tuple[Unknown, ...]:
    """The parameters of an effect; their plausible range is its prior."""
    found = []
    for name, parameter in effect.parameters.items():
        low, high = parameter.prior
        assert isinstance(parameter.neutral, float | int)
        step = 0.02 * (min(high, 2.0) - low)
        low = max(low, effect.least.get(name, low))
        found.append(Unknown(name, parameter.unit, float(parameter.neutral), low, high, step))
    return tuple(found)
