"""Fit, likelihood and intervals against closed forms: least squares with priors, AR(1) residuals, Monte Carlo, jackknife."""

from dataclasses import replace

import numpy as np
import pytest
from toy_problem import NOISE, NOMINAL, QUANTITIES, REACH, SIGMA, STRENGTH, Toy, candidate, coloured, sized

from wlr_gym.gap.estimation import (
    LONGEST,
    TWO_SIDED_95,
    FittedModel,
    Replayed,
    bounded_minimum,
    corrected,
    estimate_noise,
    estimates,
    fit,
    half_widths,
    linearise,
    minus_two_log_likelihood,
    nominal_model,
    normal_equations,
    replay,
    two_sided_95,
    widened,
)
from wlr_gym.gap.problem import Candidate, Start, Tolerance, Unknown
from wlr_gym.gap.selection.hypotheses import Hypothesis, selection_frequency
from wlr_gym.gap.selection.screening import LEAST_GAIN, Score, detectable, least_gain, responses, screen
from wlr_gym.gap.selection.search import search_effects

RUNS = range(5)


def test_autocorrelation_time_of_white_noise_is_one_and_of_ar1_the_closed_form():
    rng = np.random.default_rng(3)
    white = [rng.standard_normal((4000, 2)) for _ in range(3)]
    assert estimate_noise(white).autocorrelation_time == pytest.approx([1.0, 1.0], abs=0.15)
    for rho in (0.5, 0.8, 0.9):
        series = [coloured(rng, (2000, 20), rho) for _ in range(2)]
        assert np.mean(estimate_noise(series).autocorrelation_time) == pytest.approx((1 + rho) / (1 - rho), rel=0.15)


def test_autocorrelation_time_counts_measured_rows_only_and_ends_somewhere():
    rng = np.random.default_rng(4)
    sparse = rng.standard_normal((900, 2))
    sparse[:, 1] = np.nan
    sparse[::3, 1] = coloured(rng, (300, 1), 0.5)[:, 0]
    noise = estimate_noise([sparse])
    assert noise.rows.tolist() == [900, 300]
    assert noise.autocorrelation_time[1] == pytest.approx(3.0, rel=0.35)
    stuck = estimate_noise([np.ones((5000, 1))])
    assert 1.0 < stuck.autocorrelation_time[0] < 2 * LONGEST


def test_level_is_the_root_mean_square_and_never_below_the_sensor():
    rng = np.random.default_rng(5)
    residuals = [rng.standard_normal((500, 3)) * np.array([0.2, 1.0, 4.0]) for _ in range(2)]
    noise = estimate_noise(residuals, np.array([1.0, 2.0, 5.0]))
    assert noise.level[0] == 1.0
    assert noise.level[2] == pytest.approx(np.sqrt(np.mean(np.concatenate(residuals)[:, 2] ** 2)))
    assert noise.weight[2] == pytest.approx(1 / (noise.level[2] ** 2 * 5.0))


def test_channel_that_was_not_measured_weighs_nothing():
    residual = np.full((50, 2), np.nan)
    residual[:, 0] = 2.0
    noise = estimate_noise([residual])
    assert noise.weight[1] == 0.0
    assert noise.weight[0] > 0.0
    assert np.isfinite(minus_two_log_likelihood([residual], noise.autocorrelation_time))


def test_likelihood_is_rows_over_autocorrelation_time_times_log_level():
    rng = np.random.default_rng(6)
    residuals = [3.0 * rng.standard_normal((400, 1)), 3.0 * rng.standard_normal((100, 1))]
    square = np.mean(np.concatenate(residuals) ** 2)
    assert minus_two_log_likelihood(residuals, np.array([4.0])) == pytest.approx(500 / 4.0 * np.log(square))


class Constant(Toy):
    """Its offset moves one channel by a constant, as a supply's voltage moves the voltage that is measured."""

    def shape(self, name):
        waves = super().shape(name)
        return np.where(np.arange(waves.shape[-1]) == 2, 5.0, 0.0 * waves) if name == "offset" else waves


def test_a_constant_error_that_a_number_can_remove_is_no_single_reading():
    problem = Constant({"offset": 1.5})
    found = fit(nominal_model(problem), RUNS, scatter=15.0)
    assert found.model.scaled[1] - nominal_model(problem).scaled[1] == pytest.approx(1.5, abs=0.05)
    assert found.noise.autocorrelation_time[2] / found.noise.scatter < 2.0


