"""Where the gap is: channels by their share, states it depends on, heat maps."""

import numpy as np
import pytest
from toy_problem import CHANNELS, Toy

from wlr_gym.gap.estimation import Replayed, estimate_noise, nominal_model
from wlr_gym.gap.validation.localisation import BINS, localise

RUNS = 4


def states(problem):
    return [{"rate": problem.shape("rate")[r][:, 0], "unrelated": problem.shape("other")[r][:, 1]} for r in range(RUNS)]


def localised(residuals, problem, expected=None):
    return located(problem, residuals, states(problem), np.ones(3) if expected is None else expected)


def located(problem, residuals, features, expected):
    return localise(Replayed(nominal_model(problem), range(RUNS), residuals), expected, estimate_noise(residuals), features)


def white(problem, seed=0, size=1.0):
    rng = np.random.default_rng(seed)
    return [size * rng.standard_normal((problem.rows, 3)) for _ in range(RUNS)]


def test_channel_with_the_gap_comes_first_and_says_where():
    problem = Toy(runs=RUNS, rows=400)
    residuals = white(problem)
    for residual, own in zip(residuals, states(problem), strict=True):
        residual[:, 2] += np.where(own["rate"] > 0.8, 4.0, 0.0)
        residual[:, 0] += 0.5
    places, maps = localised(residuals, problem)
    assert places[0].name == "place"
    assert places[0].share > 0.6
    assert sum(p.share for p in places) == pytest.approx(1.0, abs=0.1)
    assert "largest for rate above" in places[0].dependence
    assert maps[0].feature == "rate"
    row = maps[0].values[maps[0].channels.index("place")]
    assert row.shape == (BINS,)
    assert np.argmax(row) == BINS - 1
    assert row[-1] > 2.5
    assert row[0] == pytest.approx(1.0, abs=0.15)


def test_a_range_without_data_is_not_where_the_error_is_smallest():
    problem = Toy(runs=RUNS, rows=400)
    residuals = white(problem)
    gains = [np.repeat([100.0, 200.0, 400.0, 800.0], 100)] * RUNS
    for residual in residuals:
        residual[:, 2] += np.where(gains[0] > 300.0, 6.0, 0.0)
    places, _ = located(problem, residuals, [{"gain": gain} for gain in gains], np.ones(3))
    smallest = places[0].dependence.partition("smallest ")[2]
    assert smallest.startswith(("100 to ", "200 to "))
    assert float(smallest.rpartition("(")[2].rstrip(")")) == pytest.approx(1.0, abs=0.1)


def test_heat_map_is_the_root_mean_square_in_each_bin():
    problem = Toy(runs=RUNS, rows=300)
    residuals = white(problem, 3, 3.0)
    for residual, own in zip(residuals, states(problem), strict=True):
        residual[:, 1] *= np.where(np.abs(own["rate"]) > 1.0, 4.0, 1.0)
    _, maps = localised(residuals, problem)
    rate = np.concatenate([own["rate"] for own in states(problem)])
    rows = np.concatenate(residuals)
    chart = maps[0]
    edges = [float(label.split()[-1]) for label in chart.bins[:-1]]
    assert edges == [round(edge, 1) for edge in edges]
    bins = np.searchsorted(edges, rate, side="right")
    for b in range(BINS):
        expected = np.sqrt(np.mean(rows[bins == b, 1] ** 2))
        assert chart.values[chart.channels.index("torque"), b] == pytest.approx(expected, rel=0.02)


def test_what_a_complete_model_leaves_too_is_no_gap():
    problem = Toy(runs=RUNS, rows=300)
    residuals = white(problem)
    for residual in residuals:
        residual[:, 0] *= 3.0
        residual[:, 1] *= 2.0
    places, _ = localised(residuals, problem, np.array([9.5, 1.0, 1.0]))
    assert places[0].name == "torque"
    assert "speed" not in [p.name for p in places]


def test_nothing_left_is_nowhere():
    problem = Toy(runs=RUNS, rows=200)
    assert localised(white(problem, size=0.5), problem) == ((), ())


def test_slow_errors_count_less_than_quick_ones():
    problem = Toy(runs=RUNS, rows=400)
    residuals = white(problem)
    for residual in residuals:
        residual[:, 0] = 2.0 * np.sign(np.sin(np.arange(400) / 30.0))
        residual[:, 1] *= 2.0
    shares = {p.name: p.share for p in localised(residuals, problem)[0]}
    assert shares["torque"] > 5 * shares.get("speed", 0.0)


def test_missing_values_and_channels():
    problem = Toy(runs=RUNS, rows=300)
    residuals = white(problem)
    for residual, own in zip(residuals, states(problem), strict=True):
        residual[:, 2] += np.where(own["rate"] > 0.8, 4.0, 0.0)
        residual[::2, 2] = np.nan
        residual[:, 1] = np.nan
    places, maps = localised(residuals, problem)
    assert places[0].name == "place"
    assert "torque" not in [p.name for p in places]
    assert np.isfinite(maps[0].values).all()
    assert localised(residuals, problem, np.array([1.0, np.nan, 1.0]))[0] == places  # what no run measured has no level


def test_one_lost_reading_does_not_hide_the_rest():
    problem = Toy(runs=RUNS, rows=300)
    residuals = white(problem)
    residuals[0][5, 0] = 1e6
    for residual in residuals:
        residual[:, 2] *= 6.0
    places, _ = localised(residuals, problem)
    assert places[0].name == "place"
    assert {p.name for p in places} <= set(CHANNELS)


def test_constant_state_is_no_reason():
    problem = Toy(runs=RUNS, rows=200)
    residuals = white(problem, size=3.0)
    features = [{"parked": np.zeros(200)} for _ in range(RUNS)]
    places, maps = located(problem, residuals, features, np.ones(3))
    assert maps == ()
    assert {p.dependence for p in places} == {"no clear dependence on the state"}
