"""Delayed setpoints: a command acts some time after it was written, per joint and robot."""

from __future__ import annotations

from typing import Any, Protocol

import numpy as np
from numba import njit
from numpy.typing import NDArray

from wlr_gym.base.snapshot import RowStore
from wlr_gym.physics.plants.base import PlantState
from wlr_gym.robot import LEG_SLICE
from wlr_gym.robot.parameter_table import SPECS
from wlr_gym.robot.parameters import Parameters

Array = NDArray[np.float64]


class Setpoints(Protocol):
    """Where a simulator gets the setpoints of a tick from; see :class:`SetpointHistory`.

    Attributes:
        given: they come from elsewhere; what is written to the simulator is ignored.
    """

    given: bool

    def reset(self, rows: NDArray[np.intp], state: PlantState, parameters: Parameters) -> None: ...

    def set_delays(self, rows: NDArray[np.intp], parameters: Parameters) -> None: ...

    def push(self, setpoints: Array) -> tuple[Array, Array, Array]: ...

    def stores(self) -> dict[str, RowStore]: ...


@njit(cache=True, nogil=True)
def _read(ring: Any, head: int, ticks: Any, newer: Any, older: Any) -> None:
    """Read the setpoints written so many ``ticks`` (N, 8) ago, and those of a tick before, from a ring (depth, N, 8)."""
    depth, count, width = ring.shape
    for i in range(count):
        for j in range(width):
            place = head - ticks[i, j]
            newer[i, j] = ring[place % depth, i, j]
            older[i, j] = ring[(place - 1) % depth, i, j]


class SetpointHistory:
    """Ring of the last setpoints, from which each joint reads at its own ``command.delay``.

    Within one control tick a joint follows the older of two neighbouring setpoints until ``switch_time``, then the newer one.
    """

    given = False

    def __init__(self, count: int, control_period: float) -> None:
        self._period = control_period
        depth = int(np.ceil(SPECS["command.delay"].high / control_period)) + 2
        self._ring = np.zeros((depth, count, 8))
        self._head = 0
        self._ticks = np.zeros((count, 8), np.intp)
        self._switch_time = np.zeros((count, 8))
        self._delayed = False

    def reset(self, rows: NDArray[np.intp], state: PlantState, parameters: Parameters) -> None:
        """Forget old setpoints: legs are told to stay where their reference is, wheels to keep their reference speed.

        Setpoints are in terms of the reading, references in terms of the true angle.
        """
        hold = state.reference_velocity[rows].copy()
        hold[:, LEG_SLICE] = state.reference_position[rows, LEG_SLICE] + parameters["joint.zero_offset"][rows]
        self._ring[:, rows] = hold
        self.set_delays(rows, parameters)

    def set_delays(self, rows: NDArray[np.intp], parameters: Parameters) -> None:
        """Take new delays; setpoints already written act at their new time."""
        delay = parameters["command.delay"][rows]
        self._ticks[rows] = np.floor(delay / self._period + 1e-9)
        self._switch_time[rows] = np.maximum(delay - self._ticks[rows] * self._period, 0.0)
        self._delayed = bool(parameters["command.delay"].any())

    def push(self, setpoints: Array) -> tuple[Array, Array, Array]:
        """Take this tick's setpoints (N, 8); return the newer and the older ones and the switch time (s), each (N, 8)."""
        self._head = (self._head + 1) % len(self._ring)
        self._ring[self._head] = setpoints
        if not self._delayed:
            return setpoints, setpoints, self._switch_time
        newer, older = np.empty_like(setpoints), np.empty_like(setpoints)
        _read(self._ring, self._head, self._ticks, newer, older)
        return newer, older, self._switch_time

    def stores(self) -> dict[str, RowStore]:
        """Return the setpoints that were written, newest first (delays are parameters)."""
        return {"setpoints": _NewestFirst(self)}


class _NewestFirst:
    """The ring as rows (M, depth, 8) of robots, wherever its head is."""

    def __init__(self, history: SetpointHistory) -> None:
        self._history = history

    def _places(self, rows: NDArray[np.intp]) -> tuple[NDArray[Any], NDArray[Any]]:
        depth = len(self._history._ring)
        return (self._history._head - np.arange(depth)[None, :]) % depth, rows[:, None]

    def __getitem__(self, rows: NDArray[np.intp]) -> Array:
        return self._history._ring[self._places(rows)]

    def __setitem__(self, rows: NDArray[np.intp], values: Array) -> None:
        self._history._ring[self._places(rows)] = values
