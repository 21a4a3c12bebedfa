"""The environment of most tests here: Velocity, alone and as a batch; what changes within its episodes."""

from typing import Any

import gymnasium as gym

import wlr_gym  # noqa: F401

ID = "WLR-Velocity-v0"


def make(**keywords) -> Any:
    return gym.make(ID, **keywords).unwrapped


def make_vec(count, **keywords) -> Any:
    return gym.make_vec(ID, num_envs=count, **keywords)


def uniform(parameters: str, low: float, high: float, operation: str = "set", **more: Any) -> dict[str, Any]:
    """An event that draws ``parameters`` between ``low`` and ``high``."""
    drawn = {"parameters": parameters.split(), "distribution": "uniform", "operation": operation, "low": low, "high": high}
    return drawn | more


def push(parameters: str, low: float, high: float, interval: list[float]) -> dict[str, Any]:
    """One that does so at every ``interval`` (s), each element for itself."""
    return uniform(parameters, low, high, when="interval", interval=interval, per="element")


PUSH = push("external_force", -2.0, 2.0, [0.04, 0.2])
DRIFT = uniform("ground.mu_x ground.mu_y", 0.5, 1.5, "scale", when="drift", interval=[0.5, 1.0])
#: Something is told in every info.
TIMED = {"base": "nominal", "events": {"push": PUSH, "drift": DRIFT}}
