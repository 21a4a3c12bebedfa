"""What environments say beside observation and reward: the ``info`` of all interfaces, batched. Fresh objects every time."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from wlr_gym.envs.core import Core
from wlr_gym.envs.tasks.success import limits_of, scales_of, succeeded, tracking_error

Array = NDArray[np.float64]

#: Channels of the truth in ``info["truth"]``; units and frames: :data:`wlr_gym.physics.plants.base.TRUTH_LAYOUT`.
TRUTH = ("position", "quaternion", "linear_velocity_in_body", "angular_velocity_in_body")


class Infos:
    """Infos of the robots of a core: {key: {name: (N,)}} or {key: (N, ...)}.

    Attributes:
        has_truth: ``truth()`` says something, because users asked for it.
    """

    def __init__(self, core: Core) -> None:
        self._core = core
        self._limits, self._scales = limits_of(core.task.config), scales_of(core.task.config)
        self.has_truth: bool = core.settings.truth_info

    def step(self) -> dict[str, Any]:
        """Return the last step's ``reward_terms`` {name: (N,)}, ``slip_velocity`` (N, 4, 2) m/s along each wheel's heading
        and axle, ``effective_friction`` (N, 4, 2) along them, and ``truth``. A real robot knows its measured reward terms
        only."""
        core = self._core
        terms = dict(zip(core.task.rewards, core.scores.terms.T.copy(), strict=True))
        return {"reward_terms": terms, **self.contact(), **self.truth()}

    def contact(self) -> dict[str, Any]:
        """Return ``slip_velocity`` and ``effective_friction`` (N, 4, 2); nothing on a real robot."""
        core = self._core
        if not core.plant.capabilities.has_truth:
            return {}
        truth, shape = core.plant.truth(), (core.count, 4, 2)
        return {name: truth[name].reshape(shape).copy() for name in ("slip_velocity", "effective_friction")}

    def truth(self) -> dict[str, Any]:
        """Return ``truth``, where it was asked for: pose, velocities and ``command`` {name: (N,)} for the next step."""
        if not self.has_truth:
            return {}
        core = self._core
        found: dict[str, Any] = {name: core.plant.truth()[name].copy() for name in TRUTH}
        return {"truth": found | {"command": dict(zip(core.task.commands, core.command.T.copy(), strict=True))}}

    def episode(self) -> dict[str, Any]:
        """Return ``episode_reward_terms`` {name: (N,)}, sums over the episode so far, and ``episode_measures`` {name: (N,)}:
        the task's measures over it as score cards state them (rms; ``_max``: largest magnitude, where that is limited), and
        ``tracking_error`` and ``success`` (0 or 1) where the task has limits."""
        core = self._core
        sums = dict(zip(core.task.rewards, core.scores.sums.T.copy(), strict=True))
        errors = self.errors()
        limited = {which: error for which, error in errors.items() if which[1] == "rms" or which in self._limits}
        measures = {name if kind == "rms" else f"{name}_{kind}": error for (name, kind), error in limited.items()}
        if self._limits:
            measures["tracking_error"] = tracking_error(self._scales, errors, core.terminated)
            measures["success"] = succeeded(self._limits, errors, core.terminated).astype(np.float64)
        return {"episode_reward_terms": sums, "episode_measures": measures}

    def errors(self) -> dict[tuple[str, str], Array]:
        """Return the measures over the episode so far: (measure, ``rms`` or ``max``) -> (N,), SI units."""
        core = self._core
        rms = np.sqrt(core.scores.squares / np.maximum(core.episodes.steps, 1)[:, None])
        errors = {(name, "rms"): rms[:, k] for k, name in enumerate(core.task.measures)}
        return errors | {(name, "max"): core.scores.largest[:, k].copy() for k, name in enumerate(core.task.measures)}

    def tracking_error(self) -> Array:
        """Return the tracking error (N,) of the episode so far."""
        return tracking_error(self._scales, self.errors(), self._core.terminated)

    def succeeded(self) -> NDArray[np.bool_]:
        """Return whether the episode so far (N,) is a success."""
        return succeeded(self._limits, self.errors(), self._core.terminated)

    def reset(self) -> dict[str, Any]:
        """Return ``randomization`` {element: (N,)}, the present values of all parameters that randomisation changes, and
        ``truth``."""
        randomization = self._core.randomization
        return {**self._samples(randomization.elements, randomization.columns), **self.truth()}

    def change(self) -> dict[str, Any]:
        """Return ``randomization`` {element: (N,)}: the present values of those that also change within an episode."""
        randomization = self._core.randomization
        return self._samples(randomization.timed_elements, randomization.timed_columns)

    def _samples(self, elements: tuple[str, ...], columns: NDArray[np.int64]) -> dict[str, Any]:
        values = self._core.parameters.values[:, columns].T.copy()
        return {"randomization": dict(zip(elements, values, strict=True))}


def row_of(found: Any, row: int) -> Any:
    """Return one robot's part of an info: numbers as floats, in dicts too."""
    if isinstance(found, dict):
        return {key: row_of(value, row) for key, value in found.items()}
    value = found[row]
    return value.copy() if np.ndim(value) else float(value)
