"""``slip_compensating`` without a camera: the same law and gains, its slip observer has wheels, legs and IMU only."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from wlr_gym.policy.control import SlipCompensating, SlipCompensatingConfig, task_settings


def make_policy(contract: Mapping[str, Any], config: Mapping[str, Any]) -> SlipCompensating:
    """Return the controller for an environment's contract."""
    return SlipCompensating(contract, task_settings(SlipCompensatingConfig, contract, config, "slip_compensating_no_camera"))
