"""The batched core of every environment: N robots, one task, one plant.

The three faces (``gym.Env``, ``gym.vector.VectorEnv``, Stable-Baselines3's ``VecEnv``) only translate calling conventions.
What happens to a robot is a function of its own seed and actions: the same alone or in a batch, bit for bit.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from gymnasium import spaces
from gymnasium.error import ResetNeeded
from numpy.typing import ArrayLike, NDArray

from wlr_gym.base.errors import InputError, unknown_name
from wlr_gym.base.random import stream_number
from wlr_gym.envs import kernels
from wlr_gym.envs.measured import measurable, measured_truth
from wlr_gym.envs.settings import Settings
from wlr_gym.envs.tasks.compiled import compile_computation, compile_evaluation
from wlr_gym.envs.tasks.describe import contract, describe
from wlr_gym.envs.tasks.draws import episode_seeds, stream_numbers, uniforms
from wlr_gym.envs.tasks.randomization import DRIFT_PERIOD, load_randomization
from wlr_gym.envs.tasks.signals import START
from wlr_gym.envs.tasks.task import ObservationColumn, RampConfig, Task, TaskConfig, bounds, build_task, read_task
from wlr_gym.envs.tasks.terms import COMMANDS
from wlr_gym.envs.tasks.terms.events import normal
from wlr_gym.envs.tasks.terms.geometry import yaw_of
from wlr_gym.perception.observer import ESTIMATE_LAYOUT, SlipObserver
from wlr_gym.physics import plants
from wlr_gym.physics.effects import apply_patch, load_patch
from wlr_gym.physics.plants.base import SENSOR_LAYOUT, TRUTH_LAYOUT, PlantOptions, PlantState, Sensors
from wlr_gym.robot import JOINTS, load_robot
from wlr_gym.robot.parameters import Parameters

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

#: Actions may exceed +-1 by rounding only.
ACTION_LIMIT = 1.0 + 1e-6
FOREVER = np.iinfo(np.int64).max
OPTIONS = ("command", "parameters")


def make_task(task_name: str, settings: Settings) -> Task:
    """Load the task of an environment with the user's overrides."""
    changes: dict[str, Any] = {}
    source: str | Path = task_name
    if isinstance(settings.task, Mapping):
        changes = dict(settings.task)
    elif settings.task is not None:
        source = settings.task
    if settings.episode_length is not None:
        changes["episode_length"] = settings.episode_length
    config = read_task(source, changes)
    return build_task(config, load_robot(config.robot if settings.robot is None else settings.robot))


