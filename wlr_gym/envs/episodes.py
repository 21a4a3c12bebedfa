"""The episodes of N robots: their seeds and ends, the commands within them, and what of the robots is drawn anew for each."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from gymnasium.error import ResetNeeded
from numpy.typing import NDArray

from wlr_gym.base.compiled import compiled
from wlr_gym.base.errors import InputError, unknown_name
from wlr_gym.base.random import episode_seeds, stream_number, stream_numbers, uniform, uniforms
from wlr_gym.base.snapshot import RowStore
from wlr_gym.envs.tasks.randomization import DRIFT_PERIOD, Randomization
from wlr_gym.envs.tasks.task import SensorsConfig, TaskConfig
from wlr_gym.envs.tasks.terms import COMMANDS
from wlr_gym.physics.effects import Patch, apply_patch
from wlr_gym.physics.floor import Floor
from wlr_gym.physics.plants.base import PlantState
from wlr_gym.robot import Robot
from wlr_gym.robot.parameters import Parameters

Mask = NDArray[np.bool_]
Rows = NDArray[np.intp]


@compiled(error_model="numpy")
def _count_step(mask: Any, limit: int, over: Any, steps: Any, sooner: Any, terminated: Any, truncated: Any) -> bool:
    """Count a step and set the end flags. Returns whether any episode ended."""
    any_done = False
    for i in range(len(mask)):
        if not mask[i]:
            continue
        terminated[i] = False
        steps[i] += 1
        for k in range(over.shape[1]):
            if over[i, k] > 0.0:
                terminated[i] = True
        truncated[i] = steps[i] >= limit - sooner[i]
        any_done = any_done or terminated[i] or truncated[i]
    return any_done


class Episodes:
    """The episodes of N robots, all (N,).

    Attributes:
        robot_seeds: the robots' own seeds. number: which episode of the robot this is, from 0. seeds: of the episodes.
        seeded: whether the robot has a seed. begun: whether its first episode has begun.
        steps: control steps since the episode began. sooner: by how many steps before the limit the present one is truncated.
        terminated, truncated: flags of the last step.
    """

    def __init__(self, count: int) -> None:
        self.robot_seeds: NDArray[np.uint64] = np.zeros(count, np.uint64)
        self.number: NDArray[np.int64] = np.zeros(count, np.int64)
        self.seeds: NDArray[np.uint64] = np.zeros(count, np.uint64)
        self.seeded: Mask = np.zeros(count, bool)
        self.begun: Mask = np.zeros(count, bool)
        self._all_begun = False
        self.steps: NDArray[np.int64] = np.zeros(count, np.int64)
        self.sooner: NDArray[np.int64] = np.zeros(count, np.int64)
        self.terminated: Mask = np.zeros(count, bool)
        self.truncated: Mask = np.zeros(count, bool)

    def seed(self, row: int, seed: int) -> None:
        """Give a robot its seed; its next episode is its first."""
        seed = read_seed(seed)
        if seed >= 2**64:  # such as fresh entropy: robots draw from 64 bits
            seed = int(np.random.SeedSequence(seed).generate_state(1, np.uint64)[0])
        self.robot_seeds[row] = seed
        self.number[row] = -1
        self.seeded[row] = True

    def next_seeds(self, rows: Rows) -> NDArray[np.uint64]:
        """Return the seeds of the next episodes of some robots."""
        return episode_seeds(self.robot_seeds[rows], self.number[rows] + 1)

    def begin(self, rows: Rows, seeds: NDArray[np.uint64]) -> None:
        """Begin the next episodes of some robots, which have these seeds; :meth:`note_begun` says when they can be stepped."""
        self.begun[rows] = self._all_begun = False
        self.number[rows] += 1
        self.seeds[rows] = seeds
        self.steps[rows] = self.sooner[rows] = 0
        self.terminated[rows] = self.truncated[rows] = False

    def count_step(self, mask: Mask, limit: int, over: NDArray[np.float64]) -> bool:
        """Count a step of the robots in ``mask``: any of their termination terms ``over`` (N, K) above 0 ends the episode, as
        does step ``limit``. Returns whether any episode ended."""
        return _count_step(mask, limit, over, self.steps, self.sooner, self.terminated, self.truncated)

    def note_begun(self, mask: Mask) -> None:
        """Say that the episodes of the robots in ``mask`` can be stepped."""
        self.begun |= mask
        self._all_begun = bool(self.begun.all())

    def stores(self) -> dict[str, RowStore]:
        """Return what snapshots hold."""
        names = ("robot_seeds", "number", "seeds", "seeded", "begun", "steps", "sooner", "terminated", "truncated")
        return {name: getattr(self, name) for name in names}

    def require_begun(self, what: str, rows: Rows | None = None) -> None:
        """Refuse what needs the episodes of some robots, None = all, to have begun."""
        if self._all_begun:
            return
        asked = np.arange(len(self.begun)) if rows is None else rows
        waiting = asked[~self.begun[asked]]
        if waiting.size:
            raise ResetNeeded(f"call reset() before {what}: no episode of robot {waiting[0]} has begun")


def is_whole(value: Any) -> bool:
    """Return whether a value is a whole number; True and False are none."""
    return isinstance(value, (int, np.integer)) and not isinstance(value, bool)


def read_seed(seed: Any) -> int:
    """Return a seed.

    Raises:
        InputError: no whole number of 0 or more.
    """
    if not is_whole(seed) or seed < 0:
        raise InputError(f"seed = {seed!r}: expected a whole number of 0 or more")
    return int(seed)


def own_seed(environment: Any) -> int:
    """Return the seed of an environment's ``np_random``; one drawn from it where the user set it, as its own is not known."""
    seed = environment.np_random_seed
    return int(environment.np_random.integers(2**63)) if seed < 0 else seed


