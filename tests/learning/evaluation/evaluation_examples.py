"""Hand-made episodes whose scores are known."""

from typing import Any

import numpy as np

from wlr_gym.learning.evaluation.rollout import Measure, Rollout

TICKS, EPISODES, PERIOD = 50, 4, 0.02
MEASURES = (Measure("velocity_error", "m/s", "speed", rms=0.02), Measure("yaw_rate_error", "rad/s", "turning", rms=0.06))


def rollout(ticks=TICKS, episodes=EPISODES, **changes) -> Rollout:
    """Robots that drive along x at 0.1 m/s as told, without slip, drawing 1 W."""
    one, vector = np.ones((ticks, episodes)), np.zeros((ticks, episodes, 2))
    position, command = vector.copy(), vector.copy()
    position[:, :, 0] = 0.1 * PERIOD * np.arange(ticks)[:, None]
    command[:, :, 0] = 0.1
    content = {
        "control_period": PERIOD,
        "seeds": np.arange(episodes),
        "measures": MEASURES,
        "active": one > 0,
        "fell": np.zeros(episodes, bool),
        "succeeded": np.ones(episodes, bool),
        "reward": 0.5 * one,
        "measured": np.zeros((ticks, episodes, 2)),
        "action": np.zeros((ticks, episodes, 8)),
        "command": command,
        "position": position,
        "forward_velocity": 0.1 * one,
        "yaw_rate": 0 * one,
        "slip_velocity": np.zeros((ticks, episodes, 4, 2)),
        "load": np.full((ticks, episodes, 4), 7.0),
        "excess_slip": 0 * one,
        "energy": 1.0 * PERIOD * one,
        "saturated": np.zeros((ticks, episodes, 8), bool),
        "friction": np.ones((episodes, 4, 2)),
        "sampled": ("body.mass",),
        "samples": np.ones((episodes, 1)),
        "parameters": np.ones((episodes, 3)),
        "start": np.ones((episodes, 5)),
    }
    return Rollout(**(content | changes))


def measured(velocity: Any, yaw_rate: Any = 0.0, ticks=TICKS, episodes=EPISODES):
    """Constant errors of velocity (m/s) and yaw rate (rad/s), one per episode or one for all."""
    errors = np.zeros((ticks, episodes, 2))
    errors[:, :, 0], errors[:, :, 1] = velocity, yaw_rate
    return errors