def test_a_fit_does_not_slide_back_as_what_is_left_lasts_longer():
    """A constant that is left lengthens the autocorrelation time: were it to count, the tolerance would pull it further."""

    class Held(Constant):
        tempering = 12.0

        def shape(self, name):
            return 0.1 * super().shape(name) if name == "offset" else super().shape(name)

    found = []
    for seed in range(6):
        problem = Held({"offset": 2.0}, seed=seed, error=0.5, white=0.3, rows=1000)
        fitted = fit(nominal_model(problem), RUNS, scatter=30.0)
        found.append((fitted.model.scaled - nominal_model(problem).scaled)[1])
    assert np.mean(found) > 0.95  # 0.84 where it slides


def test_runs_that_differ_by_what_the_numbers_can_explain_scatter_less_than_assumed():
    problem = Toy({"gain": 2.0})
    found = fit(nominal_model(problem), RUNS, scatter=100.0)
    assert found.model.scaled[0] - nominal_model(problem).scaled[0] == pytest.approx(2.0, abs=0.1)
    assert found.noise.scatter < 5.0


def test_columns_are_the_responses():
    problem = Toy()
    model = nominal_model(problem).with_effect(candidate(problem, "drag", ["left"]), (0.3,))
    now, columns = linearise(model, RUNS)
    step = model.effects[0][0].unknowns[0].step
    for r in RUNS:
        for row, name in zip(columns[r], QUANTITIES, strict=False):
            assert row.reshape(now.residuals[r].shape) == pytest.approx(-STRENGTH * problem.shape(name)[r], abs=1e-5)
        assert columns[r][3].reshape(now.residuals[r].shape) == pytest.approx(-step * problem.shape("drag left")[r], abs=1e-5)


def test_columns_at_a_bound_are_taken_inwards():
    problem = Toy()
    high = FittedModel(problem, NOMINAL + REACH * SIGMA)
    _, columns = linearise(high, [0])
    assert columns[0][0] == pytest.approx(-STRENGTH * problem.shape("gain")[0].ravel(), abs=1e-5)


@pytest.mark.parametrize(("scatter", "simulated"), [(1.0, 5), (1e9, 2)])
def test_idle_numbers_keep_their_columns(scatter, simulated):
    """Where runs scatter that much, the data say nothing of calibrated parameters; an effect's response is simulated anew."""
    problem = Toy()
    near = linearise(nominal_model(problem), RUNS)[1]
    noise = estimate_noise([r[0] for r in problem.residuals([nominal_model(problem).setting], RUNS)], None, scatter)
    marked = [columns + np.float32(1.0) for columns in near]
    model = nominal_model(problem).with_effect(candidate(problem, "drag", ["left"]), (0.3,))
    true, before = linearise(model, RUNS)[1], problem.calls
    columns = linearise(model, RUNS, marked, noise)[1]
    assert problem.calls - before == simulated
    for found, kept, right in zip(columns, marked if scatter > 1.0 else true, true, strict=True):
        assert np.array_equal(found[:3], kept[:3])
        assert np.array_equal(found[3], right[3])


def test_a_fit_has_converged_where_its_last_descent_led_nowhere():
    problem = Toy({"gain": 2.0}, rows=400)
    first = fit(nominal_model(problem), RUNS, steps=1)
    assert not first.converged
    assert fit(first.model, RUNS, steps=1).converged
    assert not fit(first.model, RUNS, steps=0).converged


def exact(problem, weight, columns, tight=(1.0,)):
    """Weighted least squares with priors that count ``tight`` times: scaled numbers away from nominal."""
    matrix, vector = np.eye(columns[0].shape[0]) * np.array(tight), np.zeros(columns[0].shape[0])
    residuals = problem.residuals([nominal_model(problem).setting], range(len(problem.runs)))
    for column, residual in zip(columns, residuals, strict=True):
        weights = np.broadcast_to(weight, residual[0].shape).ravel()
        matrix += (column * weights) @ column.T
        vector += (column * weights) @ residual[0].ravel()
    return np.linalg.solve(matrix, vector), matrix


def shape_columns(problem, names=QUANTITIES):
    return [np.stack([STRENGTH * problem.shape(n)[r].ravel() for n in names]) for r in range(len(problem.runs))]


