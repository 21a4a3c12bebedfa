"""The gap workflow on data of another simulator: sets of three runs, and the sealed matrix.

The matrix takes minutes per set: ``WLR_BLIND_SETS`` says how many (240 = all); without it one set, of three runs.
"""

import os

import pytest

from studies.bench import gap
from studies.bench.blind.cases import case
from studies.bench.blind.score import intervals_hold, size_error

SETS = int(os.environ.get("WLR_BLIND_SETS", "0"))
SHORT = (0, 2, 3)  # straight driving, skid turns, S-curves


@pytest.mark.slow
def test_workflow_against_sealed_truths(tmp_path):
    """From 200 sets on, every target; before that, that nothing breaks and no good data are refused."""
    report = gap.run_blind_test(gap.Plan(tmp_path, sets=SETS or 1, runs=() if SETS else SHORT, processes=2))
    print(gap.markdown(report))
    assert not report["failed"]
    assert report["false_alarms"]["refused_good_data"]["hits"] == 0
    if SETS >= 200:
        assert not [line for line in gap.lines(report) if line.met == "no"]


def analysed(folder, one):
    """What the workflow says of three runs of a set."""
    plan = gap.Plan(folder, sets=1, runs=SHORT)
    for name in ("data", "results", "work"):
        (folder / name).mkdir()
    gap.run_case(plan, one, gap.analyse_folder)
    return gap.read_result(plan.result_file(one))


@pytest.mark.slow
def test_nothing_is_named_where_only_tolerances_are_off(tmp_path):
    one = case(1, first_seed=700)
    assert (one.kind, one.effects) == ("parameters", ())
    result = analysed(tmp_path, one)
    assert (result["verdict"], result["effects"]) == ("nothing_missing", [])
    assert result["gap"]["heldout_calibrated"] < 0.5 * result["gap"]["heldout_before"]


@pytest.mark.slow
def test_one_slippery_wheel_is_named_from_three_runs(tmp_path):
    """A seed of development data: one wheel on mu 0.25."""
    one = case(72, first_seed=700)
    (true,) = one.effects
    assert true["name"] == "friction_asymmetry"
    result = analysed(tmp_path, one)
    (found,) = result["effects"]
    assert (result["verdict"], found["name"], found["where"]) == ("effect_found", true["name"], true["where"])
    assert size_error(true, found) < 0.1
    assert all(intervals_hold(true, found))
    assert result["gap"]["reduction"] > 0.5