# ---- commands: drawn, held for a time, and followed with a limited rate of change ------------------------------------


Seeds = NDArray[np.uint64]
Counts = NDArray[np.int64]

_STREAM = stream_number("command")

#: One command: the range it is drawn from and its largest change in a control step.
RANGE = np.dtype([(name, np.float64) for name in ("low", "high", "change")])
#: How long commands are held (control steps), how often all are zero, and the share of the ranges about their middle.
TIMING = np.dtype([(name, np.float64) for name in ("hold_low", "hold_high", "zero_probability", "share")])


# The kernels' ``buffers``: present commands (N, C), where they go to (N, C), which are given and not drawn (N, C), until which
# step (N,), how often they were drawn (N,). A plain tuple: numba takes twice as long to receive a named one.


@compiled(error_model="numpy")
def _draw(i: int, now: int, seed: Any, ranges: Any, timing: Any, buffers: Any) -> None:
    """Draw where robot i's commands go to and how long they stay there."""
    _, target, given, until, draws = buffers
    width = len(ranges)
    counter = draws[i] * (width + 2)
    draws[i] += 1
    hold = timing.hold_low + (timing.hold_high - timing.hold_low) * uniform(seed, _STREAM, counter)
    until[i] = now + max(1, math.floor(hold + 0.5))
    stop = uniform(seed, _STREAM, counter + 1) < timing.zero_probability
    for c in range(width):
        u = uniform(seed, _STREAM, counter + 2 + c)
        if timing.share != 1.0:
            u = 0.5 + timing.share * (u - 0.5)
        if not given[i, c]:
            target[i, c] = 0.0 if stop else ranges[c].low + (ranges[c].high - ranges[c].low) * u


@compiled(error_model="numpy")
def _follow(i: int, ranges: Any, buffers: Any) -> None:
    """Move robot i's commands towards their targets, no further than they may change in a step."""
    command, target, _, _, _ = buffers
    for c in range(len(ranges)):
        change = target[i, c] - command[i, c]
        if abs(change) <= ranges[c].change:
            command[i, c] = target[i, c]
        else:
            command[i, c] += math.copysign(ranges[c].change, change)


@compiled(error_model="numpy")
def _begin(mask: Any, seeds: Any, ranges: Any, timing: Any, buffers: Any) -> None:
    """Draw the first commands of an episode. Those that ramp begin at zero."""
    command, _, given, _, draws = buffers
    for i in range(len(mask)):
        if mask[i]:
            draws[i] = 0
            given[i, :] = False
            _draw(i, 0, seeds[i], ranges, timing[0], buffers)
            for c in range(len(ranges)):
                command[i, c] = 0.0
            _follow(i, ranges, buffers)


@compiled(error_model="numpy")
def _advance(mask: Any, seeds: Any, steps: Any, ranges: Any, timing: Any, buffers: Any) -> None:
    """Draw new commands where their time is up, and let commands ramp."""
    _, _, _, until, _ = buffers
    for i in range(len(mask)):
        if mask[i]:
            if steps[i] >= until[i]:
                _draw(i, steps[i], seeds[i], ranges, timing[0], buffers)
            _follow(i, ranges, buffers)