@pytest.mark.parametrize("seed", range(3))
def test_linear_fit_is_weighted_least_squares_with_priors(seed):
    problem = Toy({"gain": 1.2, "offset": -0.7, "mass": 0.3}, seed=seed, white=2.0, error=1.5)
    found = fit(nominal_model(problem), RUNS, steps=4)
    # weights depend on the level: the closed form with those of the fit must come back
    best, matrix = exact(problem, found.noise.weight, shape_columns(problem))
    assert (found.model.quantities - NOMINAL) / SIGMA == pytest.approx(best, abs=0.01)
    assert found.covariance() == pytest.approx(np.linalg.inv(matrix), rel=1e-3, abs=1e-7)


def test_imperfect_simulator_moves_a_number_only_for_what_is_said_louder():
    problem = Toy({"gain": 1.2, "offset": -0.7, "mass": 0.3}, white=2.0, error=1.5)
    problem.tempering = 30.0
    problem.quantities = (*problem.quantities[:2], replace(problem.quantities[2], drifts=True))
    found = fit(nominal_model(problem), RUNS)
    best, matrix = exact(problem, found.noise.weight, shape_columns(problem), (30.0, 30.0, 1.0))
    assert (found.model.quantities - NOMINAL) / SIGMA == pytest.approx(best, abs=0.01)
    told = matrix - np.diag([30.0, 30.0, 1.0])
    assert found.covariance() == pytest.approx(np.linalg.inv(told / 30.0 + np.eye(3)), rel=1e-3, abs=1e-7)
    assert found.model.untouched().quantities.tolist() == [*NOMINAL[:2], found.model.quantities[2]]


def test_corrected_columns_predict_the_step_and_nothing_else_changes():
    rng = np.random.default_rng(1)
    columns, taken = rng.standard_normal((4, 60)).astype(np.float32), np.array([0.5, 0.0, -2.0, 0.1])
    before, after = rng.standard_normal((2, 20, 3))
    before[3, 1] = np.nan
    new = corrected(columns, taken, before, after)
    assert taken @ new == pytest.approx(np.nan_to_num(after - before).ravel(), abs=1e-5)
    across = np.array([2.0, 7.0, 0.5, 0.0])  # at right angles to the step
    assert across @ new == pytest.approx(across @ columns, abs=1e-5)


def test_columns_from_far_away_are_good_enough_once_corrected():
    """One linearisation where the effect hardly does anything: its response grows with its square."""
    toy = Toy()
    play = candidate(toy, "play")
    problem = Toy({"gain": -1.0}, [play.effect((2.4,))])
    found = fit(nominal_model(problem).with_effect(play, (0.4,)), RUNS, steps=1)
    assert found.model.effects[0][1] == pytest.approx((2.4,), abs=0.05)


def test_weak_data_leave_a_number_where_its_file_says():
    problem = Toy({"gain": 1.0}, runs=1, rows=40, white=8.0)
    found = fit(nominal_model(problem), [0])
    best, _ = exact(problem, found.noise.weight, shape_columns(problem))
    assert (found.model.quantities - NOMINAL) / SIGMA == pytest.approx(best, abs=0.1)
    assert np.sqrt(np.diag(found.covariance())).max() <= 1.0  # never less sure than the tolerance


def test_cost_is_minus_two_log_posterior_and_falls():
    problem = Toy({"gain": 1.5}, white=1.5)
    start = nominal_model(problem)
    found = fit(start, RUNS)
    residuals = [r[0] for r in problem.residuals([found.model.setting], RUNS)]
    assert found.cost == pytest.approx(
        minus_two_log_likelihood(residuals, found.noise.autocorrelation_time) + found.model.prior_cost
    )
    (before,) = replay([start], RUNS)
    assert found.cost < before.cost_under(found.noise.autocorrelation_time) - 100.0
    assert found.model.prior_cost == pytest.approx(np.sum(((found.model.quantities - NOMINAL) / SIGMA) ** 2))


def test_number_beyond_reach_stops_there_and_the_others_take_no_blame():
    problem = Toy({"gain": 5.0, "offset": 1.0}, white=1.5)
    found = fit(nominal_model(problem), RUNS)
    scaled = (found.model.quantities - NOMINAL) / SIGMA
    assert scaled[0] == pytest.approx(REACH)
    assert found.model.on_bounds.tolist() == [True, False, False]
    assert scaled[1] == pytest.approx(1.0, abs=0.3)
    assert found.covariance()[0, 0] < 1e-6  # pinned


