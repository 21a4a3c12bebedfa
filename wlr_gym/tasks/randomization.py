"""Randomisation as data: which parameters, when, from which distribution, by which operation.

Every draw is a pure function of (seed, name of the event, what it is drawn for): an event more or less shifts no other, and
a robot gets the same values alone or in a batch.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field

from wlr_gym.errors import InputError
from wlr_gym.parameters import ELEMENTS, TABLE, XYZ, Parameters, spec_of
from wlr_gym.paths import find_config
from wlr_gym.plants.base import PlantState, standing_state
from wlr_gym.robot import LEGS, Robot, parse_config, read_yaml
from wlr_gym.tasks.draws import stream_numbers, uniforms
from wlr_gym.tasks.terms.events import DISTRIBUTIONS, number_of, tolerance_of

Array = NDArray[np.float64]
Seeds = NDArray[np.uint64]
Number = float | str


class _Data(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class EventConfig(_Data):
    """One randomisation event.

    Attributes:
        parameters: names or single elements of the parameter table.
        when: ``startup`` (once per seed), ``reset`` (each episode) or ``interval`` (also within an episode).
        distribution: ``uniform`` or ``loguniform`` (low, high), ``normal`` (mean, sigma, cut), ``choice`` (values), or
            ``tolerance``: normal with the tolerance the robot's file states, times ``sigmas``, cut at ``cut`` of them.
        operation: ``set`` the value, ``scale`` or ``add`` to the nominal one.
        per: one draw per ``robot``, per ``label`` (joint, wheel or axis; the same for all parameters listed), or ``element``.
        low, high, mean, sigma: numbers, or paths of numbers in the robot's file, such as ``sensors.imu.gyro_bias``.
        interval: s between draws, itself drawn evenly between the two.
    """

    parameters: tuple[str, ...] = Field(min_length=1)
    when: Literal["startup", "reset", "interval"] = "reset"
    distribution: Literal["uniform", "loguniform", "normal", "choice", "tolerance"]
    operation: Literal["set", "scale", "add"] | None = None
    per: Literal["robot", "label", "element"] = "robot"
    low: Number | None = None
    high: Number | None = None
    mean: Number | None = None
    sigma: Number | None = None
    sigmas: float = Field(default=1.0, gt=0)
    cut: float = Field(default=3.0, gt=0)
    values: tuple[float, ...] | None = None
    interval: tuple[float, float] | None = None


class InitialStateConfig(_Data):
    """Half-widths of the even spread around standing still at home: rad, rad, m/s, rad/s (body frame)."""

    leg_angle: float = Field(default=0.0, ge=0)
    yaw: float = Field(default=0.0, ge=0)
    linear_velocity: float = Field(default=0.0, ge=0)
    angular_velocity: float = Field(default=0.0, ge=0)


class RandomizationConfig(_Data):
    """Contents of ``configs/randomization/*.yaml``.

    Attributes:
        sensor_noise: False switches off the sensors' noise and quantisation, and the task's observation noise and bias.
        latency: False fixes every latency in the middle of its range.
        initial_state: spread of the state an episode starts from.
        events: name -> event.
    """

    name: str = "custom"
    sensor_noise: bool = True
    latency: bool = True
    initial_state: InitialStateConfig = InitialStateConfig()
    events: dict[str, EventConfig] = {}


@dataclass(frozen=True)
class _Entry:
    """One event acting on one element: value = quantile(u; first, second, cut); ``draw`` names its random number."""

    event: str
    when: str
    operation: str
    column: int
    draw: str
    distribution: str
    first: float
    second: float
    cut: float
    values: tuple[float, ...] = ()


def load_randomization(source: str | Path | Mapping[str, Any] | RandomizationConfig | None, robot: Robot) -> Randomization:
    """Load randomisation by config name, path, mapping (same keys as the file) or None (= ``none``).

    Raises:
        InputError: unknown key, parameter or element (with the nearest valid name), missing or impossible number, or a range
            to ``set`` that is not within the parameter's bounds.
    """
    if isinstance(source, RandomizationConfig):
        config = source
    elif isinstance(source, Mapping):
        config = parse_config(RandomizationConfig, dict(source), "randomization")
    else:
        path = find_config("randomization", "none" if source is None else source)
        config = parse_config(RandomizationConfig, read_yaml(path), str(path))
    return Randomization(config, robot)


class Randomization:
    """Draws parameters and initial states of robots.

    Attributes:
        config: the data.
        elements: elements of the parameter table that it changes.
        intervals: names of the events that also act within an episode.
    """

    def __init__(self, config: RandomizationConfig, robot: Robot) -> None:
        self.config = config
        self.robot = robot
        self._nominal = Parameters.nominal(robot, 1)
        self._nominal.validate()
        entries = [entry for name, event in config.events.items() for entry in _entries(name, event, robot)]
        _refuse_double_set(entries)
        self._operations = {kind: [e for e in entries if e.operation == kind] for kind in ("set", "scale", "add")}
        entries = [entry for kind in self._operations.values() for entry in kind]
        self._entries = entries
        self.intervals = tuple(name for name, event in config.events.items() if event.when == "interval")
        self.columns = np.unique([entry.column for entry in entries]).astype(np.int64)
        self.elements = tuple(ELEMENTS[column] for column in self.columns)
        self._streams = stream_numbers(*(f"event/{entry.event}/{entry.draw}" for entry in entries))
        self._interval_streams = stream_numbers(*(f"interval/{name}" for name in self.intervals))
        self._at_startup = np.array([entry.when == "startup" for entry in entries], dtype=bool)
        self._interval_index = np.array(
            [self.intervals.index(e.event) if e.event in self.intervals else len(self.intervals) for e in entries],
            dtype=np.int64,
        )
        self._first, self._second, self._cut = (np.array([getattr(e, f) for e in entries]) for f in ("first", "second", "cut"))
        self._choices = [(k, np.array(e.values)) for k, e in enumerate(entries) if e.distribution == "choice"]
        names = [entry.distribution for entry in entries]
        self._groups = {
            name: np.flatnonzero([n == name for n in names]) for name in dict.fromkeys(names) if name in DISTRIBUTIONS
        }
        self._low, self._high = _table_bounds()
        spread = config.initial_state
        widths = {"leg_angle": (spread.leg_angle, LEGS), "yaw": (spread.yaw, ("z",))}
        widths |= {"linear_velocity": (spread.linear_velocity, XYZ), "angular_velocity": (spread.angular_velocity, XYZ)}
        self._spread = np.array([width for width, labels in widths.values() for _ in labels])
        self._spread_streams = stream_numbers(
            *(f"initial_state/{n}/{label}" for n, (_, labels) in widths.items() for label in labels)
        )

    def parameters(self, robot_seeds: Seeds, episode_seeds: Seeds, occurrences: NDArray[np.int64] | None = None) -> Parameters:
        """Return the parameters of M robots.

        Args:
            robot_seeds: (M,) what ``startup`` events draw from.
            episode_seeds: (M,) what all others draw from.
            occurrences: (M, len(intervals)) how often each interval event has struck in this episode; None = never.
        """
        values = np.repeat(self._nominal.values, len(episode_seeds), axis=0)
        if self._entries:
            self._apply(values, self._draw(robot_seeds, episode_seeds, occurrences))
        return Parameters(values)

    def _draw(self, robot_seeds: Seeds, episode_seeds: Seeds, occurrences: NDArray[np.int64] | None) -> Array:
        seeds = np.where(self._at_startup, robot_seeds[:, None], episode_seeds[:, None])
        counts = np.zeros((len(episode_seeds), len(self.intervals) + 1), dtype=np.int64)
        if occurrences is not None:
            counts[:, :-1] = occurrences
        u = uniforms(seeds, self._streams, counts[:, self._interval_index])
        drawn = np.empty_like(u)
        for distribution, which in self._groups.items():
            drawn[:, which] = DISTRIBUTIONS[distribution](
                u[:, which], self._first[which], self._second[which], self._cut[which]
            )
        for k, values in self._choices:
            drawn[:, k] = values[(u[:, k] * len(values)).astype(np.int64)]
        return drawn

    def _apply(self, values: Array, drawn: Array) -> None:
        start = 0
        for kind, entries in self._operations.items():
            columns = [entry.column for entry in entries]
            block = drawn[:, start : start + len(entries)]
            start += len(entries)
            if kind == "set":
                values[:, columns] = block
            else:
                operate = np.multiply if kind == "scale" else np.add
                operate.at(values.T, columns, block.T)
        np.clip(values, self._low, self._high, out=values)
        _make_inertias_physical(Parameters(values))

    def next_strike(self, episode_seeds: Seeds, occurrences: NDArray[np.int64], control_period: float) -> NDArray[np.int64]:
        """Return (M, len(intervals)) control ticks until each interval event strikes next."""
        u = uniforms(episode_seeds, self._interval_streams, occurrences)
        limits = np.array([self.config.events[name].interval for name in self.intervals], dtype=np.float64).reshape(-1, 2)
        return np.maximum(1, np.rint((limits[:, 0] + (limits[:, 1] - limits[:, 0]) * u) / control_period)).astype(np.int64)

    def state(self, parameters: Parameters, episode_seeds: Seeds) -> PlantState:
        """Return where M robots start: standing at home, spread by ``initial_state``; the height follows the legs."""
        state = standing_state(self.robot, parameters)
        if not self._spread.any():
            return state
        offsets = self._spread * (2.0 * uniforms(episode_seeds, self._spread_streams) - 1.0)
        home = state.joint_position[:, :4].copy()
        angles = np.clip(home + offsets[:, :4], *self.robot.leg_limits)
        state.position[:, 2] += (parameters["leg.length"] * (np.sin(angles) - np.sin(home))).mean(axis=1)
        state.joint_position[:, :4] = state.reference_position[:, :4] = angles
        state.quaternion[:, 0], state.quaternion[:, 3] = np.cos(0.5 * offsets[:, 4]), np.sin(0.5 * offsets[:, 4])
        state.linear_velocity_in_body[:], state.angular_velocity_in_body[:] = offsets[:, 5:8], offsets[:, 8:11]
        return state


def _entries(name: str, event: EventConfig, robot: Robot) -> list[_Entry]:
    where = f"randomization event '{name}'"
    if (event.when == "interval") != (event.interval is not None):
        raise InputError(f"{where}: 'interval: [low, high]' (s) goes with 'when: interval', and only with it")
    if event.interval is not None and not 0 < event.interval[0] <= event.interval[1]:
        raise InputError(f"{where}: interval = {list(event.interval)}: expected 0 < low <= high (s)")
    elements = [element for parameter in event.parameters for element in _elements(parameter)]
    return [_entry(name, event, robot, element, where) for element in elements]


def _elements(parameter: str) -> list[str]:
    spec = spec_of(parameter)
    return spec.elements if parameter == spec.name else [parameter]


def _entry(name: str, event: EventConfig, robot: Robot, element: str, where: str) -> _Entry:
    label = element.partition("[")[2].rstrip("]")
    draw = {"robot": "", "label": label, "element": element}[event.per]
    common: dict[str, Any] = {
        "event": name,
        "when": event.when,
        "column": ELEMENTS.index(element),
        "draw": draw,
        "cut": event.cut,
    }
    if event.distribution == "tolerance":
        return _tolerance_entry(event, robot, element, common)
    if event.operation is None:
        raise InputError(f"{where}: 'operation' is missing; expected set, scale or add")
    common |= {"operation": event.operation, "distribution": event.distribution}
    if event.distribution == "choice":
        if not event.values:
            raise InputError(f"{where}: distribution 'choice' needs 'values: [...]'")
        _refuse_out_of_bounds(event, element, event.values, where)
        return _Entry(first=0.0, second=0.0, values=event.values, **common)
    first, second = ("mean", "sigma") if event.distribution == "normal" else ("low", "high")
    numbers = []
    for field in (first, second):
        value = getattr(event, field)
        if value is None and field == "mean" and event.operation != "set":
            value = 1.0 if event.operation == "scale" else 0.0
        if value is None:
            raise InputError(f"{where}: distribution '{event.distribution}' needs '{field}'")
        numbers.append(number_of(value, robot, f"{where}: {field}"))
    if event.distribution == "normal" and numbers[1] < 0:
        raise InputError(f"{where}: sigma = {numbers[1]:g} is negative")
    if event.distribution != "normal" and numbers[0] > numbers[1]:
        raise InputError(f"{where}: low = {numbers[0]:g} is above high = {numbers[1]:g}")
    if event.distribution == "loguniform" and numbers[0] <= 0:
        raise InputError(f"{where}: low = {numbers[0]:g}: 'loguniform' needs low > 0")
    _refuse_out_of_bounds(event, element, numbers[:1] if event.distribution == "normal" else numbers, where)
    return _Entry(first=numbers[0], second=numbers[1], **common)


def _refuse_out_of_bounds(event: EventConfig, element: str, values: Sequence[float], where: str) -> None:
    """Only tails of a ``normal`` may be clipped: a range that clipping would change is not what was asked for."""
    spec, low, high = spec_of(element), min(values), max(values)
    if event.operation == "set" and not spec.low <= low <= high <= spec.high:
        raise InputError(
            f"{where}: sets {element} in [{low:g}, {high:g}], which is not within its bounds "
            f"[{spec.low:g}, {spec.high:g}] {spec.unit}"
        )


def _tolerance_entry(event: EventConfig, robot: Robot, element: str, common: dict[str, Any]) -> _Entry:
    """A quantity whose nominal value is its lower bound (no delay, no friction) can only be larger: half-normal."""
    operation, sigma = tolerance_of(robot, element)
    spec = spec_of(element)
    nominal = float(Parameters.nominal(robot)[element][0])
    distribution = "half_normal" if operation == "add" and nominal == spec.low else "normal"
    mean = 1.0 if operation == "scale" else 0.0
    return _Entry(operation=operation, distribution=distribution, first=mean, second=sigma * event.sigmas, **common)


def _refuse_double_set(entries: list[_Entry]) -> None:
    setters: dict[int, str] = {}
    for entry in entries:
        if entry.operation == "set" and setters.setdefault(entry.column, entry.event) != entry.event:
            raise InputError(
                f"randomization events '{setters[entry.column]}' and '{entry.event}' both set {ELEMENTS[entry.column]}; "
                "let one of them scale or add"
            )


def _table_bounds() -> tuple[Array, Array]:
    sizes = [spec.size for spec in TABLE]
    return np.repeat([spec.low for spec in TABLE], sizes), np.repeat([spec.high for spec in TABLE], sizes)


def _make_inertias_physical(parameters: Parameters) -> None:
    """Lower the largest principal inertia to what the triangle inequality allows a rigid body."""
    body = parameters["body.inertia"]
    legs = parameters["leg.inertia"].reshape(len(parameters), 4, 3)
    for inertia in (body, legs):
        others = inertia.sum(axis=-1, keepdims=True) - inertia
        np.minimum(inertia, others, out=inertia)
