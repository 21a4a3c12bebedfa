"""The batched core of every environment: N robots, one task, one plant.

The three interfaces (``gym.Env``, ``gym.vector.VectorEnv``, Stable-Baselines3's ``VecEnv``) only translate calling conventions.
What happens to a robot is a function of its own seed and actions: the same alone or in a batch, bit for bit.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import ArrayLike, NDArray

from wlr_gym.base.errors import InputError, unknown_name
from wlr_gym.base.snapshot import RowStore, Snapshot, check_fit, read_rows, take_snapshot, write_snapshot
from wlr_gym.envs.episodes import Commands, Episodes, Mask, RandomizedRobots, is_whole
from wlr_gym.envs.observation import Actions, ObservationPipeline
from wlr_gym.envs.settings import EnvironmentOptions
from wlr_gym.envs.tasks.compiled_terms import Scores, compile_computed, compile_scores, not_finite
from wlr_gym.envs.tasks.describe import contract, describe
from wlr_gym.envs.tasks.randomization import load_randomization
from wlr_gym.envs.tasks.signals import PRESENCE, START, signals_of, yaw_of
from wlr_gym.envs.tasks.task import RampConfig, Task, bounds, fed_as, load_task
from wlr_gym.envs.tasks.terms import COMPUTED, SCALARS
from wlr_gym.perception.observer import ESTIMATE_LAYOUT, SlipObserver
from wlr_gym.physics import plants
from wlr_gym.physics.effects import load_patch
from wlr_gym.physics.floor import Floor, floor_noted, load_floor
from wlr_gym.physics.plants.base import SENSOR_LAYOUT, TRUTH_LAYOUT, PlantOptions, Sensors
from wlr_gym.policy.agents import FED_AS

Array = NDArray[np.float64]

OPTIONS = ("command", "parameters")


def make_task(task_name: str | Mapping[str, Any], settings: EnvironmentOptions) -> Task:
    """Load the task of an environment with the user's overrides; a real robot is the one that its hardware file names."""
    robot = settings.robot
    if robot is None and settings.robot_options is not None:
        robot = plants.robot_file(settings.robot_options)
    changes: dict[str, Any] = {}
    source: str | Path | Mapping[str, Any] = task_name
    if isinstance(settings.task, Mapping):
        changes = dict(settings.task)
        if (file := changes.pop(FED_AS, None)) is not None:
            source = fed_as(file, task_name, robot)
    elif settings.task is not None:
        source = settings.task
    if settings.episode_length is not None:
        changes["episode_length"] = settings.episode_length
    return load_task(source, robot, changes)