def test_moved_keeps_numbers_in_their_ranges():
    problem = Toy()
    model = nominal_model(problem).with_effect(candidate(problem, "weak"), (0.3,))
    far = model.moved(np.array([99.0, -99.0, 0.0, 99.0]))
    assert far.quantities == pytest.approx(NOMINAL + SIGMA * np.array([REACH, -REACH, 0.0]))
    assert far.effects[0][1] == (0.5,)
    assert far.scaled == pytest.approx([*(far.quantities / SIGMA), 0.5 / 0.025])


@pytest.mark.parametrize(("name", "values"), [("drag", (0.8,)), ("play", (1.1,)), ("ripple", (0.9, 0.7))])
def test_effect_is_fitted_beside_the_quantities(name, values):
    toy = Toy()
    chosen = candidate(toy, name)
    problem = Toy({"gain": -1.0}, [chosen.effect(values)], white=1.2)
    start = tuple(0.6 * v for v in values)
    found = fit(nominal_model(problem).with_effect(chosen, start), RUNS, steps=6)
    assert found.model.effects[0][1] == pytest.approx(values, abs=0.06)
    assert (found.model.quantities[0] - NOMINAL[0]) / SIGMA[0] == pytest.approx(-1.0, abs=0.1)
    assert found.noise.level == pytest.approx([1.2] * 3, rel=0.06)


def test_quiet_sensor_does_not_hide_a_wrong_number():
    """A sensor better than its data sheet leaves room below one noise unit: a wrong number must not hide in it."""
    problem = Toy({"gain": 0.8}, white=0.3)
    found = fit(nominal_model(problem), RUNS)
    best, _ = exact(problem, found.noise.weight, shape_columns(problem))
    assert (found.model.quantities - NOMINAL) / SIGMA == pytest.approx(best, abs=0.02)


def test_missing_values_count_nothing():
    problem = Toy({"gain": 1.0}, white=1.5)
    whole = fit(nominal_model(problem), RUNS)
    for measured in problem._measured:
        measured[::2, 1] = np.nan
        measured[:, 2] = np.nan
    found = fit(nominal_model(problem), RUNS)
    assert found.noise.rows.tolist() == [1000, 500, 0]
    assert found.model.quantities[0] == pytest.approx(whole.model.quantities[0], abs=0.2 * SIGMA[0])
    assert found.covariance()[0, 0] > whole.covariance()[0, 0]


def test_fit_tells_of_its_steps():
    told = []
    problem = Toy({"gain": 1.0}, white=1.5)
    fit(nominal_model(problem), RUNS, steps=3, tell=told.append)
    assert told
    assert told[0].startswith("step 1 of 3")


# ---- steps within bounds ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize("held", [False, True])
def test_bounded_minimum_satisfies_the_conditions_of_a_minimum(held):
    """No free number has a slope, and none that is held would return; several are active and depend on each other."""
    rng = np.random.default_rng(4)
    for _ in range(150):
        size = 12
        rows = rng.standard_normal((size, size + 3))
        rows[1], rows[3] = rows[0] + 0.2 * rows[1], 0.3 * rows[3] - rows[2]  # nearly the same, nearly opposite
        matrix, gradient = rows @ rows.T + 1e-3 * np.eye(size), 5.0 * rng.standard_normal(size)
        low, high = -rng.uniform(0.0, 1.0, size), rng.uniform(0.0, 1.0, size)
        low[5], high[5] = -np.inf, np.inf
        if held:
            low[7] = high[7] = 0.0
        x = bounded_minimum(matrix, gradient, low, high)
        assert (x >= low).all()
        assert (x <= high).all()
        slope = matrix @ x + gradient
        tolerance = 1e-6 * np.abs(gradient).max()
        at_low, at_high = x <= low + 1e-9, x >= high - 1e-9
        assert (np.abs(slope[~at_low & ~at_high]) < tolerance).all()
        assert (slope[at_low & ~at_high] > -tolerance).all()
        assert (slope[at_high & ~at_low] < tolerance).all()


# ---- intervals -------------------------------------------------------------------------------------------------------

