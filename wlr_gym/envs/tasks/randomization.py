"""Randomisation as data: which parameters, when, from which distribution, by which operation.

Every draw is a pure function of (seed, name of the event, what it is drawn for): an event more or less shifts no other, and
a robot gets the same values alone or in a batch.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from wlr_gym.base.errors import InputError, nearest
from wlr_gym.base.paths import named_in
from wlr_gym.base.random import stream_numbers, uniforms
from wlr_gym.base.settings import Layer, SettingsModel, layers_of, overlay, parse_config, read_config
from wlr_gym.envs.tasks.entries import DISTRIBUTION_KEYS, Entry, EventConfig, Sampler, elements_of, entries_of
from wlr_gym.envs.tasks.identified import identified_events
from wlr_gym.physics.plants.base import PlantState, settle, standing_state
from wlr_gym.robot import LEG_SLICE, LEGS, Robot
from wlr_gym.robot.parameter_table import ELEMENTS, XYZ
from wlr_gym.robot.parameters import HIGH, LOW, Parameters

Array = NDArray[np.float64]
Counts = NDArray[np.int64]
Seeds = NDArray[np.uint64]

#: Operation that sets a slope by the floor's friction, once that is drawn.
BELOW_LIMIT = "below_friction_limit"
#: s between the updates of a drifting parameter.
DRIFT_PERIOD = 0.2


class InitialStateConfig(SettingsModel):
    """Half-widths of the even spread around standing still at home: rad, rad, m/s, rad/s (body frame)."""

    leg_angle: float = Field(default=0.0, ge=0, le=math.tau)
    yaw: float = Field(default=0.0, ge=0, le=math.tau)
    linear_velocity: float = Field(default=0.0, ge=0, le=10.0)
    angular_velocity: float = Field(default=0.0, ge=0, le=100.0)


class RandomizationConfig(SettingsModel):
    """Contents of ``configs/randomization/*.yaml``.

    Attributes:
        base: name or path of the randomisation that this one is laid over, key by key; a key that is null is removed.
        result: path of a gap result (``result.json``) between this and ``base`` (then ``nominal`` unless named): what was
            identified replaces what ``base`` sets. Both paths are looked for beside this file first.
        sensor_noise: False switches off the sensors' noise and quantisation, and the task's observation noise and bias.
        latency: False fixes every latency in the middle of its range.
        initial_state: spread of the state an episode starts from.
        events: name -> event.
    """

    name: str = "custom"
    base: str | None = None
    result: str | None = None
    sensor_noise: bool = True
    latency: bool = True
    initial_state: InitialStateConfig = InitialStateConfig()
    events: dict[str, EventConfig] = Field(default_factory=dict)


def load_randomization(source: str | Path | Mapping[str, Any] | RandomizationConfig | None, robot: Robot) -> Randomization:
    """Load randomisation by config name, path, mapping (same keys as the file) or None (= ``none``).

    The path of a gap result (``.json``) stands for ``{"result": path}``.

    Raises:
        InputError: unknown key, parameter or element (with the nearest valid name), missing or impossible number, a range
            to ``set`` that is not within the parameter's bounds, or a result that says nothing to draw from.
    """
    if isinstance(source, RandomizationConfig):
        source = source.model_dump(mode="json", exclude_unset=True)
    layers = layers_of("randomization", _read("randomization", source), _read)
    data, places = _laid_over({}, layers[0], robot)
    for above, below in zip(layers[1:], layers, strict=False):
        parse_config(RandomizationConfig, data, below[1])  # what is wrong in a base is said with its own name
        data, added = _laid_over(data, above, robot)
        places |= added
    return Randomization(parse_config(RandomizationConfig, data, layers[-1][1]), robot, places)


def _read(kind: str, source: str | Path | Mapping[str, Any] | None) -> Layer:
    """Return what ``source`` says, and where it stands; a gap result lies over ``nominal`` unless it has another base."""
    if isinstance(source, Mapping):
        data, where = dict(source), kind
    elif source is not None and Path(source).suffix == ".json":
        data, where = {"name": Path(source).stem, "result": str(source)}, str(source)
    else:
        data, where = read_config(kind, "none" if source is None else source)
    if isinstance(data, dict) and data.get("result") is not None:
        data = {"base": "nominal", **data}
    return data, where


def _laid_over(lower: Any, layer: Layer, robot: Robot) -> tuple[Any, dict[str, str]]:
    """Return a layer and the events of its result, laid over ``lower``, complete by itself, and where each event stands."""
    data, where = layer
    if not isinstance(data, dict):
        return data, {}
    places: dict[str, str] = {}
    result = data.get("result")
    if result is not None:
        events = parse_config(RandomizationConfig, lower, where).events
        place = named_in(where, result)
        found = identified_events(place, robot)
        lower = {**lower, "events": _with_result(events, found, robot)}
        places = dict.fromkeys(found, str(place))
    own = {key: value for key, value in data.items() if key != "result"}
    merged = overlay(lower, own) if lower else own
    events = _mapping(merged.get("events"))
    _refuse_idle_keys(_mapping(own.get("events")), events, _mapping(_mapping(lower).get("events")), where)
    if events:
        merged = merged | {"events": {name: _without_idle_keys(event) for name, event in events.items()}}
    return merged, places | dict.fromkeys(_mapping(own.get("events")), where)


def _refuse_idle_keys(own: Mapping[str, Any], merged: Mapping[str, Any], below: Mapping[str, Any], where: str) -> None:
    """Refuse what changes nothing: to remove an event that is not there, to set a key that its distribution does not read."""
    for name, event in own.items():
        if event is None and name not in below:
            raise InputError(f"{where}: events.{name} = null removes nothing: no such event{nearest(name, below)}")
        given = [key for key, value in _mapping(event).items() if value not in (None, _default(key))]
        idle = [key for key in given if key in _idle_keys(merged[name])]
        if idle:
            distribution = merged[name]["distribution"]
            takes = ", ".join(DISTRIBUTION_KEYS[distribution])
            raise InputError(f"{where}: events.{name}: '{idle[0]}' does not go with '{distribution}', which takes {takes}")


def _default(key: str) -> Any:
    """A complete config, written with the defaults of its events, can be read again."""
    return EventConfig.model_fields[key].default if key in EventConfig.model_fields else None


def _without_idle_keys(event: Any) -> Any:
    """What is left of a base's event of another distribution goes."""
    return {key: value for key, value in event.items() if key not in _idle_keys(event)} if isinstance(event, Mapping) else event


def _idle_keys(event: Any) -> set[str]:
    takes = DISTRIBUTION_KEYS.get(str(_mapping(event).get("distribution")))
    return set() if takes is None else {key for keys in DISTRIBUTION_KEYS.values() for key in keys} - set(takes)


def _mapping(value: Any) -> Mapping[str, Any]:
    return value if isinstance(value, Mapping) else {}


def _with_result(events: Mapping[str, EventConfig], found: Mapping[str, EventConfig], robot: Robot) -> dict[str, Any]:
    """Lay identified events over others: an element that they set is theirs alone."""
    taken = {element for event in found.values() if event.operation == "set" for element in elements_of(event)}
    merged: dict[str, Any] = {}
    for name, event in events.items():
        kept = [element for element in elements_of(event) if element not in taken]
        if kept:
            merged[name] = event.model_dump(mode="json", exclude_unset=True) | {"parameters": kept}
    return merged | {name: event.model_dump(mode="json", exclude_unset=True) for name, event in found.items()}


class Randomization:
    """Draws parameters and initial states of robots.

    Args:
        config: events and the rest, complete.
        robot: whose numbers they change.
        places: event -> file it stands in, for messages.

    Attributes:
        config: the data, complete: laid over its base.
        elements, columns: elements of the parameter table that it changes, and their columns.
        events: element -> name of an event that changes it.
        timed_elements, timed_columns: those that also change within an episode.
        intervals: names of the events that strike within an episode. drifts: of those that drift.
    """

    def __init__(self, config: RandomizationConfig, robot: Robot, places: Mapping[str, str] | None = None) -> None:
        self.config = config
        self.robot = robot
        self._nominal = Parameters.nominal(robot, 1)
        self._nominal.validate()
        places = dict.fromkeys(config.events, "randomization") | dict(places or {})
        entries = [entry for name, event in config.events.items() for entry in entries_of(name, event, robot, places[name])]
        _refuse_double_set(entries, places)
        _refuse_no_area(entries, places)
        self._operations = {kind: [e for e in entries if e.operation == kind] for kind in ("set", "scale", "add", BELOW_LIMIT)}
        entries = [entry for kind in self._operations.values() for entry in kind]
        self._sampler = Sampler(entries) if entries else None
        self.intervals, self.drifts = (
            tuple(name for name, event in config.events.items() if event.when == when) for when in ("interval", "drift")
        )
        self.columns, self.elements = _columns(entries)
        self.events: dict[str, str] = {ELEMENTS[entry.column]: entry.event for entry in entries}
        self.timed_columns, self.timed_elements = _columns([e for e in entries if e.when in ("interval", "drift")])
        self._at_startup = np.array([entry.when == "startup" for entry in entries], dtype=bool)
        clocks = (*self.intervals, *self.drifts)
        self._clock = np.array([clocks.index(e.event) if e.event in clocks else len(clocks) for e in entries], dtype=np.int64)
        self._drifting = np.flatnonzero([entry.when == "drift" for entry in entries])
        self._drift_sampler = Sampler([entries[k] for k in self._drifting]) if self.drifts else None
        self._interval_streams = stream_numbers(*(f"interval/{name}" for name in self.intervals))
        self._interval_limits = _limits(config, self.intervals)
        self._drift_streams = stream_numbers(*(f"drift/{name}" for name in self.drifts))
        self._drift_limits = _limits(config, self.drifts)
        start = config.initial_state
        widths = {"leg_angle": (start.leg_angle, LEGS), "yaw": (start.yaw, ("z",))}
        widths |= {"linear_velocity": (start.linear_velocity, XYZ), "angular_velocity": (start.angular_velocity, XYZ)}
        self._state_width = np.array([width for width, labels in widths.values() for _ in labels])
        self._state_streams = stream_numbers(
            *(f"initial_state/{n}/{label}" for n, (_, labels) in widths.items() for label in labels)
        )

    def parameters(
        self,
        robot_seeds: Seeds,
        episode_seeds: Seeds,
        occurrences: Counts | None = None,
        time: Array | None = None,
        spread: Array | None = None,
    ) -> Parameters:
        """Return the parameters of M robots.

        Args:
            robot_seeds: (M,) what ``startup`` events draw from.
            episode_seeds: (M,) what all others draw from.
            occurrences: (M, len(intervals)) how often each interval event has struck in this episode; None = never.
            time: (M,) s since the episode began, for what drifts; None = 0.
            spread: (M,) share of every distribution about its middle that is drawn from, below 1 early in a curriculum;
                None = 1.
        """
        count, strikes = len(episode_seeds), len(self.intervals)
        values = np.repeat(self._nominal.values, count, axis=0)
        if self._sampler is None:
            return Parameters(values)
        seeds = np.where(self._at_startup, robot_seeds[:, None], episode_seeds[:, None])
        counts = np.zeros((count, strikes + len(self.drifts) + 1), dtype=np.int64)
        if occurrences is not None:
            counts[:, :strikes] = occurrences
        low, high = self._drift_limits.T
        passed = np.zeros((count, 1)) if time is None else time[:, None]
        knots = passed / (low + (high - low) * uniforms(episode_seeds, self._drift_streams))  # of each drifting event
        counts[:, strikes:-1] = np.floor(knots)
        spread = np.ones(count) if spread is None else spread
        drawn = self._sampler(seeds, counts[:, self._clock], spread)
        if self._drift_sampler is not None:
            clock = self._clock[self._drifting]
            following = self._drift_sampler(seeds[:, self._drifting], counts[:, clock] + 1, spread)
            share = (knots - np.floor(knots))[:, clock - strikes]
            share = share * share * (3.0 - 2.0 * share)  # rises smoothly from 0 to 1: the path has no kinks at its knots
            drawn[:, self._drifting] += share * (following - drawn[:, self._drifting])
        self._apply(values, drawn)
        return Parameters(values)

    def _apply(self, values: Array, drawn: Array) -> None:
        start = 0
        for kind, entries in self._operations.items():
            columns = [entry.column for entry in entries]
            block = drawn[:, start : start + len(entries)]
            start += len(entries)
            if kind == "set":
                values[:, columns] = block
            elif kind == BELOW_LIMIT:
                if entries:
                    values[:, columns] = np.maximum(_friction_limit(values)[:, None] - block, 0.0)
            else:
                operate = np.multiply if kind == "scale" else np.add
                operate.at(values.T, columns, block.T)
        np.clip(values, LOW, HIGH, out=values)
        _make_inertias_physical(Parameters(values))

    def next_strike(self, episode_seeds: Seeds, occurrences: Counts, control_period: float) -> Counts:
        """Return (M, len(intervals)) control steps until each interval event strikes next."""
        low, high = self._interval_limits.T
        wait = low + (high - low) * uniforms(episode_seeds, self._interval_streams, occurrences)
        return np.maximum(1, np.rint(wait / control_period)).astype(np.int64)

    def state(self, parameters: Parameters, episode_seeds: Seeds, spread: float = 1.0) -> PlantState:
        """Return where M robots start: standing at home, by ``spread`` times ``initial_state`` about it; the height follows the
        legs."""
        state = standing_state(self.robot, parameters)
        if not self._state_width.any():
            return state
        offsets = spread * self._state_width * (2.0 * uniforms(episode_seeds, self._state_streams) - 1.0)
        home = state.joint_position[:, LEG_SLICE].copy()
        angles = np.clip(home + offsets[:, LEG_SLICE], *self.robot.leg_limits)
        state.position[:, 2] += (parameters["leg.length"] * (np.sin(angles) - np.sin(home))).mean(axis=1)
        state.joint_position[:, LEG_SLICE] = state.reference_position[:, LEG_SLICE] = angles
        state.quaternion[:, 0], state.quaternion[:, 3] = np.cos(0.5 * offsets[:, 4]), np.sin(0.5 * offsets[:, 4])
        state.linear_velocity_in_body[:], state.angular_velocity_in_body[:] = offsets[:, 5:8], offsets[:, 8:11]
        settle(self.robot, parameters, state)
        return state


def _friction_limit(values: Array) -> Array:
    """Return the slope (M,) in rad that the mean friction along the wheels' headings just holds."""
    robots = Parameters(values)
    return np.arctan((robots["ground.mu_x"] * robots["wheel.grip"]).mean(axis=1))


def _columns(entries: Sequence[Entry]) -> tuple[NDArray[np.int64], tuple[str, ...]]:
    columns = np.unique([entry.column for entry in entries]).astype(np.int64)
    return columns, tuple(ELEMENTS[column] for column in columns)


def _limits(config: RandomizationConfig, events: Sequence[str]) -> Array:
    return np.array([config.events[name].interval for name in events], dtype=np.float64).reshape(-1, 2)


def _refuse_double_set(entries: Sequence[Entry], places: Mapping[str, str]) -> None:
    setters: dict[int, str] = {}
    for entry in entries:
        if entry.operation in ("set", BELOW_LIMIT) and setters.setdefault(entry.column, entry.event) != entry.event:
            other = setters[entry.column]
            where = " over ".join(dict.fromkeys([places[entry.event], places[other]]))
            raise InputError(
                f"{where}: events '{other}' and '{entry.event}' both set {ELEMENTS[entry.column]}; let one of them scale or add"
            )


def _refuse_no_area(entries: Sequence[Entry], places: Mapping[str, str]) -> None:
    """Refuse the friction of patches that no event gives a place: there would be none. Scaling takes those there are."""
    _, changed = _columns(entries)
    frictions = {entry: ELEMENTS[entry.column] for entry in entries if ELEMENTS[entry.column].startswith("patch.mu[")}
    lying = [entry for entry, element in frictions.items() if element.replace("mu", "x_max") in changed]
    some = {entry.event for entry in lying}
    for entry, element in frictions.items():
        if entry not in lying and (entry.operation == "set" or entry.event not in some):
            raise InputError(
                f"{places[entry.event]}: event '{entry.event}': no event says where {element} lies: expected 'area', "
                "such as {x_min: [0.3, 1.0], length: [0.3, 0.6]}, or {} for the whole floor"
            )


def _make_inertias_physical(parameters: Parameters) -> None:
    """Lower the largest principal inertia to what the triangle inequality allows a rigid body."""
    body = parameters["body.inertia"]
    legs = parameters["leg.inertia"].reshape(len(parameters), 4, 3)
    for inertia in (body, legs):
        others = inertia.sum(axis=-1, keepdims=True) - inertia
        np.minimum(inertia, others, out=inertia)
