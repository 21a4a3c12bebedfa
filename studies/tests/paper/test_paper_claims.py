"""The claims table: every claim is checked, and the verdicts are what the physics says."""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from studies.paper.claims import CLAIMS, FAILS, HOLDS, OPEN, PARTLY, VARIANTS, check_all, claims_table, gather
from studies.paper.experiments import drive_both, select
from studies.paper.verdicts import CONDITIONAL, CORRECT, EQUATIONS, INCOMPLETE, MISPRINT, WRONG
from wlr_gym.robot import load_robot

DOCS = Path(__file__).parents[3] / "docs" / "paper.md"
VERDICTS = {
    1: OPEN, 2: OPEN, 3: FAILS, 4: OPEN, 5: PARTLY, 6: HOLDS, 7: HOLDS, 8: FAILS, 9: FAILS, 10: PARTLY, 11: PARTLY, 12: FAILS,
    13: HOLDS, 14: PARTLY, 15: HOLDS, 16: HOLDS, 17: HOLDS, 18: PARTLY, 19: PARTLY, 20: FAILS, 21: PARTLY, 22: HOLDS,
    23: PARTLY, 24: HOLDS, 25: FAILS,
}  # fmt: skip


@pytest.fixture(scope="module")
def evidence():
    robot = load_robot()
    return gather(robot, drive_both("gibbs_appell", robot))


@pytest.fixture(scope="module")
def claims(evidence):
    return check_all(evidence)


def changed(evidence, test, **factors):
    """The evidence with some quantities of one test multiplied."""
    record = evidence.plant[test]
    other = replace(record, **{name: factor * getattr(record, name) for name, factor in factors.items()})
    return replace(evidence, plant={**evidence.plant, test: other})


def test_every_claim_of_the_audit_is_there():
    assert list(CLAIMS) == list(range(1, 26))


def test_verdicts(claims):
    assert {claim.number: claim.verdict for claim in claims} == VERDICTS


REAR_STAND = np.array([1.0] * 6 + [0.0] * 2)


@pytest.mark.parametrize(
    ("number", "test", "factors", "verdict"),
    [
        (1, "test_1", {"position": 0.885}, HOLDS),
        (2, "test_2", {"position": 0.95}, HOLDS),
        (10, "test_1", {"joint_position": 0.9}, FAILS),
        (11, "test_1", {"joint_velocity": -1.0}, FAILS),
        (12, "test_2", {"joint_velocity": REAR_STAND}, HOLDS),
        (13, "test_1", {"joint_velocity": 1e-3}, FAILS),
        (16, "test_1", {"torque": 5.0}, FAILS),
        (17, "test_1", {"position": 0.1}, FAILS),
        (18, "test_1", {"attitude": 0.01}, FAILS),
        (18, "test_2", {"attitude": 10.0}, HOLDS),
        (19, "test_1", {"attitude": 1e8}, FAILS),
        (24, "test_1", {"torque": 10.0}, FAILS),
        (24, "test_2", {"joint_velocity": 2.0}, FAILS),
    ],
)
def test_other_evidence_gives_another_verdict(evidence, number, test, factors, verdict):
    """A verdict follows from the numbers: a robot that did something else gets another one."""
    assert verdict != VERDICTS[number]
    assert CLAIMS[number](changed(evidence, test, **factors)).verdict == verdict


def test_side_experiments_decide_too(evidence):
    assert CLAIMS[23](replace(evidence, free=(0.0, 0.0))).verdict == HOLDS
    assert CLAIMS[23](replace(evidence, free=evidence.driven)).verdict == FAILS
    labels = list(VARIANTS)
    alike = np.full(len(labels), labels.index("drag"))
    same_robots = replace(evidence, variants={name: select(record, alike) for name, record in evidence.variants.items()})
    assert [CLAIMS[number](same_robots).verdict for number in (8, 21, 22)] == [FAILS, FAILS, FAILS]
    mirrored = replace(evidence, variants=dict.fromkeys(evidence.variants, evidence.variants["test_1"]))
    assert CLAIMS[7](mirrored).verdict == FAILS


def test_numbers_behind_the_verdicts(claims):
    """First numbers of some rows, against the audit's section 5."""
    found = {claim.number: [float(x) for x in re.findall(r"-?\d+\.\d+", claim.ours)] for claim in claims}
    assert found[1][0] == pytest.approx(0.0, abs=0.1)
    assert found[2][0] == pytest.approx(0.0, abs=0.1)
    assert found[7][:2] == pytest.approx([2.61, 7.36], abs=0.01)
    assert found[13][0] == pytest.approx(5.82, abs=0.1)
    assert found[14] == pytest.approx([0.28, 0.83, 1.39, -0.83], abs=0.01)
    assert found[17][:2] == pytest.approx([4.19, 6.75], abs=0.01)
    assert found[18][:2] == pytest.approx([8.40, 0.0], abs=0.01)
    assert found[20][0] == pytest.approx(7.1, abs=0.3)


def test_every_equation_has_its_verdict_and_functions():
    assert list(EQUATIONS) == list(range(1, 31))
    words = {CORRECT, CONDITIONAL, MISPRINT, INCOMPLETE, WRONG}
    for number, equation in EQUATIONS.items():
        assert equation.verdicts
        assert set(equation.verdicts) <= words
        printed = getattr(equation.printed, "func", equation.printed)  # of several wheels: one function
        assert f"({number})" in (printed.__doc__ or "")
        assert callable(equation.corrected)
        assert (equation.repaired is not None) == (MISPRINT in equation.verdicts and number not in range(21, 25))
        if CORRECT in equation.verdicts:
            assert equation.verdicts == (CORRECT,)


def test_docs_carry_the_verdicts(claims):
    text = DOCS.read_text(encoding="utf-8").partition("## Claims")[2].partition("## The open question")[0]
    rows = dict(re.findall(r"^\| (holds|partly|does not hold|open) \| (.*) \|$", text, re.M))
    told = {int(number): word for word, row in rows.items() for number in re.findall(r"(?:^|; |, )(\d+)(?=[ ,])", row)}
    assert told == {claim.number: claim.verdict for claim in claims}
    assert len(claims_table(claims)) == 27
