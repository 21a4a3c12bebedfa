"""Channels that effects make worse: found where they do, not where the residuals are only others."""

from dataclasses import replace

import gap_examples as examples
import numpy as np
from toy_problem import Toy, coloured

from wlr_gym.gap.analysis import EFFECT_FOUND, NOTHING_MISSING
from wlr_gym.gap.report.text import made_worse
from wlr_gym.gap.validation.held_out import worse_channels

RUNS = [0, 2, 3]
ROWS = 1000


def residuals(seed):
    rng = np.random.default_rng(seed)
    return [coloured(rng, (ROWS, 3), 0.9) for _ in RUNS]


def test_a_channel_that_gets_worse_in_all_runs_is_named_and_no_other():
    problem, before = Toy(runs=4, rows=ROWS), residuals(0)
    after = [r * [1.0, 1.05, 1.005] for r in before]  # mean squares up by 0, 10 and 1 %
    assert worse_channels(problem, RUNS, before, after).tolist() == [False, True, False]
    assert not worse_channels(problem, RUNS, after, before).any()


def test_other_noise_of_the_same_size_is_not_worse():
    problem = Toy(runs=4, rows=ROWS)
    found = [worse_channels(problem, RUNS, residuals(k), residuals(1000 + k)) for k in range(60)]
    assert np.mean(found) <= 0.04


def test_one_bad_block_does_not_make_a_channel_worse():
    problem, before = Toy(runs=4, rows=ROWS), residuals(3)
    after = [r.copy() for r in before]
    after[0][:50, 0] += 6.0
    assert np.sum(after[0][:, 0] ** 2) > 1.2 * np.sum(before[0][:, 0] ** 2)
    assert not worse_channels(problem, RUNS, before, after).any()


def test_channels_that_were_not_measured_are_neither():
    problem = Toy(runs=4, rows=ROWS)
    silent = [np.full((ROWS, 3), np.nan) for _ in RUNS]
    assert not worse_channels(problem, RUNS, silent, silent).any()


def test_the_report_says_so_first():
    fine = examples.ALL[EFFECT_FOUND]
    assert made_worse(fine) == ""
    first, second, *rest = fine.channel_gaps
    harmed = replace(first, calibrated=5.9, after=9.3, worse=True), replace(second, calibrated=2.0, after=2.1, worse=True)
    bad = replace(fine, channel_gaps=(*harmed, *rest))
    said = made_worse(bad)
    assert said.startswith(f"2 of {len(bad.channel_gaps)} channels get significantly worse in the held-out runs: ")
    assert said.index("5.90 to 9.30") < said.index("2.00 to 2.10")
    assert made_worse(replace(bad, channel_gaps=(harmed[0], *rest))).startswith("One channel gets ")
    many = [replace(gap, worse=True) for gap in bad.channel_gaps]
    assert made_worse(replace(bad, channel_gaps=tuple(many))).endswith(f" and {len(many) - 4} more.")
    assert made_worse(replace(examples.ALL[NOTHING_MISSING], channel_gaps=harmed)) == ""
