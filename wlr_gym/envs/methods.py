"""What all interfaces of a batch offer beyond their libraries' own interfaces."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from functools import cached_property
from typing import Any

from gymnasium.envs.registration import EnvSpec
from numpy.typing import NDArray

from wlr_gym.base.snapshot import Snapshot
from wlr_gym.envs.core import Core
from wlr_gym.envs.snapshots import Snapshots


class TaskMethods:
    """Commands and descriptions, for a class that holds a ``core``."""

    core: Core
    _spec: EnvSpec | None = None

    @cached_property
    def _snapshots(self) -> Snapshots:
        return Snapshots(self.core)

    @property
    def spec(self) -> EnvSpec | None:
        """What Gymnasium made this environment from. ``max_episode_steps`` is the environment's own limit, which depends on
        its options; what is registered has none, so that no ``TimeLimit`` is laid over it."""
        return self._spec

    @spec.setter
    def spec(self, spec: EnvSpec | None) -> None:
        self._spec = copy.deepcopy(spec)
        if self._spec is not None:
            self._spec.max_episode_steps = self.core.limit

    def set_command(self, **values: float) -> None:
        """Command all robots from the next step on, until their episodes end: ``set_command(linear_velocity_x=0.1)``. Commands
        that are not named are drawn as before.

        Raises:
            InputError: unknown command, or a value without meaning or beyond what the robot can do.
            gymnasium.error.ResetNeeded: before the first reset.
        """
        self.core.set_command(values)

    def set_progress(self, steps: float) -> None:
        """Say how many environment steps, of all robots together, a training has done, for the task's curriculum."""
        self.core.set_progress(steps)

    def get_state(self, rows: int | Sequence[int] | NDArray[Any] | None = None) -> Snapshot:
        """Return a snapshot: everything that decides what comes next, for planning, debugging and exact resumption.

        It holds physics with warm starts, delays, sensors with their noise counters, the slip observer, commands,
        randomisation, observation history, rewards and the episode. Not in it: ``set_progress``, and pictures.

        Args:
            rows: numbers of robots, or a mask (N,); None = all.

        Raises:
            InputError: not robots of this batch, or a plant whose state cannot be set (a real robot).
            gymnasium.error.ResetNeeded: before the first reset.
        """
        return self._snapshots.take(rows)

    def set_state(self, snapshot: Snapshot, rows: int | Sequence[int] | NDArray[Any] | None = None) -> Any:
        """Put robots into the state of a snapshot. From there the same actions give the same bits, whatever the batch.

        Args:
            snapshot: of one robot, for all of ``rows``, or of one for each. It may come from a batch of another size, with the
                same task, robot, randomisation, effects, backend, precision and steps.
            rows: numbers of robots, or a mask (N,); None = all. Others stay as they are.

        Returns:
            The observations of all robots of the batch.

        Raises:
            InputError: a snapshot that does not fit (names the first difference), or a plant whose state cannot be set (a real
                robot); nothing has changed then.
        """
        self._snapshots.put(snapshot, rows)
        return self.core.observations()

    def describe(self) -> str:
        """Return the task's tables as text."""
        return self.core.describe()

    def contract(self) -> dict[str, Any]:
        """Return what a policy must be fed and what its output means."""
        return self.core.contract()
