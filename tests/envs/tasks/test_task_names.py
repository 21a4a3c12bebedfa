"""Names of terms belong to one function each."""

import pytest

from wlr_gym.base.errors import InputError
from wlr_gym.envs.tasks.terms import COMPUTED, POLICY_TERMS, POSITIVE, REWARDS, registered
from wlr_gym.envs.tasks.terms.observations import computed


@pytest.mark.parametrize(
    ("name", "decorator"),
    [
        ("slip", registered(REWARDS)),
        ("path_error", computed(unit="m", frame="path", limit=1.0)),
        ("gyro", computed(unit="rad/s", frame="body", limit=1.0)),
    ],
)
def test_a_name_that_is_taken_is_refused(name, decorator):
    def other(signals):
        """Something else."""
        return 0.0

    other.__name__ = name
    before = REWARDS["slip"], COMPUTED["path_error"], POLICY_TERMS["gyro"]
    with pytest.raises(InputError, match=f"'{name}' of .* has one of that name"):
        decorator(other)
    assert (REWARDS["slip"], COMPUTED["path_error"], POLICY_TERMS["gyro"]) == before


def test_a_range_belongs_to_a_parameter():
    def quick(signals, *, speed=1.0):
        """Something else."""
        return 0.0

    with pytest.raises(InputError, match=r"term 'quick' of .*: unknown parameter 'sped' \(did you mean 'speed'\?\)"):
        registered(REWARDS, sped=POSITIVE)(quick)
    assert "quick" not in REWARDS


def test_the_same_function_may_come_again():
    assert registered(REWARDS)(REWARDS["alive"].function) is REWARDS["alive"].function
