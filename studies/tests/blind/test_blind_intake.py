"""Bad data are refused or called bad before any model is asked, and good data are not."""

import numpy as np
import pytest

from studies.bench.blind.copies import read_robot
from studies.bench.blind.dataset import SPOIL, simulate_runs, spoilt, write
from wlr_gym.base.errors import InputError
from wlr_gym.base.paths import data_directory
from wlr_gym.gap import workflow

ROBOT = read_robot(data_directory("configs") / "robot" / "nominal.yaml")


class PastIntakeError(Exception):
    """Raised instead of the analysis: minutes of fitting."""


@pytest.fixture
def intake_only(monkeypatch):
    def past(*args, **options):
        raise PastIntakeError

    monkeypatch.setattr(workflow, "analyse_problem", past)


@pytest.fixture(scope="module")
def good():
    """Three runs of a copy within its tolerances: posture sweeps move every leg."""
    return simulate_runs(ROBOT, [], 7, (0, 1, 6))[:2]


def test_good_data_pass(good, intake_only, tmp_path):
    tables, meta = good
    write(tmp_path, tables, meta)
    with pytest.raises(PastIntakeError):
        workflow.analyse(tmp_path)


@pytest.mark.parametrize("kind", [kind for kind in SPOIL if kind != "motionless"])
def test_bad_data_do_not(kind, good, intake_only, tmp_path):
    tables, meta = good
    write(tmp_path, spoilt(kind, [table.copy() for table in tables], np.random.default_rng(1)), meta)
    try:
        found = workflow.analyse(tmp_path)
    except InputError:
        return
    assert found.verdict == "bad_data"
    assert any(finding.fatal and finding.text for finding in found.intake), "it says what to do"