TRUTH = {"gain": 0.8, "offset": -1.2, "mass": 0.4}


def fitted(problem, size=0.7):
    model = nominal_model(problem).with_effect(candidate(problem, "drag", ["right"]), (size,))
    return fit(model, range(len(problem.runs)))


@pytest.mark.slow
@pytest.mark.parametrize(("white", "error", "ar1"), [(1.5, 0.0, 0.0), (1.0, 1.5, 0.6)], ids=["white", "ar1"])
def test_intervals_cover_the_truth_as_often_as_they_say(white, error, ar1):
    inside, draws = [], 100
    for seed in range(draws):
        problem = Toy(TRUTH, [sized("drag", 0.7, "right")], seed=seed, white=white, error=error, ar1=ar1, runs=6, rows=120)
        found = fitted(problem, 0.5)
        inside.append(abs(found.model.effects[0][1][0] - 0.7) < half_widths(found)[-1])
    assert 0.88 <= np.mean(inside) <= 0.995


def test_curvature_is_the_spread_of_repeated_fits():
    values, errors = [], []
    for seed in range(60):
        problem = Toy(TRUTH, [sized("drag", 0.7, "right")], seed=seed, white=1.5, runs=6, rows=120)
        found = fitted(problem, 0.5)
        values.append(found.model.effects[0][1][0])
        step = found.model.effects[0][0].unknowns[0].step
        errors.append(np.sqrt(found.covariance()[-1, -1]) * step)
    assert np.mean(errors) == pytest.approx(np.std(values), rel=0.25)
    assert np.mean(values) == pytest.approx(0.7, abs=4 * np.mean(errors) / np.sqrt(60))


def test_differences_from_run_to_run_widen_the_interval():
    problem = Toy(white=1.5, runs=6)
    steady = Toy(white=1.5, runs=6)
    for r, size in enumerate((0.2, 1.2, 0.4, 1.0, 0.3, 1.1)):
        for toy, own in ((problem, size), (steady, 0.7)):
            toy._measured[r] = toy._measured[r] + toy.effect_response(sized("drag", own, "right"), r) * np.array(
                [0.1, 2, 0.001]
            )
    wide, narrow = (half_widths(fitted(toy))[-1] for toy in (problem, steady))
    # six sizes with a spread of 0.42: the error of their mean is 0.19, known to five degrees of freedom
    assert wide == pytest.approx(2.57 * 0.19, rel=0.5)
    assert wide > 2 * narrow


def test_few_runs_that_differ_tell_little_of_how_much_they_do():
    """What 1.96 jackknife errors of three runs hold is 80 %."""
    inside = []
    for seed in range(80):
        problem = Toy({}, seed=seed, runs=3, rows=60, reach=1000)
        problem.quantities = tuple(replace(q, sigma=100 * q.sigma) for q in problem.quantities)
        rng = np.random.default_rng([seed, 3])
        for r in range(3):
            problem._measured[r] = problem._measured[r] + NOISE * rng.normal(0.0, 1.0) * problem.shape("offset")[r]
        found = fit(nominal_model(problem), range(3), steps=1)
        inside.append(abs(found.model.quantities[1]) <= half_widths(found)[1])
    assert 0.9 <= np.mean(inside) <= 0.99


def test_two_runs_are_helped_by_what_all_numbers_say_of_how_runs_scatter():
    """Student's t of one degree of freedom, 12.7, would make half of the intervals too wide to be of use."""
    inside, halves = [], []
    for seed in range(150):
        problem = Toy({}, seed=seed, runs=2, rows=200, reach=1000)
        problem.quantities = tuple(replace(q, sigma=100 * q.sigma) for q in problem.quantities)
        rng = np.random.default_rng([seed, 3])
        for r in range(2):
            for name in ("gain", "offset", "mass"):
                problem._measured[r] = problem._measured[r] + NOISE * rng.normal(0.0, 1.0) * problem.shape(name)[r]
        found = widened(fit(nominal_model(problem), range(2), steps=1))
        half = half_widths(found) / SIGMA
        inside.append(np.abs(found.model.quantities - NOMINAL) / SIGMA <= half)
        halves.append(half)
    assert 0.85 <= np.mean(inside) <= 0.98
    assert np.quantile(halves, 0.9) < 8.0  # 15 with one degree of freedom; the truth scatters by 0.7


