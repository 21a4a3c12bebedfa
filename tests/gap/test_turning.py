"""What goes with how far a joint has turned, and what only looks like it."""

from __future__ import annotations

from dataclasses import replace
from types import MappingProxyType

import numpy as np
import pytest
from gap_examples import EFFECT_FOUND
from toy_problem import Toy

from wlr_gym.gap.analysis import UNKNOWN, Turning
from wlr_gym.gap.report.page import save_analysis
from wlr_gym.gap.report.result import read_result
from wlr_gym.gap.report.text import sentence
from wlr_gym.gap.validation.residual_tests import turning
from wlr_gym.gap.workflow import analyse_problem

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
    return turning(problem(), residuals, [{"angle": angle} for angle in ways])


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
