"""The same robot gives the same bits alone, anywhere in a batch, on any number of threads, and again; and a golden run."""

import json
from pathlib import Path

import numpy as np
import pytest
from simulators import random_setpoints

from wlr_gym.physics.plants.base import PlantOptions
from wlr_gym.physics.plants.gibbs_appell.plant import TILES_AT_A_TIME, GibbsAppellPlant
from wlr_gym.robot import load_robot
from wlr_gym.robot.parameters import Parameters

ROBOT = load_robot()
GOLDEN = Path(__file__).parents[2] / "golden" / "engine_rollout.json"


def random_parameters(count, seed=3):
    """Robots that differ from each other; row i depends on i alone."""
    parameters = Parameters.nominal(ROBOT, count)
    for row in range(count):
        rng = np.random.default_rng([seed, row])
        parameters["ground.mu_x"][row] = rng.uniform(0.2, 0.9, 4)
        parameters["ground.mu_y"][row] = rng.uniform(0.2, 0.9, 4)
        parameters["body.com_offset"][row] = rng.uniform(-0.01, 0.01, 3)
        parameters["wheel.radius"][row] *= rng.uniform(0.98, 1.02, 4)
        parameters["command.delay"][row] = rng.uniform(0.0, 0.03)
    return parameters


def rollout(parameters, setpoints, seeds, precision="float64", threads=1):
    """Truth and sensor matrices (ticks, N, columns)."""
    count = len(parameters)
    plant = GibbsAppellPlant(ROBOT, count, PlantOptions(precision=precision, threads=threads))
    plant.reset(seeds=seeds, parameters=parameters)
    truth, sensors = [], []
    for tick in setpoints:
        sensors.append(plant.step(tick).values.copy())
        truth.append(plant.truth().values.copy())
    plant.close()
    return np.array(truth), np.array(sensors)


@pytest.mark.parametrize("precision", ["float64", "float32"])
def test_alone_or_in_a_batch(precision):
    count = 37
    parameters, setpoints, seeds = random_parameters(count), random_setpoints(count, 20), np.arange(count, dtype=np.uint64)
    truth, sensors = rollout(parameters, setpoints, seeds, precision)
    assert np.abs(truth[-1, :, :2]).max() > 1e-3
    for row in (0, 5, 15, 16, 31, 36):
        one = [row]
        alone = rollout(Parameters(parameters.values[one]), setpoints[:, one], seeds[one], precision)
        np.testing.assert_array_equal(alone[0][:, 0], truth[:, row])
        np.testing.assert_array_equal(alone[1][:, 0], sensors[:, row])
    shuffled = np.random.default_rng(0).permutation(count)
    again = rollout(Parameters(parameters.values[shuffled]), setpoints[:, shuffled], seeds[shuffled], precision)
    np.testing.assert_array_equal(again[0], truth[:, shuffled])
    np.testing.assert_array_equal(again[1], sensors[:, shuffled])


@pytest.mark.parametrize("precision", ["float64", "float32"])
def test_on_two_threads_and_again(precision):
    count = 16 * TILES_AT_A_TIME * 3 + 5
    parameters, setpoints, seeds = random_parameters(count), random_setpoints(count, 5), np.arange(count, dtype=np.uint64)
    once = rollout(parameters, setpoints, seeds, precision)
    again = rollout(parameters, setpoints, seeds, precision)
    threaded = rollout(parameters, setpoints, seeds, precision, threads=2)
    for a, b, c in zip(once, again, threaded, strict=True):
        np.testing.assert_array_equal(a, b)
        np.testing.assert_array_equal(a, c)


def test_two_threads_are_really_used():
    count = 16 * TILES_AT_A_TIME
    plant = GibbsAppellPlant(ROBOT, count, PlantOptions(threads=2))
    assert plant._pool is not None
    plant.close()
    assert plant._pool is None
    plant.step(np.zeros((count, 8)))  # goes on without threads


def test_float32_follows_float64():
    parameters, setpoints, seeds = random_parameters(16), random_setpoints(16, 25), np.arange(16, dtype=np.uint64)
    double, single = (rollout(parameters, setpoints, seeds, precision)[0][-1] for precision in ("float64", "float32"))
    error = np.abs(double[:, :3] - single[:, :3]).max()
    assert error < 1e-5
    assert not np.array_equal(double, single)


def test_golden_rollout():
    """Pose of eight different robots after 2 s of random driving.

    Compared to 1e-8 m, not bit by bit: the kernel is strict IEEE arithmetic, but numpy's exp and sin, which prepare its
    constants, differ by a rounding from one kind of processor to the next.
    """
    truth, _ = rollout(random_parameters(8), random_setpoints(8, 100), np.arange(8, dtype=np.uint64))
    golden = json.loads(GOLDEN.read_text())
    expected = np.array([[float.fromhex(number) for number in row] for row in golden["position_and_quaternion"]])
    np.testing.assert_allclose(truth[-1, :, :7], expected, atol=1e-8, rtol=0)
