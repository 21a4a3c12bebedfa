"""Episodes that a policy drives on a robot, real or emulated, scored by the measures that its task has in simulation."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
from numpy.typing import NDArray

from wlr_gym.base.errors import InputError
from wlr_gym.envs.core import make_task, measured_truth
from wlr_gym.envs.registry import task_source_of
from wlr_gym.envs.settings import read_settings
from wlr_gym.envs.tasks.compiled_terms import Scores, compile_scores
from wlr_gym.envs.tasks.signals import yaw_of
from wlr_gym.envs.tasks.task import scales_of, tracking_error
from wlr_gym.hardware.deployment import Deployment, deploy, refuse_deadman
from wlr_gym.hardware.operator import stop_on_request
from wlr_gym.hardware.plant import RobotPlant
from wlr_gym.learning.evaluation.rollout import make_core
from wlr_gym.perception.observer import ESTIMATE_LAYOUT
from wlr_gym.physics.plants.base import TRUTH_LAYOUT, RobotOptions
from wlr_gym.policy import environment_for, make_policy

if TYPE_CHECKING:
    from wlr_gym.envs.core import Core
    from wlr_gym.envs.tasks.task import Task

Array = NDArray[np.float64]

#: Why an episode ended that was driven to its end.
WHOLE = "time is over"
#: The same of one in which it fell.
FELL = "it fell"


class EpisodeRobot(Protocol):
    """A robot that policies can drive."""

    def start(self, log: Path | None, seed: int) -> tuple[RobotPlant, Any]:
        """Return the robot as a plant, torque off, and the simulator behind an emulated one; None = it is a real one."""
        ...


@dataclass(frozen=True)
class RobotEpisode:
    """How an episode went.

    Attributes:
        seed: of its commands.
        tracking_error: as in evaluations; a fall or a stop by the supervision adds 10.
        measures: rms of each measure, SI units.
        seconds: driven.
        reason: why it ended.
        run: path of its log; empty = none was written.
    """

    seed: int
    tracking_error: float
    measures: Mapping[str, float]
    seconds: float
    reason: str
    run: str = ""

    @property
    def whole(self) -> bool:
        """Whether it was driven to its end."""
        return self.reason == WHOLE


def drive_episode(
    environment: str, policy: str, robot: EpisodeRobot, seed: int, seconds: float, log: Path | None = None
) -> RobotEpisode:
    """Drive one episode; torque is off afterwards. Commands are those of a simulated episode of the same seed.

    An emulated robot is scored by its true motion, a real one by what the slip observer and the gyro say of it.

    Args:
        environment: id. policy: its source. robot: what is driven.
        seed: of the commands. seconds: of the episode.
        log: folder for the run; None = none is written.

    Raises:
        InputError: a policy that does not fit, or without a slip observer on a real robot; ports that cannot be opened.
    """
    keywords = {"backend": "dynamixel", "hardware": RobotOptions(emulated=True), "episode_length": seconds}
    core = make_core(environment, 1, environment_for(policy, keywords))
    core.plant.close()
    plant, truth = robot.start(log, seed)
    core.plant = plant
    try:
        refuse_deadman(plant)
        if truth is None and core.observer is None:
            raise InputError(f"policy '{policy}': it has no slip observer, which is what tells how a real robot moves")
        whole = make_task(task_source_of(environment), read_settings(environment_for(policy, {})))  # with all measures
        score = _Score(whole, core, truth)
        with stop_on_request(plant.loop.operator):
            driven = deploy(core, make_policy(policy, core.contract()), seed, watcher=score)
    finally:
        core.close()
    return score.episode(seed, driven)


class _Score:
    """The measures of an episode on a robot, by the kernel that scores simulated ones."""

    def __init__(self, task: Task, core: Core, truth: Any) -> None:
        self._task, self._core, self._true = task, core, truth
        self._kernel = compile_scores(task)
        self._scores = Scores.zeros(task, 1)
        self._start = np.zeros_like(core.start)
        self._ticks = 0

    def begin(self) -> None:
        """Note where the episode starts."""
        now = self._truth()
        self._start[0, :2] = TRUTH_LAYOUT.view(now, "position")[0, :2]
        self._start[0, 2] = yaw_of(*TRUTH_LAYOUT.view(now, "quaternion").T)[0]

    def take(self, command: Array) -> str:
        """Score a control step; say so where a termination of the task ends the episode."""
        core, task = self._core, self._task
        estimate = np.zeros((1, ESTIMATE_LAYOUT.width)) if core.observer is None else core.observer.values
        clock = np.array([[(self._ticks + 1) * task.config.control_period]])
        signals = (
            core.sensors.values, estimate, self._truth(), command, core.action, core.actions.previous, self._start, clock,
            core.presence, core.computed,
        )  # fmt: skip
        self._kernel.run(core.everyone, signals, self._kernel.numbers, tuple(self._scores))
        self._ticks += 1
        return FELL if (self._scores.over > 0.0).any() else ""

    def _truth(self) -> Array:
        if self._true is not None:
            return self._true.truth().values.copy()
        observer = self._core.observer
        assert observer is not None
        found = measured_truth(self._core.sensors)
        for channel in ("position", "linear_velocity_in_body"):
            found[:, TRUTH_LAYOUT.slices[channel]][:, :2] = ESTIMATE_LAYOUT.view(observer.values, channel)
        half = 0.5 * ESTIMATE_LAYOUT.view(observer.values, "yaw")
        TRUTH_LAYOUT.view(found, "quaternion")[:, [0, 3]] = np.stack([np.cos(half), np.sin(half)], axis=-1)
        return np.nan_to_num(found)

    def episode(self, seed: int, driven: Deployment) -> RobotEpisode:
        """Return how it went."""
        reason, run = driven.reason, "" if driven.run is None else str(driven.run)
        task, ticks = self._task, max(1, self._ticks)
        rms = np.sqrt(self._scores.squares[0] / ticks)
        measures = {name: float(value) for name, value in zip(task.measures, rms, strict=True)}
        largest = dict(zip(task.measures, self._scores.largest[0], strict=True))
        scales = scales_of(task.config)
        errors = {(name, kind): np.array([measures[name] if kind == "rms" else largest[name]]) for name, kind in scales}
        error = float(tracking_error(scales, errors, np.array([reason != WHOLE]))[0])
        return RobotEpisode(seed, error, measures, ticks * task.config.control_period, reason, run)