class Core:
    """N robots on a task.

    Attributes:
        task, plant, randomization, patch: what it is made of. floor: that it stands on; None = flat. count: N.
        unmeasured: rewards and terminations of the task that are left out because a real robot cannot measure them.
        limit: control steps until an episode is truncated.
        episodes: seeds, steps so far and end flags. robots: parameters and where the episodes started.
        actions: last actions and setpoints. commands: what the robots are asked to follow.
        observer: the slip observer, None where the task needs no estimate; its ``values`` are the present estimate.
        pipeline: makes the observations. scores: rewards and measures of the last step.
        sensors: last readings, noise and all.
        everyone: (N,) mask of all robots.

    The arrays that users ask for most, overwritten by each step:
        observation, privileged: (N, D) and (N, P) float32 observations (the latter only with ``observation="dict"``).
        reward: (N,). measures: (N, M), named by ``task.measures``, SI units. terminated, truncated: (N,) flags.
        command: (N, C). action: (N, 8). parameters: of every robot. state: where the present episodes started.
    """

    def __init__(self, task_name: str | Mapping[str, Any], settings: EnvironmentOptions, count: int) -> None:
        if not is_whole(count) or count < 1:
            raise InputError(f"num_envs = {count!r}: expected a whole number of 1 or more")
        self.settings = settings
        self.count: int = int(count)
        self.unmeasured: tuple[str, ...] = ()
        self.task = make_task(task_name, settings)
        if settings.is_real:
            self.task, self.unmeasured = measurable(self.task, settings.has_camera)
        config, robot = self.task.config, self.task.robot
        chosen = config.randomization if settings.randomization is None else settings.randomization
        self.randomization = load_randomization("none" if settings.is_real else chosen, robot)
        on = config.floor if settings.floor is None else settings.floor
        self.floor: Floor | None = None if settings.is_real or on == "flat" else load_floor(on, robot)
        self.patch = load_patch(settings.effects)
        options = PlantOptions(
            control_period=config.control_period,
            physics_step=settings.physics_step,
            precision=settings.precision,
            threads=settings.threads,
            sensor_noise=settings.is_real or self.randomization.config.sensor_noise,
        )
        self.plant = plants.make_plant(settings.backend, robot, self.count, options, self.patch.forces, settings.robot_options)
        if settings.is_real:
            require_flow(self.task, bool(self.plant.parameters["flow.present"][0]))
        self.limit: int = self.task.episode_steps
        self.dictionary: bool = settings.observation == "dict"
        self.observer: SlipObserver | None = None
        if self.task.needs_observer:
            self.observer = SlipObserver(robot, config.control_period, self.count, config.observer.camera)
        self._score_kernel = compile_scores(self.task)
        self._computed_kernel = compile_computed(self.task) if self.task.computed else None
        policy, privileged = (
            spaces.Box(*bounds(columns), dtype=np.float32) for columns in (self.task.policy, self.task.privileged)
        )
        self.observation_space = spaces.Dict({"policy": policy, "privileged": privileged}) if self.dictionary else policy
        self.action_space = spaces.Box(-1.0, 1.0, (len(self.task.actions),), dtype=np.float32)
        self.everyone: Mask = np.ones(self.count, dtype=bool)
        self._make_parts()
        if settings.is_real:
            self._load_kernels()

    # ---- set-up ----

    def _make_parts(self) -> None:
        task, count, real = self.task, self.count, self.settings.is_real
        period = task.config.control_period
        self.episodes = Episodes(count)
        self.robots = RandomizedRobots(
            task.robot, self.floor, self.randomization, self.patch, period, count, task.config.sensors
        )
        self.actions = Actions(task.actions, count, self.settings.free_wheels)
        self.commands = Commands(task.config, task.robot, count)
        self.pipeline = ObservationPipeline(
            task, self.randomization.config, count, has_latency=not real, has_privileged=self.dictionary
        )
        self.scores = Scores.zeros(task, count)
        self._score_buffers = tuple(self.scores)
        self._no_estimate = np.zeros((count, ESTIMATE_LAYOUT.width))
        self.start = np.zeros((count, len(START)))
        self.presence = np.zeros((count, len(PRESENCE)))
        self.end_time = np.zeros(count)
        self._clock = self.end_time[:, None]
        self.computed = np.zeros((count, len(task.computed)))
        self.observation, self.privileged = self.pipeline.policy, self.pipeline.privileged
        self.reward, self.measures = self.scores.total, self.scores.measures
        self.terminated, self.truncated = self.episodes.terminated, self.episodes.truncated
        self.command, self.action = self.commands.command, self.actions.action
        self.parameters, self.state = self.robots.parameters, self.robots.state

    def _load_kernels(self) -> None:
        """Run everything compiled once: a robot that waits for a compiler in its first step has been stopped by then."""
        self.sensors = Sensors(np.zeros((self.count, SENSOR_LAYOUT.width)))
        self._begin_observing(self.everyone, {})
        self.actions.take(self.action, self.everyone)
        self._finish_step(self.everyone)
        self._make_parts()

    # ---- episodes ----

    def seed(self, row: int, seed: int) -> None:
        """Give a robot its seed; its next episode is its first."""
        self.episodes.seed(row, seed)

    def begin_episodes(self, mask: Mask, options: Mapping[str, Any] | None = None) -> None:
        """Start a new episode for the robots in ``mask``.

        Args:
            mask: (N,) which robots; all must have been seeded.
            options: ``command`` {name: value} held for the whole episode, ``parameters`` {name or element: value} set after
                randomisation and effects; each value is that of every robot in ``mask``.

        Raises:
            InputError: unknown option, command or parameter, or a value of the wrong type or out of bounds.
        """
        options = read_options(options)
        held = self.commands.read(_mapping("command", options.get("command")))
        overrides = self.robots.read_overrides(_mapping("parameters", options.get("parameters")))
        rows = np.flatnonzero(mask)
        seeds = self.episodes.next_seeds(rows)
        self.robots.begin(rows, self.episodes.robot_seeds[rows], seeds, overrides)
        self.episodes.begin(rows, seeds)
        self.sensors = self.plant.reset(seeds=self.episodes.seeds, parameters=self.parameters, mask=mask, state=self.state)
        self.actions.begin(rows)
        for name in ("terms", "total", "sums", "measures", "squares", "largest"):
            getattr(self.scores, name)[rows] = 0.0
        self.start[rows, :2] = self.state.position[rows, :2]
        self.start[rows, 2] = yaw_of(*self.state.quaternion[rows].T)
        self._begin_observing(mask, held)
        self.episodes.note_begun(mask)

    def _begin_observing(self, mask: Mask, held_commands: Mapping[int, float]) -> None:
        rows = np.flatnonzero(mask)
        self._note_presence()
        if self.observer is not None:
            self.observer.reset(mask, self.sensors.values)
        self.pipeline.begin(rows, self.episodes.seeds[rows])
        self.commands.begin(mask, self.episodes.seeds)
        if held_commands:
            self.commands.hold(rows, held_commands)
        self.computed[rows] = 0.0
        self._observe(mask, self._signals(), first=True)

    def set_command(self, values: Mapping[str, float]) -> None:
        """Command all robots from the next step on, until the episode ends (teleoperation, evaluation)."""
        held = self.commands.read(values)
        self.episodes.require_begun("set_command()")
        self.commands.hold(np.arange(self.count), held)

    def set_progress(self, steps: float) -> None:
        """Say how many environment steps, of all robots together, a training has done: what is drawn from now on is spread as
        far as the task's curriculum says for so many steps. Without it the whole task is met.
        """
        if isinstance(steps, bool) or not isinstance(steps, (int, float, np.number)) or not steps >= 0:
            raise InputError(f"steps = {steps!r}: expected 0 or more")
        curriculum = self.task.config.curriculum
        self.commands.set_share(_share(curriculum.commands, steps))
        self.robots.share = _share(curriculum.randomization, steps)

    # ---- stepping ----

    def step(self, actions: ArrayLike, mask: Mask) -> bool:
        """Advance one control step.

        Robots outside ``mask`` move with action 0 and get reward 0; their time, flags and observation stay as they are.

        Returns:
            Whether an episode ended.

        Raises:
            InputError: wrong shape, or an action that is not finite or out of [-1, 1]; names robot and joint.
            gymnasium.error.ResetNeeded: a robot's first episode has not begun.
        """
        self.episodes.require_begun("step()")
        self.actions.take(actions, mask)
        self.sensors = self.plant.step(self.actions.setpoints, self.actions.torque_on)
        return self._finish_step(mask)

    def try_step(self, actions: ArrayLike) -> None:
        """Advance plant and scores of all robots, and nothing else: for planners, which try what they may not do."""
        self.actions.take(actions, self.everyone)
        self.sensors = self.plant.step(self.actions.setpoints, self.actions.torque_on)
        self._score(self.everyone, self._signals())

    def _finish_step(self, mask: Mask) -> bool:
        """Estimate, rewards, ends, new commands and parameters, observation; returns whether an episode ended."""
        if self.observer is not None:
            self.observer.update(mask, self.sensors.values)
        signals = self._signals()
        self._score(mask, signals)
        any_done = self.episodes.count_step(mask, self.limit, self.scores.over)
        self.commands.advance(mask, self.episodes.seeds, self.episodes.steps)
        if self.randomization.timed_elements:
            going_on = mask & ~(self.terminated | self.truncated) if any_done else mask
            if self.robots.change(going_on, self.episodes):
                self.plant.set_parameters(self.parameters, self.robots.changed)
                self._note_presence()
        self._observe(mask, signals, first=False)
        return any_done

    def _note_presence(self) -> None:
        """Note which sensors the robots have now; a real robot's plant knows what is connected."""
        parameters = self.plant.parameters if self.settings.is_real else self.parameters
        for column, sensor in enumerate(PRESENCE):
            self.presence[:, column] = parameters[f"{sensor}.present"] > 0.5

    def _signals(self) -> tuple[Array, ...]:
        """What terms and observations read, in the order of ``MATRICES``; what a real robot measures stands for the truth."""
        return (
            self.sensors.values,
            self._no_estimate if self.observer is None else self.observer.values,
            self.plant.truth().values if self.plant.capabilities.has_truth else measured_truth(self.sensors),
            self.command,
            self.action,
            self.actions.previous,
            self.start,
            self._clock,
            self.presence,
            self.computed,
        )

    def _score(self, mask: Mask, signals: tuple[Array, ...]) -> None:
        np.multiply(self.episodes.steps + 1, self.task.config.control_period, out=self.end_time)
        bad = self._score_kernel.run(mask, signals, self._score_kernel.numbers, self._score_buffers)
        if bad >= 0:
            raise FloatingPointError(f"{self._what_is_not_finite(bad)} (episode seed {self.episodes.seeds[bad]})")

    def _what_is_not_finite(self, row: int) -> str:
        """Say whether a robot or, where its motion is finite, only terms of its task left the finite numbers."""
        finite = not self.plant.capabilities.has_truth or np.isfinite(self.plant.truth().values[row]).all()
        if finite and np.isfinite(self.sensors.values[row]).all():
            return f"{' and '.join(not_finite(self.task, self.scores, row))}: not finite for robot {row} of the batch"
        hint = "; a formula among its effects may have left its domain" if self.patch.forces else ""
        return f"robot {row} of the batch left the finite numbers{hint}"

    def _observe(self, mask: Mask, signals: tuple[Array, ...], *, first: bool) -> None:
        if self._computed_kernel is not None:
            self.end_time[:] = self.time
            self._computed_kernel.run(mask, signals, self._computed_kernel.numbers)
        self.pipeline.observe(mask, signals, self.episodes, first=first)

    @property
    def time(self) -> Array:
        """Time (N,) since the episodes began, s."""
        return np.multiply(self.episodes.steps, self.task.config.control_period, dtype=np.float64)

    # ---- what the interfaces hand out: fresh objects every time ----

    def observations(self, rows: int | slice = slice(None)) -> Any:
        """Return a copy of all observations, or of one robot's: array (N, D) or (D,), or dict of such."""
        if self.dictionary:
            return {"policy": self.observation[rows].copy(), "privileged": self.privileged[rows].copy()}
        return self.observation[rows].copy()

    def describe(self) -> str:
        """Return the task's tables as text."""
        return describe(self.task)

    def contract(self) -> dict[str, Any]:
        """Return what a policy must be fed and what its output means (see :func:`wlr_gym.envs.tasks.describe.contract`)."""
        randomization = self.randomization.config.model_dump(mode="json", exclude_none=True)
        return contract(self.task, randomization, floor_noted(self.floor))

    def shorten(self, max_episode_steps: int | None) -> None:
        """Truncate episodes after ``max_episode_steps``, if that is before the task's own limit; None and -1 keep the limit."""
        if max_episode_steps is None or max_episode_steps == -1:
            return
        if not is_whole(max_episode_steps) or max_episode_steps < 1:
            raise InputError(f"max_episode_steps = {max_episode_steps!r}: expected a whole number of 1 or more, or -1")
        self.limit = min(self.limit, int(max_episode_steps))

    def close(self) -> None:
        """Release the plant."""
        self.plant.close()


