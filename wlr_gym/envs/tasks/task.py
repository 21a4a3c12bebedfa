"""Tasks: their files in ``configs/task/``, checked, and what a file means for a robot.

:class:`TaskConfig` is the file, :class:`Task` the file resolved for a robot: the columns of its observations and of its action.
How well an episode went is said here too, by one definition for environments and cards.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, NonNegativeFloat, PositiveFloat

from wlr_gym.base.errors import InputError, check_name
from wlr_gym.base.paths import named_in
from wlr_gym.base.settings import ORDERED, SettingsModel, overlay, parse_config, read_config
from wlr_gym.envs.tasks.scaling import check_rule, scaled
from wlr_gym.envs.tasks.signals import signals_of
from wlr_gym.envs.tasks.terms import (
    COMMANDS,
    COMPUTED,
    CONTROLLER,
    POLICY_TERMS,
    PRIVILEGED_TERMS,
    SCALARS,
    ObservationTerm,
)
from wlr_gym.envs.tasks.terms.observations import limit_for
from wlr_gym.policy.agents import FED
from wlr_gym.policy.control import SlipGains
from wlr_gym.robot import JOINTS, LEGS, WHEELS, Robot, RobotSource, load_robot

#: Group of a task's data -> its terms.
_TERMS: dict[str, Mapping[str, Any]] = {"observations": POLICY_TERMS, "privileged": PRIVILEGED_TERMS, **SCALARS}
#: Group -> what messages call one of its terms.
_CALLED = {
    "observations": "observation term",
    "privileged": "privileged term",
    "rewards": "reward term",
    "terminations": "termination term",
    "measures": "measure",
}


class ActionConfig(SettingsModel):
    """Setpoint = centre + scale * action: rad about the home angle (legs), rad/s about zero (wheels)."""

    leg_scale: float = Field(gt=0)
    wheel_scale: float = Field(gt=0)


class CommandsConfig(SettingsModel):
    """Commands drawn uniformly in [low, high], held for a time drawn in ``hold_time`` (s); all zero now and then.

    ``ramp``: largest rate of change (unit/s) of a command, from 0 at the start; those not named jump. A command that is given
    (reset option, ``set_command``) holds at once.
    """

    hold_time: Annotated[tuple[PositiveFloat, PositiveFloat], ORDERED]
    zero_probability: float = Field(default=0.0, ge=0, le=1)
    ramp: dict[str, Annotated[float, Field(gt=0)]] = Field(default={})
    terms: dict[str, Annotated[tuple[float, float], ORDERED]]


class LatencyConfig(SettingsModel):
    """Age of a device's readings: drawn per episode and robot in ``delay`` (s).

    ``interpolate`` mixes the two readings around that age; ``hold`` gives the newest reading at least that old.
    """

    delay: Annotated[tuple[NonNegativeFloat, NonNegativeFloat], ORDERED]
    mode: Literal["interpolate", "hold"] = "interpolate"


class ObservationConfig(SettingsModel):
    """How a term enters the observation: ``scale * clip(reading - offset + bias + noise, +-limit)``.

    ``noise`` (per reading) and ``bias`` (per episode) are 1 sigma in the term's unit; ``history`` readings, newest first.
    """

    scale: float = Field(default=1.0, gt=0)
    noise: float = Field(default=0.0, ge=0)
    bias: float = Field(default=0.0, ge=0)
    limit: float | None = Field(default=None, gt=0)
    history: int = Field(default=1, ge=1, le=64)


class PrivilegedConfig(SettingsModel):
    """How a true quantity enters the privileged observation: ``scale * clip(value, +-limit)``."""

    scale: float = Field(default=1.0, gt=0)
    limit: float | None = Field(default=None, gt=0)


class ObserverConfig(SettingsModel):
    """The slip observer (:mod:`wlr_gym.perception.observer`); it runs where a term needs its estimate.

    ``camera``: it uses the camera's poses as they come; False = as if there were no camera.
    """

    camera: bool = True


class SensorsConfig(SettingsModel):
    """Which sensors the robots have: probability per episode that there is a camera, and an optical-flow sensor.

    Drawn from streams of their own. None = as the robot's file and the randomisation say.
    """

    camera: float | None = Field(default=None, ge=0, le=1)
    flow: float | None = Field(default=None, ge=0, le=1)


#: Sensors that a robot may have or not.
OPTIONAL = tuple(SensorsConfig.model_fields)


def having(sensors: Sequence[str] | None) -> dict[str, Any]:
    """Return the keywords of an environment whose robots have these of :data:`OPTIONAL` and not the others."""
    if sensors is None:
        return {}
    for name in sensors:
        check_name("sensor", name, OPTIONAL)
    return {"task": {"sensors": {name: float(name in sensors) for name in OPTIONAL}}}


class RampConfig(SettingsModel):
    """Share of a spread: ``start`` in the beginning, rising evenly to 1 after ``steps`` environment steps of all robots."""

    start: float = Field(gt=0, le=1)
    steps: float = Field(gt=0)


class CurriculumConfig(SettingsModel):
    """What a training begins with less of. Every draw is moved towards the middle of its distribution.

    It only acts on who says how far training is (``Core.set_progress``): all else meets the whole task.
    """

    commands: RampConfig | None = None
    randomization: RampConfig | None = None


class SuccessConfig(SettingsModel):
    """Largest root mean square and largest magnitude of a measure over an episode, in its unit.

    ``scale``: root mean square that counts as 1 in the tracking error, in place of the limit ``rms``.
    """

    rms: float | None = Field(default=None, gt=0)
    max: float | None = Field(default=None, gt=0)
    scale: float | None = Field(default=None, gt=0)


class TaskConfig(SettingsModel):
    """Contents of ``configs/task/*.yaml``.

    An episode is a success when no termination term ended it and every measure named in ``success`` stays within its limits.
    ``summary``: what it asks for. ``history``: version of the id -> what changed. The last
    version is the present one. ``robot`` is the one that the numbers are written for; ``scaling`` says how they follow another:
    place of a number -> rule, see :mod:`wlr_gym.envs.tasks.scaling`. ``controller``: gains of the hand-written controller whose
    action may be observed.
    """

    name: str = Field(pattern=r"^[a-z][a-z0-9_]*$")
    summary: str = ""
    history: dict[Annotated[str, Field(pattern=r"^v\d+$")], str] = Field(default={"v0": "first version"}, min_length=1)
    robot: str = "nominal"
    randomization: str = "nominal"
    floor: str = "flat"
    control_period: float = Field(gt=0, le=0.5)
    episode_length: float = Field(gt=0)
    action: ActionConfig
    commands: CommandsConfig
    latency: dict[Literal["joints", "imu", "camera", "flow"], LatencyConfig] = Field(default={})
    observer: ObserverConfig = ObserverConfig()
    sensors: SensorsConfig = SensorsConfig()
    controller: SlipGains | None = None
    observations: dict[str, ObservationConfig] = Field(min_length=1)
    privileged: dict[str, PrivilegedConfig] = Field(default={})
    rewards: dict[str, dict[str, float]] = Field(min_length=1)
    terminations: dict[str, dict[str, float]] = Field(default={})
    measures: dict[str, dict[str, float]] = Field(default={})
    success: dict[str, SuccessConfig] = Field(default={})
    curriculum: CurriculumConfig = CurriculumConfig()
    scaling: dict[str, str] = Field(default={})


def read_task(
    source: str | Path | Mapping[str, Any], overrides: Mapping[str, Any] | None = None, robot: Robot | None = None
) -> TaskConfig:
    """Read a task and check every name and number in it.

    Args:
        source: name in ``configs/task/``, path of a YAML file, or a mapping with the same keys.
        overrides: nested mapping laid over it; a term set to None is removed, if it is there.
        robot: that the numbers of the file are scaled for; overrides hold as they are given. None = as they are written.

    Raises:
        InputError: unknown or wrong key, term, parameter or value, with the nearest valid name.
    """
    data, where = _task_data(source)
    if robot is not None:
        data = _for_robot(data, (overrides or {}).get("scaling"), robot, where)
    if overrides:
        where = f"{where} with overrides"
        _check_names(overrides, where)
        data = overlay(data, overrides)
    config = parse_config(TaskConfig, data, where)
    _check_ranges(config, where)
    _check_names(vars(config), where)
    for group in SCALARS:
        _check_scalars(group, getattr(config, group), where)
    for name in config.success:
        check_name("measure", name, config.measures, f"{where}: success")
    _check_commands(config, where)
    for place, rule in config.scaling.items():
        check_rule(place, rule, where)
    return config


def _for_robot(data: Any, changed_rules: Any, robot: Robot, where: str) -> Any:
    """Return a task file's content with its numbers for ``robot``, by its rules and those laid over them."""
    written = parse_config(TaskConfig, data, where)
    rules = overlay(written.scaling, changed_rules if isinstance(changed_rules, Mapping) else {})
    for place, rule in rules.items():
        check_rule(place, rule, where)
    return scaled(data, rules, robot, load_robot(written.robot), where)


def _task_data(source: Any) -> tuple[Any, str]:
    if isinstance(source, Mapping):
        return dict(source), "task"
    if not isinstance(source, (str, Path)):
        raise InputError(f"task = {source!r}: expected a name, a path or a mapping")
    data, where = read_config("task", source)
    if isinstance(data, Mapping):  # the files that it names are seen from its own folder
        named = {key: data[key] for key in ("robot", "randomization") if isinstance(data.get(key), str)}
        data = {**data, **{key: str(named_in(where, name)) for key, name in named.items()}}
    return data, where


def _check_names(data: Mapping[str, Any], where: str) -> None:
    """Refuse a term that does not exist, in changes also one that is to be removed."""
    for group, registry in _TERMS.items():
        names = data.get(group)
        for name in names if isinstance(names, Mapping) else ():
            check_name(_CALLED[group], name, registry, where)


def _check_ranges(config: TaskConfig, where: str) -> None:
    for name, (low, high) in config.commands.terms.items():
        check_name("command", name, COMMANDS, where)
        term = COMMANDS[name]
        if low < term.least or high > term.most:
            expected = term.words(term.least, term.most)
            raise InputError(f"{where}: commands.terms.{name} = {[low, high]}: expected {expected}")
    for name in config.commands.ramp:
        check_name("command", name, config.commands.terms, f"{where}: commands.ramp")
    steps = config.episode_length / config.control_period
    if not math.isclose(steps, round(steps), abs_tol=1e-6) or round(steps) < 1:
        length, period = config.episode_length, config.control_period
        raise InputError(f"{where}: episode_length = {length:g} s is not a whole number of control periods of {period:g} s")


def _check_scalars(group: str, chosen: Mapping[str, Mapping[str, float]], where: str) -> None:
    kind, registry = _CALLED[group], SCALARS[group]
    required = {"weight"} if group == "rewards" else set[str]()
    for name, values in chosen.items():
        valid = required | set(registry[name].parameters)
        for key in values:
            check_name(f"parameter of {kind} '{name}'", key, valid, where)
        for key in required - set(values):
            raise InputError(f"{where}: {kind} '{name}' lacks '{key}'")
        for key, (low, high) in registry[name].ranges.items():
            if key in values and not low < values[key] < high:
                raise InputError(
                    f"{where}: {kind} '{name}': {key} = {values[key]:g}: expected a number above {low:g} and below {high:g}"
                )


def _check_commands(config: TaskConfig, where: str) -> None:
    """Refuse a term that reads a command which the task does not give."""
    functions = {
        f"{_CALLED[group]} '{name}'": registry[name].function
        for group, registry in SCALARS.items()
        for name in getattr(config, group)
    }
    used = [name for name in (*config.observations, *config.privileged) if name in COMPUTED]
    for name in used:
        needed = f"{name.removesuffix(CONTROLLER)}_memory"
        for gain in ("warp", "forward_lead", "turn_lead"):
            if name.endswith(CONTROLLER) and getattr(config.controller, gain, 0.0) and needed not in used:
                how = f"needs the observation term '{needed}'" if needed in COMPUTED else "cannot do it: its legs sweep"
                raise InputError(f"{where}: controller.{gain} is not 0: '{name}' {how}")
    functions |= {f"observation term '{name}'": COMPUTED[name].function for name in used}
    for term, function in functions.items():
        if config.controller is None and any(name.startswith("controller.") for name in signals_of(function)):
            raise InputError(f"{where}: {term} needs 'controller', the gains of the controller: {{steering: 2.0, ...}}")
        for command in sorted(name.removeprefix("command.") for name in signals_of(function) if name.startswith("command.")):
            if command not in config.commands.terms:
                raise InputError(f"{where}: {term} needs the command '{command}', which commands.terms does not give")


# ---- a task, resolved for a robot ------------------------------------------------------------------------------------


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
    """Resolve a checked task for a robot."""
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


# ---- tracking error and success of an episode ------------------------------------------------------------------------


Array = NDArray[np.float64]
Flags = NDArray[np.bool_]
#: A measure of the task and what of it counts over an episode: ``rms`` or ``max`` (largest magnitude).
Which = tuple[str, str]

#: What a fall adds to the tracking error of its episode, which otherwise knows the time before it only.
FALL = 10.0


def limits_within(bounds: Any) -> dict[str, float]:
    """Return the limits that there are, ``rms`` and ``max``, of what has them and a ``scale``, as :class:`SuccessConfig`."""
    return {kind: limit for kind, limit in (("rms", bounds.rms), ("max", bounds.max)) if limit is not None}


def scales_within(bounds: Any) -> dict[str, float]:
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
