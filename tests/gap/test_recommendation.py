"""What to record next: the motion that is named is the one that the reason speaks of, and the commands are possible."""

import pytest

from wlr_gym.data.excitations import EXCITATIONS
from wlr_gym.gap.report.recommendation import record_commands, separating_run, separation
from wlr_gym.gap.robot.candidates import shown_by
from wlr_gym.physics.effects import EFFECTS

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
