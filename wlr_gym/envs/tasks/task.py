"""A task, resolved for a robot: the columns of its observations and of its action."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from wlr_gym.base.errors import InputError
from wlr_gym.envs.tasks.signals import signals_of
from wlr_gym.envs.tasks.task_config import TaskConfig, read_task
from wlr_gym.envs.tasks.terms import COMMANDS, COMPUTED, POLICY_TERMS, PRIVILEGED_TERMS, SCALARS, ObservationTerm
from wlr_gym.envs.tasks.terms.observations import limit_for
from wlr_gym.policy.sources import FED
from wlr_gym.robot import JOINTS, LEGS, WHEELS, Robot, RobotSource, load_robot


@dataclass(frozen=True)
class ObservationColumn:
    """One number of the observation: ``scale * clip(source[element] - offset, +-limit)``, ``lag`` control steps old.

    ``device`` names whose latency comes on top (empty: none); ``noise`` and ``bias`` are 1 sigma in ``unit`` and come on top
    of ``sensor_noise``, the sensor's own noise (an encoder: one count).
    """

    term: str
    element: str
    source: str
    unit: str
    frame: str
    offset: float
    scale: float
    limit: float
    sensor_noise: float
    noise: float
    bias: float
    lag: int
    device: str
    doc: str


@dataclass(frozen=True)
class ActionColumn:
    """One number of the action: ``setpoint = clip(centre + scale * action, low, high)``."""

    joint: str
    quantity: str
    unit: str
    centre: float
    scale: float
    low: float
    high: float


@dataclass(frozen=True)
class Task:
    """A checked task for a robot.

    Attributes:
        config: the data.
        robot: whose limits, home pose and numbers the terms use.
        policy: columns of the policy observation.
        privileged: columns of the privileged observation.
        actions: columns of the action.
    """

    config: TaskConfig
    robot: Robot
    policy: tuple[ObservationColumn, ...]
    privileged: tuple[ObservationColumn, ...]
    actions: tuple[ActionColumn, ...]

    @property
    def commands(self) -> tuple[str, ...]:
        """Names of the commands, in order."""
        return tuple(self.config.commands.terms)

    @property
    def rewards(self) -> tuple[str, ...]:
        """Names of the reward terms, in order."""
        return tuple(self.config.rewards)

    @property
    def terminations(self) -> tuple[str, ...]:
        """Names of the termination terms, in order."""
        return tuple(self.config.terminations)

    @property
    def measures(self) -> tuple[str, ...]:
        """Names of the measures, in order."""
        return tuple(self.config.measures)

    @property
    def computed(self) -> tuple[str, ...]:
        """Elements of the computed observations, policy and privileged, in order."""
        return tuple(dict.fromkeys(c.element for c in (*self.policy, *self.privileged) if c.source == "computed"))

    @property
    def computed_terms(self) -> tuple[str, ...]:
        """Names of the computed observation terms, in order."""
        return tuple(dict.fromkeys(c.term for c in (*self.policy, *self.privileged) if c.source == "computed"))

    @property
    def needs_observer(self) -> bool:
        """Whether any term needs the slip observer's estimate."""
        functions = [COMPUTED[name].function for name in self.computed_terms]
        functions += [registry[name].function for group, registry in SCALARS.items() for name in getattr(self.config, group)]
        return self.shows_estimate or any(map(_reads_estimate, functions))

    @property
    def shows_estimate(self) -> bool:
        """Whether the policy is fed the slip observer's estimate, as it is or by a computed observation."""
        return any(c.source == "estimate" for c in self.policy) or any(
            _reads_estimate(COMPUTED[c.term].function) for c in self.policy if c.source == "computed"
        )

    @property
    def episode_steps(self) -> int:
        """Control steps until truncation."""
        return max(1, round(self.config.episode_length / self.config.control_period))


def _reads_estimate(function: Callable[..., Any]) -> bool:
    return any(signal.startswith("estimate.") for signal in signals_of(function))


def load_task(
    source: str | Path | Mapping[str, Any], robot: RobotSource | None = None, overrides: Mapping[str, Any] | None = None
) -> Task:
    """Load a task for a robot, its numbers scaled for it; see :func:`read_task`. None = the task's own robot."""
    chosen = load_robot(read_task(source, overrides).robot if robot is None else robot)
    return build_task(read_task(source, overrides, chosen), chosen)


