"""The error falls with the step at the method's order, the solver's sweeps suffice, and nothing explodes up to 4 ms."""

import numpy as np
import pytest
from rig import make_plant

COUNT = 32


def edit(parameters):
    mu = np.random.default_rng(1).uniform(0.2, 0.9, (COUNT, 4))
    parameters["ground.mu_x"] = parameters["ground.mu_y"] = mu


def smooth(parameters):
    edit(parameters)
    parameters["servo.profile_velocity"] = 2.0
    parameters["servo.profile_acceleration"] = np.repeat([15.0, 10.0], 4)


def random_setpoints(rng):
    return np.hstack([np.pi / 2 + rng.uniform(-0.3, 0.3, (COUNT, 4)), rng.uniform(-6, 6, (COUNT, 4))])


def drive_smoothly(step, sweeps=4):
    """Position after 1 s of trapezoidal profiles between two random setpoints."""
    rng = np.random.default_rng(5)
    setpoints = random_setpoints(rng), random_setpoints(rng)
    plant = make_plant(COUNT, smooth, step=step, sweeps=sweeps)
    for tick in range(50):
        plant.step(setpoints[tick // 15 % 2])
    return plant.truth().position.copy()


@pytest.fixture(scope="module")
def reference():
    return drive_smoothly(1e-5, sweeps=8)


def test_error_falls_with_the_step(reference):
    steps = np.array([2e-3, 1e-3, 5e-4])
    error = [np.median(np.linalg.norm(drive_smoothly(step) - reference, axis=1)) for step in steps]
    order = np.log2(error[0] / error[2]) / 2
    assert error[0] > error[1] > error[2]
    assert order > 0.9
    assert error[1] < 5e-4


def test_four_sweeps_are_enough():
    error = np.linalg.norm(drive_smoothly(1e-3) - drive_smoothly(1e-3, sweeps=100), axis=1)
    assert error.max() < 1e-4


@pytest.mark.parametrize("step", [2.5e-4, 5e-4, 1e-3, 2e-3, 4e-3])
def test_stable_after_a_drop_and_under_random_commands(step):
    """Dropped from 5 cm, then new random setpoints every tick for 4 s: no growth of speed, height or tilt."""

    def place(state):
        state.position[:, 2] += 0.05

    rng = np.random.default_rng(7)
    plant = make_plant(COUNT, edit, place, step=step)
    for _ in range(200):
        plant.step(random_setpoints(rng))
        truth = plant.truth()
        assert np.isfinite(truth.values).all()
        assert np.abs(truth.linear_velocity_in_body).max() < 2.0
        assert np.abs(truth.position[:, 2] - 0.17).max() < 0.08
        assert np.hypot(truth.quaternion[:, 1], truth.quaternion[:, 2]).max() < 0.3
    np.testing.assert_allclose(np.linalg.norm(plant.truth().quaternion, axis=1), 1.0, atol=1e-12)
