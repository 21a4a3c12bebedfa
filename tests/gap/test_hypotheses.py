"""Probability of names: what unknowns cost, none of them, and the set of names that the data leave."""

from dataclasses import replace

import numpy as np
import pytest
from toy_problem import Toy, candidate, sized

from wlr_gym.gap.estimation import Replayed, fit, nominal_model
from wlr_gym.gap.problem import Start
from wlr_gym.gap.selection.hypotheses import Hypothesis, credible_names, occam, probabilities
from wlr_gym.gap.selection.screening import Score
from wlr_gym.gap.selection.search import search_effects

RUNS = range(5)


def score(problem, name, information):
    own = candidate(problem, name)
    return Score(own, (0.0,) * len(own.unknowns), 0.0, 1.0, np.atleast_2d(information), own.starts[0])


def hypothesis(problem, name, gain, cost=0.0):
    own, nominal = candidate(problem, name), nominal_model(problem)
    model = nominal.with_effect(own, (1.0,) * len(own.unknowns))
    return Hypothesis(model, RUNS, [], Replayed(nominal, RUNS, []), gain, np.full(5, gain / 5), 1.0, occam=cost)


def test_an_unknown_costs_what_it_is_known_better_than_beforehand():
    """Exactly, for one number: the Gaussian integral over its prior, beside the best value alone."""
    problem, information, tempering = Toy(), 40.0, 3.0
    one = score(problem, "decoy_0", information)
    low, high = one.candidate.unknowns[0].low, one.candidate.unknowns[0].high
    amplitude = np.linspace(-400.0, 400.0, 2_000_001)  # probes of 0.5
    weight = np.exp(-0.5 * (information * amplitude**2 + tempering * (2.0 * 0.5 * amplitude / (high - low)) ** 2))
    prior = np.exp(-0.5 * tempering * (2.0 * 0.5 * amplitude / (high - low)) ** 2)
    assert occam(one, tempering) == pytest.approx(-2.0 * np.log(weight.sum() / prior.sum()), rel=0.02)


def test_two_unknowns_cost_more_than_one_and_do_not_win_by_little():
    problem = Toy()
    single, double = score(problem, "decoy_0", 40.0), score(problem, "ripple", 40.0 * np.eye(2))
    less, more = occam(single, 1.0), occam(double, 1.0)
    assert more > less + 3.5
    found, none = probabilities(
        [hypothesis(problem, "ripple", 100.8, more), hypothesis(problem, "decoy_0", 100.0, less)], [single, double]
    )
    assert found[1] > 0.8
    assert sum(found) + none == pytest.approx(1.0)


def test_small_gains_among_many_candidates_are_none_of_them():
    problem = Toy()
    scores = [score(problem, f"decoy_{k}", 40.0) for k in range(5)] * 20
    (little,), none = probabilities([hypothesis(problem, "decoy_0", 12.0, 6.0)], scores)
    assert none > 0.8 > little
    (much,), none = probabilities([hypothesis(problem, "decoy_0", 60.0, 6.0)], scores)
    assert much > 1.0 - 1e-6 > none
    (allowed,), none = probabilities([replace(hypothesis(problem, "decoy_0", 60.0, 6.0), tolerable=True)], scores)
    assert (allowed, none) == (0.0, 1.0)


def test_the_set_holds_the_fewest_names_and_places_of_a_name_count_together():
    problem = Toy()
    names = ("decoy_0", "decoy_1", "decoy_2", "decoy_2", "decoy_3")
    several = [hypothesis(problem, name, 50.0) for name in names]
    assert credible_names(several, [0.3, 0.1, 0.3, 0.28, 0.02]) == ["decoy_2", "decoy_0", "decoy_1"]
    assert credible_names(several, [0.96, 0.01, 0.01, 0.01, 0.01]) == ["decoy_0"]
    assert credible_names([], []) == []


def test_a_search_keeps_the_names_that_respond_alike_and_those_alone():
    problem = Toy({}, [sized("drag", 3.0, "left")])
    first = search_effects(fit(nominal_model(problem), RUNS)).rounds[0]
    assert first.selected is not None
    assert {first.selected.candidate.name, *(h.candidate.name for h in first.equivalents)} == {"drag", "twin"}
    assert first.probabilities[1] < 1e-6
    last = search_effects(fit(nominal_model(Toy()), RUNS)).rounds[-1]
    assert last.selected is None
    assert last.probabilities[1] > 0.5
    assert last.equivalents == []


def test_another_start_than_the_one_that_was_scored_is_no_error():
    one = score(Toy(), "ripple", 40.0 * np.eye(2))
    other = Start((one.start.directions[0],), lambda a: (float(a[0]), 0.0))
    assert 0.0 < occam(replace(one, start=other), 1.0) < occam(one, 1.0)