def fed_as(file: str | Path, source: str | Path | Mapping[str, Any], robot: RobotSource | None) -> str | Path | dict[str, Any]:
    """Return the task of ``source`` with what decides what a policy is fed taken from a task file, its numbers for a robot.

    A file with other commands is another task, which holds as a whole.
    """
    chosen = load_robot(read_task(source).robot if robot is None else robot)
    own, fed = (read_task(one, None, chosen).model_dump(mode="json", exclude_none=True) for one in (source, file))
    if own["commands"]["terms"].keys() != fed["commands"]["terms"].keys():
        return file
    conditions = {key: value for key, value in own.items() if key not in FED}
    return {**conditions, **{key: fed[key] for key in FED if key in fed}, "scaling": {}}


def build_task(config: TaskConfig, robot: Robot) -> Task:
    """Resolve a checked task for a robot.

    Raises:
        InputError: the task has optical flow, the robot has not.
    """
    if config.sensors.flow and robot.sensors.flow is None:
        raise InputError(
            f"sensors.flow = {config.sensors.flow:g}: robot '{robot.name}' has no optical-flow sensor; expected a robot "
            "with a section sensors.flow, such as --robot flow"
        )
    policy = tuple(column for name in config.observations for column in _policy_columns(config, robot, name))
    privileged = tuple(column for name in config.privileged for column in _privileged_columns(config, robot, name))
    return Task(config, robot, policy, privileged, _action_columns(config, robot))


def _policy_columns(config: TaskConfig, robot: Robot, name: str) -> list[ObservationColumn]:
    term, settings = POLICY_TERMS[name], config.observations[name]
    commands = config.commands.terms if term.source == "command" else {}
    return [
        ObservationColumn(
            term=name,
            element=element,
            source=term.source,
            unit=unit,
            frame=term.frame,
            offset=term.offset(robot),
            scale=settings.scale,
            limit=limit_for(term, robot, commands.get(element, ())) if settings.limit is None else settings.limit,
            sensor_noise=term.sensor_noise(robot),
            noise=settings.noise,
            bias=settings.bias,
            lag=lag,
            device=term.device,
            doc=doc,
        )
        for lag in range(settings.history)
        for element, unit, doc in _term_elements(term, config)
    ]


def _term_elements(term: ObservationTerm, config: TaskConfig) -> list[tuple[str, str, str]]:
    if term.source == "command":
        return [(command, COMMANDS[command].unit, COMMANDS[command].doc) for command in config.commands.terms]
    if term.source == "action":
        return [(joint, term.unit, term.doc) for joint in JOINTS]
    units = term.unit.split(", ")
    if len(units) == len(term.elements):
        return [(element, unit, term.doc) for element, unit in zip(term.elements, units, strict=True)]
    return [(element, term.unit, term.doc) for element in term.elements]


def _privileged_columns(config: TaskConfig, robot: Robot, name: str) -> list[ObservationColumn]:
    term, settings = PRIVILEGED_TERMS[name], config.privileged[name]
    limit = limit_for(term, robot) if settings.limit is None else settings.limit
    return [
        ObservationColumn(name, element, term.source, unit, term.frame, 0.0, settings.scale, limit, 0.0, 0.0, 0.0, 0, "", doc)
        for element, unit, doc in _term_elements(term, config)
    ]


def _action_columns(config: TaskConfig, robot: Robot) -> tuple[ActionColumn, ...]:
    low, high = robot.leg_limits
    speed = robot.servo.wheel.no_load_speed
    legs = [ActionColumn(joint, "angle", "rad", robot.home.leg_angle, config.action.leg_scale, low, high) for joint in LEGS]
    wheels = [ActionColumn(joint, "speed", "rad/s", 0.0, config.action.wheel_scale, -speed, speed) for joint in WHEELS]
    return (*legs, *wheels)


def bounds(columns: tuple[ObservationColumn, ...]) -> tuple[np.ndarray, np.ndarray]:
    """Lowest and highest value of each observation column, float32."""
    high = np.array([np.float32(column.scale * column.limit) for column in columns], dtype=np.float32)
    return -high, high
