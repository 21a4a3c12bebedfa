"""Actions: checked, and turned into setpoints of the joints."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import ArrayLike, NDArray

from wlr_gym.base.errors import InputError
from wlr_gym.base.snapshot import RowStore
from wlr_gym.envs.tasks.task import ActionColumn
from wlr_gym.robot import JOINTS

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

#: Actions may exceed +-1 by rounding only.
ACTION_LIMIT = 1.0 + 1e-6

_FLOAT32 = np.dtype(np.float32)

#: One column of the action: setpoint = clip(centre + scale * action, low, high).
SCALING = np.dtype([(name, np.float64) for name in ("centre", "scale", "low", "high")])


@njit(cache=True, nogil=True, error_model="numpy")
def _take(mask: Any, given: Any, limit: float, scaling: Any, buffers: Any) -> int:
    """Check actions (N, 8) and turn them into setpoints; nothing is written when one is bad.

    Robots outside ``mask`` get the setpoints of action 0. ``buffers``: action, previous action and setpoints, (N, 8) each.

    Returns:
        Flat index of the first action that is not finite or beyond the limit, or -1.
    """
    action, previous, setpoints = buffers
    robots, width = given.shape
    for i in range(robots):
        if mask[i]:
            for j in range(width):
                if not abs(given[i, j]) <= limit:
                    return i * width + j
    for i in range(robots):
        for j in range(width):
            value = min(max(float(given[i, j]), -1.0), 1.0) if mask[i] else 0.0
            previous[i, j] = action[i, j]
            action[i, j] = value
            row = scaling[j]
            setpoints[i, j] = min(max(row.centre + row.scale * value, row.low), row.high)
    return -1


class Actions:
    """The actions of N robots.

    Args:
        columns: of the action.
        count: N.
        free_wheels: wheels whose motors are off.

    Attributes:
        action, previous: (N, 8) last actions and those of the step before.
        setpoints: (N, 8) last setpoints, rad and rad/s.
        torque_on: (N, 8) whether the motors are on; None = all.
    """

    def __init__(self, columns: Sequence[ActionColumn], count: int, free_wheels: Sequence[str]) -> None:
        self._scaling = np.array([(c.centre, c.scale, c.low, c.high) for c in columns], SCALING)
        self.action, self.previous, self.setpoints = np.zeros((3, count, len(columns)))
        self._buffers = (self.action, self.previous, self.setpoints)
        self.torque_on: Mask | None = None
        if free_wheels:
            self.torque_on = np.ones((count, len(columns)), bool)
            self.torque_on[:, [JOINTS.index(wheel) for wheel in free_wheels]] = False

    def begin(self, rows: NDArray[np.intp]) -> None:
        """Forget the actions of some robots."""
        self.action[rows] = self.previous[rows] = 0.0

    def stores(self) -> dict[str, RowStore]:
        """Return what snapshots hold."""
        return {"action": self.action, "previous_action": self.previous, "setpoints": self.setpoints}

    def take(self, actions: ArrayLike, mask: Mask) -> None:
        """Turn actions (N, 8) into setpoints; robots outside ``mask`` get those of action 0.

        Raises:
            InputError: wrong shape, or an action that is not finite or out of [-1, 1]; names robot and joint.
        """
        given = read_actions(actions, self.action.shape)
        bad = _take(mask, given, ACTION_LIMIT, self._scaling, self._buffers)
        if bad >= 0:
            row, joint = divmod(int(bad), given.shape[1])
            robot = f" of robot {row} of the batch" if len(given) > 1 else ""
            raise InputError(f"action for {JOINTS[joint]}{robot} is {given[row, joint]:g}, expected a finite number in [-1, 1]")


def read_actions(actions: ArrayLike, shape: tuple[int, ...]) -> NDArray[np.float32]:
    """Return actions as float32 of the given shape.

    Raises:
        InputError: not numbers, or another shape.
    """
    if type(actions) is np.ndarray and actions.dtype == _FLOAT32 and actions.shape == shape:
        return actions  # as nearly always: half of the time of what follows, twice in a step
    try:
        given = np.asarray(actions)
        if given.dtype.kind not in "iuf":
            raise TypeError
        given = given.astype(np.float32, copy=False)
    except (TypeError, ValueError):
        raise InputError(f"action of type {type(actions).__name__}: expected real numbers of shape {shape}") from None
    if given.shape != shape:
        raise InputError(f"action has shape {given.shape}, expected {shape}; joints {', '.join(JOINTS)}")
    return given
