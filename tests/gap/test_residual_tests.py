"""What the final model leaves, beside what it leaves in runs that it made itself."""

from typing import Any

import numpy as np
import pytest
from toy_problem import CHANNELS, NOISE, Toy

from wlr_gym.gap.estimation.fit import fit
from wlr_gym.gap.estimation.model import nominal_model
from wlr_gym.gap.report.text import adequacy
from wlr_gym.gap.validation.held_out import noise_floor
from wlr_gym.gap.validation.residual_tests import REPLICATES, adequacy_of, compared
from wlr_gym.gap.workflow import analyse_problem

RUNS = [0, 1, 2, 3, 4]


def judged(problem, runs=RUNS):
    found = adequacy_of(problem, runs, fit(problem, runs, nominal_model(problem)))
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
    assert sum(one.pulled.errors.rejected for one in found) <= 2
    channels = [statistic.rejected for one in found for both in one.channels.values() for statistic in both]
    assert np.mean(channels) < 0.12
    assert "nothing in the fitted runs that chance does not explain" in adequacy(found[0])


@pytest.mark.parametrize("channel", CHANNELS)
def test_a_slow_drift_is_found_at_its_channel(channel):
    found = judged(drifting(channel, seed=3))
    level, whiteness = found.channels[channel]
    assert level.rejected
    assert whiteness.rejected
    assert whiteness.ratio > 10.0
    assert found.whiteness.rejected
    for other in set(CHANNELS) - {channel}:
        assert not found.channels[other][1].rejected
        assert found.channels[other][1].ratio < 1.3
    assert f"that is not expected is in {channel}" in adequacy(found)


def test_a_drift_that_no_level_shows_is_seen_as_whiteness():
    """White noise that is a little smaller, and a drift that fills it up: the level is as expected, the rows are not."""
    found = judged(drifting("speed", 0.6, seed=5, white=0.9))
    level, whiteness = found.channels["speed"]
    assert not level.rejected
    assert whiteness.rejected


def test_numbers_that_differ_from_run_to_run_are_no_constants():
    steps = np.array([0.15, -0.15, 0.0, 0.15, -0.15])
    problem = Toy(seed=1)
    shape = problem.shape("mass")
    found = judged(added(problem, lambda r: steps[r] * shape[r]))
    assert found.constancy.rejected
    assert found.constancy.ratio > 4.0
    assert found.pulled.number == "mass"
    assert steps[problem.runs.index(found.pulled.run)] != 0.0
    assert found.pulled.errors.rejected
    assert not found.level.rejected
    assert found.whiteness.ratio < 1.2
    assert f"{found.pulled.run} pulls mass farthest" in adequacy(found)


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
    assert set(found.channels) == {"speed", "place"}
    assert np.isfinite([found.level.value, found.level.limit, found.whiteness.value, found.constancy.value]).all()
    assert found.level.value == pytest.approx(found.level.expected, rel=0.1)


def test_the_same_data_give_the_same_numbers():
    assert judged(drifting("place", seed=4)) == judged(drifting("place", seed=4))
    assert judged(Toy(seed=4)).replicates == REPLICATES


def test_a_model_that_cannot_make_its_runs_is_not_judged():
    problem = Toy()
    problem.remade = lambda setting, runs, count: iter(())
    assert adequacy_of(problem, RUNS, fit(problem, RUNS, nominal_model(problem))) is None
    assert np.isnan(noise_floor(problem, nominal_model(problem).setting, RUNS))
    done = analyse_problem(problem, "toy")
    assert done.adequacy is None
    assert done.gap is not None
    assert np.isnan(done.gap.noise_floor)


def test_one_run_alone_says_that_constancy_could_not_be_tested():
    assert "Whether the runs agree could not be tested." in adequacy(judged(Toy(), [0]))
