"""What all interfaces of a batch offer beyond their libraries' own interfaces."""

from __future__ import annotations

from typing import Any

from wlr_gym.envs.core import Core


class TaskMethods:
    """Commands and descriptions, for a class that holds a ``core``."""

    core: Core

    def set_command(self, **values: float) -> None:
        """Command all robots from the next step on, until their episodes end: ``set_command(linear_velocity_x=0.1)``."""
        self.core.set_command(values)

    def set_progress(self, steps: float) -> None:
        """Say how many environment steps, of all robots together, a training has done, for the task's curriculum."""
        self.core.set_progress(steps)

    def describe(self) -> str:
        """Return the task's tables as text."""
        return self.core.describe()

    def contract(self) -> dict[str, Any]:
        """Return what a policy must be fed and what its output means."""
        return self.core.contract()
