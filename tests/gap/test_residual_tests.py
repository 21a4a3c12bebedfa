"""What the final model leaves, beside what it leaves in runs that it made itself."""

from __future__ import annotations

from dataclasses import replace
from types import MappingProxyType
from typing import Any

import numpy as np
import pytest
from gap_examples import EFFECT_FOUND
from toy_problem import CHANNELS, NOISE, Toy

from wlr_gym.gap.analysis import UNKNOWN, Turning
from wlr_gym.gap.estimation import Replayed, fit, nominal_model
from wlr_gym.gap.report.page import save_analysis
from wlr_gym.gap.report.result import read_result
from wlr_gym.gap.report.text import adequacy, sentence
from wlr_gym.gap.validation.held_out import noise_floor
from wlr_gym.gap.validation.residual_tests import REPLICATES, adequacy_of, compared, turning
from wlr_gym.gap.workflow import analyse_problem

RUNS = [0, 1, 2, 3, 4]


def judged(problem, runs=RUNS):
    found = adequacy_of(fit(nominal_model(problem), runs))
    assert found is not None
    return found


def added(problem, change):
    """The problem with ``change`` (run, noise units: rows or (rows, channels)) in what was measured."""
    for r, measured in enumerate(problem._measured):
        measured += change(r) * NOISE
    return problem


def drifting(channel, size=1.0, **more):
    """A toy with a slow wave in one channel, another in every run."""
    own = np.arange(len(CHANNELS)) == CHANNELS.index(channel)
    return added(Toy(**more), lambda r: size * np.outer(np.sin(0.03 * np.arange(200) + r), own))


def test_what_is_observed_is_compared_with_what_chance_leaves():
    others = np.arange(1.0, 20.0)
    assert compared(np.array([10.0, *others])) == pytest.approx(compared(np.array([10.0, *others[::-1]])))
    found = compared(np.array([15.0, *others]))
    assert (found.value, found.expected, found.ratio) == (15.0, 10.0, 1.5)
    assert found.p == pytest.approx(6 / 20)  # 15 to 19, and itself
    assert not found.rejected
    assert compared(np.array([19.5, *others])).rejected
    assert not compared(np.array([19.0, *others])).rejected  # the limit itself is not beyond it
    assert found.limit == pytest.approx(19.0)
    assert np.isnan(compared(np.array([np.nan, *others])).p)
    assert np.isnan(compared(np.array([10.0, np.nan, *others])).p)  # nor where a replicate has none
    assert not compared(np.array([np.nan, *others])).rejected


def test_chance_is_not_rejected():
    found = [judged(Toy({"gain": 1.0}, seed=seed)) for seed in range(12)]
    for name in ("level", "whiteness", "constancy"):
        rejected = [getattr(one, name).rejected for one in found]
        assert sum(rejected) <= 2, name
    assert [one.level.ratio for one in found] == pytest.approx(np.ones(12), abs=0.06)
    assert sum(one.constancy.pulled_most.rejected for one in found) <= 2
    channels = [each.rejected for one in found for both in (one.level, one.whiteness) for each in both.channels.values()]
    assert np.mean(channels) < 0.12
    assert "nothing in the fitted runs that chance does not explain" in adequacy(found[0])


@pytest.mark.parametrize("channel", CHANNELS)
def test_a_slow_drift_is_found_at_its_channel(channel):
    found = judged(drifting(channel, seed=3))
    level, whiteness = found.level.channels[channel], found.whiteness.channels[channel]
    assert level.rejected
    assert whiteness.rejected
    assert whiteness.ratio > 10.0
    assert found.whiteness.rejected
    for other in set(CHANNELS) - {channel}:
        assert not found.whiteness.channels[other].rejected
        assert found.whiteness.channels[other].ratio < 1.3
    assert f"that is not expected is in {channel}" in adequacy(found)


def test_a_drift_that_no_level_shows_is_seen_as_whiteness():
    """White noise that is a little smaller, and a drift that fills it up: the level is as expected, the rows are not."""
    found = judged(drifting("speed", 0.6, seed=5, white=0.9))
    level, whiteness = found.level.channels["speed"], found.whiteness.channels["speed"]
    assert not level.rejected
    assert whiteness.rejected


