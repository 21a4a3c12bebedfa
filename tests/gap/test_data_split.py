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


def squares(problem, names, runs):
    """Products of shapes over runs, as information."""
    shapes = [problem.shape(name).reshape(len(problem.runs), -1)[list(runs)].ravel() for name in names]
    return np.array([[a @ b for a in shapes] for b in shapes]) / AUTOCORRELATION_TIME


#: Shape -> size of the probe of every effect of the toy at its largest set of places.
PROBED = {"weak body": 0.2, "play": 0.25, "ripple sine": 0.5} | {f"decoy_{k} body": 0.5 for k in range(5)}


def test_no_split_is_better_for_numbers_and_effects_together():
    problem = Toy(runs=6, rows=40)
    both = {name: problem.shape(name) for name in ("drag left", "drag right")}

    def information(shape, size, runs):
        matrix = squares(problem, [*QUANTITIES, shape], runs)
        known, across = np.eye(3) + matrix[:3, :3], matrix[:3, 3]
        return np.log1p(size**2 * max(matrix[3, 3] - across @ np.linalg.solve(known, across), 0.0))

    problem.shape = lambda name: both["drag left"] + both["drag right"] if name == "drag" else Toy.shape(problem, name)
    probed = {**PROBED, "drag left": 1.0, "drag": 0.5}  # twin is twice drag left; copy is gain itself

    def worth(kept):
        sides = kept, [k for k in range(6) if k not in kept]
        told = sum(min(information(shape, size, side) for side in sides) for shape, size in probed.items())
        copies = min(np.log1p(alone(squares(problem, QUANTITIES, side))) for side in sides)
        return np.linalg.slogdet(np.eye(3) + squares(problem, QUANTITIES, kept))[1] + told + copies

    fitted, _, columns = informative_split(problem)
    assert worth(fitted) == pytest.approx(max(worth(kept) for kept in itertools.combinations(range(6), 4)))
    assert columns is not None
    assert columns[0][0] == pytest.approx(-problem.shape("gain")[fitted[0]].ravel(), abs=1e-5)


def alone(matrix):
    """Information about the first number, the others projected out: a copy of it has no tolerance."""
    return matrix[0, 0] - matrix[0, 1:] @ np.linalg.solve(np.eye(2) + matrix[1:, 1:], matrix[1:, 0])


def test_an_effect_that_two_runs_show_is_on_both_sides():
    problem, known = Toy(runs=6, rows=40), Toy(runs=6, rows=40).shape
    seldom = {name: 9.0 * known(name) for name in (*(f"decoy_{k} body" for k in range(5)), "ripple sine", "ripple cosine")}
    for shape in seldom.values():
        shape[[0, 2, 3, 5]] = 0.0
    problem.shape = lambda name: seldom.get(name, known(name))
    fitted, held, _ = informative_split(problem)
    assert len({1, 4} & {*fitted}) == len({1, 4} & {*held}) == 1


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
