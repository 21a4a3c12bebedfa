"""A recording as input of the simulation: setpoints, supply and switch on a fixed grid, and states to start from."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from wlr_gym.gap.rig import kernel
from wlr_gym.gap.rig.model import REFERENCE_TEMPERATURE, RigModel, pack
from wlr_gym.gap.rig.recording import Recording
from wlr_gym.physics.plants.forces import force_values

Array = NDArray[np.float64]

#: Substep, s. Half of it changes the mean error over the real runs by 0.1 %.
STEP = 2e-3
#: A row's goal is computed this long before the row's timestamp, s (time stamps of the chirp runs: 3.5 to 3.7 ms); how much
#: later the servo has it is the model's delay.
GOAL_LEAD = 0.0035
#: Rows on either side through which a cubic is laid to find angle and rate at a row.
HALF_WINDOW = 4


class Replay:
    """One recording, ready to be simulated."""

    def __init__(self, recording: Recording) -> None:
        self.recording = recording
        time = recording.time
        count = max(2, int((time[-1] - time[0]) / STEP) + 1)
        self._grid = time[0] + STEP * np.arange(count + 1)
        self._goals = _mean_setpoints(recording, self._grid)
        middle = self._grid[:-1] + 0.5 * STEP
        row = np.clip(np.searchsorted(time - GOAL_LEAD, middle, side="right") - 1, 0, len(time) - 1)
        self._inputs = np.stack(
            [
                np.interp(middle, time, recording.supply),
                recording.enabled[row].astype(np.float64),
                np.interp(middle, time, recording.temperature) - REFERENCE_TEMPERATURE,
            ],
            axis=1,
        )
        self.angle, self.rate = smoothed_state(time, recording.angle)
        place = (time - time[0]) / STEP
        self._below = np.clip(place.astype(np.int64), 0, count - 2)
        self._share = place - self._below

    def simulate(self, models: Sequence[RigModel], horizon: float | None = None) -> Array:
        """Return (models, rows, 5) :data:`kernel.OUTPUTS` at the rows of the recording.

        Args:
            models: what to simulate.
            horizon: s between restarts from the measured state; None = one simulation from the first row on.
        """
        count = len(self._goals)
        every = count if horizon is None else max(1, round(horizon / STEP))
        restarts = np.arange(0, count, every)
        starts = np.full(count, -1)
        starts[restarts] = np.arange(len(restarts))
        time = self.recording.time
        begun = np.stack([np.interp(self._grid[restarts], time, state) for state in (self.angle, self.rate)], axis=1)
        found = np.empty((len(models), count, len(kernel.OUTPUTS)))
        for same in _alike(models):
            part = [models[k] for k in same]
            lag = np.array([model.numbers["delay"] for model in part]) / STEP
            values = np.stack([force_values(model.forces) for model in part])
            run = (self._goals, self._inputs, starts, begun, STEP)
            found[same] = kernel.simulate(pack(part, self.recording, STEP), lag, *run, part[0].forces, values)
        below, above = found[:, self._below], found[:, self._below + 1]
        return below + (above - below) * self._share[:, None]


def _alike(models: Sequence[RigModel]) -> list[list[int]]:
    """Group models by the formulas that act in them: each group is one compiled kernel."""
    groups: dict[tuple[object, ...], list[int]] = {}
    for k, model in enumerate(models):
        groups.setdefault(tuple((force.formula, tuple(force.parameters)) for force in model.forces), []).append(k)
    return list(groups.values())


def _mean_setpoints(recording: Recording, grid: Array) -> Array:
    """Mean goal within every substep: each row's goal holds until the next is written."""
    written = recording.time - GOAL_LEAD
    edges = np.concatenate([[grid[0] - 1.0], written[1:], [grid[-1] + 1.0]])
    integral = np.concatenate([[0.0], np.cumsum(np.diff(edges) * recording.goal)])
    return np.diff(np.interp(grid, edges, integral)) / STEP


def smoothed_state(time: Array, angle: Array) -> tuple[Array, Array]:
    """Return angle (rad) and rate (rad/s) at every row, from a cubic through the rows around it."""
    count = len(time)
    first = np.clip(np.arange(count) - HALF_WINDOW, 0, count - 2 * HALF_WINDOW - 1)
    rows = first[:, None] + np.arange(2 * HALF_WINDOW + 1)
    scale = time[rows[:, -1]] - time[rows[:, 0]]
    powers = ((time[rows] - time[:, None]) / scale[:, None])[:, :, None] ** np.arange(4)
    turned = powers.transpose(0, 2, 1)
    fitted = np.linalg.solve(turned @ powers, turned @ angle[rows][:, :, None])[:, :, 0]
    return np.asarray(fitted[:, 0], np.float64), np.asarray(fitted[:, 1] / scale, np.float64)
