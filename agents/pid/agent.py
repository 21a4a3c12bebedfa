"""Feedback on the gyroscope, with gains found by search: the tuned controller of a robot that cannot see its slip.

The law is in ``wlr_gym/policy/control.py``. ``wlr train ENV --agent pid`` searches the
gains (``wlr_gym/learning/tuning.py``).
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from wlr_gym.policy import Training
from wlr_gym.policy.control import Pid, PidConfig, task_settings


def check_settings(config: Mapping[str, Any]) -> None:
    """Refuse settings that are none."""
    task_settings(PidConfig, {"task": ""}, config, "pid")


def make_policy(contract: Mapping[str, Any], config: Mapping[str, Any]) -> Pid:
    """Return the controller for an environment's contract."""
    return Pid(contract, task_settings(PidConfig, contract, config, "pid"))


def load_policy(folder: Path, contract: Mapping[str, Any]) -> Pid:
    """Return the controller that a search found; ``contract`` is the content of the folder's ``contract.json``."""
    return make_policy(contract["environment"], contract["config"])


def train(training: Training) -> Path:
    """Search the gains, and return the folder of the best."""
    from wlr_gym.learning.tuning import tune

    return tune(training, "pid", make_policy, PidConfig)
