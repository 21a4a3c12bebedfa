"""Episodes: their seeds, how many steps they have lasted, and how they end."""

from __future__ import annotations

from typing import Any

import numpy as np
from gymnasium.error import ResetNeeded
from numba import njit
from numpy.typing import NDArray

from wlr_gym.base.errors import InputError
from wlr_gym.base.snapshot import RowStore
from wlr_gym.envs.tasks.draws import episode_seeds

Mask = NDArray[np.bool_]
Rows = NDArray[np.intp]


@njit(cache=True, nogil=True, error_model="numpy")
def _count_step(mask: Any, limit: int, over: Any, steps: Any, sooner: Any, terminated: Any, truncated: Any) -> bool:
    """Count a step and set the end flags. Returns whether any episode ended."""
    any_done = False
    for i in range(len(mask)):
        if not mask[i]:
            continue
        terminated[i] = False
        steps[i] += 1
        for k in range(over.shape[1]):
            if over[i, k] > 0.0:
                terminated[i] = True
        truncated[i] = steps[i] >= limit - sooner[i]
        any_done = any_done or terminated[i] or truncated[i]
    return any_done


class Episodes:
    """The episodes of N robots, all (N,).

    Attributes:
        robot_seeds: the robots' own seeds. number: which episode of the robot this is, from 0. seeds: of the episodes.
        seeded: whether the robot has a seed. begun: whether its first episode has begun.
        steps: control steps since the episode began. sooner: by how many steps before the limit the present one is truncated.
        terminated, truncated: flags of the last step.
    """

    def __init__(self, count: int) -> None:
        self.robot_seeds: NDArray[np.uint64] = np.zeros(count, np.uint64)
        self.number: NDArray[np.int64] = np.zeros(count, np.int64)
        self.seeds: NDArray[np.uint64] = np.zeros(count, np.uint64)
        self.seeded: Mask = np.zeros(count, bool)
        self.begun: Mask = np.zeros(count, bool)
        self._all_begun = False
        self.steps: NDArray[np.int64] = np.zeros(count, np.int64)
        self.sooner: NDArray[np.int64] = np.zeros(count, np.int64)
        self.terminated: Mask = np.zeros(count, bool)
        self.truncated: Mask = np.zeros(count, bool)

    def seed(self, row: int, seed: int) -> None:
        """Give a robot its seed; its next episode is its first.

        Raises:
            InputError: see :func:`read_seed`.
        """
        self.robot_seeds[row] = _word(read_seed(seed))
        self.number[row] = -1
        self.seeded[row] = True

    def next_seeds(self, rows: Rows) -> NDArray[np.uint64]:
        """Return the seeds of the next episodes of some robots."""
        return episode_seeds(self.robot_seeds[rows], self.number[rows] + 1)

    def begin(self, rows: Rows, seeds: NDArray[np.uint64]) -> None:
        """Begin the next episodes of some robots, which have these seeds; :meth:`note_begun` says when they can be stepped."""
        self.begun[rows] = self._all_begun = False
        self.number[rows] += 1
        self.seeds[rows] = seeds
        self.steps[rows] = self.sooner[rows] = 0
        self.terminated[rows] = self.truncated[rows] = False

    def count_step(self, mask: Mask, limit: int, over: NDArray[np.float64]) -> bool:
        """Count a step of the robots in ``mask``: any of their termination terms ``over`` (N, K) above 0 ends the episode, as
        does step ``limit``. Returns whether any episode ended."""
        return _count_step(mask, limit, over, self.steps, self.sooner, self.terminated, self.truncated)

    def note_begun(self, mask: Mask) -> None:
        """Say that the episodes of the robots in ``mask`` can be stepped."""
        self.begun |= mask
        self._all_begun = bool(self.begun.all())

    def stores(self) -> dict[str, RowStore]:
        """Return what snapshots hold."""
        names = ("robot_seeds", "number", "seeds", "seeded", "begun", "steps", "sooner", "terminated", "truncated")
        return {name: getattr(self, name) for name in names}

    def require_begun(self, what: str, rows: Rows | None = None) -> None:
        """Refuse what needs the episodes of some robots, None = all, to have begun.

        Raises:
            gymnasium.error.ResetNeeded: one has not.
        """
        if self._all_begun:
            return
        asked = np.arange(len(self.begun)) if rows is None else rows
        waiting = asked[~self.begun[asked]]
        if waiting.size:
            raise ResetNeeded(f"call reset() before {what}: no episode of robot {waiting[0]} has begun")


def is_whole(value: Any) -> bool:
    """Return whether a value is a whole number; True and False are none."""
    return isinstance(value, (int, np.integer)) and not isinstance(value, bool)


def read_seed(seed: Any) -> int:
    """Return a seed.

    Raises:
        InputError: no whole number of 0 or more.
    """
    if not is_whole(seed) or seed < 0:
        raise InputError(f"seed = {seed!r}: expected a whole number of 0 or more")
    return int(seed)


def own_seed(environment: Any) -> int:
    """Return the seed of an environment's ``np_random``; one drawn from it where the user set it, as its own is not known."""
    seed = environment.np_random_seed
    return int(environment.np_random.integers(2**63)) if seed < 0 else seed


def _word(seed: int) -> int:
    """Return the 64 bits that a seed draws from: itself, or, of a larger one such as fresh entropy, its hash."""
    return seed if seed < 2**64 else int(np.random.SeedSequence(seed).generate_state(1, np.uint64)[0])