def _share(ramp: RampConfig | None, steps: float) -> float:
    return 1.0 if ramp is None else min(1.0, ramp.start + (1.0 - ramp.start) * steps / ramp.steps)


def read_options(options: Any, valid: tuple[str, ...] = OPTIONS) -> Mapping[str, Any]:
    """Return reset options, empty for None."""
    options = _mapping("options", options)
    for name in options:
        if name not in valid:
            raise unknown_name("reset option", str(name), valid)
    return options


def _mapping(name: str, given: Any) -> Mapping[str, Any]:
    if given is None:
        return {}
    if not isinstance(given, Mapping):
        raise InputError(f"{name} = {given!r}: expected a mapping {{name: value}}")
    return given


# ---- snapshots: what robots must have alike to take one, and where their state lives ---------------------------------


#: Names of the plant's arrays in a snapshot begin with this.
PLANT = "plant/"


class Snapshots:
    """Takes snapshots of the robots of a core, and sets robots back.

    Args:
        core: of the environment.
    """

    def __init__(self, core: Core) -> None:
        if not core.plant.capabilities.can_set_state:
            raise InputError(f"backend '{core.settings.backend}': its robots cannot be saved and set back; simulators can")
        self._core = core
        self._fits = {
            "task": core.task.config.model_dump(mode="json"),
            "randomization": core.randomization.config.model_dump(mode="json"),
            "floor": floor_noted(core.floor),
            "effects": core.patch.content(),
            "free_wheels": core.settings.free_wheels,
            "observation": core.settings.observation,
        }
        parts = (core.episodes, core.robots, core.actions, core.commands, core.pipeline, core.observer)
        self._stores: dict[str, RowStore] = {
            "start": core.start,
            "end_time": core.end_time,
            "computed": core.computed,
            "presence": core.presence,
        }
        self._stores |= {f"score_{name}": values for name, values in core.scores._asdict().items()}
        self._stores |= {name: store for part in parts if part is not None for name, store in part.stores().items()}

    def take(self, rows: int | Sequence[int] | NDArray[Any] | None) -> Snapshot:
        """Return the snapshot of some robots; see :meth:`wlr_gym.envs.interfaces.TaskMethods.get_state`."""
        index = read_rows(rows, self._core.count)
        self._core.episodes.require_begun("get_state()", index)
        plant = self._core.plant.get_state(index)
        own = take_snapshot(self._stores, index, self._fits)
        arrays = {PLANT + name: values for name, values in plant.arrays.items()}
        return Snapshot({**plant.fits, **own.fits}, {**own.arrays, **arrays})

    def put(self, snapshot: Snapshot, rows: int | Sequence[int] | NDArray[Any] | None) -> None:
        """Put robots into the state of a snapshot; see :meth:`wlr_gym.envs.interfaces.TaskMethods.set_state`."""
        core = self._core
        index = read_rows(rows, core.count)
        check_fit(snapshot, index, self._fits, self._stores)
        arrays = {name.removeprefix(PLANT): values for name, values in snapshot.arrays.items() if name.startswith(PLANT)}
        core.sensors = core.plant.set_state(Snapshot(snapshot.fits, arrays), index)
        write_snapshot(snapshot, self._stores, index)
        core.episodes.note_begun(np.isin(np.arange(core.count), index))


