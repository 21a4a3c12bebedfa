"""Which relation of the model could hold the gap: a joint's torque, a wheel's contact, a length, a time, a sensor.

Laws that act on one relation alone are tried on each. A law's score (:mod:`wlr_gym.gap.selection.screening`) is its predicted
improvement of the calibrated model: to first order, all calibrated parameters refitted. The score of a relation is that of its
best law.
"""

from __future__ import annotations

from collections.abc import Sequence

from wlr_gym.gap.analysis import Relation
from wlr_gym.gap.problem import Candidate
from wlr_gym.gap.report.text import places
from wlr_gym.gap.selection.screening import LEAST_GAIN, Score
from wlr_gym.physics.effects import EFFECTS
from wlr_gym.robot import JOINTS

#: What effects outside the library change.
_TORQUE = "torque in the {}"


def relation_of(candidate: Candidate) -> str | None:
    """Return the relation that a candidate changes, in words; None where it changes several places at once."""
    effect = EFFECTS.get(candidate.name)
    search = None if effect is None else effect.search
    if len(candidate.where) != 1:
        at_all_places = effect is not None and candidate.where == effect.where
        return (search.relation_of_all or None) if search is not None and at_all_places else None
    where = places(candidate.where)
    if candidate.formula and candidate.where[0] not in JOINTS:
        return where
    return (_TORQUE if search is None else search.relation).format(where)


def relations(scores: Sequence[Score]) -> tuple[Relation, ...]:
    """Return the relations in which a law could explain more than chance, the best one of each, strongest first."""
    best: dict[str, Score] = {}
    for score in scores:
        relation = relation_of(score.candidate)
        if relation is not None and score.gain > max(LEAST_GAIN, best[relation].gain if relation in best else 0.0):
            best[relation] = score
    found = [Relation(relation, score.candidate.name, score.candidate.formula, score.gain) for relation, score in best.items()]
    return tuple(sorted(found, key=lambda one: -one.gain))