def test_jackknife_is_leaving_one_run_out():
    problem = Toy({"gain": 1.0}, [sized("drag", 0.7, "right")], error=1.0, ar1=0.95, runs=6)
    for r, more in enumerate((0.3, -0.3, 0.2, -0.2, 0.4, -0.4)):
        own = problem.effect_response(sized("drag", more, "right"), r)
        problem._measured[r] = problem._measured[r] + own * NOISE
    found = fitted(problem)
    scale = found.model.effects[0][0].unknowns[0].step
    left_out = []
    for r in range(6):
        kept = [k for k in range(6) if k != r]
        parts = [normal_equations([found.columns[k]], [found.residuals[k]], found.noise) for k in kept]
        tight = np.diag([1.0, 1.0, 1.0, 4 * (1 / 20) ** 2])
        away = np.append((found.model.quantities - NOMINAL) / SIGMA, found.model.effects[0][1][0] / scale)
        step = -np.linalg.solve(sum(m for m, _ in parts) + tight, sum(v for _, v in parts) + tight @ away)
        left_out.append(step)
    jackknife = np.sqrt(5 / 6 * ((left_out - np.mean(left_out, axis=0)) ** 2).sum(axis=0))
    curvature = np.sqrt(np.diag(found.covariance()))
    expected = np.where(jackknife > curvature, 2.571 * jackknife, 1.96 * curvature) * np.append(SIGMA, scale)
    assert 0 < (jackknife > curvature).sum() < 4
    assert half_widths(found) == pytest.approx(expected, rel=0.01)


def test_student():
    """Quantiles of any printed table."""
    assert [two_sided_95(n) for n in (1, 2, 5, 30)] == pytest.approx([12.706, 4.303, 2.571, 2.042], abs=1e-3)


def test_number_on_its_bound_does_not_widen_the_others():
    beyond = Toy({"gain": REACH + 2.0}, white=1.0, runs=6)
    found = fit(nominal_model(beyond), range(6))
    assert found.model.on_bounds[0]
    halves = half_widths(found) / SIGMA
    assert halves[0] == pytest.approx(1.96, abs=0.01)  # no better than beforehand
    # pinned means pinned: the jackknife of the others is that of a model without the number
    tight = np.eye(2)
    away = (found.model.quantities[1:] - NOMINAL[1:]) / SIGMA[1:]
    left_out = []
    for r in range(6):
        kept = [k for k in range(6) if k != r]
        parts = [normal_equations([found.columns[k][1:]], [found.residuals[k]], found.noise) for k in kept]
        left_out.append(-np.linalg.solve(sum(m for m, _ in parts) + tight, sum(v for _, v in parts) + away))
    jackknife = np.sqrt(5 / 6 * ((left_out - np.mean(left_out, axis=0)) ** 2).sum(axis=0))
    curvature = np.sqrt(np.diag(found.covariance()))[1:]
    expected = np.where(jackknife > curvature, 2.571 * jackknife, 1.96 * curvature)
    assert halves[1:] == pytest.approx(expected, rel=0.02)


def test_estimates_are_values_with_two_sided_intervals():
    problem = Toy({}, [sized("drag", 0.7, "right")], white=1.5)
    found = fitted(problem)
    own = estimates(found)[0]["size"]
    half = half_widths(found)[-1]
    assert own.value == found.model.effects[0][1][0]
    assert (own.low, own.high) == pytest.approx((own.value - half, own.value + half), rel=1e-3)
    assert own.unit == "1"
    assert own.low < 0.7 < own.high


def test_parameter_at_the_edge_of_its_range_keeps_its_interval():
    """The data ask for 0.7, more than 0.5 is not plausible: the fit ends there, and knows how well the data tell it."""
    problem = Toy({}, [sized("drag", 0.7, "right")], white=1.5)
    (free,) = estimates(fitted(problem))[0].values()
    edge = {"within": lambda v: (min(v[0], 0.5),), "convert": lambda v: {"size": min(v[0], 0.5)}}
    model = nominal_model(problem).with_effect(replace(candidate(problem, "drag", ["right"]), **edge), (0.3,))
    (held,) = estimates(fit(model, range(5)))[0].values()
    assert held.value == 0.5
    assert held.high - held.low == pytest.approx(free.high - free.low, rel=0.3)


