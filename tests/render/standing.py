"""Truths to draw, without a plant."""

import numpy as np

from wlr_gym.physics.plants.base import TRUTH_LAYOUT, Truth, standing_state
from wlr_gym.render.view import View
from wlr_gym.robot import load_robot

PLAIN = View(size=(320, 240), text=False)


def truth_of(parameters, **channels):
    """Robots that stand at the origin; ``channels`` overwrite what they say."""
    robots, truth = load_robot(), Truth(np.zeros((len(parameters), TRUTH_LAYOUT.width)))
    state = standing_state(robots, parameters)
    for name in ("position", "quaternion", "joint_position"):
        truth[name][:] = getattr(state, name)
    for name, value in channels.items():
        truth[name][:] = value
    return truth
