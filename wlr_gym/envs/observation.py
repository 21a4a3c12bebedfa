"""What a policy sees and what it sets.

Readings get noise and bias, are kept for a while, and are shown as old as their devices make them; actions are checked, and
turned into setpoints of the joints.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from wlr_gym.base.compiled import compiled
from wlr_gym.base.errors import InputError
from wlr_gym.base.random import normals4, stream_numbers, uniforms
from wlr_gym.base.snapshot import RowStore
from wlr_gym.envs.episodes import Episodes
from wlr_gym.envs.tasks.compiled_terms import MATRICES
from wlr_gym.envs.tasks.entries import normal
from wlr_gym.envs.tasks.randomization import RandomizationConfig
from wlr_gym.envs.tasks.task import ActionColumn, ObservationColumn, Task
from wlr_gym.perception.observer import ESTIMATE_LAYOUT
from wlr_gym.physics.plants.base import SENSOR_LAYOUT, TRUTH_LAYOUT
from wlr_gym.robot import JOINTS

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
Rows = NDArray[np.intp]

# Where the matrices that observations show stand in :data:`MATRICES`.
SENSORS = MATRICES.index("sensors")
ESTIMATE = MATRICES.index("estimate")
COMMAND = MATRICES.index("command")
ACTION = MATRICES.index("action")
COMPUTED = MATRICES.index("computed")

#: A bias is cut off so many sigmas from zero.
BIAS_CUT = 4.0

#: One number that is read in every step: its matrix of :data:`MATRICES`, column there, offset, noise (1 sigma), noise's stream.
READING = np.dtype(
    [("matrix", np.int64), ("column", np.int64), ("offset", np.float64), ("noise", np.float64), ("stream", np.uint64)]
)
#: One number of the policy observation: which reading, how old (control steps, on top of its device's latency), clipped and
#: scaled. Between the two readings around that age it is interpolated where they differ by at most ``interpolate``; else it is
#: the newest that is at least that old.
SHOWN = np.dtype(
    [
        ("reading", np.int64),
        ("lag", np.int64),
        ("device", np.int64),
        ("interpolate", np.float64),
        ("limit", np.float64),
        ("scale", np.float64),
    ]
)
#: One number of the privileged observation: its matrix of :data:`MATRICES`, column there, clipped and scaled.
PICKED = np.dtype([("matrix", np.int64), ("column", np.int64), ("limit", np.float64), ("scale", np.float64)])


# Of the kernels' arguments, ``tables`` is what is read (W,) and what is shown of it (D,). ``buffers``: bias (N, W) of the
# readings, delays (N, devices + 1) of the devices in control steps, of which the last is zero, ring (N, K, W) with the last K
# readings, and the policy observation (N, D). Plain tuples: numba takes twice as long to receive named ones.


@compiled(error_model="numpy")
def _observe(mask: Any, first: bool, signals: Any, seeds: Any, steps: Any, tables: Any, buffers: Any) -> None:
    """Take all readings, and show those of the right age. ``first``: the episode starts, older readings are as this one."""
    readings, shown = tables
    _read(mask, first, signals, seeds, steps, readings, buffers)
    _show(mask, steps, shown, buffers)


@compiled(error_model="numpy")
def _read(mask: Any, first: bool, signals: Any, seeds: Any, steps: Any, readings: Any, buffers: Any) -> None:
    """Take the readings into the ring."""
    sensors, estimate, truth, command, action, _, _, _, _, computed = signals
    bias, _, ring, _ = buffers
    depth = ring.shape[1]
    for i in range(len(mask)):
        if not mask[i]:
            continue
        now = steps[i] % depth
        for w in range(len(readings)):
            reading = readings[w]
            matrix, column = reading.matrix, reading.column
            if matrix == SENSORS:
                value = sensors[i, column]
            elif matrix == COMMAND:
                value = command[i, column]
            elif matrix == ACTION:
                value = action[i, column]
            elif matrix == ESTIMATE:
                value = estimate[i, column]
            elif matrix == COMPUTED:
                value = computed[i, column]
            else:
                value = truth[i, column]
            value = value - reading.offset + bias[i, w]
            if reading.noise > 0.0:
                value += reading.noise * normals4(seeds[i], reading.stream, steps[i], 0)[0]
            ring[i, now, w] = value
            if first:
                for k in range(depth):
                    ring[i, k, w] = value


@compiled(error_model="numpy")
def _show(mask: Any, steps: Any, shown: Any, buffers: Any) -> None:
    """Assemble the observation from readings of the right age."""
    _, delays, ring, policy = buffers
    depth = ring.shape[1]
    for i in range(len(mask)):
        if not mask[i]:
            continue
        now = steps[i] % depth
        for d in range(len(shown)):
            column = shown[d]
            age = delays[i, column.device] + column.lag
            whole = math.floor(age)
            rest = age - whole
            value = ring[i, (now - whole + depth) % depth, column.reading]
            if rest > 0.0:
                older = ring[i, (now - whole - 1 + depth) % depth, column.reading]
                change = older - value
                value = value + rest * change if abs(change) <= column.interpolate else older
            policy[i, d] = column.scale * min(max(value, -column.limit), column.limit)


@compiled(error_model="numpy")
def _pick(mask: Any, signals: Any, picked: Any, out: Any) -> None:
    """Copy columns of the truth and of what is computed, clipped to a limit and scaled."""
    _, _, truth, _, _, _, _, _, _, computed = signals
    for i in range(len(mask)):
        if mask[i]:
            for d in range(len(picked)):
                column = picked[d]
                value = computed[i, column.column] if column.matrix == COMPUTED else truth[i, column.column]
                out[i, d] = column.scale * min(max(value, -column.limit), column.limit)


class ObservationPipeline:
    """Makes the observations of N robots.

    Args:
        task: what is observed.
        randomization: whether sensors are noisy, and whether latency is drawn.
        count: N.
        has_latency: False for a real robot, whose readings are late by themselves.
        has_privileged: whether privileged observations are made.

    Attributes:
        policy: (N, D) float32 policy observations. privileged: (N, P) float32 privileged ones.
        bias: (N, W) of the readings, in their units. delays: (N, devices + 1) of the devices, control steps.
    """

    def __init__(
        self, task: Task, randomization: RandomizationConfig, count: int, *, has_latency: bool, has_privileged: bool
    ) -> None:
        latency, period = task.config.latency, task.config.control_period
        read = list({(c.term, c.element): c for c in task.policy}.values())
        noisy = float(randomization.sensor_noise)
        noise_streams = stream_numbers(*(f"noise/{c.term}/{c.element}" for c in read))
        readings = [(*_place(c, task), c.offset, c.noise * noisy, s) for c, s in zip(read, noise_streams, strict=True)]
        self._tables = (np.array(readings, READING), _shown(task, read))
        self._picked = np.array([(*_place(c, task), c.limit, c.scale) for c in task.privileged], PICKED)
        self._bias_sigma = np.array([c.bias * noisy for c in read])
        self._bias_stream = stream_numbers(*(f"bias/{c.term}/{c.element}" for c in read))
        self._latency = np.array([device.delay for device in latency.values()]).reshape(-1, 2) / period
        self._latency_stream = stream_numbers(*(f"latency/{device}" for device in latency))
        self._draws_latency = randomization.latency
        self._has_latency = has_latency
        self._has_privileged = has_privileged
        longest_delay = float(self._latency.max()) if latency else 0.0
        depth = max(c.lag for c in task.policy) + math.ceil(longest_delay) + 1
        self.bias = np.zeros((count, len(read)))
        self.delays = np.zeros((count, len(latency) + 1))
        self.policy = np.zeros((count, len(task.policy)), np.float32)
        self._buffers = (self.bias, self.delays, np.zeros((count, depth, len(read))), self.policy)
        self.privileged = np.zeros((count, len(task.privileged)), np.float32)

    def begin(self, rows: Rows, seeds: NDArray[np.uint64]) -> None:
        """Draw latency and bias of some robots' episodes, which have these seeds (M,)."""
        low, high = self._latency[:, 0], self._latency[:, 1]
        share = uniforms(seeds, self._latency_stream) if self._draws_latency else 0.5
        self.delays[rows, :-1] = low + (high - low) * share if self._has_latency else 0.0
        if self._bias_sigma.any():
            u = uniforms(seeds, self._bias_stream)
            self.bias[rows] = normal(u, np.zeros(1), self._bias_sigma, np.full(1, BIAS_CUT))

    def stores(self) -> dict[str, RowStore]:
        """Return what snapshots hold."""
        names = ("observation_bias", "observation_delays", "observation_ring", "observation")
        return {**dict(zip(names, self._buffers, strict=True)), "privileged": self.privileged}

    def observe(self, mask: Mask, signals: tuple[Array, ...], episodes: Episodes, *, first: bool) -> None:
        """Observe the robots in ``mask``; ``signals`` are :data:`MATRICES`, ``first``: their episodes start."""
        _observe(mask, first, signals, episodes.seeds, episodes.steps, self._tables, self._buffers)
        if self._has_privileged:
            _pick(mask, signals, self._picked, self.privileged)


