"""``mppi`` that plans for a nominal robot on a nominal floor, from the true state: :mod:`wlr_gym.learning.mppi`."""

from wlr_gym.learning.mppi import make_planner as make_policy

__all__ = ["make_policy"]
