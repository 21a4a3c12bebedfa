"""Sampling model predictive control on the true state, what is reachable: :mod:`wlr_gym.learning.mppi`."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from wlr_gym.learning.mppi import Mppi, parse_settings

__all__ = ["make_policy"]


def make_policy(contract: Mapping[str, Any], config: Mapping[str, Any]) -> Mppi:
    """Return the planner for an environment's contract."""
    return Mppi(contract, parse_settings(config, contract["task"]))
