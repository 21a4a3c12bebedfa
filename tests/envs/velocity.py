"""The environment of most tests here: Velocity, alone and as a batch."""

from typing import Any

import gymnasium as gym

import wlr_gym  # noqa: F401

ID = "WLR-Velocity-v0"


def make(**keywords) -> Any:
    return gym.make(ID, **keywords).unwrapped


def make_vec(count, **keywords) -> Any:
    return gym.make_vec(ID, num_envs=count, **keywords)
