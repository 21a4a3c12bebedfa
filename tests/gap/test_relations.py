"""Which relation of the model could hold the gap: every effect has one, the best law of each stands for it."""

import numpy as np
import pytest

from wlr_gym.gap.problem import Candidate, Start, Unknown
from wlr_gym.gap.report.recommendation import relation_of, relations
from wlr_gym.gap.selection.screening import LEAST_GAIN, Score
from wlr_gym.physics.effects import EFFECTS
from wlr_gym.robot import JOINTS

START = Start((("probe",),), lambda a: (float(a[0]),))
SIZE = (Unknown("size", "1", 0.0, -1.0, 1.0, 0.1),)


def candidate(name, *where, formula=""):
    return Candidate(name, where, SIZE, (START,), formula)


def score(gain, name, *where, formula=""):
    return Score(candidate(name, *where, formula=formula), (0.0,), gain, 1.0, np.eye(1), START, True)


@pytest.mark.parametrize(
    ("one", "relation"),
    [
        (candidate("coulomb_friction", "leg_lr"), "torque in the left rear leg"),
        (candidate("unknown_effect", "wheel_rf", formula="-k * rate"), "torque in the right front wheel"),
        (candidate("unknown_effect", "body_force_x", formula="-k * velocity_x"), "body force x"),
        (candidate("unknown_effect", "floor_force_y", formula="c"), "floor force y"),
        (candidate("tyre_creep", "wheel_rf"), "contact of the right front wheel"),
        (candidate("friction_patch", "ground"), "friction of the floor"),
        (candidate("gyro_bias", "sensor"), "reading of the gyroscope"),
        (candidate("command_delay", *JOINTS), "timing of the commands"),
        (candidate("coulomb_friction", "leg_lr", "leg_rr"), None),
    ],
)
def test_relation_of_a_law(one, relation):
    assert relation_of(one) == relation


def test_only_effects_in_joints_are_torques():
    for name, effect in EFFECTS.items():
        if effect.search is None:
            continue
        relation = relation_of(candidate(name, effect.where[0]))
        assert relation is not None
        assert not relation.startswith("torque") or set(effect.where) == set(JOINTS), name


def test_the_best_law_of_each_relation_strongest_first():
    found = relations(
        [
            score(30.0, "coulomb_friction", "leg_lr"),
            score(70.0, "viscous_friction", "leg_lr"),
            score(50.0, "tyre_creep", "wheel_lf"),
            score(LEAST_GAIN, "floor_slope", "ground"),
            score(900.0, "coulomb_friction", "leg_lr", "leg_rr"),
        ]
    )
    assert [(one.name, one.law, one.gain) for one in found] == [
        ("torque in the left rear leg", "viscous_friction", 70.0),
        ("contact of the left front wheel", "tyre_creep", 50.0),
    ]