def _place(column: ObservationColumn, task: Task) -> tuple[int, int]:
    """Matrix of :data:`MATRICES` and column there."""
    elements = {
        "sensors": SENSOR_LAYOUT.elements,
        "command": task.commands,
        "action": JOINTS,
        "estimate": ESTIMATE_LAYOUT.elements,
        "computed": task.computed,
        "truth": TRUTH_LAYOUT.elements,
    }
    return MATRICES.index(column.source), elements[column.source].index(column.element)


def _shown(task: Task, read: list[ObservationColumn]) -> NDArray[np.void]:
    places = {(c.term, c.element): index for index, c in enumerate(read)}
    devices: list[str] = list(task.config.latency)
    modes = [latency.mode for latency in task.config.latency.values()]
    rows = []
    for c in task.policy:
        device = devices.index(c.device) if c.device in devices else len(devices)
        # Nothing turns by half a turn within a step: an angle that differs by more went over its end from pi to -pi.
        most = math.pi if c.unit == "rad" else math.inf
        interpolate = most if c.device in devices and modes[device] == "interpolate" else -1.0
        rows.append((places[c.term, c.element], c.lag, device, interpolate, c.limit, c.scale))
    return np.array(rows, SHOWN)


# ---- actions ------------------------------------------------ -------------------------------------------------------


