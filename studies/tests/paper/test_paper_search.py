"""The search for what could explain the paper's slip: what counts as a match, reproducibility, and what it can find."""

import numpy as np
import pytest

from studies.paper import report, slip_search
from studies.paper.slip_search import CANDIDATES, READINGS, Outcomes, make_parameters, outcomes, search
from wlr_gym.physics.effects import EFFECTS
from wlr_gym.robot import load_robot

ROBOT = load_robot()
BY_NAME = {candidate.name: candidate for candidate in CANDIDATES}
CHOSEN = [BY_NAME["radius"], BY_NAME["camera"]]


@pytest.fixture(autouse=True)
def small(monkeypatch):
    """The reference precision only, no second kernel to compile; a short search."""
    monkeypatch.setattr(slip_search, "_FAST", (0.002, "float64"))
    monkeypatch.setattr(slip_search, "_EXACT", (0.002, "float64"))
    monkeypatch.setattr(slip_search, "ROUNDS", 1)


def made(error, lateral):
    error, lateral = np.array([error]), np.array([lateral])
    return Outcomes(error, error, lateral, *np.zeros((3, 1, 2)))


def test_a_match_has_all_four_numbers_of_the_paper():
    short = READINGS[0]
    assert made([0.115, 0.05], [0.011, 0.052]).miss(short)[0] == 0.0
    assert made([0.115, 0.05], [0.011, -0.052]).miss(short)[0] == 0.0  # the paper does not say which side
    assert made([0.125, 0.06], [0.014, 0.049]).miss(short)[0] < 1.0
    for wrong in (([0.135, 0.05], [0.011, 0.052]), ([0.115, 0.05], [0.0, 0.052]), ([-0.115, -0.05], [0.011, 0.052])):
        assert made(*wrong).miss(short)[0] > 1.0
    assert made([-0.115, -0.05], [0.011, 0.052]).miss(READINGS[2])[0] == 0.0  # unsigned
    assert made([np.nan, 0.05], [0.011, 0.052]).miss(short)[0] == np.inf


def test_dials_turn_named_effects_within_their_bounds():
    for candidate in CANDIDATES:
        for dial in candidate.dials:
            spec = EFFECTS[dial.effect].parameters[dial.parameter]
            assert set(dial.where) <= set(EFFECTS[dial.effect].where)
            assert spec.low <= dial.low < dial.high <= spec.high
    dials = BY_NAME["radius"].dials
    parameters = make_parameters(ROBOT, dials, np.array([[0.9, 1.1], [1.0, 1.0]]))
    np.testing.assert_allclose(parameters["wheel.radius"][:, :2] / ROBOT.wheel.radius, [[0.9, 1.1], [1.0, 1.0]])


def test_nominal_robot_and_a_scaled_camera():
    """No departure: nothing to explain. A camera that sees lengths 10 % short: 10 % in both tests, sideways by its turn."""
    dials = BY_NAME["camera"].dials
    found = outcomes(ROBOT, make_parameters(ROBOT, dials, np.array([[0.0, 1.0], [0.05, 0.9]])))
    np.testing.assert_allclose(found.error_encoder[0], 0.0, atol=1e-3)
    np.testing.assert_allclose(found.lateral[0], 0.0, atol=1e-6)
    np.testing.assert_allclose(found.error_encoder[1], 0.1, atol=2e-3)
    np.testing.assert_allclose(found.lateral[1], -0.9 * np.sin(0.05) * np.array([0.8524, 1.1622]), atol=5e-4)


@pytest.mark.slow
def test_search_is_reproducible_covers_pairs_and_closes_in(tmp_path):
    first, again = (search(ROBOT, draws=3, levels=2, seed=5, candidates=CHOSEN) for _ in range(2))
    assert [finding.label for finding in first] == ["radius", "camera", "radius + camera"]
    for a, b in zip(first, again, strict=True):
        np.testing.assert_array_equal(a.values, b.values)
        np.testing.assert_array_equal(a.outcomes.lateral, b.outcomes.lateral)
    pair = first[2]
    assert len(pair.values) == 3 + slip_search.ROUNDS * 12
    low, high = (np.array([getattr(dial, end) for dial in pair.dials]) for end in ("low", "high"))
    assert (pair.values >= low).all()
    assert (pair.values <= high).all()
    miss = pair.outcomes.miss(READINGS[0])
    assert miss[-12:].min() < miss[:3].min()
    text = "\n".join(report.question_lines(first, report.what_would_decide(ROBOT, first)))
    assert "radius + camera" in text
    assert f"### Reading: {READINGS[0].doc}" in text
    entry = pair.as_dict()["readings"][READINGS[0].name]
    assert entry["closest"] == pytest.approx(miss.min())
