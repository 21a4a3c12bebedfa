"""Setpoints of recorded runs, as they arrive at the servos of a batch of robots."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from wlr_gym.base.compiled import compiled
from wlr_gym.base.errors import InputError
from wlr_gym.base.snapshot import RowStore
from wlr_gym.gap.robot.clock import CLOCK, RunClock
from wlr_gym.physics.plants.base import PlantState
from wlr_gym.robot.parameters import Parameters

Array = NDArray[np.float64]


class Schedule(NamedTuple):
    """Setpoints of runs, and where a batch is in them.

    Attributes:
        times: (rows of all runs, one more of each that never arrives) when setpoints were written, s.
        goals: (the same rows, 8) the setpoints.
        delay: (robots, 8) s; how much later each joint has them.
        rows: (robots, 8) which one each joint has.
        newer, older, wait: (robots, 8) of the present tick: the two setpoints and the time between, s.
    """

    times: Array
    goals: Array
    delay: Array
    rows: NDArray[np.int64]
    newer: Array
    older: Array
    wait: Array


class WrittenSetpoints:
    """Setpoints that arrive at their measured times, each joint's late by its own ``command.delay``."""

    given = True

    def __init__(self, clocks: Sequence[RunClock], run_of: NDArray[np.intp], delay: Array) -> None:
        rows = [len(clock.t) for clock in clocks]
        start = np.concatenate([[0], np.cumsum([n + 1 for n in rows])])[:-1]
        times = np.concatenate([np.append(clock.t - clock.begin, np.inf) for clock in clocks])
        goals = np.concatenate([np.vstack([clock.setpoints, clock.setpoints[-1:]]) for clock in clocks])
        buffers = (np.zeros(delay.shape) for _ in range(3))
        self.schedule: Schedule = Schedule(times, goals, delay, np.repeat(start[run_of][:, None], 8, axis=1), *buffers)
        self._tick = 0

    def reset(self, rows: NDArray[np.intp], state: PlantState, parameters: Parameters) -> None:
        """Nothing: the setpoints are given."""

    def set_delays(self, rows: NDArray[np.intp], parameters: Parameters) -> None:
        """Nothing: the delays are given."""

    def stores(self) -> dict[str, RowStore]:
        """Refuse: the setpoints are those of a recorded run."""
        raise InputError("a plant that follows recorded setpoints cannot be saved and set back")

    def push(self, setpoints: Array) -> tuple[Array, Array, Array]:
        """Return the newer setpoints, the older setpoints and the time between (s) of the present tick; see SetpointHistory.

        The next call overwrites them.
        """
        arrive(self._tick * CLOCK, self.schedule)
        self._tick += 1
        return self.schedule.newer, self.schedule.older, self.schedule.wait


@compiled
def arrive(now: Any, schedule: Any) -> None:
    """Fill the setpoints of the tick that begins at ``now`` (s) and move the rows on to those that have arrived."""
    rows, goals = schedule.rows, schedule.goals
    for i in range(len(rows)):
        for j in range(8):
            schedule.older[i, j] = goals[rows[i, j], j]
            due = schedule.times[rows[i, j] + 1] + schedule.delay[i, j] - now
            schedule.wait[i, j] = 0.0
            if due < CLOCK:
                rows[i, j] += 1
                schedule.wait[i, j] = max(due, 0.0)
            schedule.newer[i, j] = goals[rows[i, j], j]
