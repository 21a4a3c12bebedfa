"""What to record next: the motion that is named is the one that the reason speaks of, and the commands are possible."""

from dataclasses import replace

import numpy as np
import pytest

from wlr_gym.data.excitations import EXCITATIONS, excite
from wlr_gym.gap.analysis import EFFECT_FOUND, Equivalent
from wlr_gym.gap.report.recommendation import recommend, record_commands, separating_run, separation
from wlr_gym.gap.robot.candidates import shown_by
from wlr_gym.gap.selection.search import Round
from wlr_gym.physics.effects import EFFECTS
from wlr_gym.robot import LEG_SLICE, LEGS

SHOWN_BY = shown_by()


@pytest.mark.parametrize(
    ("chosen", "other", "excitation", "reason"),
    [
        ("rolling_resistance", "floor_slope", "turns", "turn round"),
        ("com_offset", "payload", "chirp", "extra mass"),
        ("payload", "com_offset", "chirp", "extra mass"),
        ("friction_level", "friction_patch", "turns", "shows best"),
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
