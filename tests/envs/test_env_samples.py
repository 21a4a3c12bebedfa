"""What randomisation sampled shows in ``info``, at reset and whenever it changes, in every face; and at the contacts."""

from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import data_equivalence
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from test_env_interfaces import same_where_masked

import wlr_gym  # noqa: F401
from wlr_gym.envs.tasks import load_randomization
from wlr_gym.physics.plants import make_plant
from wlr_gym.physics.plants.base import PlantOptions
from wlr_gym.robot import CORNER_SIGNS, load_robot

ID = "WLR-Velocity-v0"
PUSH = {
    "parameters": ["external_force"],
    "when": "interval",
    "interval": [0.04, 0.2],
    "distribution": "uniform",
    "operation": "set",
    "low": -2.0,
    "high": 2.0,
    "per": "element",
}
DRIFT = {
    "parameters": ["ground.mu_x", "ground.mu_y"],
    "when": "drift",
    "interval": [0.5, 1.0],
    "distribution": "uniform",
    "operation": "scale",
    "low": 0.5,
    "high": 1.5,
}
TIMED = {"base": "nominal", "events": {"push": PUSH, "drift": DRIFT}}
SHORT: dict[str, Any] = {"episode_length": 0.5, "randomization": TIMED}


def make(**keywords) -> Any:
    return gym.make(ID, **{**SHORT, **keywords}).unwrapped


def make_vec(count, **keywords) -> Any:
    return gym.make_vec(ID, num_envs=count, **{**SHORT, **keywords})


def test_info_tells_every_change_and_only_what_changed(fake):
    env = make(episode_length=3.0)
    _, info = env.reset(seed=0)
    plant = fake["plants"][-1]
    assert len(info["randomization"]) > 60
    last, told = plant.parameters.values.copy(), 0
    for _ in range(140):
        *_, info = env.step(np.zeros(8, np.float32))
        changed = not np.array_equal(plant.parameters.values, last)
        assert ("randomization" in info) == changed
        if changed:
            told += 1
            assert len(info["randomization"]) == 10
            for name, value in info["randomization"].items():
                assert plant.parameters[name][0] == value
        last = plant.parameters.values.copy()
    assert told > 20


def test_a_drifting_parameter_moves_a_few_times_a_second_and_smoothly(fake):
    env = make_vec(50, randomization={"events": {"drift": DRIFT}}, episode_length=5.0)
    env.reset(seed=0)
    friction = []
    for _ in range(200):
        env.step(np.zeros((50, 8)))
        friction.append(fake["plants"][-1].parameters["ground.mu_x"][:, 0].copy())
    steps = np.diff(np.array(friction), axis=0)
    assert set(np.flatnonzero(steps.any(axis=1)).tolist()) == set(range(8, 199, 10))
    assert np.abs(steps).max() < 0.6 * 1.5 / 0.5 * 0.2
    assert np.ptp(friction) > 0.4


def test_overrides_and_effects_hold_against_drift(fake):
    env = make(effects=[{"name": "friction_asymmetry", "where": ["wheel_rr"], "parameters": {"mu": 0.4}}], episode_length=3.0)
    env.reset(seed=0, options={"parameters": {"ground.mu_x[wheel_lf]": 0.1}})
    plant = fake["plants"][-1]
    seen = []
    for _ in range(60):
        env.step(np.zeros(8, np.float32))
        seen.append(plant.parameters["ground.mu_x"][0].copy())
    assert np.all(np.array(seen)[:, [0, 3]] == [0.1, 0.4])
    assert np.ptp(np.array(seen)[:, 1]) > 0.01


@pytest.mark.parametrize("mode", ["NextStep", "SameStep"])
def test_vector_tells_the_same_as_a_loop_over_single_environments(fake, mode):
    ours = make_vec(3, autoreset_mode=mode)
    loop = SyncVectorEnv([lambda: gym.make(ID, **SHORT)] * 3, autoreset_mode=AutoresetMode(mode))
    assert data_equivalence(ours.reset(seed=11)[1], loop.reset(seed=11)[1], exact=True)
    stagger = np.array([True, False, False])
    seen = 0
    for step in range(80):
        if step == 7:
            for env in (ours, loop):
                env.reset(options={"reset_mask": stagger.copy()})
        action = np.zeros((3, 8), np.float32)
        infos, expected = ours.step(action)[4], loop.step(action)[4]
        assert set(infos) == set(expected), step
        for key in infos:
            assert same_where_masked(infos, expected, key), (step, key)
        seen += "randomization" in infos
    assert seen > 20


