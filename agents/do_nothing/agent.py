"""Zero action at every step: legs at home, wheels held still. What any policy must beat."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray


class DoNothing:
    """A policy that always returns zeros."""

    def __init__(self, actions: int) -> None:
        self.actions = actions

    def act(self, observations: NDArray[np.floating]) -> NDArray[np.float32]:
        """Return zeros (N, 8)."""
        return np.zeros((len(observations), self.actions), dtype=np.float32)

    def reset(self, mask: NDArray[np.bool_]) -> None:
        """Nothing to forget."""


def make_policy(contract: Mapping[str, Any], config: Mapping[str, Any]) -> DoNothing:
    """Return the policy for an environment's contract; there are no settings."""
    return DoNothing(len(contract["action"]))