class Core:
    """N robots on a task.

    Attributes:
        task, plant, randomization, patch: what it is made of.
        count: N.
        observation: (N, D) float32 policy observation of every robot, overwritten by each step.
        privileged: (N, P) float32 privileged observation (only with ``observation="dict"``).
        reward: (N,) reward of the last step. terms: (N, T) its weighted terms. sums: (N, T) their sums over the episode.
        terminated, truncated: (N,) flags of the last step.
        command: (N, C) present commands. action: (N, 8) last actions. ticks: (N,) control ticks since the episode began.
        goals: (N, 8) last goals, rad and rad/s. torque_on: (N, 8) whether the motors are on; None = all.
        measures: (N, M) measures of the last step, named by ``task.measures``; SI units.
        observer: the slip observer, None where the task needs no estimate; its ``values`` are the present estimate.
        sensors: last readings, noise and all. state: where the robots of the present episodes started.
        changed: (N,) whether randomisation changed the robot's parameters at the end of the last step.
        begun: (N,) whether the robot's first episode has begun.
        unmeasured: rewards and terminations of the task that are left out because a real robot cannot measure them.
    """

    def __init__(self, task_name: str, settings: Settings, count: int) -> None:
        if not isinstance(count, (int, np.integer)) or count < 1:
            raise InputError(f"num_envs = {count!r}: expected a whole number of 1 or more")
        self.settings = settings
        self.count = int(count)
        self.unmeasured: tuple[str, ...] = ()
        self.task = make_task(task_name, settings)
        if settings.is_real:
            self.task, self.unmeasured = measurable(self.task)
        config, robot = self.task.config, self.task.robot
        chosen = config.randomization if settings.randomization is None else settings.randomization
        self.randomization = load_randomization("none" if settings.is_real else chosen, robot)
        self.patch = load_patch(settings.effects)
        options = PlantOptions(
            control_period=config.control_period,
            physics_step=settings.physics_step,
            precision=settings.precision,
            threads=settings.threads,
            sensor_noise=settings.is_real or self.randomization.config.sensor_noise,
        )
        self.plant = plants.make_plant(settings.backend, robot, self.count, options, self.patch.forces, settings.robot_options)
        self.limit = self.task.episode_ticks
        self.dictionary = settings.observation == "dict"
        self.observer: SlipObserver | None = None
        if self.task.needs_observer:
            self.observer = SlipObserver(robot, config.control_period, self.count, config.observer.camera)
        self._evaluation = compile_evaluation(self.task)
        self._computation = compile_computation(self.task) if self.task.computed else None
        self._make_spaces()
        self._make_tables(config)
        self._make_buffers()
        self.everyone: Mask = np.ones(self.count, dtype=bool)
        self.seeded: Mask = np.zeros(self.count, dtype=bool)
        self.begun: Mask = np.zeros(self.count, dtype=bool)
        if settings.is_real:
            self._load_kernels()

    # ---- set-up ----

    def _make_spaces(self) -> None:
        low, high = bounds(self.task.policy)
        policy = spaces.Box(low, high, dtype=np.float32)
        low, high = bounds(self.task.privileged)
        privileged = spaces.Box(low, high, dtype=np.float32)
        self.observation_space = spaces.Dict({"policy": policy, "privileged": privileged}) if self.dictionary else policy
        self.action_space = spaces.Box(-1.0, 1.0, (len(self.task.actions),), dtype=np.float32)

    def _make_tables(self, config: TaskConfig) -> None:
        task = self.task
        columns = {
            "sensors": SENSOR_LAYOUT.elements,
            "command": task.commands,
            "action": JOINTS,
            "estimate": ESTIMATE_LAYOUT.elements,
            "computed": task.computed,
            "truth": TRUTH_LAYOUT.elements,
        }

        def address(column: ObservationColumn) -> list[int]:
            return [kernels.SOURCES.index(column.source), columns[column.source].index(column.element)]

        sampled = list({(c.term, c.element): c for c in task.policy}.values())
        place = {(c.term, c.element): index for index, c in enumerate(sampled)}
        noisy = float(self.randomization.config.sensor_noise)
        self._sampled_index = np.array([address(c) for c in sampled])
        self._sampled_value = np.array([[c.offset, c.noise * noisy] for c in sampled])
        self._sampled_stream = stream_numbers(*(f"noise/{c.term}/{c.element}" for c in sampled))
        self._bias_sigma = np.array([c.bias * noisy for c in sampled])
        self._bias_stream = stream_numbers(*(f"bias/{c.term}/{c.element}" for c in sampled))
        devices = tuple(config.latency)
        self._latency = np.array([config.latency[device].delay for device in devices]).reshape(-1, 2) / config.control_period
        self._latency_stream = stream_numbers(*(f"latency/{device}" for device in devices))
        self._column_index = np.array([self._column(c, place, devices) for c in task.policy])
        self._column_value = np.array([[c.limit, c.scale] for c in task.policy])
        self._privileged_index = np.array([address(c) for c in task.privileged], dtype=np.int64).reshape(-1, 2)
        self._privileged_value = np.array([[c.limit, c.scale] for c in task.privileged]).reshape(-1, 2)
        self._action_table = np.array([[a.centre, a.scale, a.low, a.high] for a in task.actions])
        ramp = {name: rate * config.control_period for name, rate in config.commands.ramp.items()}
        self._command_table = np.array([[*config.commands.terms[c], ramp.get(c, np.inf)] for c in task.commands]).reshape(-1, 3)
        hold = [time / config.control_period for time in config.commands.hold_time]
        self._command_timing = np.array([*hold, config.commands.zero_probability, 1.0])
        self._command_stream = stream_number("command")
        longest_lag = max(c.lag for c in task.policy)
        longest_delay = float(self._latency.max()) if devices else 0.0
        self._ring_depth = longest_lag + int(np.ceil(longest_delay)) + 1

    def _column(self, column: ObservationColumn, place: dict[tuple[str, str], int], devices: tuple[str, ...]) -> list[int]:
        latency = self.task.config.latency
        if column.device not in devices:
            return [place[column.term, column.element], column.lag, len(devices), 0]
        mode = latency[column.device].mode  # type: ignore[index]
        return [place[column.term, column.element], column.lag, devices.index(column.device), int(mode == "interpolate")]

    def _make_buffers(self) -> None:
        count, task = self.count, self.task
        actions, sampled = len(task.actions), len(self._sampled_index)
        self.observation = np.zeros((count, len(task.policy)), np.float32)
        self.privileged = np.zeros((count, len(task.privileged)), np.float32)
        self.reward = np.zeros(count)
        self.terms = np.zeros((count, len(task.rewards)))
        self.sums = np.zeros((count, len(task.rewards)))
        self.measures = np.zeros((count, len(task.measures)))
        self._over = np.zeros((count, len(task.terminations)))
        self.terminated = np.zeros(count, bool)
        self.truncated = np.zeros(count, bool)
        self.ticks = np.zeros(count, np.int64)
        self._clock = np.zeros((count, 1))
        self._start = np.zeros((count, len(START)))
        self._no_estimate = np.zeros((count, ESTIMATE_LAYOUT.width))
        self._computed = np.zeros((count, len(task.computed)))
        self.command = np.zeros((count, len(task.commands)))
        self._command_target = np.zeros((count, len(task.commands)))
        self._command_until = np.zeros(count, np.int64)
        self._command_draws = np.zeros(count, np.int64)
        self.action = np.zeros((count, actions))
        self._previous_action = np.zeros((count, actions))
        self.goals = np.zeros((count, actions))
        self._bias = np.zeros((count, sampled))
        self._delays = np.zeros((count, len(self._latency) + 1))
        self._ring = np.zeros((count, self._ring_depth, sampled))
        self.robot_seeds = np.zeros(count, np.uint64)
        self.episodes = np.zeros(count, np.int64)
        self.episode_seeds = np.zeros(count, np.uint64)
        self._spread = 1.0  # share of the randomisation that new episodes are drawn with
        self._spreads = np.ones(count)  # and the present ones were
        self.parameters = apply_patch(self.patch, Parameters.nominal(task.robot, count))
        self._overrides: dict[int, dict[str, float]] = {}
        self.state: PlantState = self.randomization.state(self.parameters, self.episode_seeds)
        intervals = len(self.randomization.intervals)
        self._occurrences = np.zeros((count, intervals), np.int64)
        self._strike_at = np.zeros((count, intervals), np.int64)
        self.changed = np.zeros(count, bool)
        self._drift_ticks = max(1, round(DRIFT_PERIOD / task.config.control_period)) if self.randomization.drifts else 0
        free = [JOINTS.index(wheel) for wheel in self.settings.free_wheels]
        self.torque_on: Mask | None = None
        if free:
            self.torque_on = np.ones((count, actions), bool)
            self.torque_on[:, free] = False

    def _load_kernels(self) -> None:
        """Run everything compiled once: a robot that waits for a compiler in its first tick has been stopped by then."""
        self.sensors = Sensors(np.zeros((self.count, SENSOR_LAYOUT.width)))
        kernels.start_commands(
            self.everyone, self.episode_seeds, self._command_stream, self._command_table, self._command_timing,
            self.command, self._command_target, self._command_until, self._command_draws,
        )  # fmt: skip
        self._start_observer(self.everyone)
        self._observe(self.everyone, True)
        self._take_action(self.action, self.everyone)
        self._update_observer(self.everyone)
        self._finish_tick(self.everyone)
        self._make_buffers()

    # ---- episodes ----

    def seed(self, row: int, seed: int) -> None:
        """Give a robot its seed; its next episode is its first.

        Raises:
            InputError: see :func:`read_seed`.
        """
        self.robot_seeds[row] = read_seed(seed) % 2**64
        self.episodes[row] = -1
        self.seeded[row] = True

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
        fixed_command = self._read_command(_mapping("command", options.get("command")))
        overrides = self._read_parameters(_mapping("parameters", options.get("parameters")))
        rows = np.flatnonzero(mask)
        seeds = episode_seeds(self.robot_seeds[rows], self.episodes[rows] + 1)
        robots = self._draw_parameters(rows, seeds, np.full(len(rows), self._spread))
        _override(robots, overrides)
        self._spreads[rows] = self._spread
        self.episodes[rows] += 1
        self.episode_seeds[rows] = seeds
        self.parameters.values[rows] = robots.values
        self._overrides |= dict.fromkeys(rows.tolist(), overrides)
        for name, value in vars(self.randomization.state(robots, seeds, self._spread)).items():
            if value is not None:
                getattr(self.state, name)[rows] = value
        self.sensors = self.plant.reset(seeds=self.episode_seeds, parameters=self.parameters, mask=mask, state=self.state)
        self._clear(rows)
        self._start_observer(mask)
        self._draw_imperfections(rows, seeds)
        kernels.start_commands(
            mask, self.episode_seeds, self._command_stream, self._command_table, self._command_timing,
            self.command, self._command_target, self._command_until, self._command_draws,
        )  # fmt: skip
        if fixed_command:
            self._hold_command(rows, fixed_command)
        self._observe(mask, True)
        self.begun |= mask

    def require_begun(self, what: str) -> None:
        """Refuse what needs the episodes of all robots to have begun.

        Raises:
            gymnasium.error.ResetNeeded: one has not.
        """
        if not self.begun.all():
            raise ResetNeeded(f"call reset() before {what}: no episode of robot {int(np.argmin(self.begun))} has begun")

    def _draw_parameters(
        self,
        rows: NDArray[np.intp],
        seeds: NDArray[np.uint64],
        spread: Array,
        occurrences: NDArray[np.int64] | None = None,
        time: Array | None = None,
    ) -> Parameters:
        """Randomisation of some robots, then the effects."""
        robots = self.randomization.parameters(self.robot_seeds[rows], seeds, occurrences, time, spread)
        return apply_patch(self.patch, robots) if self.patch else robots

    def _clear(self, rows: NDArray[np.intp]) -> None:
        for buffer in (self.ticks, self.action, self._previous_action, self.sums, self.terms, self.reward, self._occurrences):
            buffer[rows] = 0
        self.measures[rows] = 0.0
        self._start[rows, :2] = self.state.position[rows, :2]
        self._start[rows, 2] = yaw_of(*self.state.quaternion[rows].T)
        self.terminated[rows] = self.truncated[rows] = self.changed[rows] = False
        if self.randomization.intervals:
            self._strike_at[rows] = self._next_strike(rows)

    def _draw_imperfections(self, rows: NDArray[np.intp], seeds: NDArray[np.uint64]) -> None:
        """Latency and observation bias of an episode."""
        low, high = self._latency[:, 0], self._latency[:, 1]
        share = uniforms(seeds, self._latency_stream) if self.randomization.config.latency else 0.5
        self._delays[rows, :-1] = 0.0 if self.settings.is_real else low + (high - low) * share  # a robot has its own
        if self._bias_sigma.any():
            u = uniforms(seeds, self._bias_stream)
            self._bias[rows] = normal(u, np.zeros(1), self._bias_sigma, np.full(1, 4.0))

    def _read_command(self, given: Mapping[str, float]) -> dict[int, float]:
        values: dict[int, float] = {}
        for name, value in given.items():
            if name not in self.task.commands:
                raise unknown_name("command", str(name), self.task.commands)
            number = np.asarray(value)
            if number.shape != () or number.dtype.kind not in "iuf" or not np.isfinite(number):
                raise InputError(f"command {name} = {value!r}: expected a finite number")
            term = COMMANDS[name]
            if number < term.least:
                raise InputError(f"command {name} = {value!r}: expected {term.least:g} {term.unit} or more")
            values[self.task.commands.index(name)] = float(value)
        return values

    def _read_parameters(self, given: Mapping[str, Any]) -> dict[str, Any]:
        """Return values that fit one robot: they are set again, robot by robot, whenever its parameters are redrawn."""
        for name, value in given.items():
            one = self.parameters[str(name)][:1]
            try:
                np.broadcast_to(value, one.shape)
            except ValueError:
                raise InputError(
                    f"parameters: {name} of shape {np.shape(value)}: expected shape {one.shape[1:]}, the same for every robot"
                ) from None
        return dict(given)

    def _hold_command(self, rows: NDArray[np.intp], values: Mapping[int, float]) -> None:
        self._command_until[rows] = FOREVER
        for column, value in values.items():
            self.command[rows, column] = self._command_target[rows, column] = value

    def set_command(self, values: Mapping[str, float]) -> None:
        """Command all robots from the next step on, until the episode ends (teleoperation, evaluation)."""
        self._hold_command(np.arange(self.count), self._read_command(values))

    def set_progress(self, steps: float) -> None:
        """Say how many environment steps, of all robots together, a training has done: what is drawn from now on is spread as
        far as the task's curriculum says for so many steps. Without it the whole task is met.

        Raises:
            InputError: fewer than 0, or no number.
        """
        if not isinstance(steps, (int, float, np.number)) or not steps >= 0:
            raise InputError(f"steps = {steps!r}: expected 0 or more")
        curriculum = self.task.config.curriculum
        self._command_timing[3] = _share(curriculum.commands, steps)
        self._spread = _share(curriculum.randomization, steps)

    # ---- stepping ----

    def step(self, actions: ArrayLike, mask: Mask) -> bool:
        """Advance one control tick.

        Robots outside ``mask`` move with action 0 and get reward 0; their time, flags and observation stay as they are.

        Returns:
            Whether an episode ended.

        Raises:
            InputError: wrong shape, or an action that is not finite or out of [-1, 1]; names robot and joint.
            gymnasium.error.ResetNeeded: a robot's first episode has not begun.
        """
        self.require_begun("step()")
        self._take_action(actions, mask)
        self.sensors = self.plant.step(self.goals, self.torque_on)
        self._update_observer(mask)
        return self._finish_tick(mask)

    def _take_action(self, actions: ArrayLike, mask: Mask) -> None:
        given = read_actions(actions, self.action.shape)
        bad = kernels.take_action(mask, given, ACTION_LIMIT, self._action_table, self.action, self._previous_action, self.goals)
        if bad >= 0:
            raise self._bad_action(given, bad)

    def _finish_tick(self, mask: Mask) -> bool:
        """Rewards, ends, new commands and parameters, observation; returns whether an episode ended."""
        evaluation = self._evaluation
        self._clock[:, 0] = (self.ticks + 1) * self.task.config.control_period
        bad = evaluation.run(
            mask, *self._matrices(), evaluation.numbers, self.terms, self.reward, self._over, self.sums, self.measures
        )
        if bad >= 0:
            hint = "; a formula among its effects may have left its domain" if self.patch.forces else ""
            raise FloatingPointError(
                f"robot {bad} of the batch left the finite numbers (episode seed {self.episode_seeds[bad]}){hint}"
            )
        any_done = kernels.advance(
            mask, self.limit, self.ticks, self._over, self.terminated, self.truncated, self.episode_seeds, self._command_stream,
            self._command_table, self._command_timing, self.command, self._command_target, self._command_until,
            self._command_draws,
        )  # fmt: skip
        if self.randomization.timed_elements:
            self._change_parameters(mask & ~(self.terminated | self.truncated) if any_done else mask)
        self._observe(mask, False)
        return any_done

    def _start_observer(self, mask: Mask) -> None:
        if self.observer is not None:
            self.observer.reset(mask, self.sensors.values)

    def _update_observer(self, mask: Mask) -> None:
        if self.observer is not None:
            self.observer.update(mask, self.sensors.values)

    def _matrices(self) -> tuple[Array, ...]:
        """What terms read, in the order of ``evaluation.MATRICES``."""
        estimate = self._no_estimate if self.observer is None else self.observer.values
        return (
            self.sensors.values, estimate, self._truth(), self.command, self.action, self._previous_action, self._start,
            self._clock,
        )  # fmt: skip

    def _truth(self) -> Array:
        """The true state, or what a real robot measures of it."""
        return self.plant.truth().values if self.plant.capabilities.has_truth else measured_truth(self.sensors)

    def _observe(self, mask: Mask, first: bool) -> None:
        matrices = self._matrices()
        sensors, estimate, truth = matrices[:3]
        if self._computation is not None:
            self._clock[:, 0] = self.ticks * self.task.config.control_period
            self._computation.run(mask, *matrices, self._computation.numbers, self._computed)
        kernels.observe(
            mask, first, sensors, self.command, self.action, estimate, self._computed, truth, self.episode_seeds, self.ticks,
            self._bias, self._delays, self._sampled_index, self._sampled_value, self._sampled_stream, self._column_index,
            self._column_value, self._ring, self.observation,
        )  # fmt: skip
        if self.dictionary:
            kernels.pick(mask, truth, self._computed, self._privileged_index, self._privileged_value, self.privileged)

    def _bad_action(self, given: NDArray[np.float32], index: int) -> InputError:
        row, joint = divmod(int(index), given.shape[1])
        robot = f" of robot {row} of the batch" if self.count > 1 else ""
        return InputError(f"action for {JOINTS[joint]}{robot} is {given[row, joint]:g}, expected a finite number in [-1, 1]")

    def _next_strike(self, rows: NDArray[np.intp]) -> NDArray[np.int64]:
        period = self.task.config.control_period
        wait = self.randomization.next_strike(self.episode_seeds[rows], self._occurrences[rows], period)
        return self.ticks[rows, None] + wait

    def _change_parameters(self, mask: Mask) -> None:
        """Redraw the parameters of interval events whose time has come, and of those that drift every few ticks."""
        due = (self._strike_at <= self.ticks[:, None]) & mask[:, None]
        self.changed[:] = due.any(axis=1)
        if self._drift_ticks:
            self.changed |= mask & (self.ticks % self._drift_ticks == 0)
        if not self.changed.any():
            return
        rows = np.flatnonzero(self.changed)
        self._occurrences[due] += 1
        if self.randomization.intervals:
            self._strike_at[rows] = np.where(due[rows], self._next_strike(rows), self._strike_at[rows])
        time = np.asarray(self.ticks[rows] * self.task.config.control_period, np.float64)
        robots = self._draw_parameters(rows, self.episode_seeds[rows], self._spreads[rows], self._occurrences[rows], time)
        for index, row in enumerate(rows.tolist()):
            if self._overrides.get(row):
                _override(Parameters(robots.values[index : index + 1]), self._overrides[row])
        self.parameters.values[rows] = robots.values
        self.plant.set_parameters(self.parameters, self.changed)

    # ---- what the faces hand out: fresh objects every time ----

    def observations(self) -> Any:
        """Return a copy of all observations: (N, D) array, or dict of arrays."""
        if self.dictionary:
            return {"policy": self.observation.copy(), "privileged": self.privileged.copy()}
        return self.observation.copy()

    def observation_of(self, row: int) -> Any:
        """Return a copy of one robot's observation."""
        if self.dictionary:
            return {"policy": self.observation[row].copy(), "privileged": self.privileged[row].copy()}
        return self.observation[row].copy()

    def step_info(self) -> dict[str, Any]:
        """Return the last step's ``reward_terms`` {name: (N,)}, ``slip_velocity`` (N, 4, 2) m/s along each wheel's heading
        and axle, and ``effective_friction`` (N, 4, 2) along them. A real robot knows its measured reward terms only."""
        return {"reward_terms": dict(zip(self.task.rewards, self.terms.T.copy(), strict=True)), **self.contact_info()}

    def contact_info(self) -> dict[str, Any]:
        """Return ``slip_velocity`` and ``effective_friction`` (N, 4, 2); nothing on a real robot."""
        if not self.plant.capabilities.has_truth:
            return {}
        truth, shape = self.plant.truth(), (self.count, 4, 2)
        return {name: truth[name].reshape(shape).copy() for name in ("slip_velocity", "effective_friction")}

    def episode_info(self) -> dict[str, Any]:
        """Return ``episode_reward_terms`` {name: (N,)}: sums over the episode so far."""
        return {"episode_reward_terms": dict(zip(self.task.rewards, self.sums.T.copy(), strict=True))}

    def reset_info(self) -> dict[str, Any]:
        """Return ``randomization`` {element: (N,)}: the present values of all parameters that randomisation changes."""
        return self._samples(self.randomization.elements, self.randomization.columns)

    def change_info(self) -> dict[str, Any]:
        """Return ``randomization`` {element: (N,)}: the present values of those that also change within an episode."""
        return self._samples(self.randomization.timed_elements, self.randomization.timed_columns)

    def _samples(self, elements: tuple[str, ...], columns: NDArray[np.int64]) -> dict[str, Any]:
        values = self.parameters.values[:, columns].T.copy()
        return {"randomization": dict(zip(elements, values, strict=True))}

    def describe(self) -> str:
        """Return the task's tables as text."""
        return describe(self.task)

    def contract(self) -> dict[str, Any]:
        """Return what a policy must be fed and what its output means (see :func:`wlr_gym.envs.tasks.describe.contract`)."""
        return contract(self.task, self.randomization.config.model_dump(mode="json", exclude_none=True))

    def close(self) -> None:
        """Release the plant."""
        self.plant.close()


