"""Validation on held-out runs: bars, reduction and its interval, channels."""

from dataclasses import replace

import gap_examples as examples
import numpy as np
import pytest
from toy_problem import CHANNELS, NOISE, Toy, candidate, coloured, sized

from wlr_gym.gap.analysis import EFFECT_FOUND, NOTHING_MISSING, Place
from wlr_gym.gap.estimation import Replayed, fit, level, mean_squares, nominal_model
from wlr_gym.gap.report.text import made_worse
from wlr_gym.gap.selection.screening import LEAST_GAIN
from wlr_gym.gap.validation.held_out import _beyond_need, _interval, compare_models, reduction, worse_channels
from wlr_gym.gap.validation.localisation import MOST, informative_traces

FITTED, HELD_OUT = [0, 1, 2, 4], [3, 5, 6]


def models(problem, size=0.8):
    nominal = nominal_model(problem)
    calibrated = fit(nominal, FITTED).model
    return nominal, calibrated, fit(nominal.with_effect(candidate(problem, "drag", ["right"]), (size,)), FITTED).model


def test_mean_squares_skip_what_was_not_measured_and_cap_what_is_lost():
    residual = np.array([[1.0, np.nan, 200.0], [3.0, np.nan, 0.0]])
    squares = mean_squares([residual, np.full((2, 3), 2.0)], 10.0)
    assert squares[0][[0, 2]] == pytest.approx([5.0, 50.0])
    assert np.isnan(squares[0, 1])
    assert squares[1] == pytest.approx(4.0)
    assert level(np.array([[5.0, np.nan], [4.0, 3.0]])) == pytest.approx(2.0)


def test_reduction_is_the_closed_share_of_the_room_above_the_floor():
    square = np.array([[9.0]])
    assert reduction(square, np.array([[4.0]]), 1.0) == pytest.approx(0.5)
    assert reduction(square, np.array([[0.25]]), 1.0) == pytest.approx(1.25)
    assert reduction(square, np.array([[16.0]]), 1.0) == pytest.approx(-0.5)
    assert np.isnan(reduction(np.array([[1.0]]), np.array([[1.0]]), 1.0))


def drawn(rng, runs, share, spread):
    """Mean squares (runs, 1) of runs whose gaps differ, and what is left when this share of each is removed."""
    calibrated = rng.normal(5.0, 0.5, (runs, 1))
    left = 1.0 + (calibrated - 1.0) * (1.0 - rng.normal(share, spread, (runs, 1)))
    return calibrated**2, left**2


@pytest.mark.parametrize("runs", [3, 4])
@pytest.mark.parametrize("share", [0.8, -0.2])
def test_interval_holds_the_truth_as_often_as_it_says(runs, share):
    rng = np.random.default_rng(runs)
    truth = reduction(*drawn(rng, 200_000, share, 0.06), 1.0)
    inside = [low <= truth <= high for low, high in (_interval(*drawn(rng, runs, share, 0.06), 1.0) for _ in range(800))]
    assert 0.92 <= np.mean(inside) <= 0.97


def test_interval_is_student_s_of_leaving_out_one_run_after_the_other():
    calibrated, after = np.array([[25.0], [16.0], [36.0], [30.0]]), np.array([[4.0], [2.0], [9.0], [3.0]])
    left_out = []
    for k in range(4):
        kept = [r for r in range(4) if r != k]
        before, left = np.sqrt(calibrated[kept].mean()), np.sqrt(after[kept].mean())
        left_out.append((before - left) / (before - 1.0))
    half = 3.182 * np.sqrt(3 / 4 * np.sum((np.array(left_out) - np.mean(left_out)) ** 2))
    whole = reduction(calibrated, after, 1.0)
    assert _interval(calibrated, after, 1.0) == pytest.approx((whole - half, min(whole + half, 1.0)), rel=1e-3)