class Commands:
    """The commands of N robots.

    Attributes:
        names: of the commands, in order.
        command: (N, C) present commands, SI units.
        target: (N, C) where they go to.
    """

    def __init__(self, config: TaskConfig, robot: Robot, count: int) -> None:
        self._robot = robot
        self.names: tuple[str, ...] = tuple(config.commands.terms)
        period = config.control_period
        ramp = {name: rate * period for name, rate in config.commands.ramp.items()}
        ranges = [(low, high, ramp.get(name, np.inf)) for name, (low, high) in config.commands.terms.items()]
        self._ranges = np.array(ranges, RANGE)
        low, high = (time / period for time in config.commands.hold_time)
        self._timing = np.array([(low, high, config.commands.zero_probability, 1.0)], TIMING)
        self.command, self.target = np.zeros((2, count, len(self.names)))
        self._given = np.zeros(self.command.shape, bool)
        until, draws = np.zeros((2, count), np.int64)
        self._buffers = (self.command, self.target, self._given, until, draws)

    def set_share(self, share: float) -> None:
        """Draw from this share of every range about its middle from now on."""
        self._timing["share"] = share

    def begin(self, mask: Mask, seeds: Seeds) -> None:
        """Draw the first commands of the episodes with ``seeds`` (N,)."""
        _begin(mask, seeds, self._ranges, self._timing, self._buffers)

    def advance(self, mask: Mask, seeds: Seeds, steps: Counts) -> None:
        """Go on by a control step; ``steps`` (N,) since the episodes began."""
        _advance(mask, seeds, steps, self._ranges, self._timing, self._buffers)

    def hold(self, rows: NDArray[np.intp], values: Mapping[int, float]) -> None:
        """Hold commands {column: value} of some robots until the episode ends; the others are drawn as before."""
        for column, value in values.items():
            self.command[rows, column] = self.target[rows, column] = value
            self._given[rows, column] = True

    def stores(self) -> dict[str, RowStore]:
        """Return what snapshots hold."""
        names = ("command", "command_target", "command_given", "command_until", "command_draws")
        return dict(zip(names, self._buffers, strict=True))

    def read(self, given: Mapping[str, Any]) -> dict[int, float]:
        """Return commands {name: value} as {column: value}.

        Raises:
            InputError: unknown command, or a value of the wrong type, without meaning, or beyond what the robot can do.
        """
        values: dict[int, float] = {}
        for name, value in given.items():
            if name not in self.names:
                raise unknown_name("command", str(name), self.names)
            number = np.asarray(value)
            if number.shape != () or number.dtype.kind not in "iuf" or not np.isfinite(number):
                raise InputError(f"command {name} = {value!r}: expected a finite number")
            low, high = COMMANDS[name].bounds(self._robot)
            if not low <= number <= high:
                raise InputError(f"command {name} = {value!r}: expected {COMMANDS[name].words(low, high)}")
            values[self.names.index(name)] = float(value)
        return values


# ---- parameters and initial states -----------------------------------------------------------------------------------

# What randomisation draws, then the floor, the effects, which sensors the task gives the robots, and what the user sets.


Array = NDArray[np.float64]


class RandomizedRobots:
    """Parameters and initial states of N robots.

    Args:
        robot: the nominal one.
        floor: that they drive on; None = a plane.
        randomization: what is drawn.
        patch: effects that are added to it.
        control_period: s.
        count: N.
        sensors: how often a sensor is present.

    Raises:
        InputError: floor and randomisation both say what a number is.

    Attributes:
        parameters: present parameters of every robot.
        state: where the robots of the present episodes started.
        changed: (N,) whether randomisation changed the robot's parameters at the end of the last step.
        share: of the randomisation that new episodes are drawn with, below 1 early in a curriculum.
    """

    def __init__(
        self,
        robot: Robot,
        floor: Floor | None,
        randomization: Randomization,
        patch: Patch,
        control_period: float,
        count: int,
        sensors: SensorsConfig,
    ) -> None:
        if floor is not None:
            _refuse_stated_twice(floor, randomization)
        self._floor = floor
        self._randomization = randomization
        self._patch = patch
        self._presence = [(f"{name}.present", share) for name, share in sensors if share is not None]
        self._presence_streams = stream_numbers(*(name for name, _ in self._presence))
        self._period = control_period
        self.share: float = 1.0
        self._shares = np.ones(count)  # that the present episodes were drawn with
        self.parameters: Parameters = Parameters.nominal(robot, count)
        if floor is not None:
            floor.write(self.parameters, np.zeros(count, np.uint64))
        self.parameters = apply_patch(patch, self.parameters)
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
        """Randomisation of some robots, then the floor, then the effects, then the sensors."""
        robots = self._randomization.parameters(robot_seeds, seeds, occurrences, time, share)
        if self._floor is not None:
            self._floor.write(robots, seeds)
        robots = apply_patch(self._patch, robots) if self._patch else robots
        for (name, share), drawn in zip(self._presence, uniforms(seeds, self._presence_streams).T, strict=True):
            robots[name] = drawn < share
        return robots

    def _wait(self, rows: Rows, seeds: Seeds) -> Counts:
        """Control steps (M, intervals) until each interval event strikes some robots next."""
        return self._randomization.next_strike(seeds, self._occurrences[rows], self._period)


def _refuse_stated_twice(floor: Floor, randomization: Randomization) -> None:
    """Refuse a randomisation of what the floor states: the floor would overwrite it without a word."""
    for element, part in floor.elements().items():
        if (event := randomization.events.get(element)) is not None:
            both = f"floor '{floor.name}': {part}, and randomization '{randomization.config.name}': event '{event}'"
            remedy = f"leave it out of the floor, or lay events: {{{event}: null}} over the randomization"
            raise InputError(f"{both}: both state {element}; {remedy}")


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
