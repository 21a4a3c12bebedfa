"""Parameters and initial states of the robots: what randomisation draws, then the effects, then which sensors the task gives
them, then what the user sets."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wlr_gym.base.errors import InputError
from wlr_gym.base.snapshot import RowStore
from wlr_gym.envs.episodes import Episodes
from wlr_gym.envs.tasks.draws import stream_numbers, uniforms
from wlr_gym.envs.tasks.randomization import DRIFT_PERIOD, Randomization
from wlr_gym.envs.tasks.task_config import SensorsConfig
from wlr_gym.physics.effects import Patch, apply_patch
from wlr_gym.physics.plants.base import PlantState
from wlr_gym.robot import Robot
from wlr_gym.robot.parameters import Parameters

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
Rows = NDArray[np.intp]
Seeds = NDArray[np.uint64]
Counts = NDArray[np.int64]


class RandomizedRobots:
    """Parameters and initial states of N robots.

    Args:
        robot: the nominal one.
        randomization: what is drawn.
        patch: effects that are added to it.
        control_period: s.
        count: N.
        sensors: how often a sensor is present.

    Attributes:
        parameters: present parameters of every robot.
        state: where the robots of the present episodes started.
        changed: (N,) whether randomisation changed the robot's parameters at the end of the last step.
        share: of the randomisation that new episodes are drawn with, below 1 early in a curriculum.
    """

    def __init__(
        self,
        robot: Robot,
        randomization: Randomization,
        patch: Patch,
        control_period: float,
        count: int,
        sensors: SensorsConfig,
    ) -> None:
        self._randomization = randomization
        self._patch = patch
        self._presence = [(f"{name}.present", share) for name, share in sensors if share is not None]
        self._presence_streams = stream_numbers(*(name for name, _ in self._presence))
        self._period = control_period
        self.share: float = 1.0
        self._shares = np.ones(count)  # that the present episodes were drawn with
        self.parameters: Parameters = apply_patch(patch, Parameters.nominal(robot, count))
        self.state: PlantState = randomization.state(self.parameters, np.zeros(count, np.uint64))
        self.changed = np.zeros(count, bool)
        self._overrides = np.full(count, None, dtype=object)  # {parameter: value} that users set for the present episodes
        intervals = len(randomization.intervals)
        self._occurrences = np.zeros((count, intervals), np.int64)
        self._strike_at = np.zeros((count, intervals), np.int64)
        self._drift_steps = max(1, round(DRIFT_PERIOD / control_period)) if randomization.drifts else 0

    def begin(self, rows: Rows, robot_seeds: Seeds, seeds: Seeds, overrides: dict[str, Any]) -> None:
        """Draw some robots for a new episode.

        Args:
            rows: (M,) which robots.
            robot_seeds, seeds: (M,) of the robots and of their episodes.
            overrides: parameters that keep these values for the whole episode.

        Raises:
            InputError: an override out of bounds; nothing has changed then.
        """
        robots = self._draw(robot_seeds, seeds, np.full(len(rows), self.share))
        _override(robots, overrides)
        self._shares[rows] = self.share
        self.parameters.values[rows] = robots.values
        self._overrides[rows] = overrides
        for name, value in vars(self._randomization.state(robots, seeds, self.share)).items():
            if value is not None:
                getattr(self.state, name)[rows] = value
        self.changed[rows] = False
        self._occurrences[rows] = 0
        if self._randomization.intervals:
            self._strike_at[rows] = self._wait(rows, seeds)

    def change(self, mask: Mask, episodes: Episodes) -> bool:
        """Redraw the parameters of interval events whose time has come, and of those that drift every few steps.

        Returns:
            Whether those of any robot in ``mask`` changed.
        """
        steps = episodes.steps
        due = (self._strike_at <= steps[:, None]) & mask[:, None]
        due.any(axis=1, out=self.changed)
        if self._drift_steps:
            self.changed |= mask & (steps % self._drift_steps == 0)
        if not self.changed.any():
            return False
        rows = np.flatnonzero(self.changed)
        seeds = episodes.seeds[rows]
        self._occurrences[due] += 1
        if self._randomization.intervals:
            strikes = steps[rows, None] + self._wait(rows, seeds)
            self._strike_at[rows] = np.where(due[rows], strikes, self._strike_at[rows])
        time = np.asarray(steps[rows] * self._period, np.float64)
        robots = self._draw(episodes.robot_seeds[rows], seeds, self._shares[rows], self._occurrences[rows], time)
        for index, row in enumerate(rows.tolist()):
            if self._overrides[row]:
                _override(Parameters(robots.values[index : index + 1]), self._overrides[row])
        self.parameters.values[rows] = robots.values
        return True

    def stores(self) -> dict[str, RowStore]:
        """Return what snapshots hold."""
        start = {f"start_{name}": value for name, value in vars(self.state).items() if value is not None}
        return {
            "parameters": self.parameters.values,
            "parameters_changed": self.changed,
            "randomization_share": self._shares,
            "overrides": self._overrides,
            "occurrences": self._occurrences,
            "strike_at": self._strike_at,
            **start,
        }

    def read_overrides(self, given: Mapping[str, Any]) -> dict[str, Any]:
        """Return parameters {name or element: value} that fit one robot: they are set again, robot by robot, whenever its
        parameters are redrawn.

        Raises:
            InputError: unknown parameter, or a value of another type or shape.
        """
        for name, value in given.items():
            one = self.parameters[str(name)][:1]
            if _type_of(value) not in "biuf":
                raise InputError(f"parameters: {name} = {value!r}: expected a number, or an array of shape {one.shape[1:]}")
            try:
                np.broadcast_to(value, one.shape)
            except ValueError:
                raise InputError(
                    f"parameters: {name} of shape {np.shape(value)}: expected shape {one.shape[1:]}, the same for every robot"
                ) from None
        return {name: np.array(value, np.float64) for name, value in given.items()}  # a copy: what the caller does later is his

    def _draw(
        self, robot_seeds: Seeds, seeds: Seeds, share: Array, occurrences: Counts | None = None, time: Array | None = None
    ) -> Parameters:
        """Randomisation of some robots, then the effects, then the sensors."""
        robots = self._randomization.parameters(robot_seeds, seeds, occurrences, time, share)
        robots = apply_patch(self._patch, robots) if self._patch else robots
        for (name, share), drawn in zip(self._presence, uniforms(seeds, self._presence_streams).T, strict=True):
            robots[name] = drawn < share
        return robots

    def _wait(self, rows: Rows, seeds: Seeds) -> Counts:
        """Control steps (M, intervals) until each interval event strikes some robots next."""
        return self._randomization.next_strike(seeds, self._occurrences[rows], self._period)


def _type_of(value: Any) -> str:
    try:
        return np.asarray(value).dtype.kind
    except ValueError:  # lists of different lengths
        return "O"


def _override(parameters: Parameters, values: Mapping[str, Any]) -> None:
    for name, value in values.items():
        parameters[str(name)] = value
    if values:
        parameters.validate()
