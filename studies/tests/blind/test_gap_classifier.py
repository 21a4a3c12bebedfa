"""The baseline of the blind test: a classifier on the scores of the first screening."""

import math
from typing import Any, cast

import numpy as np
import pytest
from scipy.special import softmax

from studies.bench import gap_classifier as baseline
from wlr_gym.base.errors import InputError
from wlr_gym.gap.analysis import Evidence
from wlr_gym.gap.problem import Candidate, Quantity, Start, Unknown

NAMES = ("payload", "backlash", "unknown_effect")


def made(count, seed, strength=3.0):
    """Sets in which what is missing scores high, and one more than it by chance."""
    rng = np.random.default_rng(seed)
    sets = []
    for _ in range(count):
        missing = [baseline.NOTHING, *NAMES][int(rng.integers(4))]
        gains = {name: float(np.exp(rng.normal(1.0 + strength * (name == missing), 1.0))) for name in NAMES}
        screen = {name: {"gain": gain, "where": ["body"], "values": {"size": 2.0}} for name, gain in gains.items()}
        sets.append({"missing": missing, "screen": screen})
    return sets


def test_what_separates_is_learned_and_holds_on_new_sets():
    trained, new = baseline.train(made(300, 1)), made(200, 2)
    said = trained.probabilities([one["screen"] for one in new]).argmax(axis=1)
    right = np.mean([trained.classes[k] == one["missing"] for k, one in zip(said, new, strict=True)])
    assert right > 0.85
    nothing = baseline.train(made(300, 1, strength=0.0)).probabilities([one["screen"] for one in new])
    assert nothing.max() < 0.6


def test_weights_are_at_the_minimum():
    sets = made(60, 3)
    trained = baseline.train(sets)

    def loss(weight, bias):
        x = baseline.features([one["screen"] for one in sets], trained.names)
        shares = softmax(x @ weight.T + bias, axis=1)
        right = [trained.classes.index(one["missing"]) for one in sets]
        return -np.log(shares[np.arange(len(sets)), right]).mean() + 0.5 * baseline.RIDGE * (weight**2).sum()

    best = loss(trained.weight, trained.bias)
    rng = np.random.default_rng(0)
    for _ in range(20):
        weight = trained.weight + 0.02 * rng.standard_normal(trained.weight.shape)
        assert loss(weight, trained.bias + 0.02 * rng.standard_normal(len(trained.bias))) > best - 1e-7


def test_answers_read_like_results_of_the_workflow():
    trained = baseline.train(made(300, 1))
    gains = {"payload": 900.0, "backlash": 2.0, "unknown_effect": 2.0}
    screen = {name: {"gain": gain, "where": [f"at {name}"], "values": {"mass": 0.4}} for name, gain in gains.items()}
    results = {"a": {"verdict": "bad_data"}, "b": {"verdict": "nothing_missing", "screen": screen, "blind_test": {"runs": [1]}}}
    found = baseline.answers_of(trained, results)
    assert found["a"] == {"verdict": "bad_data"}
    (effect,) = found["b"]["effects"]
    assert (found["b"]["verdict"], effect["name"], effect["where"]) == ("effect_found", "payload", ["at payload"])
    assert effect["parameters"] == {"mass": {"value": 0.4, "ci95": None}}
    assert found["b"]["blind_test"] == {"runs": [1]}
    low = {name: {**one, "gain": 1.0} for name, one in screen.items()}
    assert baseline.answer(trained, low) == {"verdict": "nothing_missing", "effects": []}
    high = {name: {**one, "gain": 900.0 if name == "unknown_effect" else 1.0} for name, one in screen.items()}
    assert baseline.answer(trained, high)["verdict"] == "unknown_effect"


def test_one_class_is_too_few():
    with pytest.raises(InputError, match="2 training sets of 1 classes"):
        baseline.train([{"missing": "payload", "screen": {}}] * 2)


def test_the_screen_is_the_best_of_every_name_in_the_first_round():
    def entry(number, name, where, screened):
        return Evidence(number, name, (where,), {"size": screened}, 0.0, screened, "worse fit", "")

    rows = [entry(1, "payload", "body", 3.0), entry(1, "payload", "leg_lf", 7.0), entry(2, "payload", "body", 99.0)]
    assert baseline.first_screen(rows) == {"payload": {"gain": 7.0, "where": ["leg_lf"], "values": {"size": 7.0}}}


class Numbers:
    quantities = (Quantity("mass", "kg", 2.0, 0.1, 1.9, 2.5),)


def test_drawn_models_stay_within_tolerances_and_ranges():
    unknowns = (Unknown("size", "1", 0.0, -2.0, 4.0, 0.1), Unknown("place", "m", 0.0, 0.5, 0.7, 0.1, is_size=False))
    candidates = [Candidate(name, (place,), unknowns, (Start((), tuple),)) for name in ("one", "two") for place in "ab"]
    rng = np.random.default_rng(0)
    drawn = [baseline.drawn_setting(cast("Any", Numbers()), candidates, rng) for _ in range(400)]
    masses = np.array([setting.quantities[0] for setting, _ in drawn])
    assert 1.9 <= masses.min() < masses.max() <= 2.2
    names = [name for _, name in drawn]
    assert 0.4 < names.count(baseline.NOTHING) / 400 < 0.6
    effects = [setting.effects[0] for setting, _ in drawn if setting.effects]
    assert {(effect.name, *effect.where) for effect in effects} == {(n, p) for n in ("one", "two") for p in "ab"}
    sizes = np.array([effect.parameters["size"] for effect in effects])
    assert -2.0 <= sizes.min() < -1.0 < 0.0 < 3.0 < sizes.max() <= 4.0
    assert np.abs(sizes).min() >= 0.05 * 2.0 - 1e-9
    assert all(0.5 <= effect.parameters["place"] <= 0.7 for effect in effects)
    assert math.isfinite(sizes.sum())


@pytest.mark.slow
def test_training_sets_are_made_and_stay(tmp_path):
    said = []
    (one,) = baseline.training_sets(tmp_path, 1, 1, said.append)
    assert one["missing"] == baseline.NOTHING or one["missing"] in one["screen"]
    assert len(one["screen"]) > 20
    assert len(said) == 1
    assert baseline.training_sets(tmp_path, 1, 1, said.append) == [one]
    assert len(said) == 1
