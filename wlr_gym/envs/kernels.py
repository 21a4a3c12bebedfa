"""Compiled loops over robots for one control tick: action to goals, time and commands, observation.

Which columns are read, scaled, delayed and clipped is data (index tables made from the task), so nothing here is compiled
per task. ``mask`` (N,) chooses whose rows are done. Results of a robot depend on its own rows only.
"""

from __future__ import annotations

import math
from typing import Any

from numba import njit

from wlr_gym.base.random import normals4
from wlr_gym.envs.tasks.draws import uniform

#: Sources of an observation column, as numbered in the index tables.
SOURCES = ("sensors", "command", "action", "estimate", "computed", "truth")


@njit(cache=True, nogil=True, error_model="numpy")
def take_action(mask: Any, given: Any, limit: float, table: Any, action: Any, previous_action: Any, goals: Any) -> int:
    """Check actions and turn them into goals; nothing is written when one is bad.

    Args:
        mask: (N,) robots that act; the others get the goal of action 0.
        given: (N, A) actions.
        limit: largest magnitude accepted.
        table: (A, 4) centre, scale, low, high.
        action, previous_action, goals: (N, A) written.

    Returns:
        Flat index of the first action that is not finite or beyond the limit, or -1.
    """
    robots, width = given.shape
    for i in range(robots):
        if mask[i]:
            for j in range(width):
                if not abs(given[i, j]) <= limit:
                    return i * width + j
    for i in range(robots):
        for j in range(width):
            value = min(max(float(given[i, j]), -1.0), 1.0) if mask[i] else 0.0
            previous_action[i, j] = action[i, j]
            action[i, j] = value
            goals[i, j] = min(max(table[j, 0] + table[j, 1] * value, table[j, 2]), table[j, 3])
    return -1


@njit(cache=True, nogil=True, error_model="numpy")
def _draw_target(
    i: int, now: int, seeds: Any, stream: Any, table: Any, timing: Any, target: Any, until: Any, draws: Any
) -> None:
    """Draw where robot i's commands go to and how long they stay there.

    ``timing``: hold low and high (ticks), probability of all zero, share of the ranges about their middle.
    """
    width = target.shape[1]
    counter = draws[i] * (width + 2)
    draws[i] += 1
    hold = timing[0] + (timing[1] - timing[0]) * uniform(seeds[i], stream, counter)
    until[i] = now + max(1, math.floor(hold + 0.5))
    stop = uniform(seeds[i], stream, counter + 1) < timing[2]
    for c in range(width):
        u = uniform(seeds[i], stream, counter + 2 + c)
        if timing[3] != 1.0:
            u = 0.5 + timing[3] * (u - 0.5)
        target[i, c] = 0.0 if stop else table[c, 0] + (table[c, 1] - table[c, 0]) * u


@njit(cache=True, nogil=True, error_model="numpy")
def start_commands(
    mask: Any, seeds: Any, stream: Any, table: Any, timing: Any, command: Any, target: Any, until: Any, draws: Any
) -> None:
    """Draw the first commands of an episode. Those that ramp begin at zero."""
    for i in range(command.shape[0]):
        if mask[i]:
            draws[i] = 0
            _draw_target(i, 0, seeds, stream, table, timing, target, until, draws)
            for c in range(command.shape[1]):
                command[i, c] = 0.0
            _follow(i, table, command, target)


@njit(cache=True, nogil=True, error_model="numpy")
def _follow(i: int, table: Any, command: Any, target: Any) -> None:
    """Move robot i's commands towards their targets, no further than ``table[:, 2]`` in a tick."""
    for c in range(command.shape[1]):
        change = target[i, c] - command[i, c]
        if abs(change) <= table[c, 2]:
            command[i, c] = target[i, c]
        else:
            command[i, c] += math.copysign(table[c, 2], change)