def test_what_adds_to_a_known_number_is_known_no_better_than_it():
    """However well the data seem to tell them apart: the errors of simulated responses do that, too."""
    problem = Toy({"gain": 1.0}, white=1.5)
    adds = replace(candidate(problem, "copy"), tolerances=(Tolerance(("gain", "mass"), 0.5, REACH),))
    found = fit(nominal_model(problem).with_effect(adds, (1.0,)), range(5))
    own = estimates(replace(found, precision=1e9 * np.eye(4), columns=[1e4 * c for c in found.columns]))[0]["size"]
    assert own.high - own.value == pytest.approx(TWO_SIDED_95 * 0.5 / np.sqrt(2.0), rel=1e-3)


def test_simulators_do_not_disagree_about_places():
    problem = Toy(TRUTH, [sized("drag", 0.7, "right")], white=1.5)
    own = candidate(problem, "drag", ["right"])
    place = replace(own, unknowns=tuple(replace(unknown, is_size=False) for unknown in own.unknowns))
    found = fit(nominal_model(problem).with_effect(place, (0.7,)), range(5))
    (plain,) = estimates(found)[0].values()
    problem.disagreement = 0.1
    assert estimates(found)[0]["size"] == plain


def test_disagreement_of_simulators_adds_a_share_of_the_effect():
    problem = Toy(TRUTH, [sized("drag", 0.7, "right")], white=1.5)
    found = fitted(problem)
    (narrow,) = estimates(found)[0].values()
    problem.disagreement = 0.1
    (wide,) = estimates(found)[0].values()
    assert wide.value == narrow.value
    both = np.hypot(narrow.high - narrow.value, TWO_SIDED_95 * 0.1 * narrow.value)
    assert wide.high - wide.value == pytest.approx(both, rel=1e-6)
    assert wide.value - wide.low == pytest.approx(both, rel=1e-6)


def test_confidence_counts_the_samples_in_which_the_effect_wins():
    problem = Toy({}, [sized("drag", 0.8, "right")], error=0.5)
    look = search_effects(fit(nominal_model(problem), RUNS)).rounds[0]
    assert look.selected is not None
    assert selection_frequency(look.selected, look.hypotheses) > 0.95
    twin = Toy({}, [sized("drag", 0.8, "left")], error=0.5)
    look = search_effects(fit(nominal_model(twin), RUNS)).rounds[0]
    assert look.selected is not None
    assert selection_frequency(look.selected, look.hypotheses) == selection_frequency(look.selected, look.hypotheses)


def explained(problem, name, gain, by_run):
    """A hypothesis of so much gain, from runs that fall by so much."""
    own, nominal = candidate(problem, name), nominal_model(problem)
    model = nominal.with_effect(own, (1.0,) * len(own.unknowns))
    return Hypothesis(model, RUNS, [], Replayed(nominal, RUNS, []), gain, np.array(by_run, float), 1.0)


@pytest.mark.parametrize(
    ("gain", "by_run", "threshold", "expected"),
    [
        (100.0, [20] * 5, 16.0, 1.0),
        (20.0, [20] * 5, 16.0, 1.0),
        (15.0, [20] * 5, 16.0, 0.0),  # the runs' falls of squares are 100: what counts is the gain
        (100.0, [20] * 5, 120.0, 0.0),
        (400.0, [300, -12, -12, -12, -12], 16.0, 0.67),  # drawn once it is enough, not at all (33 %) is harm alone
        (400.0, [300, -90, -90, 140, 140], 16.0, 0.3),  # in most samples some are harmed too much: no effect
    ],
)
def test_confidence_asks_of_every_sample_what_is_asked_of_an_effect(gain, by_run, threshold, expected):
    problem = Toy()
    assert selection_frequency(explained(problem, "decoy_1", gain, by_run), [], threshold) == pytest.approx(expected, abs=0.12)


def test_confidence_asks_more_of_an_effect_with_more_numbers():
    problem = Toy()
    assert LEAST_GAIN < 18.0 < least_gain(2)
    assert selection_frequency(explained(problem, "decoy_1", 18.0, [18 / 5] * 5), []) == 1.0
    assert selection_frequency(explained(problem, "ripple", 18.0, [18 / 5] * 5), []) == 0.0


