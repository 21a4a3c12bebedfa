"""Fit and likelihood against closed forms: weighted least squares with priors, AR(1) residuals, Monte Carlo."""

from dataclasses import replace

import numpy as np
import pytest
from toy_problem import NOMINAL, QUANTITIES, REACH, SIGMA, STRENGTH, Toy, candidate, coloured

from wlr_gym.gap.estimation import (
    LONGEST,
    FittedModel,
    bounded_minimum,
    corrected,
    estimate_noise,
    fit,
    linearise,
    minus_two_log_likelihood,
    nominal_model,
    replay,
)

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
    residuals, columns = linearise(model, RUNS)
    step = model.effects[0][0].unknowns[0].step
    for r in RUNS:
        for row, name in zip(columns[r], QUANTITIES, strict=False):
            assert row.reshape(residuals[r].shape) == pytest.approx(-STRENGTH * problem.shape(name)[r], abs=1e-5)
        assert columns[r][3].reshape(residuals[r].shape) == pytest.approx(-step * problem.shape("drag left")[r], abs=1e-5)


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
