"""Roll-outs of every task are what they were: by the bit where the machine computes alike, nearly everywhere else."""

import json

import pytest
from golden_rollouts import FILE, arithmetic, roll_out, rollouts

GOLDEN = json.loads(FILE.read_text(encoding="utf-8"))
SAME_MACHINE = arithmetic() in GOLDEN["arithmetic"]


def test_the_golden_file_has_all_rollouts():
    assert set(GOLDEN["rollouts"]) == set(rollouts())


@pytest.mark.parametrize("name", rollouts())
def test_rollout(name):
    """Another processor or compiler rounds elementary functions its own way; the rewards then agree to 1e-3."""
    env_id, keywords = rollouts()[name]
    found, golden = roll_out(env_id, keywords), GOLDEN["rollouts"][name]
    assert found["reward"] == pytest.approx(golden["reward"], rel=1e-3, abs=1e-3)
    if SAME_MACHINE:
        assert found["bits"] == golden["bits"]
