"""Proximal policy optimisation (Schulman et al. 2017) with Stable-Baselines3: :mod:`wlr_gym.learning.ppo`."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from wlr_gym.base.errors import require_package
from wlr_gym.learning.ppo.policy import export_network, load_policy, make_policy, parse_settings, settings_to_start_from
from wlr_gym.policy import Training

__all__ = ["check_settings", "export_network", "load_policy", "make_policy", "settings_to_start_from", "train"]


def check_settings(config: Mapping[str, Any]) -> None:
    """Refuse what no training can begin with.

    Raises:
        InputError: an unknown setting, or a bad value.
        MissingPackageError: a package is not installed.
    """
    for package in ("torch", "stable_baselines3", "tensorboard"):
        require_package(package, "train")
    parse_settings(config)


def train(training: Training) -> Path:
    """Train, and return the folder of the final policy.

    Raises:
        InputError: an unknown setting, or a bad value.
        MissingPackageError: a package is not installed.
    """
    check_settings(training.config)
    from wlr_gym.learning.ppo.training import run_training

    return run_training(training)
