"""First-order scores against exact least squares."""

from dataclasses import replace

import numpy as np
import pytest
from toy_problem import CHANNELS, DECOYS, NOISE, NOMINAL, QUANTITIES, REACH, SIGMA, STRENGTH, Toy, candidate, coloured, sized

from wlr_gym.gap.analysis import NOTHING_MISSING, UNKNOWN
from wlr_gym.gap.estimation import autocorrelation_times, estimate_noise, fit, nominal_model
from wlr_gym.gap.problem import Candidate, Start, Unknown
from wlr_gym.gap.report.text import sentence
from wlr_gym.gap.selection import finalists
from wlr_gym.gap.selection.screening import (
    LEAST_GAIN,
    LEAST_SHARE,
    PER_UNKNOWN,
    acceptance_threshold,
    largest_by_chance,
    rescored,
    responses,
    screen,
)
from wlr_gym.gap.selection.search import search_effects
from wlr_gym.gap.workflow import analyse_problem

RUNS = range(5)


def screened(problem, quantities=None):
    found = fit(nominal_model(problem), RUNS)
    probes, candidates = problem.candidates(found.model.setting, found.residuals, RUNS)
    responded = responses(found, probes)
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
    found = fit(nominal_model(problem), RUNS)
    probes, _ = problem.candidates(found.model.setting, found.residuals, RUNS)
    before = problem.calls
    responses(found, probes)
    assert problem.calls - before == len(probes)


# --- scores under the alternative -------------------------------------------------------------------------------------


#: As between two simulators of one robot.
SCATTER = 15.0


class Lasting(Toy):
    """``decoy_0`` is a constant error of all channels."""

    def shape(self, name):
        return np.ones_like(super().shape(name)) if name == "decoy_0 body" else super().shape(name)


class Kinked(Toy):
    """``decoy_1`` shows in one channel; of another it predicts much to first order, but at its true size nothing happens."""

    def __init__(self, *arguments, **options):
        super().__init__(*arguments, **options)
        self.signals = tuple(replace(signal, group=signal.name) for signal in self.signals)

    def effect_response(self, effect, run):
        if effect.name != "decoy_1":
            return super().effect_response(effect, run)
        size, response = effect.parameters["size"], np.zeros((self.rows, len(CHANNELS)))
        response[:, 0] = 20.0 * size * (1.0 - size) * self.shape("play")[run][:, 0]
        response[:, 2] = 8.0 * size
        return response


def scored(problem):
    found = fit(nominal_model(problem), RUNS, scatter=SCATTER)
    probes, candidates = problem.candidates(found.model.setting, found.residuals, RUNS)
    responded = responses(found, probes)
    first = screen(candidates, responded)
    return found, first, *rescored(responded, first)


def of(scores, name):
    return next(score for score in scores if score.candidate.name == name)


def test_an_error_that_lasts_counts_as_many_readings_once_it_is_explained():
    problem = Lasting({"gain": 0.5}, [sized("decoy_0", 3.0)])
    found, first, again, _ = scored(problem)
    assert of(first, "decoy_0").gain < LEAST_GAIN  # by the residuals of the model without it
    assert again[0].candidate.name == "decoy_0"
    assert again[0].values == pytest.approx((3.0,), abs=0.1)
    # n/tau ln s^2 of five runs of 200 rows of three channels, white once it is explained, and scattering no more than that
    most = 3 * 5 * 200 * np.log(1.0 + 3.0**2)
    assert most / SCATTER < again[0].gain < most
    assert max(score.gain for score in again[1:]) < 0.2 * again[0].gain
    search = search_effects(found)
    assert [one.label for one, _ in search.fit.model.effects] == ["decoy_0 body"]
    assert search.fit.model.effects[0][1] == pytest.approx((3.0,), abs=0.1)


@pytest.mark.parametrize("seed", range(3))
def test_coloured_errors_alone_gain_nothing(seed):
    _, _, again, alone = scored(Toy({"gain": 1.0}, error=3.0, seed=seed))
    assert max(score.gain for score in (*again, *alone)) < LEAST_GAIN


def test_a_kink_does_not_hide_an_effect():
    problem = Kinked({}, [sized("decoy_1", 1.0)])
    found, _, again, alone = scored(problem)
    assert of(again, "decoy_1").gain < LEAST_GAIN
    assert alone[0].candidate.name == "decoy_1"
    assert alone[0].values == pytest.approx((1.0,), abs=0.1)
    search = search_effects(found)
    assert [one.label for one, _ in search.fit.model.effects] == ["decoy_1 body"]
    assert search.fit.model.effects[0][1] == pytest.approx((1.0,), abs=0.05)


