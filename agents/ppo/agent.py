"""Proximal policy optimisation (Schulman et al. 2017) with Stable-Baselines3: :mod:`wlr_gym.learning.ppo`."""

from __future__ import annotations

from pathlib import Path

from wlr_gym.base.errors import require_package
from wlr_gym.learning.ppo.policy import export_network, load_policy, make_policy
from wlr_gym.policy import Training

__all__ = ["export_network", "load_policy", "make_policy", "train"]


def train(training: Training) -> Path:
    """Train, and return the folder of the final policy.

    Raises:
        MissingPackageError: a package is not installed.
    """
    for package in ("torch", "stable_baselines3", "tensorboard"):
        require_package(package, "train")
    from wlr_gym.learning.ppo.training import run_training

    return run_training(training)
