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
from wlr_gym.robot import JOINTS

#: Effect -> what it changes; ``{}`` is its place. A formula is a force on its place; all others are torques in a joint.
_CHANGES = {
    "friction_asymmetry": "contact of the {}",
    "tyre_creep": "contact of the {}",
    "rolling_resistance": "contact of the {}",
    "wheel_radius_error": "radius of the {}",
    "joint_zero_offset": "zero of the {}",
    "command_delay": "timing of the {}",
    "friction_level": "friction of the floor",
    "friction_anisotropy": "friction of the floor",
    "friction_patch": "friction of the floor",
    "slip_weakening": "friction of the floor",
    "floor_slope": "force on the body",
    "external_force": "force on the body",
    "tether": "force on the body",
    "payload": "mass of the body",
    "com_offset": "mass of the body",
    "supply_sag": "supply",
    "gyro_bias": "reading of the gyroscope",
    "imu_misalignment": "mounting of the IMU",
    "camera_misalignment": "mounting of the camera",
    "camera_delay": "timing of the camera",
}
_TORQUE = "torque in the {}"


def relation_of(candidate: Candidate) -> str | None:
    """Return the relation that a candidate changes, in words; None where it changes several places at once."""
    if candidate.where == JOINTS and candidate.name == "command_delay":
        return "timing of the commands"
    if len(candidate.where) != 1:
        return None
    where = places(candidate.where)
    if candidate.formula and candidate.where[0] not in JOINTS:
        return where
    return _CHANGES.get(candidate.name, _TORQUE).format(where)


def relations(scores: Sequence[Score]) -> tuple[Relation, ...]:
    """Return the relations in which a law could explain more than chance, the best one of each, strongest first."""
    best: dict[str, Score] = {}
    for score in scores:
        relation = relation_of(score.candidate)
        if relation is not None and score.gain > max(LEAST_GAIN, best[relation].gain if relation in best else 0.0):
            best[relation] = score
    found = [Relation(relation, score.candidate.name, score.candidate.formula, score.gain) for relation, score in best.items()]
    return tuple(sorted(found, key=lambda one: -one.gain))