def test_numbers_that_differ_from_run_to_run_are_no_constants():
    steps = np.array([0.15, -0.15, 0.0, 0.15, -0.15])
    problem = Toy(seed=1)
    shape = problem.shape("mass")
    found = judged(added(problem, lambda r: steps[r] * shape[r]))
    assert found.constancy.rejected
    assert found.constancy.ratio > 4.0
    pulled = found.constancy.pulled_most
    assert pulled.number == "mass"
    assert steps[problem.runs.index(pulled.run)] != 0.0
    assert pulled.rejected
    assert not found.level.rejected
    assert found.whiteness.ratio < 1.2
    assert f"{pulled.run} pulls mass farthest" in adequacy(found)


class Moved(Toy):
    """The sets it makes hold more of what one number explains."""

    def remade(self, setting, runs, count) -> Any:
        shape = self.shape("gain")
        for made in super().remade(setting, runs, count):
            yield [one + 2.0 * shape[r] for r, one in zip(runs, made, strict=True)]


def test_the_numbers_are_fitted_to_every_set_that_was_made():
    found = judged(Moved(seed=6))
    assert found.level.expected == pytest.approx(judged(Toy(seed=6)).level.expected, rel=0.01)


class Gappy(Toy):
    """One channel is never measured, another now and then."""

    def __init__(self, **more):
        super().__init__(**more)
        for measured in self._measured:
            measured[:, 1] = np.nan
            measured[::3, 0] = np.nan

    def remade(self, setting, runs, count) -> Any:
        for made in super().remade(setting, runs, count):
            yield [np.where(np.isnan(self.measured(r)), np.nan, one) for r, one in zip(runs, made, strict=True)]


def test_channels_that_were_not_measured_say_nothing():
    found = judged(Gappy(seed=2), [0, 2, 4])
    assert set(found.level.channels) == {"speed", "place"}
    assert np.isfinite([found.level.value, found.level.limit, found.whiteness.value, found.constancy.value]).all()
    assert found.level.value == pytest.approx(found.level.expected, rel=0.1)


def test_the_same_data_give_the_same_numbers():
    assert judged(drifting("place", seed=4)) == judged(drifting("place", seed=4))
    assert judged(Toy(seed=4)).replicates == REPLICATES


def test_a_model_that_cannot_make_its_runs_is_not_judged():
    problem = Toy()
    problem.remade = lambda setting, runs, count: iter(())
    assert adequacy_of(fit(nominal_model(problem), RUNS)) is None
    assert np.isnan(noise_floor(nominal_model(problem), RUNS))
    done = analyse_problem(problem, "toy")
    assert done.adequacy is None
    assert done.gap is not None
    assert np.isnan(done.gap.noise_floor)


def test_one_run_alone_says_that_constancy_could_not_be_tested():
    assert "Whether the runs agree could not be tested." in adequacy(judged(Toy(), [0]))


# ---- periodic residuals ----------------------------------------------------------------------------------------------


RNG = np.random.default_rng(3)


def problem():
    toy = Toy()
    name = toy.signals[0].name
    toy.turning = MappingProxyType({"wheel_rr": ("angle", (name,))})
    return toy


