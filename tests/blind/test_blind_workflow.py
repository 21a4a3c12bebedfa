"""The gap workflow on data with sealed truths. Minutes per set: ``WLR_BLIND_SETS`` says how many (240 = the full matrix)."""

import os

import pytest

from wlr_gym.bench import gap

SETS = int(os.environ.get("WLR_BLIND_SETS", "1"))


@pytest.mark.slow
def test_workflow_against_sealed_truths(tmp_path):
    """From 200 sets on, every target; before that, that nothing breaks and no good data are refused."""
    report = gap.run_blind_test(gap.Plan(tmp_path, sets=SETS, processes=2))
    print(gap.markdown(report))
    assert not report["failed"]
    assert report["false_alarms"]["refused_good_data"]["hits"] == 0
    if SETS >= 200:
        assert not [line for line in gap.lines(report) if line.met == "no"]
