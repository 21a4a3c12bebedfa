"""The feedback of ``pid`` with what the slip observer knows; the law is :mod:`wlr_gym.policy.control`."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from wlr_gym.policy import Training
from wlr_gym.policy.control import SlipCompensating, SlipCompensatingConfig, task_settings


def check_settings(config: Mapping[str, Any]) -> None:
    """Refuse settings that are none."""
    task_settings(SlipCompensatingConfig, {"task": ""}, config, "slip_compensating")


def make_policy(contract: Mapping[str, Any], config: Mapping[str, Any]) -> SlipCompensating:
    """Return the controller for an environment's contract."""
    return SlipCompensating(contract, task_settings(SlipCompensatingConfig, contract, config, "slip_compensating"))


def load_policy(folder: Path, contract: Mapping[str, Any]) -> SlipCompensating:
    """Return the controller that a search found; ``contract`` is the content of the folder's ``contract.json``."""
    return make_policy(contract["environment"], contract["config"])


def train(training: Training) -> Path:
    """Search the settings, and return the folder of the best."""
    from wlr_gym.learning.tuning import tune

    return tune(training, "slip_compensating", make_policy, SlipCompensatingConfig)
