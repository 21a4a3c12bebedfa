"""What ``info`` holds: the truth where it was asked for, and an episode's measures at its end."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.wrappers.vector import RecordEpisodeStatistics

import wlr_gym  # noqa: F401
from wlr_gym.base.errors import InputError
from wlr_gym.envs import Sb3VecEnv
from wlr_gym.learning.evaluation.metrics import summarise
from wlr_gym.learning.evaluation.rollout import make_core, roll_out
from wlr_gym.policy import Policy

ID = "WLR-Velocity-v0"
SHORT: dict[str, Any] = {"episode_length": 0.5, "randomization": "ice"}
COUNT = 5


class Wild(Policy):
    """The same random actions for every robot; some robots fall."""

    def __init__(self, count: int) -> None:
        self._rng, self._count = np.random.default_rng(8), count

    def reset(self, mask: Any) -> None:
        pass

    def act(self, observations: Any) -> np.ndarray:
        return np.repeat(self._rng.uniform(-1, 1, (1, 8)).astype(np.float32), self._count, axis=0)


def ends(env: Any) -> list[dict[str, float]]:
    """Measures of every robot's first episode, by a plain loop."""
    policy, found = Wild(COUNT), [{}] * COUNT
    env.reset(seed=20)
    while not all(found):
        *_, infos = env.step(policy.act(None))
        for row in range(COUNT):
            if infos.get("_episode_measures", np.zeros(COUNT, bool))[row] and not found[row]:
                found[row] = {name: float(v[row]) for name, v in infos["episode_measures"].items() if not name.startswith("_")}
    return found


def test_measures_of_an_episode_are_those_of_the_score_card():
    found = ends(gym.make_vec(ID, num_envs=COUNT, **SHORT))
    played = summarise([roll_out(make_core(ID, COUNT, SHORT), Wild(COUNT), first_seed=20)])
    assert {"tracking_error", "success", "velocity_error", "slip_speed"} <= set(found[0])
    for row, measures in enumerate(found):
        for name in ("tracking_error", "velocity_error", "yaw_rate_error"):
            assert measures[name] == played.pairs[name][0, 0, row, 0], name
        assert 100.0 * measures["success"] == played.pairs["success"][0, 0, row, 0]


def test_measures_are_said_by_all_interfaces() -> None:
    expected = ends(gym.make_vec(ID, num_envs=COUNT, **SHORT))
    at_once = gym.make_vec(ID, num_envs=COUNT, autoreset_mode="SameStep", **SHORT)
    policy = Wild(COUNT)
    at_once.reset(seed=20)
    batch = Sb3VecEnv(ID, COUNT, seed=20, **SHORT)
    batch.reset()
    found: list[Any] = [None] * COUNT
    while any(each is None for each in found):
        actions = policy.act(None)
        *_, final = at_once.step(actions)
        *_, dones, infos = batch.step(actions)
        for row in np.flatnonzero(dones & [each is None for each in found]).tolist():
            found[row] = infos[row]["episode_measures"]
            same = final["final_info"]["episode_measures"]
            assert found[row] == {name: same[name][row] for name in found[row]}
    assert found == expected
    env, policy = gym.make(ID, **SHORT), Wild(1)
    env.reset(seed=20)
    over, info = False, {}
    while not over:
        *_, terminated, truncated, info = env.step(policy.act(None)[0])
        over = terminated or truncated
        assert ("episode_measures" in info) == over
    assert info["episode_measures"] == expected[0]


def test_wrappers_that_record_episodes_still_work() -> None:
    env = RecordEpisodeStatistics(gym.make_vec(ID, num_envs=2, **SHORT))
    env.reset(seed=0)
    infos: dict[str, Any] = {}
    for _ in range(25):
        *_, infos = env.step(np.zeros((2, 8), np.float32))
    assert infos["episode"]["l"].tolist() == [25, 25]
    assert infos["episode_measures"]["velocity_error"].shape == (2,)


def test_the_truth_is_there_only_when_it_is_asked_for() -> None:
    env, plain = (gym.make(ID, truth_info=asked, **SHORT) for asked in (True, False))
    batch = gym.make_vec(ID, num_envs=2, truth_info=True, **SHORT)
    infos = batch.reset(seed=4)[1]
    info = env.reset(seed=4)[1]
    assert "truth" not in plain.reset(seed=4)[1]
    for _ in range(3):
        truth = env.unwrapped.core.plant.truth()  # type: ignore[attr-defined]
        shapes = {"position": (3,), "quaternion": (4,), "linear_velocity_in_body": (3,), "angular_velocity_in_body": (3,)}
        for name, shape in shapes.items():
            assert info["truth"][name].shape == shape
            np.testing.assert_array_equal(info["truth"][name], truth[name][0])
            np.testing.assert_array_equal(infos["truth"][name][0], truth[name][0])
        command = dict(zip(("linear_velocity_x", "yaw_rate"), env.unwrapped.core.command[0], strict=True))  # type: ignore[attr-defined]
        assert info["truth"]["command"] == command
        assert infos["truth"]["command"]["yaw_rate"][0] == command["yaw_rate"]
        assert infos["truth"]["command"]["_yaw_rate"].all()
        action = np.full(8, 0.1, np.float32)
        info, infos = env.step(action)[-1], batch.step(np.stack([action, action]))[-1]
        assert "truth" not in plain.step(action)[-1]
    kept = info["truth"]["position"].copy()
    env.step(np.ones(8, np.float32))
    np.testing.assert_array_equal(info["truth"]["position"], kept)  # a copy
    by_robot = Sb3VecEnv(ID, 2, seed=4, truth_info=True, **SHORT)
    by_robot.reset()
    assert by_robot.reset_infos[1]["truth"]["position"].shape == (3,)
    assert by_robot.step(np.zeros((2, 8)))[-1][1]["truth"]["quaternion"].shape == (4,)


@pytest.mark.parametrize("mode", ["NextStep", "SameStep"])
def test_the_truth_of_a_batch_whose_episodes_end_at_different_times(mode: str) -> None:
    """Robots that begin anew have their own pose in the info of the same step as robots that drive on."""
    batch = gym.make_vec(ID, num_envs=3, truth_info=True, autoreset_mode=mode, **SHORT)
    batch.reset(seed=4)
    batch.unwrapped.core.episodes.steps[1] = 20  # type: ignore[attr-defined]
    for _ in range(30):
        infos = batch.step(np.full((3, 8), 0.1, np.float32))[-1]
        truth = batch.unwrapped.core.plant.truth()  # type: ignore[attr-defined]
        for name in ("position", "quaternion"):
            np.testing.assert_array_equal(infos["truth"][name], truth[name])


def test_only_simulators_know_the_truth() -> None:
    with pytest.raises(InputError, match="truth_info = True: a real robot is what it is"):
        gym.make(ID, backend="dynamixel", hardware={"emulated": True}, truth_info=True)
    with pytest.raises(InputError, match="truth_info = 1: expected True or False"):
        gym.make(ID, truth_info=1)  # type: ignore[arg-type]
