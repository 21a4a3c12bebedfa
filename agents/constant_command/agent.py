"""The commanded motion by kinematics alone, without any feedback: what a robot does that trusts its wheels."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from wlr_gym.policy.control import Pid, PidConfig, task_settings


def make_policy(contract: Mapping[str, Any], config: Mapping[str, Any]) -> Pid:
    """Return the controller for an environment's contract; the settings have no gains."""
    return Pid(contract, task_settings(PidConfig, contract, config, "constant_command"), "constant_command")
