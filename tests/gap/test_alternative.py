"""Scores under the alternative: what lasts counts, a kink does not hide an effect, and tolerances are no effect."""

from dataclasses import replace

import numpy as np
import pytest
from toy_problem import CHANNELS, NOISE, QUANTITIES, STRENGTH, Toy, candidate, coloured, sized

from wlr_gym.gap.analysis import NOTHING_MISSING, UNKNOWN
from wlr_gym.gap.estimation.fit import fit
from wlr_gym.gap.estimation.model import autocorrelation_times, nominal_model
from wlr_gym.gap.problem import Candidate, Start
from wlr_gym.gap.report.text import sentence
from wlr_gym.gap.selection import cross_validation
from wlr_gym.gap.selection.screening import LEAST_GAIN, Products, rescored, responses, screen
from wlr_gym.gap.selection.search import search_effects
from wlr_gym.gap.workflow import analyse_problem

RUNS = range(5)
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
    found = fit(problem, RUNS, nominal_model(problem), scatter=SCATTER)
    probes, candidates = problem.candidates(found.model.setting, found.residuals, RUNS)
    responded = responses(problem, found, RUNS, probes)
    first = screen(candidates, responded)
    return found, first, *rescored(problem, found, responded, Products.of(found, responded), first)


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
    search = search_effects(problem, RUNS, found)
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
    search = search_effects(problem, RUNS, found)
    assert [one.label for one, _ in search.fit.model.effects] == ["decoy_1 body"]
    assert search.fit.model.effects[0][1] == pytest.approx((1.0,), abs=0.05)


def test_autocorrelation_is_the_sum_over_lags_of_what_was_measured():
    rng = np.random.default_rng(3)
    series = [np.cumsum(rng.standard_normal((300, 2)), axis=0) * 0.1 + rng.standard_normal((300, 2)) for _ in range(2)]
    series[0][::7, 1] = np.nan
    found = autocorrelation_times(series)
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
    found = fit(problem, RUNS, nominal_model(problem), scatter=6.0, steps=problem.steps)
    assert search_effects(problem, RUNS, found).fit.model.effects == ()
    monkeypatch.setattr(cross_validation, "_tolerances_do", lambda *_: False)
    assert [one.name for one, _ in search_effects(problem, RUNS, found).fit.model.effects] == ["together"]


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