def test_interval_of_more_than_everything_keeps_its_lower_end():
    """What is left lies below the floor, which is simulated itself: 1 is told, and how far below it the truth may be."""
    calibrated, after = np.array([[25.0], [16.0], [36.0]]), np.array([[0.8], [0.85], [0.75]])
    assert reduction(calibrated, after, 1.0) > 1.02
    low, high = _interval(calibrated, after, 1.0)
    assert 0.99 < low < 0.999
    assert high == 1.0


def test_two_runs_give_no_interval():
    problem = Toy({"gain": 1.5}, [sized("drag", 1.5, "right")], runs=7)
    gap, runs, _ = compare_models(models(problem), FITTED, [3, 5], 1.0)
    assert np.isnan(gap.reduction_ci95).all()
    assert gap.reduction > 0.9
    single = [reduction(np.array([[r.calibrated**2]]), np.array([[r.after**2]]), 1.0) for r in runs]
    assert [r.reduction for r in runs] == pytest.approx(np.minimum(single, 1.0).tolist())


def test_true_effect_closes_the_gap_on_held_out_runs():
    problem = Toy({"gain": 1.5}, [sized("drag", 1.5, "right")], runs=7)
    gap, runs, channels = compare_models(models(problem), FITTED, HELD_OUT, 1.0)
    assert gap.heldout_before > gap.heldout_calibrated > gap.heldout_after
    assert gap.heldout_after == pytest.approx(1.0, abs=0.06)
    assert gap.fit_before > gap.fit_after
    assert gap.reduction > 0.9
    low, high = gap.reduction_ci95
    assert low <= gap.reduction <= high <= 1.0
    assert low > 0.5
    assert [(r.run, r.heldout) for r in runs] == [(f"run_{k + 1}", k in HELD_OUT) for k in (*FITTED, *HELD_OUT)]
    assert [c.channel for c in channels] == list(CHANNELS)
    assert {c.group for c in channels} == {"all"}
    assert [c.noise for c in channels] == list(NOISE)
    assert gap.metric == problem.metric


def test_bars_of_runs_add_up_to_the_whole():
    problem = Toy({"gain": 1.5}, [sized("drag", 1.0, "right")], runs=7)
    gap, runs, channels = compare_models(models(problem), FITTED, HELD_OUT, 1.0)
    held_out = [r.after for r in runs if r.heldout]
    assert np.sqrt(np.mean(np.square(held_out))) == pytest.approx(gap.heldout_after)
    assert np.sqrt(np.mean([c.after**2 for c in channels])) == pytest.approx(gap.heldout_after)
    assert np.sqrt(np.mean([r.before**2 for r in runs if not r.heldout])) == pytest.approx(gap.fit_before)


def test_effect_that_makes_runs_worse_is_seen_to():
    problem = Toy({"gain": 1.0}, error=1.0, runs=7)
    nominal, calibrated, _ = models(problem)
    wrong = calibrated.with_effect(candidate(problem, "drag", ["right"]), (1.0,))
    gap, _, _ = compare_models((nominal, calibrated, wrong), FITTED, HELD_OUT, 1.0)
    assert gap.heldout_after > 1.1 * gap.heldout_calibrated
    assert gap.reduction < -0.2
    assert gap.reduction_ci95[0] < gap.reduction < gap.reduction_ci95[1] < 0.0


def test_where_calibration_leaves_nothing_there_is_no_share_of_it():
    problem = Toy({"gain": 1.0}, runs=7)
    nominal, calibrated, _ = models(problem)
    gap, _, _ = compare_models((nominal, calibrated, calibrated), FITTED, HELD_OUT, 2.0)
    assert np.isnan([gap.reduction, *gap.reduction_ci95]).all()


def test_effect_of_one_run_only_has_a_wide_interval():
    problem = Toy(runs=8)
    held_out = [3, 4, 5, 6, 7]
    response = problem.effect_response(sized("drag", 2.0, "right"), 3)
    problem._measured[3] = problem._measured[3] + response * NOISE
    nominal = nominal_model(problem)
    whole = nominal.with_effect(candidate(problem, "drag", ["right"]), (0.9,))
    gap = compare_models((nominal, nominal, whole), [0, 1, 2], held_out, 0.9)[0]
    low, high = gap.reduction_ci95
    assert low < 0.0 < high
    assert low < gap.reduction < high


