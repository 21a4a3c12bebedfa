"""First-order scores against exact least squares."""

from dataclasses import replace

import numpy as np
import pytest
from toy_problem import CHANNELS, DECOYS, NOMINAL, REACH, SIGMA, STRENGTH, Toy, candidate, sized

from wlr_gym.gap.estimation.fit import fit
from wlr_gym.gap.estimation.model import nominal_model
from wlr_gym.gap.problem import Candidate, Start, Unknown
from wlr_gym.gap.selection.screening import LEAST_GAIN, responses, screen

RUNS = range(5)


def screened(problem, quantities=None):
    found = fit(problem, RUNS, nominal_model(problem))
    probes, candidates = problem.candidates(found.model.setting, found.residuals, RUNS)
    responded = responses(problem, found, RUNS, probes)
    return found, responded, screen(candidates, responded)


def score_of(scores, name, where=None):
    return next(s for s in scores if s.candidate.name == name and (where is None or s.candidate.where == where))


def exact_gain(problem, found, shape):
    """Fall of the penalised weighted squares when a column is added and all numbers are solved anew; and its amplitude."""
    names = ("gain", "offset", "mass")
    weight = np.broadcast_to(found.noise.weight, (len(RUNS), problem.rows, len(CHANNELS))).ravel()
    known = np.stack([STRENGTH * problem.shape(n).ravel() for n in names])
    both = np.vstack([known, shape.ravel()])
    residual = np.stack(found.residuals).ravel() + ((found.model.quantities - NOMINAL) / SIGMA) @ known

    def least(columns):
        prior = np.diag([1.0] * 3 + [0.0] * (len(columns) - 3))
        matrix, vector = (columns * weight) @ columns.T + prior, (columns * weight) @ residual
        best = np.linalg.solve(matrix, vector)
        return float(residual * weight @ residual - best @ vector), best

    before, _ = least(known)
    after, best = least(both)
    return before - after, best[-1]


@pytest.mark.parametrize("size", [0.15, 0.6])
def test_gain_and_amplitude_are_those_of_least_squares(size):
    problem = Toy({"gain": 1.0, "mass": -0.5}, [sized("drag", size, "left")], white=1.4, error=0.5)
    found, _, scores = screened(problem)
    for name, where, shape in [
        ("drag", ("left",), problem.shape("drag left")),
        ("drag", ("left", "right"), problem.shape("drag left") + problem.shape("drag right")),
        ("decoy_1", ("body",), problem.shape("decoy_1 body")),
    ]:
        gain, amplitude = exact_gain(problem, found, shape)
        score = score_of(scores, name, where)
        assert score.gain == pytest.approx(gain, rel=0.01, abs=0.3)
        assert score.values[0] == pytest.approx(amplitude, rel=0.01, abs=0.01)


def test_truth_comes_first_and_its_first_guess_is_near():
    problem = Toy({"gain": -1.0}, [sized("drag", 0.5, "right")], white=1.0, error=1.0)
    _, _, scores = screened(problem)
    assert scores[0].candidate.label == "drag right"
    assert scores[0].values[0] == pytest.approx(0.5, abs=0.1)
    assert [s.gain for s in scores] == sorted((s.gain for s in scores), reverse=True)


def test_what_a_known_number_imitates_gets_nothing():
    problem = Toy({"gain": 1.5}, white=1.5)
    _, _, scores = screened(problem)
    copy = score_of(scores, "copy")
    assert copy.gain < 5.0
    assert copy.own < 0.01
    assert all(score_of(scores, name).own > 0.5 for name in DECOYS)


def test_number_at_its_bound_is_scored_as_an_effect():
    problem = Toy({"gain": REACH + 3.0}, white=1.5)
    found, _, scores = screened(problem)
    copy = score_of(scores, "copy")
    assert scores[0].candidate.name == "copy"
    assert copy.gain > 2 * LEAST_GAIN
    assert copy.values[0] == pytest.approx(REACH + 3.0, rel=0.03)  # the quantity goes back to where its file says
    assert found.model.quantities[0] == pytest.approx(NOMINAL[0] + REACH * SIGMA[0])


def test_finite_probe_finds_what_has_no_slope_at_neutral():
    problem = Toy({}, [sized("play", 1.2)], white=1.0)
    _, _, scores = screened(problem)
    assert scores[0].candidate.name == "play"
    assert scores[0].values[0] == pytest.approx(1.2, abs=0.05)


def test_two_unknowns_are_projected_together():
    toy = Toy()
    problem = Toy({}, [candidate(toy, "ripple").effect((0.8, 1.1))], white=1.0)
    _, _, scores = screened(problem)
    assert scores[0].candidate.name == "ripple"
    assert scores[0].values == pytest.approx((0.8, 1.1), abs=0.08)


def test_first_guess_stays_plausible():
    problem = Toy({}, [sized("weak", 2.0)])
    _, _, scores = screened(problem)
    assert 0.0 <= score_of(scores, "weak").values[0] <= 0.5
    assert share_of_prediction(problem) == pytest.approx(1.0, abs=0.02)
    opposite = Toy({}, [sized("weak", -2.0)])
    assert score_of(screened(opposite)[2], "weak").values == (0.0,)


def share_of_prediction(problem):
    """Gain of a shortened first guess over the fall of the cost along the way, calibrated parameters at their best."""
    _found, responded, scores = screened(problem)
    weak, wide = (
        score_of(scores, "weak"),
        replace(candidate(problem, "weak"), unknowns=(Unknown("size", "1", 0.0, -99.0, 99.0, 1.0),)),
    )
    free = screen([wide], responded)[0]
    share = weak.values[0] / free.values[0]
    assert 0.0 < share < 1.0
    return weak.gain / (free.gain * (2 * share - share**2))


def test_best_of_several_starts_is_taken():
    problem = Toy({}, [sized("drag", 0.7, "right")], white=1.0)
    _found, responded, _ = screened(problem)
    wrong = Start((("drag left",),), lambda a: (9.0,))
    right = Start((("drag right",),), lambda a: (0.5 * float(a[0]),))
    both = Candidate("drag", ("right",), (Unknown("size", "1", 0.0, -10.0, 10.0, 1.0),), (wrong, right))
    assert screen([both], responded)[0].values[0] == pytest.approx(0.7, abs=0.1)


def test_effect_that_only_an_implausible_size_would_show_is_not_visible():
    problem = Toy(white=1.0, rows=200)
    assert score_of(screened(problem)[2], "decoy_0").visible
    blind = Toy(white=60.0, rows=20)
    scores = screened(blind)[2]
    assert not score_of(scores, "weak").visible
    told = float(score_of(scores, "weak").information[0, 0])
    assert 0.2 * np.sqrt(LEAST_GAIN / told) > 0.5


def test_all_probes_are_one_batch():
    problem = Toy()
    found = fit(problem, RUNS, nominal_model(problem))
    probes, _ = problem.candidates(found.model.setting, found.residuals, RUNS)
    before = problem.calls
    responses(problem, found, RUNS, probes)
    assert problem.calls - before == len(probes)
