"""Runs to fit and runs to hold out."""

import itertools
import time

import numpy as np
import pytest
from toy_problem import QUANTITIES, Toy

from wlr_gym.base.errors import InputError
from wlr_gym.gap.validation.data_split import AUTOCORRELATION_TIME, LEAST_FITTED, informative_split, named_split

NAMES = ("run_1", "run_2", "run_3", "run_4")


def test_named_runs_are_held_out():
    assert named_split(NAMES, ["run_4", "run_2"]) == ([0, 2], [1, 3])
    assert named_split(NAMES, ["run_2", "run_2"]) == ([0, 2, 3], [1])


def test_unknown_run_names_the_nearest():
    with pytest.raises(InputError, match="run_3"):
        named_split(NAMES, ["run_33"])


def test_too_many_held_out():
    with pytest.raises(InputError, match="at least 2 must be left to fit"):
        named_split(NAMES, NAMES[:3])


@pytest.mark.parametrize(("runs", "held_out"), [(3, 1), (4, 2), (5, 2), (8, 3), (10, 3)])
def test_a_third_is_held_out_and_every_run_is_somewhere(runs, held_out):
    fitted, held, columns = informative_split(Toy(runs=runs, rows=30))
    assert sorted([*fitted, *held]) == list(range(runs))
    assert len(held) == held_out
    assert len(fitted) >= LEAST_FITTED
    assert columns is not None
    assert len(columns) == len(fitted)


def test_two_runs_are_too_few():
    with pytest.raises(InputError, match="2 runs: at least 3"):
        informative_split(Toy(runs=2))


def test_runs_left_tell_most():
    problem = Toy(runs=6, rows=40)
    fitted, _, columns = informative_split(problem)
    told = [problem.shape(name).reshape(6, -1) for name in QUANTITIES]

    def volume(kept):
        matrix = np.eye(3) + sum(np.array([[a[k] @ b[k] for a in told] for b in told]) for k in kept) / AUTOCORRELATION_TIME
        return np.linalg.slogdet(matrix)[1]

    assert volume(fitted) == pytest.approx(max(volume(kept) for kept in itertools.combinations(range(6), 4)))
    assert columns is not None
    assert columns[0][0] == pytest.approx(-told[0][fitted[0]], abs=1e-5)


def test_split_does_not_look_at_the_measurements():
    one, two = Toy(seed=1, rows=40), Toy({"gain": 2.0}, seed=2, error=3.0, rows=40)
    assert informative_split(one)[:2] == informative_split(two)[:2]


def test_run_without_motion_is_held_out():
    problem = Toy(runs=4, rows=40)
    still = {name: problem.shape(name).copy() for name in QUANTITIES}
    for shape in still.values():
        shape[2] = 0.0
    known = problem.shape
    problem.shape = lambda name: still.get(name, known(name))
    assert 2 in informative_split(problem)[1]


def test_many_runs_are_split_in_no_time():
    problem = Toy(runs=40, rows=10)
    since = time.process_time()
    fitted, held, _ = informative_split(problem)
    assert (len(fitted), len(held)) == (28, 12)
    assert time.process_time() - since < 10.0