def angles(runs=4, rows=1200):
    """Wheels that drive forth and back at speeds that change."""
    found = []
    for k in range(runs):
        speed = 6.0 * np.sin(np.linspace(0.0, 3.0 + k, rows)) + np.repeat(RNG.normal(0.0, 1.5, rows // 60), 60)
        found.append(np.cumsum(speed) * 0.02 + RNG.uniform(0.0, 6.0))
    return found


def found_in(made, ways):
    """The turning that is found where ``made`` gives the error of the first signal from angle and row number."""
    residuals = []
    for k, angle in enumerate(ways):
        left = RNG.standard_normal((len(angle), len(problem().signals)))
        left[:, 0] += made(angle, k)
        residuals.append(left)
    return turning(Replayed(nominal_model(problem()), range(len(ways)), residuals), [{"angle": angle} for angle in ways])


@pytest.mark.parametrize("order", [1, 2, 3])
def test_an_error_that_goes_with_the_turning_is_found_at_any_phase(order):
    found = found_in(lambda angle, k: 3.0 * np.sin(order * angle + 1.7 * k), angles())
    assert found is not None
    assert (found.joint, found.order) == ("wheel_rr", order)
    assert found.amplitude == pytest.approx(3.0, abs=0.3)
    assert 0.5 < found.share < 0.9
    assert found.confidence == 1.0


@pytest.mark.parametrize(
    "made",
    [
        lambda angle, k: np.zeros(len(angle)),
        lambda angle, k: 0.3 * np.cumsum(RNG.standard_normal(len(angle))),  # errors that last
        lambda angle, k: 4.0 * np.tanh((angle - 8.0) / 2.0),  # the edge of a patch: the wheel tells the place
        lambda angle, k: 0.2 * angle,  # a slope, a tether
        lambda angle, k: 4.0 * np.sin(2.5 * angle),  # no turned part has two and a half periods
        lambda angle, k: 3.0 * np.sign(np.gradient(angle)),  # dry friction
    ],
)
def test_what_else_a_model_may_lack_is_not_taken_for_it(made):
    assert found_in(made, angles()) is None


def test_what_comes_and_goes_with_time_while_a_wheel_turns_steadily_is_not_taken_for_it():
    ways = [np.linspace(0.0, 50.0 + 9.0 * k, 1200) for k in range(4)]
    assert found_in(lambda angle, k: 4.0 * np.sin(angle), ways) is None  # may be either
    uneven = [way + 2.0 * np.sin(way / 9.0) for way in ways]
    assert found_in(lambda angle, k: 4.0 * np.sin(angle), uneven) is not None


@pytest.mark.parametrize("order", [0.7, 1.3, 1.7, 2.3, 2.6])
def test_orders_that_no_turned_part_has_do_not_pass_for_whole_ones_where_wheels_turn_little(order):
    ways = [19.0 * np.linspace(0.0, 1.0, 700) ** (1.5 + 0.2 * k) for k in range(4)]
    assert found_in(lambda angle, k: 5.0 * np.sin(order * angle + k), ways) is None


def test_a_few_runs_tell_nothing():
    assert found_in(lambda angle, k: 5.0 * np.sin(angle), angles(runs=3)) is not None
    assert found_in(lambda angle, k: 5.0 * np.sin(angle), angles(runs=2)) is None


def test_what_half_of_the_runs_show_is_not_sure_enough():
    assert found_in(lambda angle, k: 1.5 * np.sin(angle) * (k == 0), angles()) is None


def test_a_joint_that_hardly_turns_tells_nothing():
    ways = [0.2 * angle / np.ptp(angle) * 2 * np.pi for angle in angles()]
    assert found_in(lambda angle, k: 5.0 * np.sin(angle), ways) is None


def turning_toy(turning_runs):
    """A system with an error that goes with the angle of a wheel, which turns far in some of its runs."""
    toy = problem()
    far = [1.0 if k < turning_runs else 0.05 for k in range(len(toy.runs))]
    ways = [np.linspace(0.0, 6.0, toy.rows) ** 2 * (1.0 + 0.1 * k) * far[k] for k in range(len(toy.runs))]
    toy.features = lambda setting, runs: [{"angle": ways[r]} for r in runs]
    plain = toy.residuals
    column = np.zeros(len(toy.signals))
    column[0] = 4.0
    toy.residuals = lambda settings, runs: [
        r + np.sin(ways[k])[None, :, None] * column for k, r in zip(runs, plain(settings, runs), strict=True)
    ]
    return toy


def test_held_out_runs_tell_of_a_wheels_turning_too():
    done = analyse_problem(turning_toy(3), "toy", heldout=("run_1",))
    assert (done.verdict, done.effects[0].where) == (UNKNOWN, ("wheel_rr",))


def test_verdict_is_unknown_without_name_or_formula(tmp_path):
    done = analyse_problem(turning_toy(5), "toy")
    assert done.verdict == UNKNOWN
    (effect,) = done.effects
    assert (effect.name, effect.where, effect.formula) == ("unknown_effect", ("wheel_rr",), "")
    assert done.turning is not None
    assert done.turning.order == 1
    assert "once per turn of the right rear wheel" in sentence(done)
    save_analysis(done, tmp_path / "out")
    result = read_result(tmp_path / "out" / "result.json")
    assert result.verdict == "unknown_effect"
    assert result.effects[0].formula is None
    assert result.turning is not None
    assert result.turning.joint == "wheel_rr"
    assert "once per turn" in (tmp_path / "out" / "report.html").read_text()


def test_a_name_stays_beside_what_goes_with_the_turning():
    done = replace(EFFECT_FOUND, turning=Turning("wheel_rr", "pos_wheel_rr", 1, 0.3, 9.0, 1.0))
    assert "out of round" not in sentence(done)
