"""Commands: drawn, held for a time, and followed with a limited rate of change."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from wlr_gym.base.errors import InputError, unknown_name
from wlr_gym.base.random import stream_number, uniform
from wlr_gym.base.snapshot import RowStore
from wlr_gym.envs.tasks.task import TaskConfig
from wlr_gym.envs.tasks.terms import COMMANDS
from wlr_gym.robot import Robot

Mask = NDArray[np.bool_]
Seeds = NDArray[np.uint64]
Counts = NDArray[np.int64]

_STREAM = stream_number("command")

#: One command: the range it is drawn from and its largest change in a control step.
RANGE = np.dtype([(name, np.float64) for name in ("low", "high", "change")])
#: How long commands are held (control steps), how often all are zero, and the share of the ranges about their middle.
TIMING = np.dtype([(name, np.float64) for name in ("hold_low", "hold_high", "zero_probability", "share")])


# The kernels' ``buffers``: present commands (N, C), where they go to (N, C), which are given and not drawn (N, C), until which
# step (N,), how often they were drawn (N,). A plain tuple: numba takes twice as long to receive a named one.


@njit(cache=True, nogil=True, error_model="numpy")
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


@njit(cache=True, nogil=True, error_model="numpy")
def _follow(i: int, ranges: Any, buffers: Any) -> None:
    """Move robot i's commands towards their targets, no further than they may change in a step."""
    command, target, _, _, _ = buffers
    for c in range(len(ranges)):
        change = target[i, c] - command[i, c]
        if abs(change) <= ranges[c].change:
            command[i, c] = target[i, c]
        else:
            command[i, c] += math.copysign(ranges[c].change, change)


@njit(cache=True, nogil=True, error_model="numpy")
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


@njit(cache=True, nogil=True, error_model="numpy")
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