@njit(cache=True, nogil=True, error_model="numpy")
def advance(
    mask: Any,
    limit: int,
    ticks: Any,
    over: Any,
    terminated: Any,
    truncated: Any,
    seeds: Any,
    stream: Any,
    table: Any,
    timing: Any,
    command: Any,
    target: Any,
    until: Any,
    draws: Any,
) -> bool:
    """Count a tick, set the end flags, draw new commands where their time is up, let commands ramp.

    ``table`` (C, 3): low, high, largest change in a tick. Returns whether any episode ended.
    """
    any_done = False
    for i in range(command.shape[0]):
        if not mask[i]:
            continue
        terminated[i] = False
        ticks[i] += 1
        for k in range(over.shape[1]):
            if over[i, k] > 0.0:
                terminated[i] = True
        truncated[i] = ticks[i] >= limit
        any_done = any_done or terminated[i] or truncated[i]
        if ticks[i] >= until[i]:
            _draw_target(i, ticks[i], seeds, stream, table, timing, target, until, draws)
        _follow(i, table, command, target)
    return any_done  # fmt: skip


@njit(cache=True, nogil=True, error_model="numpy")
def observe(
    mask: Any,
    first: bool,
    sensors: Any,
    command: Any,
    action: Any,
    estimate: Any,
    computed: Any,
    truth: Any,
    seeds: Any,
    ticks: Any,
    bias: Any,
    delays: Any,
    sampled_index: Any,
    sampled_value: Any,
    sampled_stream: Any,
    column_index: Any,
    column_value: Any,
    ring: Any,
    out: Any,
) -> None:
    """Take a reading of every sampled column into the ring, and assemble the observation from readings of the right age.

    Args:
        first: the episode starts: fill the whole ring with this reading.
        bias: (N, W) added to each reading.
        delays: (N, devices + 1) age in control ticks; the last column is zero.
        sampled_index: (W, 2) source (see ``SOURCES``) and column there.
        sampled_value: (W, 2) offset and noise (1 sigma).
        sampled_stream: (W,) stream of the noise.
        column_index: (D, 4) sampled column, lag in ticks, device, 1 to interpolate or 0 to hold.
        column_value: (D, 2) limit and scale.
        ring: (N, K, W) the last K readings.
        out: (N, D) float32 observation.
    """
    depth, width = ring.shape[1], ring.shape[2]
    for i in range(out.shape[0]):
        if not mask[i]:
            continue
        now = ticks[i] % depth
        for w in range(width):
            column = sampled_index[w, 1]
            source = sampled_index[w, 0]
            if source == 0:
                value = sensors[i, column]
            elif source == 1:
                value = command[i, column]
            elif source == 2:
                value = action[i, column]
            elif source == 3:
                value = estimate[i, column]
            elif source == 4:
                value = computed[i, column]
            else:
                value = truth[i, column]
            value = value - sampled_value[w, 0] + bias[i, w]
            if sampled_value[w, 1] > 0.0:
                value += sampled_value[w, 1] * normals4(seeds[i], sampled_stream[w], ticks[i], 0)[0]
            ring[i, now, w] = value
            if first:
                for k in range(depth):
                    ring[i, k, w] = value
        for d in range(out.shape[1]):
            w, device = column_index[d, 0], column_index[d, 2]
            age = delays[i, device] + column_index[d, 1]
            whole = math.floor(age)
            rest = age - whole
            value = ring[i, (now - whole + depth) % depth, w]
            if rest > 0.0:
                older = ring[i, (now - whole - 1 + depth) % depth, w]
                value = value + rest * (older - value) if column_index[d, 3] == 1 else older
            limit = column_value[d, 0]
            out[i, d] = column_value[d, 1] * min(max(value, -limit), limit)


@njit(cache=True, nogil=True, error_model="numpy")
def pick(mask: Any, truth: Any, computed: Any, index: Any, column_value: Any, out: Any) -> None:
    """Copy chosen columns, clipped to a limit and scaled.

    Args:
        index: (D, 2) source (see ``SOURCES``) and column there. column_value: (D, 2) limit and scale.
    """
    for i in range(out.shape[0]):
        if not mask[i]:
            continue
        for d in range(out.shape[1]):
            limit = column_value[d, 0]
            column = index[d, 1]
            value = computed[i, column] if index[d, 0] == 4 else truth[i, column]
            out[i, d] = column_value[d, 1] * min(max(value, -limit), limit)
