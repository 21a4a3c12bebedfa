"""Sampling model predictive control on the true state, what is reachable: :mod:`wlr_gym.learning.mppi`."""

from wlr_gym.learning.mppi import make_planner as make_policy

__all__ = ["make_policy"]
