"""Confidence intervals: they cover what they claim to, and pairing pays."""

import numpy as np
import pytest

from wlr_gym.learning.evaluation.metrics import Bootstrap


def pairs(values):
    values = np.asarray(values, float)
    return np.stack([values, np.ones_like(values)], axis=-1)


def test_the_interval_covers_the_truth_as_often_as_it_says():
    draws, resampling, covered, trials = np.random.default_rng(1), Bootstrap(1, 60), 0, 300
    for _ in range(trials):
        estimate = resampling.mean(pairs(draws.normal(3.0, 1.0, (1, 60))))
        covered += estimate.low <= 3.0 <= estimate.high
    assert 0.90 <= covered / trials <= 0.98


def test_seeds_that_differ_widen_the_interval():
    noise = np.random.default_rng(0).normal(0.0, 1.0, (5, 200))
    resampling = Bootstrap(5, 200)
    alike, apart = resampling.mean(pairs(noise)), resampling.mean(pairs(noise + np.arange(5)[:, None]))
    assert apart.high - apart.low > 5 * (alike.high - alike.low)


def test_pairing_sees_a_difference_far_below_the_spread():
    floors = np.random.default_rng(0).normal(10.0, 5.0, (2, 100))
    resampling = Bootstrap(2, 100)
    ours, theirs = pairs(floors), pairs(floors + 0.1)
    difference = resampling.difference(ours, theirs)
    assert (difference.mean, difference.low, difference.high) == pytest.approx((-0.1, -0.1, -0.1))
    assert difference.excludes_zero
    assert resampling.mean(ours).high > resampling.mean(theirs).low


def test_reduction_and_share():
    resampling = Bootstrap(1, 10)
    ones = np.ones((1, 10))
    assert resampling.reduction(pairs(3 * ones), pairs(4 * ones)).mean == pytest.approx(25.0)
    share = resampling.share(pairs(8 * ones), pairs(12 * ones), pairs(2 * ones), pairs(4 * ones), subjects=(0, 1, 2, 2))
    assert share.mean == pytest.approx(75.0)


def test_a_share_of_less_than_nothing_says_nothing():
    """Worse than both: the quotient of two negative scores would be 150 %."""
    resampling, ones = Bootstrap(1, 10), np.ones((1, 10))
    idle = pairs(4 * ones)
    assert np.isnan(resampling.share(pairs(ones), pairs(2 * ones), idle, idle, subjects=(0, 1, 2, 2)).mean)
    assert np.isnan(resampling.reduction(pairs(ones), pairs(-ones)).mean)


def test_ratios_weigh_by_their_denominator():
    values = np.array([[[1.0, 1.0], [1.0, 9.0]]])
    assert Bootstrap(1, 2).mean(values).mean == pytest.approx(0.2)


def test_nothing_over_nothing_is_nothing():
    resampling = Bootstrap(1, 3)
    assert np.isnan(resampling.mean(np.zeros((1, 3, 2))).mean)
    assert np.isnan(resampling.reduction(pairs(np.ones((1, 3))), pairs(np.zeros((1, 3)))).low)


def test_the_same_resamples_every_time():
    values = pairs(np.random.default_rng(0).normal(size=(3, 20)))
    assert Bootstrap(3, 20).mean(values) == Bootstrap(3, 20).mean(values)


def test_quantiles_of_resampled_episodes():
    """Against numpy's own quantile of repeated episodes, for every resample."""
    values = np.random.default_rng(0).lognormal(0.0, 1.0, (2, 3, 20))
    resampling = Bootstrap(3, 20)
    found = resampling.scores(pairs(values), 0.9)
    for row in (0, 1, 77, 2000):
        counts = np.ones(60) if row == 0 else resampling._weights[row - 1]
        for seed in range(2):
            repeated = np.repeat(values[seed].ravel(), counts.astype(int))
            assert found[row, seed] == np.quantile(repeated, 0.9, method="inverted_cdf")
    assert resampling.mean(pairs(values), 0.5).mean == pytest.approx(
        np.mean([np.quantile(values[seed], 0.5, method="inverted_cdf") for seed in range(2)])
    )


def test_one_episode_has_no_interval():
    assert np.isnan(Bootstrap(1, 1).mean(np.ones((1, 1, 1, 2))).low)
    assert Bootstrap(1, 2).mean(np.ones((1, 1, 2, 2))).low == 1.0
