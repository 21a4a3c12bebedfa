"""What may still be missing, as a result file says: the names that its data do not distinguish, and "nothing more"."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from wlr_gym.gap.analysis import EQUIVALENT, FAILS_CROSS_VALIDATION, REMOVED, SELECTED, TOO_LITTLE, WORSE_FIT
from wlr_gym.gap.report.entries import EvidenceEntry, Result
from wlr_gym.physics.effects import PatchEffect

#: Probability from which on a name is decided.
DECIDED = 0.95
#: Name of the explanation that adds nothing to the effects found before.
NOTHING = "nothing"
#: Outcomes that further runs can change: what needs an implausible size, or less than tolerances allow, they do not.
_OPEN = frozenset({SELECTED, EQUIVALENT, WORSE_FIT, TOO_LITTLE, FAILS_CROSS_VALIDATION})


@dataclass(frozen=True)
class Explanation:
    """One way to explain the runs.

    Attributes:
        name: of the effect in question, or :data:`NOTHING`.
        probability: among all explanations of its round.
        effects: of the whole model, those found in earlier rounds included.
    """

    name: str
    probability: float
    effects: tuple[PatchEffect, ...]


def explanations(result: Result) -> tuple[Explanation, ...]:
    """Return the explanations in play, most probable first; one where the runs distinguish it, none without an analysis.

    They are those of the first round of the search in which no name alone has 95 %, or names are equivalent: the smallest set
    of names that has 95 %, nothing among them, what was selected, and what is equivalent to it (probabilities know nothing of
    what simulators cannot reproduce). Once an effect was found, a round that adds nothing is decided.
    """
    added: tuple[PatchEffect, ...] = ()
    found: list[Explanation] = []
    for threshold in result.thresholds:
        entries = [one for one in result.evidence if one.round == threshold.round and one.outcome in _OPEN]
        selected = next((one for one in entries if one.outcome == SELECTED), None)
        if any(one.outcome == REMOVED for one in result.evidence if one.round == threshold.round):
            continue
        if selected is None and added:
            break
        found = _of_round(entries, threshold.none or 0.0, added)
        if selected is None or len(found) > 1:
            break
        added = found[0].effects
    return tuple(found)


def _of_round(entries: Sequence[EvidenceEntry], nothing: float, added: tuple[PatchEffect, ...]) -> list[Explanation]:
    best: dict[str, EvidenceEntry] = {}
    total: dict[str, float] = {NOTHING: nothing}
    for entry in sorted(entries, key=lambda one: -one.probability):
        best.setdefault(entry.name, entry)
        total[entry.name] = total.get(entry.name, 0.0) + entry.probability
    whole = sum(total.values()) or 1.0
    ranked = [
        Explanation(name, share / whole, (*added, _effect(best[name])) if name in best else added)
        for name, share in sorted(total.items(), key=lambda one: -one[1])
    ]
    chosen = next((entry.name for entry in entries if entry.outcome == SELECTED), NOTHING)
    rivals = {entry.name for entry in entries if entry.outcome == EQUIVALENT}
    if ranked[0].name == chosen and ranked[0].probability >= DECIDED and not rivals:
        return ranked[:1]
    reached, credible = 0.0, set()
    for one in ranked:
        if reached < DECIDED:
            credible.add(one.name)
        reached += one.probability
    return [one for one in ranked if one.name in credible | rivals | {chosen}]


def _effect(entry: EvidenceEntry) -> PatchEffect:
    values = {name: value for name, value in entry.values.items() if value is not None}
    return PatchEffect(entry.name, tuple(entry.where), values, entry.formula, entry.units)
