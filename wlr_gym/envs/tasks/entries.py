"""Randomisation events as data, and what they come down to: one random number, distribution and operation per element."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, PositiveFloat

from wlr_gym.base.errors import InputError
from wlr_gym.base.random import stream_numbers, uniforms
from wlr_gym.base.settings import ORDERED, SettingsModel
from wlr_gym.robot import Robot
from wlr_gym.robot.parameter_table import ELEMENTS, SPECS, range_in_words, spec_of
from wlr_gym.robot.parameters import Parameters

Array = NDArray[np.float64]
Number = float | str
Interval = Annotated[tuple[PositiveFloat, PositiveFloat], ORDERED]
_END = SPECS["patch.x_max"].high
_Place = Annotated[float, Field(ge=-_END, le=_END)]
_Size = Annotated[float, Field(ge=0.0, le=_END)]
Edge = Annotated[tuple[_Place, _Place], ORDERED]
Size = Annotated[tuple[_Size, _Size], ORDERED]


#: Distribution -> the keys of an event that it reads.
DISTRIBUTION_KEYS = {
    "uniform": ("operation", "low", "high"),
    "loguniform": ("operation", "low", "high"),
    "normal": ("operation", "mean", "sigma", "cut"),
    "choice": ("operation", "values"),
    "tolerance": ("sigmas", "cut"),
}


class AreaConfig(SettingsModel):
    """Where the patches of an event lie: each edge and size is drawn evenly, for every patch on its own. Floor frame, m.

    Attributes:
        x_min, y_min: lower edges; left out = the floor's end.
        length, width: size along x and along y; left out = to the floor's end.
    """

    x_min: Edge | None = None
    length: Size | None = None
    y_min: Edge | None = None
    width: Size | None = None


class EventConfig(SettingsModel):
    """One randomisation event.

    Attributes:
        parameters: names or single elements of the parameter table.
        when: ``startup`` (once per seed), ``reset`` (each episode), ``interval`` (also within an episode, in steps) or
            ``drift`` (all the time: a smooth path through draws ``interval`` seconds apart).
        distribution: ``uniform`` or ``loguniform`` (low, high), ``normal`` (mean, sigma, cut), ``choice`` (values), or
            ``tolerance``: normal with the tolerance the robot's file states, times ``sigmas``, cut at ``cut`` of them.
        operation: ``set`` the value, ``scale`` or ``add`` to the nominal one; ``below_friction_limit`` sets a slope to the
            steepest one that the floor's drawn friction holds, atan(mu), less the value (rad), but not below 0.
        per: one draw per ``robot``, per ``label`` (joint, wheel, axis or patch; the same for all parameters listed), or
            ``element``.
        low, high, mean, sigma: numbers, or paths of numbers in the robot's file, such as ``sensors.imu.gyro_bias``.
        interval: s between draws, itself drawn evenly between the two: every time (``interval``), once per episode (``drift``).
        area: place and size of the patches whose ``patch.mu`` the event sets.
    """

    parameters: tuple[str, ...] = Field(min_length=1)
    when: Literal["startup", "reset", "interval", "drift"] = "reset"
    distribution: Literal["uniform", "loguniform", "normal", "choice", "tolerance"]
    operation: Literal["set", "scale", "add", "below_friction_limit"] | None = None
    per: Literal["robot", "label", "element"] = "robot"
    low: Number | None = None
    high: Number | None = None
    mean: Number | None = None
    sigma: Number | None = None
    sigmas: float = Field(default=1.0, gt=0)
    cut: float = Field(default=3.0, gt=0)
    values: tuple[float, ...] | None = None
    interval: Interval | None = None
    area: AreaConfig | None = None


@dataclass(frozen=True)
class Entry:
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


class Sampler:
    """Draws the values of many entries for many robots at once."""

    def __init__(self, entries: Sequence[Entry]) -> None:
        self._streams = stream_numbers(*(f"event/{entry.event}/{entry.draw}" for entry in entries))
        self._first, self._second, self._cut = (np.array([getattr(e, f) for e in entries]) for f in ("first", "second", "cut"))
        self._choices = [(k, np.array(e.values)) for k, e in enumerate(entries) if e.distribution == "choice"]
        names = [entry.distribution for entry in entries]
        self._groups = {
            name: np.flatnonzero([n == name for n in names]) for name in dict.fromkeys(names) if name in DISTRIBUTIONS
        }

    def __call__(self, seeds: NDArray[np.uint64], counters: NDArray[np.int64], spread: Array) -> Array:
        """Return values (M, K) for seeds and counters of that shape, K entries.

        ``spread`` (M,) below 1 moves every draw of a robot towards the middle of its distribution.
        """
        u = 0.5 + spread[:, None] * (uniforms(seeds, self._streams, counters) - 0.5)  # with 1 exact
        drawn = np.empty_like(u)
        for distribution, which in self._groups.items():
            drawn[:, which] = DISTRIBUTIONS[distribution](
                u[:, which], self._first[which], self._second[which], self._cut[which]
            )
        for k, values in self._choices:
            drawn[:, k] = values[(u[:, k] * len(values)).astype(np.int64)]
        return drawn


def entries_of(name: str, event: EventConfig, robot: Robot, source: str = "randomization") -> list[Entry]:
    """Return what an event comes down to; errors name ``source``, the file it stands in.

    Raises:
        InputError: unknown parameter, missing or impossible number, or a range to ``set`` that is not within the bounds.
    """
    where = f"{source}: event '{name}'"
    if (event.when in ("interval", "drift")) != (event.interval is not None):
        raise InputError(
            f"{where}: 'interval: [low, high]' (s) goes with 'when: interval' or 'when: drift', and only with them"
        )
    try:
        elements = elements_of(event)
    except InputError as error:
        raise InputError(f"{where}: {error}") from None
    for element in elements:
        if elements.count(element) > 1:
            raise InputError(f"{where}: parameters = {list(event.parameters)}: {element} occurs twice, expected each once")
    entries = [_entry(name, event, robot, element, where) for element in elements]
    if event.operation == "below_friction_limit" and len(elements) > 1:
        raise InputError(
            f"{where}: operation 'below_friction_limit' sets one slope, got {', '.join(elements)}: together they would be "
            f"steeper than friction holds"
        )
    return entries + ([] if event.area is None else _area_entries(name, event, event.area, elements, where))


def elements_of(event: EventConfig) -> list[str]:
    """Return the elements of the parameter table that ``event.parameters`` names, without those of its area."""
    found = []
    for parameter in event.parameters:
        spec = spec_of(parameter)
        found += spec.elements if parameter == spec.name else [parameter]
    return found


def label_of(element: str) -> str:
    """Return the joint, wheel, axis or patch of an element; empty for a scalar."""
    return element.partition("[")[2].rstrip("]")


def _entry(name: str, event: EventConfig, robot: Robot, element: str, where: str) -> Entry:
    draw = {"robot": "", "label": label_of(element), "element": element}[event.per]
    common: dict[str, Any] = {
        "event": name,
        "when": event.when,
        "column": ELEMENTS.index(element),
        "draw": draw,
        "cut": event.cut,
    }
    if event.distribution == "tolerance":
        return _tolerance_entry(event, robot, element, common, where)
    if event.operation is None:
        raise InputError(f"{where}: 'operation' is missing; expected set, scale or add")
    if event.operation == "below_friction_limit" and spec_of(element).name != "ground.slope":
        raise InputError(f"{where}: operation 'below_friction_limit' goes with 'ground.slope' only, not with '{element}'")
    common |= {"operation": event.operation, "distribution": event.distribution}
    if event.distribution == "choice":
        if not event.values:
            raise InputError(f"{where}: distribution 'choice' needs 'values: [...]'")
        _refuse_out_of_bounds(event, element, event.values, where)
        return Entry(first=0.0, second=0.0, values=event.values, **common)
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
    return Entry(first=numbers[0], second=numbers[1], **common)


def _refuse_out_of_bounds(event: EventConfig, element: str, values: Sequence[float], where: str) -> None:
    """Only tails of a ``normal`` may be clipped: a range that clipping would change is not what was asked for."""
    spec, low, high = spec_of(element), min(values), max(values)
    if event.operation == "set" and not spec.low <= low <= high <= spec.high:
        raise InputError(
            f"{where}: sets {element} in [{low:g}, {high:g}], which is not within its bounds "
            f"{range_in_words(spec.low, spec.high, spec.unit)}"
        )


def _tolerance_entry(event: EventConfig, robot: Robot, element: str, common: dict[str, Any], where: str) -> Entry:
    """A quantity whose nominal value is its lower bound (no delay, no friction) can only be larger: half-normal."""
    try:
        operation, sigma = tolerance_of(robot, element)
    except InputError as error:
        raise InputError(f"{where}: {error}") from None
    spec = spec_of(element)
    nominal = float(Parameters.nominal(robot)[element][0])
    distribution = "half_normal" if operation == "add" and nominal == spec.low else "normal"
    mean = 1.0 if operation == "scale" else 0.0
    return Entry(operation=operation, distribution=distribution, first=mean, second=sigma * event.sigmas, **common)


# ---- areas ----


def _area_entries(name: str, event: EventConfig, area: AreaConfig, elements: Sequence[str], where: str) -> list[Entry]:
    """An area is ranges for the edges of its patches: upper edge = the same draw as the lower one, plus a size."""
    if any(spec_of(element).name != "patch.mu" for element in elements):
        raise InputError(f"{where}: 'area' goes with 'patch.mu' only, not with {', '.join(event.parameters)}")
    entries = []
    for patch in map(label_of, elements):
        for axis, size in (("x", "length"), ("y", "width")):
            edge, extent = getattr(area, f"{axis}_min"), getattr(area, size)
            if extent and edge is None:
                raise InputError(f"{where}: area.{size} = {list(extent)}: expected '{axis}_min' too")

            def entry(element: str, operation: str, draw: str, limits: tuple[float, float], patch: str = patch) -> Entry:
                column = ELEMENTS.index(f"{element}[{patch}]")
                return Entry(name, event.when, operation, column, f"area/{draw}/{patch}", "uniform", *limits, cut=event.cut)

            low, high = f"patch.{axis}_min", f"patch.{axis}_max"
            ends = SPECS[low].low, SPECS[high].high
            entries.append(entry(low, "set", low, edge or (ends[0], ends[0])))
            entries.append(entry(high, "set", low, edge if edge and extent else (ends[1], ends[1])))
            if extent:
                entries.append(entry(high, "add", size, extent))
    return entries


# ---- distributions and tolerances that events draw from: quantile functions of one uniform number --------------------


def uniform(u: Array, low: Array, high: Array, cut: Array) -> Array:
    """Evenly spread between ``low`` and ``high``."""
    return low + (high - low) * u


def loguniform(u: Array, low: Array, high: Array, cut: Array) -> Array:
    """Evenly spread in the logarithm between ``low`` and ``high`` (both positive)."""
    return low * (high / low) ** u


def normal(u: Array, mean: Array, sigma: Array, cut: Array) -> Array:
    """Normal with ``mean`` and ``sigma``, cut off ``cut`` sigmas from the mean (the rest is renormalised)."""
    from scipy.special import ndtr, ndtri

    tail = ndtr(-cut)
    return mean + sigma * ndtri(tail + (1.0 - 2.0 * tail) * u)


def half_normal(u: Array, mean: Array, sigma: Array, cut: Array) -> Array:
    """Normal folded at its mean: never below it."""
    return mean + np.abs(normal(u, np.zeros_like(mean), sigma, cut))


#: Distribution -> quantile function of (u, first parameter, second parameter, cut).
DISTRIBUTIONS: dict[str, Callable[[Array, Array, Array, Array], Array]] = {
    "uniform": uniform,
    "loguniform": loguniform,
    "normal": normal,
    "half_normal": half_normal,
}


def tolerance_of(robot: Robot, element: str) -> tuple[str, float]:
    """Return how well the robot file says an element is known: operation (``scale`` or ``add``) and 1 sigma."""
    spec = spec_of(element)
    stated = robot.tolerances.get(spec.tolerance)
    if stated is None:
        raise InputError(
            f"robot '{robot.name}' states no tolerance for parameter '{spec.name}'; known: {', '.join(robot.tolerances)}"
        )
    return "scale" if stated.unit is None else "add", stated.of(element)


def number_of(value: float | str, robot: Robot, where: str) -> float:
    """Return a number given as such or as a dotted path into the robot's file (``sensors.imu.gyro_bias``)."""
    if not isinstance(value, str):
        return float(value)
    found: Any = robot
    for part in value.split("."):
        found = getattr(found, part, None)
    if not isinstance(found, (int, float)):
        raise InputError(f"{where} = {value!r}: neither a number nor the path of a number in robot '{robot.name}'")
    return float(found)