# ---- a task on a real robot, which has sensors and no truth ----------------------------------------------------------


#: Channel of the truth -> sensor that measures it.
MEASURED = {
    "joint_position": "joint_position",
    "joint_velocity": "joint_velocity",
    "angular_velocity_in_body": "gyro",
    "motor_torque": "joint_effort",
}
_KNOWN = {f"truth.{element}" for channel in MEASURED for element in TRUTH_LAYOUT.channels[channel].elements}


def measured_truth(sensors: Sensors) -> Array:
    """Return a truth matrix (N, W) filled with what sensors measure; NaN where there is no sensor."""
    truth = np.full((len(sensors.values), TRUTH_LAYOUT.width), np.nan)
    for channel, sensor in MEASURED.items():
        truth[:, TRUTH_LAYOUT.slices[channel]] = sensors.values[:, SENSOR_LAYOUT.slices[sensor]]
    return truth


def measurable(task: Task, has_camera: bool) -> tuple[Task, tuple[str, ...]]:
    """Return the task with the rewards, terminations and measures that a robot can measure, and the names of those it cannot.

    A robot does not know its speed over the floor, its slip, or the height of its body. The safety rules watch its tilt.
    The slip observer runs on its sensors, and on the camera's poses where there is one.

    Raises:
        InputError: an observation that needs the true state, or a camera where there is none.
    """
    for column in task.policy:
        if column.device == "camera" and not has_camera:
            raise InputError(f"observation '{column.term}': this robot has no camera; see docs/camera.md")
        if column.source == "truth" or (column.source == "computed" and not _is_known(COMPUTED[column.term].function)):
            raise InputError(f"observation '{column.term}': only a simulator knows the true state")
    kept, left_out = {}, []
    for group, registry in SCALARS.items():
        chosen = getattr(task.config, group)
        kept[group] = {name: values for name, values in chosen.items() if _is_known(registry[name].function)}
        left_out += [name for name in chosen if name not in kept[group]]
    kept["success"] = {name: limits for name, limits in task.config.success.items() if name in kept["measures"]}
    config = task.config.model_copy(update=kept)
    return replace(task, config=config, privileged=()), tuple(dict.fromkeys(left_out))


def require_flow(task: Task, has_flow: bool) -> None:
    """Refuse a task that observes optical flow on a robot without the sensor, unless it is one that does without at times."""
    always = task.config.sensors.flow is None or task.config.sensors.flow >= 1.0
    for column in task.policy:
        if column.device == "flow" and always and not has_flow:
            raise InputError(f"observation '{column.term}': this robot has no optical-flow sensor; see docs/camera.md")


def _is_known(function: Callable[..., Any]) -> bool:
    """Whether all signals that a term reads can be measured."""
    return all(name in _KNOWN for name in signals_of(function) if name.startswith(("truth.", "start[")))
