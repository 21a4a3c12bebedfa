"""The environment on the Gibbs-Appell engine."""

import gymnasium as gym
import numpy as np
import pytest
from velocity import ID, PUSH, make, make_vec


@pytest.mark.parametrize(
    ("mode", "randomization"),
    [("NextStep", "wide"), ("SameStep", "wide"), ("SameStep", {"base": "patches", "events": {"push": PUSH}})],
)
def test_vector_and_single_are_the_same_bits_over_episodes_and_resets(mode, randomization):
    keywords = {"randomization": randomization, "episode_length": 1.0}
    count, picked = 11, (0, 4, 10)
    vector = make_vec(count, autoreset_mode=mode, **keywords)
    singles = {row: gym.make(ID, **keywords) for row in picked}
    observation, _ = vector.reset(seed=70)
    for row, single in singles.items():
        assert np.array_equal(single.reset(seed=70 + row)[0], observation[row])
    waiting = dict.fromkeys(picked, False)
    ended = 0
    for actions in np.random.default_rng(1).uniform(-1, 1, (130, count, 8)).astype(np.float32):
        observation, reward, terminated, truncated, infos = vector.step(actions)
        for row, single in singles.items():
            if waiting[row]:
                assert np.array_equal(single.reset()[0], observation[row])
                waiting[row] = False
                continue
            one = single.step(actions[row])
            assert (one[1], one[2], one[3]) == (reward[row], terminated[row], truncated[row])
            over = one[2] or one[3]
            ended += over
            if over and mode == "SameStep":
                assert np.array_equal(one[0], infos["final_obs"][row])
                assert np.array_equal(single.reset()[0], observation[row])
            else:
                assert np.array_equal(one[0], observation[row])
                assert np.array_equal(one[4]["slip_velocity"], infos["slip_velocity"][row])
                waiting[row] = over
    assert ended >= 2 * len(picked)


def test_threads_change_nothing():
    one, two = (make_vec(256, threads=threads, randomization="wide") for threads in (1, 2))
    one.reset(seed=0)
    two.reset(seed=0)
    for actions in np.random.default_rng(1).uniform(-1, 1, (20, 256, 8)).astype(np.float32):
        a, b = one.step(actions), two.step(actions)
        assert all(np.array_equal(x, y) for x, y in zip(a[:4], b[:4], strict=True))


def test_equal_wheel_speeds_drive_straight_at_rolling_speed():
    env = make(randomization="none")
    env.reset(seed=0, options={"command": {"linear_velocity_x": 0.1, "yaw_rate": 0.0}})
    radius = env.core.task.robot.wheel.radius
    action = np.zeros(8, np.float32)
    action[4:] = 0.1 / radius / 6.0
    rewards, info = [], {}
    for _ in range(150):
        _, _, terminated, _, info = env.step(action)
        rewards.append(info["reward_terms"])
        assert not terminated
    truth = env.core.plant.truth()
    assert truth.linear_velocity_in_body[0, 0] == pytest.approx(0.1, rel=0.02)
    assert abs(truth.angular_velocity_in_body[0, 2]) < 1e-3
    assert rewards[-1]["track_linear_velocity"] == pytest.approx(0.02, rel=1e-3)
    assert rewards[-1]["slip"] == pytest.approx(0.0, abs=1e-4)
    assert np.abs(info["slip_velocity"]).max() < 1e-3


def test_opposite_wheel_speeds_turn_left_and_slip_sideways():
    env = make(randomization="none")
    env.reset(seed=0)
    action = np.zeros(8, np.float32)
    action[4:] = [-0.8, 0.8, -0.8, 0.8]
    info = [env.step(action) for _ in range(150)][-1][4]
    truth = env.core.plant.truth()
    assert truth.angular_velocity_in_body[0, 2] > 0.1
    sideways = info["slip_velocity"][:, 1]
    assert np.all(np.sign(sideways) == [1, 1, -1, -1])
    assert np.abs(info["slip_velocity"]).min() > 0.03
    assert info["reward_terms"]["slip"] > -0.02 * 0.02  # all of it is what a skid turn needs


def test_standing_still_lasts_the_whole_episode_under_every_randomization():
    for randomization in ("none", "nominal", "wide", "ice", "split", "patches"):
        env = make_vec(32, randomization=randomization, episode_length=2.0)
        env.reset(seed=0)
        truncated = np.zeros(32, bool)
        for step in range(100):
            observation, reward, terminated, truncated, _ = env.step(np.zeros((32, 8), np.float32))
            assert not terminated.any(), (randomization, step)
            assert np.isfinite(observation).all()
            assert np.isfinite(reward).all()
        assert truncated.all()
