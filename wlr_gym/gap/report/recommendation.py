"""What a report says beyond the fits: what to record next, and which relation of the model could hold the gap.

Excitations are recommended that show what these data could not, or distinguish equivalent effects. A relation is a joint's
torque, a wheel's contact, a length, a time, a sensor: laws that act on one alone are tried on each, and the score of a relation
is the predicted improvement by its best law (:mod:`wlr_gym.gap.selection.screening`).
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence

from wlr_gym.data.excitations import EXCITATIONS
from wlr_gym.data.format import Profile
from wlr_gym.gap.analysis import EFFECT_FOUND, Equivalent, Recommendation, Relation
from wlr_gym.gap.problem import Candidate
from wlr_gym.gap.report.text import places
from wlr_gym.gap.selection.finalists import shown_by_some_runs_only
from wlr_gym.gap.selection.screening import LEAST_GAIN, Score
from wlr_gym.gap.selection.search import Round
from wlr_gym.physics.effects import EFFECTS
from wlr_gym.robot import JOINTS, LEGS

_FRICTION = ("coulomb_friction", "viscous_friction", "stribeck_friction", "load_dependent_friction")
_PULL = ("floor_slope", "external_force", "tether")
#: One of the first and one of the second -> excitation that separates them, and why it does.
_SEPARATED_BY: Sequence[tuple[Sequence[str], Sequence[str], str, str]] = (
    (("rolling_resistance",), _FRICTION, "straight",
     "repeat it with extra weight on the body: rolling resistance grows with the load on a wheel, gear friction does not"),
    (("rolling_resistance",), _PULL, "turns",
     "turn round and drive back: a pull keeps its direction on the floor, resistance turns with the robot"),
    (_PULL, ("com_offset", "payload", "imu_misalignment"), "turns",
     "a full turn on the spot: what belongs to the floor changes sign with the heading, what belongs to the body does not"),
    (("com_offset",), ("payload",), "chirp",
     "an extra mass also slows every acceleration down, a displaced centre does not"),
    (("command_delay",), ("camera_delay", "backlash", "viscous_friction"), "chirp",
     "the phase of a delay grows with frequency at full amplitude; friction and play lose amplitude"),
    (("backlash",), ("stribeck_friction", "coulomb_friction"), "stop_and_go",
     "reversals at two loads: play is constant in angle and vanishes under a steady load, friction is constant in torque"),
    (("weak_motor",), ("supply_sag", "load_dependent_friction"), "rear_legs",
     "drive and be driven: friction changes its sign with the speed, a weak motor does not; sag needs a high total current"),
    (("wheel_radius_error",), ("camera_misalignment", "tyre_creep"), "turns",
     "a wrong radius turns the robot where wheels differ; a wrong camera scale does not"),
    (("tyre_brush",), ("tyre_creep", "friction_level", "friction_asymmetry", "slip_weakening"), "posture",
     "legs that swing press wheels along the floor as they roll: an elastic tread slips in proportion to its speed, creep as "
     "fast at any speed, and friction and its weakening show only where wheels slide"),
    (("friction_anisotropy", "slip_weakening"), ("friction_level", "friction_asymmetry", "tyre_creep"), "turns",
     "spins in place at several speeds beside straight braking: lateral and longitudinal grip are used apart"),
    (("coulomb_friction",), ("viscous_friction", "stribeck_friction"), "straight",
     "several steady speeds, one of them near zero"),
)  # fmt: skip
#: Excitations in which no leg moves, or none at the front.
_LEGS_STAND, _FRONT_STANDS = ("straight", "turns", "s_curve", "stop_and_go"), ("rear_legs",)
#: Why an excitation separates effects at legs, where it is not for the reason that holds at wheels.
_AT_LEGS = {
    "several steady speeds, one of them near zero": "legs swing at a steady speed, stop and reverse; all_legs has half of it"
}


def motion_for(excitation: str, where: Collection[str]) -> str:
    """Return the excitation, or where all places are legs and stand in it, one in which they move."""
    if not where or not set(where) <= set(LEGS):
        return excitation
    if excitation in _LEGS_STAND:
        return "posture"
    return "all_legs" if excitation in _FRONT_STANDS and set(where) & set(LEGS[:2]) else excitation


def separation(chosen: str, other: str, motions: Mapping[str, str], where: Collection[str] = ()) -> tuple[str, str] | None:
    """Return the excitation that distinguishes two effects, and why it does; None where none is known.

    Args:
        chosen, other: names of effects.
        motions: effect -> motion of the system that shows it best; empty = it has no named motions.
        where: places of the chosen one.
    """
    for one, two, excitation, why in _SEPARATED_BY if motions else ():
        if (chosen in one and other in two) or (chosen in two and other in one):
            motion = motion_for(excitation, where)
            return motion, why if motion == excitation else _AT_LEGS.get(why, why)
    if chosen not in motions:
        return None
    return motion_for(motions[chosen], where), f"the motion in which {chosen} shows best"


def separating_run(names: Iterable[str], motions: Mapping[str, str], where: Collection[str] = ()) -> str:
    """Return the discriminating experiment in words: the run that distinguishes the chosen effect from the others."""
    chosen, *others = names
    found = dict.fromkeys(filter(None, (separation(chosen, other, motions, where) for other in others)))
    texts = [f"{excitation} ({EXCITATIONS[excitation].doc}): {why}" for excitation, why in found]
    return "; ".join(texts) or "more runs, of other kinds and at other loads"


def recommend(
    last: Round, equivalent: Sequence[Equivalent], verdict: str, motions: Mapping[str, str]
) -> tuple[Recommendation, ...]:
    """Return runs worth recording: to distinguish equivalent effects, then to show what these data would have missed.

    Args:
        last: the last round of the search.
        equivalent: groups of effects that the data cannot distinguish.
        verdict: of the analysis.
        motions: effect -> motion of the system that shows it best.
    """
    found: dict[str, str] = {}
    for group in equivalent:
        chosen, *others = group.names
        for other in others:
            apart = separation(chosen, other, motions, group.where)
            if apart is not None:
                found.setdefault(apart[0], f"distinguishes {chosen} from {other}: {apart[1]}")
    for hypothesis in last.hypotheses:
        name, where = hypothesis.candidate.name, hypothesis.candidate.where
        if name in motions and shown_by_some_runs_only(hypothesis, last.threshold):
            why = f"{name} fails cross-validation: runs left out of the fit do not show it"
            found.setdefault(motion_for(motions[name], where), why)
    if verdict != EFFECT_FOUND:
        visible = {score.candidate.name for score in last.scores if score.visible}
        blind: dict[str, list[str]] = {}
        for name in dict.fromkeys(score.candidate.name for score in last.scores):
            if name not in visible and name in motions:
                blind.setdefault(motions[name], []).append(name)
        for excitation, names in blind.items():
            found.setdefault(excitation, f"would show {', '.join(sorted(names))}, of which these data show nothing")
    return tuple(Recommendation(excitation, why) for excitation, why in found.items())


def record_commands(excitations: Iterable[str]) -> list[str]:
    """Return the commands that record excitations: a folder of runs has one servo profile."""
    alike: dict[Profile, list[str]] = {}
    for name in excitations:
        alike.setdefault(EXCITATIONS[name].profile, []).append(name)
    folders = ["new_runs", *(f"new_runs_{k}" for k in range(2, len(alike) + 1))]
    return [
        f"wlr record --excitation {' '.join(names)} --out {out}" for out, names in zip(folders, alike.values(), strict=True)
    ]


# ---- relations -------------------------------------------------------------------------------------------------------


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
    return f"torque in the {where}" if search is None else search.relation.format(where)


def relations(scores: Sequence[Score]) -> tuple[Relation, ...]:
    """Return the relations in which a law could explain more than chance, the best one of each, strongest first."""
    best: dict[str, Score] = {}
    for score in scores:
        relation = relation_of(score.candidate)
        if relation is not None and score.gain > max(LEAST_GAIN, best[relation].gain if relation in best else 0.0):
            best[relation] = score
    found = [Relation(relation, score.candidate.name, score.candidate.formula, score.gain) for relation, score in best.items()]
    return tuple(sorted(found, key=lambda one: -one.gain))