def test_confidence_falls_with_a_rival_that_buys_as_much():
    problem = Toy()
    selected = explained(problem, "decoy_1", 100.0, [20] * 5)
    rival = explained(problem, "decoy_2", 99.0, [60, 10, 10, 10, 9])
    assert selection_frequency(selected, [rival]) == pytest.approx(0.74, abs=0.06)  # the run with 60 drawn twice: 26 %


def screened(problem):
    found = fit(nominal_model(problem), RUNS)
    probes, candidates = problem.candidates(None, [], [])
    return found, responses(found, probes), candidates


def test_detectable_severity_is_where_the_gain_is_just_enough():
    problem = Toy(white=1.5)
    _, responded, candidates = screened(problem)
    smallest = detectable(screen(candidates, responded))["decoy_2"]
    assert (smallest.parameter, smallest.unit) == ("size", "1")
    shown = Toy({}, [sized("decoy_2", smallest.value)], seed=11, white=1.5)
    _found, with_it, candidates = screened(shown)
    gain = next(s.gain for s in screen(candidates, with_it) if s.candidate.name == "decoy_2")
    assert gain == pytest.approx(LEAST_GAIN, rel=0.5)


def test_detectable_severity_is_that_of_the_start_that_fits():
    problem = Toy({}, [sized("decoy_2", 0.5)], white=1.5)
    _, responded, candidates = screened(problem)
    decoy = candidate(problem, "decoy_2")
    elsewhere = Start((("decoy_1",),), lambda a: (9.0 * float(a[0]),))
    several = Candidate("several", ("body",), decoy.unknowns, (elsewhere, *decoy.starts))
    told = detectable(screen([*candidates, several], responded))
    assert told["several"].value == pytest.approx(told["decoy_2"].value)


def test_detectable_severity_is_of_the_direction_that_shows_best_at_the_place_that_shows_worst():
    unknowns = tuple(Unknown(axis, "m", 0.0, -0.05, 0.05, 0.005) for axis in "xyz")
    start = Start((("x",), ("y",), ("z",)), lambda a: tuple(0.005 * float(v) for v in a))

    def score(place, *information):
        return Score(Candidate("shift", (place,), unknowns, (start,)), (0.0,) * 3, 0.0, 1.0, np.diag(information), start, True)

    told = detectable([score("front", 1.0, 400.0, 0.01), score("rear", 1.0, 100.0, 0.01)])["shift"]
    assert (told.parameter, told.unit) == ("y", "m")
    assert told.value == pytest.approx(0.005 * np.sqrt(least_gain(3) / 100.0))
    hidden = replace(score("left", 1.0, 200.0, 0.01), visible=False)  # a size beyond all that is plausible is none
    assert np.isnan(detectable([hidden, score("rear", 1.0, 100.0, 0.01)])["shift"].value)


def test_what_is_detectable_is_a_size():
    """Not the speed over which a friction fades, however far from its neutral value a first guess puts it; and no formula."""
    unknowns = (
        Unknown("extra_static_torque", "N m", 0.0, 0.0, 1.0, 0.01),
        Unknown("stribeck_speed", "rad/s", 0.1, 0.02, 3.0, 0.1),
    )
    start = Start((("probe",),), lambda a: (0.01 * float(a[0]), 1.0))
    stribeck = Candidate("stribeck_friction", ("wheel_lf",), unknowns, (start,))
    law = Candidate("unknown_effect", ("wheel_lf",), unknowns[:1], (start,), formula="-c * rate")
    scores = [Score(one, (0.0, 1.0), 0.0, 1.0, np.diag([1.0]), start, True) for one in (stribeck, law)]
    assert {name: found.parameter for name, found in detectable(scores).items()} == {"stribeck_friction": "extra_static_torque"}


def test_what_is_left_hides_more_effects():
    """What the screen calls visible requires as much as is asked of an effect."""
    responded, candidates = screened(Toy(white=1.5))[1:]
    scores = screen(candidates, responded)
    assert all(score.visible for score in scores)
    assert not any(score.is_visible(1e9) for score in scores)


def test_noisier_data_show_less():
    looks = [screened(Toy(white=w)) for w in (1.0, 4.0)]
    quiet, loud = (detectable(screen(candidates, responded)) for _, responded, candidates in looks)
    assert set(quiet) == set(loud) >= {"drag", "twin", "play", "decoy_0"}
    assert loud["decoy_0"].value > 2.5 * quiet["decoy_0"].value
