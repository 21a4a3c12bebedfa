"""``python -m studies.bench`` runs and reports; no test looks at a time."""

import json
import math
from contextlib import nullcontext
from types import SimpleNamespace

import numpy as np
import pytest
from rich.console import Console

from studies.bench import __main__ as bench
from studies.bench import training
from studies.bench.__main__ import main
from studies.bench.measure import Measurement, Size, against_fastest, interleave
from studies.bench.mujoco_loop import MujocoLoopPlant
from wlr_gym.physics.plants.gibbs_appell.plant import GibbsAppellPlant
from wlr_gym.robot import load_robot


@pytest.mark.parametrize(
    "name",
    [
        *("engine", "mujoco", "env_step", "ppo", "learning", "import", "batch", "relief", "convergence"),
        pytest.param("start", marks=pytest.mark.slow),  # compiles in an empty cache
    ],
)
def test_measurement_runs_and_reports(name, tmp_path, capsys):
    file = tmp_path / "bench.json"
    assert main(["--quick", "--rounds", "1", name, "--save", str(file)]) == 0
    assert name in capsys.readouterr().out
    report = json.loads(file.read_text())
    assert report["schema"] == 1
    assert report["machine"]["cores"] >= 1
    assert report["machine"]["processor"]
    assert ("engine" in report) == (name == "engine")
    rows = report["convergence" if name == "convergence" else "measurements"]
    assert rows
    for row in rows:
        if name == "convergence":
            assert math.isfinite(row["worst"])
            continue
        assert row["name"] == name
        assert len(row["ours"]["values"]) == 1
        assert math.isfinite(row["ours"]["median"])
        assert (row["ratio"] is None) == (row["peer"] is None)
        assert (row["met"] is None) == (row["bar"] is None)


def test_rounds_are_interleaved():
    calls: list[str] = []
    contenders = {name: lambda name=name: float(calls.append(name) or len(calls)) for name in "AB"}
    told = []
    values = interleave(contenders, 2, tell=told.append)
    assert "".join(calls) == "ABABAB"  # the first pair is not measured
    assert values == {"A": (3.0, 5.0), "B": (4.0, 6.0)}
    assert told == [1 / 3, 1 / 2, 2 / 3, 5 / 6]


def test_ratio_is_pair_by_pair_against_the_fastest_peer():
    row = against_fastest("n", "w", "1/s", (10.0, 40.0, 30.0), {"slow": (1.0, 1.0, 1.0), "fast": (5.0, 10.0, 10.0)}, 3.0)
    assert row.peer_name == "fast"
    assert row.ratios == (2.0, 4.0, 3.0)
    assert row.met is True
    assert row.others == {"slow": 1.0}
    assert Measurement("n", "w", "s", (0.5,), bar=0.3).met is False


def test_a_peer_that_got_nothing_done_is_infinitely_slower():
    assert against_fastest("n", "w", "1/h", (2.0, 0.0, 3.0), {"peer": (0.0, 0.0, 1.0)}, 2.0).ratios == (math.inf, 0.0, 3.0)


class _Learner:
    """Stands for a PPO that learns the task in ``seconds``."""

    def __init__(self, seconds: float) -> None:
        self.seconds = seconds

    def learn(self, frames: int) -> None: ...


@pytest.mark.parametrize(
    ("dummy", "workers", "ratio", "at_least"),
    [(60.0, 80.0, 6.0, False), (500.0, 80.0, 8.0, False), (500.0, 500.0, 10.0, True)],
)
def test_a_peer_that_is_given_up_gives_a_lower_bound(monkeypatch, dummy, workers, ratio, at_least):
    """Ours takes 10 s; a peer is given up after ten times that, and what is told then is no ratio but a bound."""
    seconds = {"SubprocVecEnv(2)": workers, "DummyVecEnv(8)": dummy, "ours": 10.0}

    def learn(model, size, most_seconds):
        spent = min(model.seconds, most_seconds)
        return training._Run(model.seconds <= most_seconds, spent, spent, 1000)

    vectors = {name: SimpleNamespace(num_envs=8, seconds=value) for name, value in seconds.items()}
    monkeypatch.setattr(training, "_vectors", lambda robots, workers: nullcontext(vectors))
    monkeypatch.setattr(training, "_learner", lambda vector, seed, size, ours: _Learner(vector.seconds))
    monkeypatch.setattr(training, "_learn", learn)
    row, *details = training.measure_learning(Size(2))
    assert row.ratios == (ratio, ratio)
    assert row.at_least == at_least
    assert row.as_dict()["at_least"] == at_least
    assert row.met
    given_up = [name for name, value in seconds.items() if value > 100.0]
    assert all(any(name in detail.what and "not learnt in 2 of 2" in detail.what for detail in details) for name in given_up)
    assert len(details) == 9


def test_a_lower_bound_is_printed_as_one(capsys):
    row = Measurement("learning", "w", "1/h", (20.0,), (2.0,), "peer", 5.0, at_least=True)
    bench._print_speed([row], Console())
    assert ">= 10 [10..10]" in capsys.readouterr().out


@pytest.mark.parametrize(("arguments", "message"), [(["engin"], "engine"), (["--rounds", "0"], "--rounds")])
def test_bad_input_is_named(arguments, message, capsys):
    assert main([*arguments]) == 2
    assert message in capsys.readouterr().err


def test_peer_is_the_same_robot_under_the_same_servo_law():
    """The comparison is fair only if both do the same work: same motion, here within the contact models' difference."""
    robot = load_robot()
    plants = MujocoLoopPlant(robot), GibbsAppellPlant(robot)
    setpoints = np.array([[*[robot.home.leg_angle] * 4, *[3.0] * 4]])
    setpoints[0, :4] += 0.1
    for plant in plants:
        plant.reset()
        for _ in range(50):
            plant.step(setpoints)
    peer, ours = (plant.truth() for plant in plants)
    assert np.abs(ours.position[0, 0]) > 0.05
    np.testing.assert_allclose(peer.position[0], ours.position[0], atol=2e-3)
    np.testing.assert_allclose(peer.joint_position[0], ours.joint_position[0], atol=0.05)
    np.testing.assert_allclose(peer.joint_velocity[0, 4:], ours.joint_velocity[0, 4:], atol=0.05)