def test_autocorrelation_is_the_sum_over_lags_of_what_was_measured():
    rng = np.random.default_rng(3)
    series = [np.cumsum(rng.standard_normal((300, 2)), axis=0) * 0.1 + rng.standard_normal((300, 2)) for _ in range(2)]
    series[0][::7, 1] = np.nan
    found = autocorrelation_times([one.T for one in series])
    for c in range(2):
        known = [s[np.isfinite(s[:, c]), c] for s in series]
        rho = np.array([sum(s[lag:] @ s[: len(s) - lag] for s in known) for lag in range(100)]) / sum(s @ s for s in known)
        end = int(np.argmax(rho < 0.05)) or 100
        assert found[c] == pytest.approx(1.0 + 2.0 * rho[1:end].sum(), rel=1e-9)


class Together(Toy):
    """An effect that does what a tolerance of every quantity does, with one number."""

    def effect_response(self, effect, run):
        if effect.name != "together":
            return super().effect_response(effect, run)
        return STRENGTH * effect.parameters["size"] * sum(self.shape(name)[run] for name in QUANTITIES)

    def candidates(self, setting, residuals, runs):
        probes, found = super().candidates(setting, residuals, runs)
        like = candidate(Toy(), "copy")
        start = Start((QUANTITIES,), lambda a: (float(a[0]),))
        return probes, [*(c for c in found if c.name != "copy"), Candidate("together", ("body",), like.unknowns, (start,))]


def test_one_number_in_place_of_many_tolerances_is_no_effect(monkeypatch):
    """Tolerances that count many times make it cheap; counted once they explain as much."""
    problem = Together(dict.fromkeys(QUANTITIES, 1.5))
    problem.tempering = 10.0
    found = fit(nominal_model(problem), RUNS, scatter=6.0)
    assert search_effects(found).fit.model.effects == ()
    monkeypatch.setattr(finalists, "_tolerances_do", lambda *_: False)
    assert [one.name for one, _ in search_effects(found).fit.model.effects] == ["together"]


@pytest.mark.parametrize(("misfit", "verdict"), [(3.5, UNKNOWN), (np.inf, NOTHING_MISSING)])
def test_a_misfit_without_a_name_is_not_passed_over(misfit, verdict):
    problem = Toy(error=6.0, rows=400)
    problem.misfit = misfit
    done = analyse_problem(problem, "toy")
    assert done.verdict == verdict
    assert [effect.where for effect in done.effects] == ([("body",)] if verdict == UNKNOWN else [])
    assert ("where a complete model reaches 1.0" in sentence(done)) == (verdict == UNKNOWN)


@pytest.mark.parametrize(("error", "verdict"), [(6.0, UNKNOWN), (2.0, NOTHING_MISSING)])
def test_a_misfit_of_one_held_out_run_is_not_passed_over(error, verdict):
    problem = Toy(rows=400)
    problem.misfit = 3.5
    problem._measured[4][:, 1] += np.sqrt(3.0) * error * NOISE[1] * coloured(np.random.default_rng(1), 400, 0.9)
    done = analyse_problem(problem, "toy", heldout=("run_4", "run_5"))
    assert done.gap is not None
    assert (done.gap.fit_after < 1.5, done.verdict) == (True, verdict)
    said = "run_5, which no fit has used, is replayed to within"
    assert (said in sentence(done)) == sentence(done).endswith("; in held-out runs torque is worst.") == (verdict == UNKNOWN)


# --- the least improvement that counts --------------------------------------------------------------------------------


#: Rows of a run: 20 s.
ROWS = 1000


def by_chance(problem, scatter=1.0):
    """Largest improvements of the draws, and that of the data themselves, to first order."""
    found = fit(nominal_model(problem), RUNS)
    found = replace(found, noise=estimate_noise(found.residuals, scatter=scatter))
    probes, candidates = problem.candidates(found.model.setting, found.residuals, RUNS)
    responded = responses(found, probes)
    first = screen(candidates, responded)
    scores, _ = rescored(responded, first)
    actual = max(score.gain - PER_UNKNOWN * (len(score.values) - 1) for score in first)
    return largest_by_chance(responded, scores), actual


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
