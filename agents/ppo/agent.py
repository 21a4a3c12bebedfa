"""Proximal policy optimisation (Schulman et al. 2017) with Stable-Baselines3: :mod:`wlr_gym.learning.ppo`."""

from wlr_gym.learning.ppo.policy import export_network, load_policy, make_policy, train

__all__ = ["export_network", "load_policy", "make_policy", "train"]
