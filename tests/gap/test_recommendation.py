"""What to record next: the motion that is named is the one that the reason speaks of, and the commands are possible."""

from dataclasses import replace

import numpy as np
import pytest

from wlr_gym.data.excitations import EXCITATIONS, excite
from wlr_gym.gap.analysis import EFFECT_FOUND, Equivalent
from wlr_gym.gap.problem import Candidate, Start, Unknown
from wlr_gym.gap.report.recommendation import recommend, record_commands, relation_of, relations, separating_run, separation
from wlr_gym.gap.robot.candidates import shown_by
from wlr_gym.gap.selection.screening import LEAST_GAIN, Score
from wlr_gym.gap.selection.search import Round
from wlr_gym.physics.effects import EFFECTS
from wlr_gym.robot import JOINTS, LEG_SLICE, LEGS

SHOWN_BY = shown_by()


@pytest.mark.parametrize(
    ("chosen", "other", "excitation", "reason"),
    [
        ("rolling_resistance", "floor_slope", "turns", "turn round"),
        ("com_offset", "payload", "chirp", "extra mass"),
        ("payload", "com_offset", "chirp", "extra mass"),
        ("friction_level", "friction_patch", "turns", "shows best"),
        ("tyre_brush", "tyre_creep", "posture", "in proportion to its speed"),
    ],
)
def test_the_motion_is_that_of_the_reason(chosen, other, excitation, reason):
    found = separation(chosen, other, SHOWN_BY)
    assert found is not None
    assert found[0] == excitation
    assert reason in found[1]
    assert separating_run((chosen, other), SHOWN_BY).startswith(f"{excitation} (")


LEGS_MOVE = {name for name in EXCITATIONS if np.ptp(excite(name).setpoints[:, LEG_SLICE], axis=0).all()}


@pytest.mark.parametrize("where", [(leg,) for leg in LEGS] + [LEGS], ids="+".join)
@pytest.mark.parametrize("chosen", [name for name, one in EFFECTS.items() if one.search and set(LEGS) <= set(one.where)])
def test_at_legs_it_is_a_motion_in_which_they_move(chosen, where):
    moving = LEGS_MOVE | ({"rear_legs"} if set(where) <= {"leg_lr", "leg_rr"} else set())
    for other in SHOWN_BY:
        found = separation(chosen, other, SHOWN_BY, where)
        assert found is not None
        assert found[0] in moving
    wheels = separation("coulomb_friction", "stribeck_friction", SHOWN_BY, ("wheel_lf",))
    assert wheels == ("straight", "several steady speeds, one of them near zero")


def test_what_is_recommended_goes_by_the_place():
    last = Round([], [], None)
    assert separating_run(("coulomb_friction", "stribeck_friction"), SHOWN_BY, ("leg_lf",)).startswith("posture (")
    group = Equivalent(("backlash", "coulomb_friction"), "", ("leg_lf",))
    (run,) = recommend(last, [group], EFFECT_FOUND, SHOWN_BY)
    assert run.excitation == "posture"
    (run,) = recommend(last, [replace(group, where=("wheel_lf",))], EFFECT_FOUND, SHOWN_BY)
    assert run.excitation == "stop_and_go"


def test_a_system_without_named_motions_asks_for_more_runs():
    assert separation("backlash", "coulomb_friction", {}) is None
    assert separating_run(("backlash", "coulomb_friction"), {}) == "more runs, of other kinds and at other loads"


def test_motions_of_other_servo_profiles_are_recorded_apart():
    first, second = record_commands(["straight", "steps", "turns"])
    assert first == "wlr record --excitation straight turns --out new_runs"
    assert second == "wlr record --excitation steps --out new_runs_2"
    assert EXCITATIONS["steps"].profile != EXCITATIONS["turns"].profile


def test_every_motion_exists():
    assert set(SHOWN_BY) == {name for name, effect in EFFECTS.items() if effect.search}
    assert set(SHOWN_BY.values()) <= set(EXCITATIONS)


# ---- relations -------------------------------------------------------------------------------------------------------


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
