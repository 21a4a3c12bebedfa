"""Every refusal names place, value and what was expected."""

from dataclasses import dataclass
from typing import Annotated

import pytest

from wlr_gym.base.errors import InputError, Interval, check_file, check_folder, check_name, check_number, check_ranges


@pytest.mark.parametrize(
    ("place", "value", "unit", "bounds", "message"),
    [
        ("--segment", 0.0, "s", {"above": 0.0}, "--segment 0: expected more than 0 s"),
        ("--deadman", 7.0, "s", {"above": 0.0, "most": 5.0}, "--deadman 7: expected more than 0 and at most 5 s"),
        ("robot.yaml: body.mass", -1, "kg", {"least": 0.0}, "robot.yaml: body.mass = -1: expected 0 or more kg"),
        ("episodes", 3.5, "", {"least": 1, "most": 9, "whole": True}, "episodes = 3.5: expected a whole number from 1 to 9"),
        ("episodes", True, "", {"least": 1, "whole": True}, "episodes = True: expected a whole number, 1 or more"),
        ("share", float("nan"), "", {}, "share = nan: expected a finite number"),
        ("segment", float("inf"), "s", {"above": 0.1}, "segment = inf: expected a finite number, more than 0.1 s"),
        ("share", 1.0, "", {"least": 0.0, "below": 1.0, "what": "a share"}, "expected 0 or more and less than 1; a share"),
        ("share", "half", "", {"least": 0.0, "most": 1.0}, "share = 'half': expected a number from 0 to 1"),
    ],
)
def test_numbers_outside_are_refused(place, value, unit, bounds, message):
    with pytest.raises(InputError) as refused:
        check_number(place, value, unit, **bounds)
    assert message in str(refused.value)


@pytest.mark.parametrize(
    ("value", "bounds"), [(0, {"least": 0}), (5.0, {"most": 5.0}), (1, {"whole": True, "above": 0}), (1e-9, {"above": 0.0})]
)
def test_numbers_inside_pass(value, bounds):
    check_number("x", value, **bounds)


def test_names_and_places(tmp_path):
    check_name("plant", "mujoco", ["mujoco", "gibbs_appell"])
    with pytest.raises(InputError, match=r"--backend: unknown plant 'mujco' \(did you mean 'mujoco'\?\); valid: "):
        check_name("plant", "mujco", ["mujoco", "gibbs_appell"], "--backend")
    check_folder(tmp_path)
    with pytest.raises(InputError, match="is a folder; expected a file"):
        check_file(tmp_path)
    with pytest.raises(InputError, match="no such folder; expected a folder"):
        check_folder(tmp_path / "none")
    with pytest.raises(InputError, match="no such folder; expected a folder of runs"):
        check_folder(tmp_path / "none", of="runs")


@dataclass
class Options:
    most_runs: Annotated[int, Interval(least=1)] = 1
    seconds: Annotated[float, Interval("s", above=0.0)] | None = None


def test_ranges_that_fields_declare():
    check_ranges(Options())
    check_ranges(Options(3, 0.5))
    with pytest.raises(InputError, match=r"^--most-runs 0: expected 1 or more$"):
        check_ranges(Options(0))
    with pytest.raises(InputError, match=r"^run: seconds = 0: expected more than 0 s$"):
        check_ranges(Options(seconds=0.0), "run: ")