def _share(ramp: RampConfig | None, steps: float) -> float:
    return 1.0 if ramp is None else min(1.0, ramp.start + (1.0 - ramp.start) * steps / ramp.steps)


def read_actions(actions: ArrayLike, shape: tuple[int, ...]) -> NDArray[np.float32]:
    """Return actions as float32 of the given shape.

    Raises:
        InputError: not numbers, or another shape.
    """
    try:
        if np.iscomplexobj(actions):
            raise TypeError
        given = np.asarray(actions, dtype=np.float32)
    except (TypeError, ValueError):
        raise InputError(f"action of type {type(actions).__name__}: expected real numbers of shape {shape}") from None
    if given.shape != shape:
        raise InputError(f"action has shape {given.shape}, expected {shape}; joints {', '.join(JOINTS)}")
    return given


def read_seed(seed: Any) -> int:
    """Return a seed.

    Raises:
        InputError: no whole number of 0 or more.
    """
    if isinstance(seed, bool) or not isinstance(seed, (int, np.integer)) or seed < 0:
        raise InputError(f"seed = {seed!r}: expected a whole number of 0 or more")
    return int(seed)


def read_options(options: Any, valid: tuple[str, ...] = OPTIONS) -> Mapping[str, Any]:
    """Return reset options, empty for None.

    Raises:
        InputError: not a mapping, or an option that is not in ``valid``.
    """
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


def _override(parameters: Parameters, values: Mapping[str, float]) -> None:
    for name, value in values.items():
        parameters[str(name)] = value
    if values:
        parameters.validate()