#: Actions may exceed +-1 by rounding only.
ACTION_LIMIT = 1.0 + 1e-6

_FLOAT32 = np.dtype(np.float32)

#: One column of the action: setpoint = clip(centre + scale * action, low, high).
SCALING = np.dtype([(name, np.float64) for name in ("centre", "scale", "low", "high")])


@compiled(error_model="numpy")
def _take(mask: Any, given: Any, limit: float, scaling: Any, buffers: Any) -> int:
    """Check actions (N, 8) and turn them into setpoints; nothing is written when one is bad.

    Robots outside ``mask`` get the setpoints of action 0. ``buffers``: action, previous action and setpoints, (N, 8) each.

    Returns:
        Flat index of the first action that is not finite or beyond the limit, or -1.
    """
    action, previous, setpoints = buffers
    robots, width = given.shape
    for i in range(robots):
        if mask[i]:
            for j in range(width):
                if not abs(given[i, j]) <= limit:
                    return i * width + j
    for i in range(robots):
        for j in range(width):
            value = min(max(float(given[i, j]), -1.0), 1.0) if mask[i] else 0.0
            previous[i, j] = action[i, j]
            action[i, j] = value
            row = scaling[j]
            setpoints[i, j] = min(max(row.centre + row.scale * value, row.low), row.high)
    return -1


class Actions:
    """The actions of N robots.

    Args:
        columns: of the action.
        count: N.
        free_wheels: wheels whose motors are off.

    Attributes:
        action, previous: (N, 8) last actions and those of the step before.
        setpoints: (N, 8) last setpoints, rad and rad/s.
        torque_on: (N, 8) whether the motors are on; None = all.
    """

    def __init__(self, columns: Sequence[ActionColumn], count: int, free_wheels: Iterable[str]) -> None:
        self._scaling = np.array([(c.centre, c.scale, c.low, c.high) for c in columns], SCALING)
        self.action, self.previous, self.setpoints = np.zeros((3, count, len(columns)))
        self._buffers = (self.action, self.previous, self.setpoints)
        self.torque_on: Mask | None = None
        if free_wheels:
            self.torque_on = np.ones((count, len(columns)), bool)
            self.torque_on[:, [JOINTS.index(wheel) for wheel in free_wheels]] = False

    def begin(self, rows: NDArray[np.intp]) -> None:
        """Forget the actions of some robots."""
        self.action[rows] = self.previous[rows] = 0.0

    def stores(self) -> dict[str, RowStore]:
        """Return what snapshots hold."""
        return {"action": self.action, "previous_action": self.previous, "setpoints": self.setpoints}

    def take(self, actions: ArrayLike, mask: Mask) -> None:
        """Turn actions (N, 8) into setpoints; robots outside ``mask`` get those of action 0.

        Raises:
            InputError: wrong shape, or an action that is not finite or out of [-1, 1]; names robot and joint.
        """
        given = read_actions(actions, self.action.shape)
        bad = _take(mask, given, ACTION_LIMIT, self._scaling, self._buffers)
        if bad >= 0:
            row, joint = divmod(int(bad), given.shape[1])
            robot = f" of robot {row} of the batch" if len(given) > 1 else ""
            raise InputError(f"action for {JOINTS[joint]}{robot} is {given[row, joint]:g}, expected a finite number in [-1, 1]")


def read_actions(actions: ArrayLike, shape: tuple[int, ...]) -> NDArray[np.float32]:
    """Return actions as float32 of the given shape."""
    if type(actions) is np.ndarray and actions.dtype == _FLOAT32 and actions.shape == shape:
        return actions  # as nearly always: half of the time of what follows, twice in a step
    try:
        given = np.asarray(actions)
        if given.dtype.kind not in "iuf":
            raise TypeError
        given = given.astype(np.float32, copy=False)
    except (TypeError, ValueError):
        raise InputError(f"action of type {type(actions).__name__}: expected real numbers of shape {shape}") from None
    if given.shape != shape:
        raise InputError(f"action has shape {given.shape}, expected {shape}; joints {', '.join(JOINTS)}")
    return given
