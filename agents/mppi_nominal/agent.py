"""``mppi`` that plans for a nominal robot on a nominal floor, from the true state: :mod:`wlr_gym.learning.mppi`."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from wlr_gym.learning.mppi import Mppi, parse_settings

__all__ = ["make_policy"]


def make_policy(contract: Mapping[str, Any], config: Mapping[str, Any]) -> Mppi:
    """Return the planner for an environment's contract."""
    return Mppi(contract, parse_settings(config, contract["task"]))
