"""Whether an episode was a success: one definition, for evaluations, cards and training."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from wlr_gym.envs.tasks.task_config import TaskConfig

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]


def episode_rms(measure: Array, active: Flags) -> Array:
    """Return the root mean square (N,) of a measure (T, N) over the steps in which each episode was going on (T, N)."""
    return np.sqrt((np.where(active, measure, 0.0) ** 2).sum(axis=0) / np.maximum(active.sum(axis=0), 1))


def episode_max(measure: Array, active: Flags) -> Array:
    """Return the largest magnitude (N,) of a measure (T, N) over the steps in which each episode was going on (T, N)."""
    return np.abs(np.where(active, measure, 0.0)).max(axis=0)


def succeeded(config: TaskConfig, measures: Array, active: Flags, fell: Flags) -> Flags:
    """Return which episodes (N,) were a success: not fallen, and every measure within the limits of ``config.success``.

    Args:
        config: of the task.
        measures: (T, N, M) in the order of ``config.measures``.
        active: (T, N) the episode was going on in this step.
        fell: (N,) a termination term ended it.
    """
    well = ~fell
    names = list(config.measures)
    for name, limits in config.success.items():
        measure = measures[:, :, names.index(name)]
        if limits.rms is not None:
            well &= episode_rms(measure, active) <= limits.rms
        if limits.max is not None:
            well &= episode_max(measure, active) <= limits.max
    return well
