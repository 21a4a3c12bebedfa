"""By how much an effect must improve the fit: what chance gives on the same data, whatever the effect that they hold."""

from dataclasses import replace

import numpy as np
import pytest
from toy_problem import Toy, sized

from wlr_gym.gap.estimation.fit import fit
from wlr_gym.gap.estimation.model import estimate_noise, nominal_model
from wlr_gym.gap.selection.screening import (
    LEAST_GAIN,
    LEAST_SHARE,
    PER_UNKNOWN,
    Products,
    acceptance_threshold,
    largest_by_chance,
    rescored,
    responses,
    screen,
)

RUNS = range(5)
#: Rows of a run: 20 s.
ROWS = 1000


def by_chance(problem, scatter=1.0):
    """Largest improvements of the draws, and that of the data themselves, to first order."""
    found = fit(problem, RUNS, nominal_model(problem))
    found = replace(found, noise=estimate_noise(found.residuals, scatter=scatter))
    probes, candidates = problem.candidates(found.model.setting, found.residuals, RUNS)
    responded = responses(problem, found, RUNS, probes)
    products, first = Products.of(found, responded), screen(candidates, responded)
    scores, _ = rescored(problem, found, responded, products, first)
    actual = max(score.gain - PER_UNKNOWN * (len(score.values) - 1) for score in first)
    return largest_by_chance(problem, RUNS, found, responded, products, scores), actual


def test_the_draws_are_as_large_as_what_data_without_an_effect_give():
    beyond = {0.5: 0, 0.98: 0}
    for seed in range(30):
        drawn, actual = by_chance(Toy(seed=seed, rows=ROWS, error=1.0))
        for share in beyond:
            beyond[share] += actual > np.quantile(drawn, share)
    assert 6 <= beyond[0.5] <= 24  # half of them, but for chance
    assert beyond[0.98] <= 3


def test_an_effect_in_the_data_does_not_raise_the_threshold():
    without, with_it = (
        np.quantile(by_chance(Toy({}, effects, rows=ROWS))[0], 0.98) for effects in ([], [sized("drag", 4.0, "left")])
    )
    assert by_chance(Toy({}, [sized("drag", 4.0, "left")], rows=ROWS))[1] > 50.0 * without
    assert with_it == pytest.approx(without, rel=0.35)


def test_where_the_noise_counts_less_chance_gives_less():
    plain, wide = (np.median(by_chance(Toy(rows=ROWS), scatter)[0]) for scatter in (1.0, 4.0))
    assert wide == pytest.approx(plain / 4.0, rel=0.3)


def test_the_threshold_is_the_highest_of_chance_an_imperfect_simulator_and_what_is_left():
    draws = np.linspace(0.0, 50.0, 101)
    assert acceptance_threshold(0.0, draws) == pytest.approx(49.0)
    assert acceptance_threshold(0.0, draws / 10.0) == LEAST_GAIN
    assert acceptance_threshold(0.0, np.zeros(0)) == LEAST_GAIN
    assert acceptance_threshold(5e3, draws) == pytest.approx(LEAST_SHARE * 5e3)
