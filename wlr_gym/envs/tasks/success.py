"""How well an episode went: its tracking error, and whether it was a success. One definition, for environments and cards."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from wlr_gym.envs.tasks.task_config import TaskConfig

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]
#: A measure of the task and what of it counts over an episode: ``rms`` or ``max`` (largest magnitude).
Which = tuple[str, str]

#: What a fall adds to the tracking error of its episode, which otherwise knows the time before it only.
FALL = 10.0


class Bounds(Protocol):
    """What success asks of a measure, as :class:`wlr_gym.envs.tasks.task_config.SuccessConfig`."""

    @property
    def rms(self) -> float | None: ...
    @property
    def max(self) -> float | None: ...
    @property
    def scale(self) -> float | None: ...


def limits_within(bounds: Bounds) -> dict[str, float]:
    """Return the limits of success of a measure: ``rms`` and ``max``, those there are."""
    return {kind: limit for kind, limit in (("rms", bounds.rms), ("max", bounds.max)) if limit is not None}


def scales_within(bounds: Bounds) -> dict[str, float]:
    """Return what counts as 1 in the tracking error: the limits, in place of the limit ``rms`` its scale where there is one."""
    limits = limits_within(bounds)
    return limits | ({"rms": bounds.scale} if "rms" in limits and bounds.scale is not None else {})


def limits_of(config: TaskConfig) -> dict[Which, float]:
    """Return the limits of success of a task, in the order of its measures, SI units."""
    chosen = [(name, config.success[name]) for name in config.measures if name in config.success]
    return {(name, kind): limit for name, bounds in chosen for kind, limit in limits_within(bounds).items()}


def scales_of(config: TaskConfig) -> dict[Which, float]:
    """Return what counts as 1 in the tracking error of a task, in the order of its measures, SI units."""
    chosen = [(name, config.success[name]) for name in config.measures if name in config.success]
    return {(name, kind): scale for name, bounds in chosen for kind, scale in scales_within(bounds).items()}


def tracking_error(scales: Mapping[Which, float], errors: Mapping[Which, Array], fell: Flags) -> Array:
    """Return the tracking error of each episode (N,): rms over the measures in units of their scales; a fall adds :data:`FALL`.

    Args:
        scales: of the task; without any the rms is 0.
        errors: measure and kind -> (N,), SI units; of all that has a scale.
        fell: (N,) a termination term ended the episode.
    """
    shares = np.array([errors[which] / scale for which, scale in scales.items()]).reshape(len(scales), len(fell))
    return np.sqrt((shares**2).sum(axis=0) / max(1, len(scales))) + FALL * fell


def succeeded(limits: Mapping[Which, float], errors: Mapping[Which, Array], fell: Flags) -> Flags:
    """Return which episodes (N,) did not fall and stayed within every limit; with limits of success: which were a success.

    Arguments as for the tracking error.
    """
    well = ~fell
    for which, limit in limits.items():
        well &= errors[which] <= limit
    return well
