"""Intervals against Monte Carlo and the jackknife's definition; confidence; equals; what would have been seen."""

from dataclasses import replace

import numpy as np
import pytest
from toy_problem import NOISE, NOMINAL, REACH, SIGMA, Toy, candidate, sized

from wlr_gym.gap.estimation import (
    TWO_SIDED_95,
    Replayed,
    estimates,
    fit,
    half_widths,
    nominal_model,
    normal_equations,
    two_sided_95,
    widened,
)
from wlr_gym.gap.problem import Candidate, Start, Tolerance, Unknown
from wlr_gym.gap.selection.hypotheses import Hypothesis, selection_frequency
from wlr_gym.gap.selection.screening import LEAST_GAIN, Score, detectable, least_gain, responses, screen
from wlr_gym.gap.selection.search import search_effects

RUNS = range(5)
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
    assert all(score.visible for score in screen(candidates, responded))
    hidden = [score for score in screen(candidates, responded, 1e9) if not score.visible]
    assert len(hidden) == len(screen(candidates, responded))


def test_noisier_data_show_less():
    looks = [screened(Toy(white=w)) for w in (1.0, 4.0)]
    quiet, loud = (detectable(screen(candidates, responded)) for _, responded, candidates in looks)
    assert set(quiet) == set(loud) >= {"drag", "twin", "play", "decoy_0"}
    assert loud["decoy_0"].value > 2.5 * quiet["decoy_0"].value