def test_channel_without_values_is_left_out():
    problem = Toy(runs=7)
    for measured in problem._measured:
        measured[:, 1] = np.nan
    gap, runs, channels = compare_models(models(problem), FITTED, HELD_OUT, 1.0)
    assert [c.channel for c in channels] == ["speed", "place"]
    assert np.isfinite([gap.heldout_after, *(r.after for r in runs)]).all()


def test_traces_show_held_out_runs_where_the_gap_is():
    problem = Toy({}, [sized("drag", 1.5, "right")], runs=7)
    traces = informative_traces(models(problem), HELD_OUT, (Place("place", 0.7, ""), Place("speed", 0.3, "")))
    assert [t.channel for t in traces] == ["place", "speed"]
    assert len(traces) <= MOST
    for trace in traces:
        assert trace.run in ("run_4", "run_6", "run_7")
        c = CHANNELS.index(trace.channel)
        assert trace.measured == pytest.approx(problem.measured(int(trace.run[-1]) - 1)[:, c])
        assert np.std(trace.measured - trace.after) == pytest.approx(NOISE[c], rel=0.15)
        assert np.std(trace.measured - trace.calibrated) > 1.2 * NOISE[c]


@pytest.mark.parametrize(("before", "after", "refuted"), [(1.0, 1.1, True), (1.0, 1.01, False), (1.1, 1.0, False)])
def test_effect_with_which_the_held_out_error_grows_must_gain_as_much_as_one_must_to_be_selected(before, after, refuted):
    """Channels that hardly err may gain likelihood while the error of all together grows."""
    noise = np.random.default_rng(0).standard_normal((400, 3))
    sizes = ([1.3, 1.0, 10.0 * before], [1.2, 1.0, 10.0 * after])
    one, two = (Replayed(nominal_model(Toy()), [0], [noise * size]) for size in sizes)
    tau = np.array([10.0, 10.0, 100.0])
    assert 0.0 < one.cost_under(tau) - two.cost_under(tau) < LEAST_GAIN
    assert (_beyond_need(one, two, tau) < 0.0) is refuted


# ---- channels that effects make worse --------------------------------------------------------------------------------


RUNS = [0, 2, 3]
ROWS = 1000


def left(residuals):
    """What a model leaves in the runs."""
    return Replayed(nominal_model(Toy(runs=4, rows=ROWS)), RUNS, residuals)


def coloured_left(seed):
    rng = np.random.default_rng(seed)
    return left([coloured(rng, (ROWS, 3), 0.9) for _ in RUNS])


def test_a_channel_that_gets_worse_in_all_runs_is_named_and_no_other():
    before = coloured_left(0)
    after = left([r * [1.0, 1.05, 1.005] for r in before.residuals])  # mean squares up by 0, 10 and 1 %
    assert worse_channels(before, after).tolist() == [False, True, False]
    assert not worse_channels(after, before).any()


def test_other_noise_of_the_same_size_is_not_worse():
    found = [worse_channels(coloured_left(k), coloured_left(1000 + k)) for k in range(60)]
    assert np.mean(found) <= 0.04


def test_one_bad_block_does_not_make_a_channel_worse():
    before, after = coloured_left(3), coloured_left(3)
    after.residuals[0][:50, 0] += 6.0
    assert np.sum(after.residuals[0][:, 0] ** 2) > 1.2 * np.sum(before.residuals[0][:, 0] ** 2)
    assert not worse_channels(before, after).any()


def test_channels_that_were_not_measured_are_neither():
    silent = left([np.full((ROWS, 3), np.nan) for _ in RUNS])
    assert not worse_channels(silent, silent).any()


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