def test_stable_baselines3_tells_the_same_as_a_loop_over_single_environments(fake):
    pytest.importorskip("stable_baselines3")
    from stable_baselines3.common.vec_env import DummyVecEnv

    from wlr_gym.envs import Sb3VecEnv

    ours = Sb3VecEnv(ID, 3, seed=5, **SHORT)
    loop = DummyVecEnv([lambda: gym.make(ID, **SHORT)] * 3)
    loop.seed(5)
    ours.reset()
    loop.reset()
    seen = 0
    for _ in range(60):
        action = np.zeros((3, 8), np.float32)
        infos, expected = ours.step(action)[3], loop.step(action)[3]
        for one, two in zip(infos, expected, strict=True):
            assert one.get("randomization") == two.get("randomization")
            seen += "randomization" in one
        assert ours.reset_infos == loop.reset_infos
    assert seen > 20


# ---- on the engine ----


def test_drift_is_the_same_alone_and_in_a_batch():
    keywords = {"randomization": {"base": "patches", "events": {"push": PUSH}}, "episode_length": 2.0}
    vector, single = make_vec(11, **keywords), gym.make(ID, **keywords)
    vector.reset(seed=70)
    single.reset(seed=77)
    for actions in np.random.default_rng(1).uniform(-1, 1, (60, 11, 8)).astype(np.float32):
        many, one = vector.step(actions), single.step(actions[7])
        assert np.array_equal(many[0][7], one[0])
        assert many[1][7] == one[1]


def drawn_friction(parameters, truth):
    """Friction each wheel should find, (N, 4, 2), by where it stands; and how far (m) it is from any patch's edge."""
    position, quaternion = truth.position, truth.quaternion
    yaw = 2 * np.arctan2(quaternion[:, 3], quaternion[:, 0])[:, None]
    signs, hip = np.array(CORNER_SIGNS), parameters["hip.position"]
    forward = signs[:, 0] * hip[:, :1] + parameters["leg.length"] * np.cos(truth.joint_position[:, :4])
    left = signs[:, 1] * hip[:, 1:2] + np.zeros_like(forward)
    x = position[:, :1] + np.cos(yaw) * forward - np.sin(yaw) * left
    y = position[:, 1:2] + np.sin(yaw) * forward + np.cos(yaw) * left
    mu, edge = parameters["ground.mu_x"].copy(), np.full(x.shape, np.inf)
    for k in range(4):
        x_min, x_max, y_min, y_max = (
            parameters[f"patch.{name}"][:, k : k + 1] for name in ("x_min", "x_max", "y_min", "y_max")
        )
        outside = np.maximum.reduce([x_min - x, x - x_max, y_min - y, y - y_max])
        exists = (x_max > x_min) & (y_max > y_min)
        mu = np.where(exists & (outside < 0), parameters["patch.mu"][:, k : k + 1], mu)
        edge = np.where(exists, np.minimum(edge, np.abs(outside)), edge)
    mu_x = mu * parameters["wheel.grip"]
    return np.stack([mu_x, mu_x * parameters["ground.mu_y"] / parameters["ground.mu_x"]], axis=-1), edge


@pytest.mark.parametrize("name", ["wide", "ice", "split", "patches"])
def test_the_friction_that_acts_is_the_one_drawn(name):
    """Standing, every wheel reports it; pushed sideways, contact forces lie on its ellipse, at every heading."""
    robot, count = load_robot(), 400
    randomization = load_randomization({"base": name, "initial_state": {"yaw": 3.14}}, robot)
    seeds = np.arange(count, dtype=np.uint64)
    parameters = randomization.parameters(seeds, seeds)
    parameters["external_force"] = 0.0
    state = randomization.state(parameters, seeds)
    state.linear_velocity_in_body[:] = [0.0, 1.0, 0.0]
    state.angular_velocity_in_body[:] = 0.0
    plant = make_plant("gibbs_appell", robot, count, PlantOptions(control_period=0.005))
    plant.reset(seeds, parameters, state=state)
    expected, edge = drawn_friction(parameters, plant.truth())
    clear = edge > 0.015
    assert clear.mean() > 0.8
    shown = plant.truth().effective_friction.reshape(count, 4, 2)
    np.testing.assert_allclose(shown[clear], expected[clear], rtol=1e-12)
    plant.step(np.column_stack([state.joint_position[:, :4], np.zeros((count, 4))]))
    force = plant.truth().contact_force.reshape(count, 4, 3)
    loaded = clear & (force[:, :, 2] > 1.0)
    assert loaded.mean() > 0.6
    used = np.linalg.norm(force[loaded][:, :2] / (expected[loaded] * force[loaded][:, 2:]), axis=-1)
    np.testing.assert_allclose(used, 1.0, rtol=1e-6)
    spread = expected[loaded][:, 0]
    assert spread.max() / spread.min() > 3.5
    plant.close()
