"""Randomisation from a gap result: what was identified on a robot, with its uncertainty, as ordinary events.

A calibrated parameter is set to its fitted value. An effect is applied to the calibrated parameters, and what it does to
each element (set, scale or add) becomes an event of that operation: the effect's own definition decides. The spread is the
one the result states, ``ci95`` = +-1.96 sigma, or none.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wlr_gym.base.errors import InputError, unknown_name
from wlr_gym.base.settings import read_json
from wlr_gym.envs.tasks.entries import EventConfig
from wlr_gym.physics import effects
from wlr_gym.physics.codegen.expression import finite_number
from wlr_gym.robot import Robot
from wlr_gym.robot.parameter_table import ELEMENTS, SPECS, TABLE
from wlr_gym.robot.parameters import HIGH, Parameters

Array = NDArray[np.float64]

_TWO_SIDED_95 = 2 * 1.959964
#: Verdicts after which there are numbers to draw from.
_VERDICTS = ("nothing_missing", "effect_found", "unknown_effect")
#: The table holds one of each (and few patches): an identified one takes the place of a drawn one.
_REPLACED = ("payload.", "patch.", "servo.stribeck_", "servo.ripple_")


def identified_events(path: str | Path, robot: Robot) -> dict[str, EventConfig]:
    """Return the events of a gap result.

    Raises:
        InputError: unreadable file, a verdict without numbers, an unknown parameter or effect, an effect that is a formula, or
            a value that is not a number; the message names file and place.
    """
    result = _read(path)
    events: dict[str, EventConfig] = {}
    robot_as_found = Parameters.nominal(robot)
    for name, entry in _mapping(result.get("calibration") or {}, f"{path}: calibration").items():
        place = f"{path}: calibration.{name}"
        mean, low, high = _estimate(entry, "fitted", place)
        elements = _calibrated(name, place)
        events[f"calibrated {name}"] = _event(elements, "set", mean, (high - low) / _TWO_SIDED_95)
        for element in elements:
            robot_as_found[element] = mean
    for index, entry in enumerate(result.get("effects") or []):
        for number, event in enumerate(_effect_events(entry, robot_as_found, f"{path}: effect {index + 1}")):
            if event.operation == "set":
                events = _without(events, event.parameters)
            events[f"identified {entry['name']} {index + 1}.{number + 1}"] = event
            for element in event.parameters:
                if element.startswith(_REPLACED):
                    robot_as_found[element] = np.asarray(event.mean, np.float64)
    if not events:
        raise InputError(f"{path}: neither calibrated parameters nor effects: nothing to draw from")
    return events


def _without(events: Mapping[str, EventConfig], elements: tuple[str, ...]) -> dict[str, EventConfig]:
    """Events without what they set of some elements: what an effect sets, such as one wheel's friction, replaces it."""
    found = {}
    for name, event in events.items():
        kept = tuple(one for one in event.parameters if event.operation != "set" or one not in elements)
        if kept:
            found[name] = event.model_copy(update={"parameters": kept})
    return found


def _read(path: str | Path) -> Mapping[str, Any]:
    result = _mapping(read_json(path), str(path))
    if result.get("verdict") not in _VERDICTS:
        raise InputError(f"{path}: verdict = {result.get('verdict')!r}: expected {', '.join(_VERDICTS)}")
    return result


def _mapping(value: Any, place: str) -> Mapping[str, Any]:
    if not isinstance(value, Mapping):
        raise InputError(f"{place}: expected a mapping, got {type(value).__name__}")
    return value


def _estimate(entry: Any, key: str, place: str) -> tuple[float, float, float]:
    """Value and the ends of its interval; without an interval both ends are the value."""
    given: Any = _mapping(entry, place).get(key)
    interval: Any = entry.get("ci95")
    ends = [given, given] if interval is None else interval
    numbers = [given, *ends] if isinstance(ends, list) and len(ends) == 2 else []
    if not numbers or None in map(finite_number, numbers):
        raise InputError(f"{place}: {key} = {given!r}, ci95 = {interval!r}: expected a finite number and [low, high]")
    value, low, high = map(float, numbers)
    if not low <= value <= high:
        raise InputError(f"{place}: {key} = {value:g} is not within its ci95 [{low:g}, {high:g}]")
    return value, low, high


def _event(elements: tuple[str, ...], operation: Any, mean: float, sigma: float) -> EventConfig:
    return EventConfig(parameters=elements, distribution="normal", operation=operation, mean=mean, sigma=sigma)


def _calibrated(name: str, place: str) -> tuple[str, ...]:
    """Elements that a calibrated parameter stands for: of the table, or of one of the robot file's tolerances."""
    if name in ELEMENTS:
        return (name,)
    base, _, label = name.partition("[")
    specs = [spec for spec in TABLE if base in (spec.name, spec.tolerance)]
    found = tuple(element for spec in specs for element in spec.elements if not label or element.endswith(f"[{label}"))
    if not found:
        raise unknown_name("parameter", name, {*SPECS, *(spec.tolerance for spec in TABLE if spec.tolerance)}, place)
    return found


# ---- effects ----


def _effect_events(entry: Any, robot: Parameters, place: str) -> list[EventConfig]:
    name: Any = _mapping(entry, place).get("name")
    if name == "unknown_effect":
        raise InputError(f"{place}: a formula has no place in the parameter table: pass the result's patch as effects= instead")
    if name not in effects.EFFECTS:
        raise unknown_name("effect", str(name), effects.EFFECTS, place)
    given = _mapping(entry.get("parameters") or {}, f"{place}.parameters")
    estimates = {key: _estimate(value, "value", f"{place} ({name}).{key}") for key, value in given.items()}
    values = {key: value for key, (value, _, _) in estimates.items()}
    try:
        elements, operations, means = _action(name, entry.get("where"), values, robot)
    except InputError as error:
        raise InputError(f"{place}: {error}") from None
    variance = np.zeros(len(elements))
    for key, (_, low, high) in estimates.items():
        bounds = effects.EFFECTS[name].parameters[key]
        ends = [values | {key: min(max(end, bounds.low), bounds.high)} for end in (low, high)]
        first, last = (_numbers(name, entry.get("where"), end, robot, elements, operations) for end in ends)
        variance += ((last - first) / _TWO_SIDED_95) ** 2
    groups: dict[tuple[str, float, float], list[str]] = {}
    for element, operation, mean, sigma in zip(elements, operations, means, np.sqrt(variance), strict=True):
        groups.setdefault((operation, float(mean), float(sigma)), []).append(element)
    return [_event(tuple(group), *numbers) for numbers, group in groups.items()]


def _action(name: str, where: Any, values: Mapping[str, float], robot: Parameters) -> tuple[list[str], list[str], Array]:
    """What an effect changes, by which operation, and its numbers: seen by applying it to two different robots."""
    before = robot.values[0]
    other = np.minimum(np.where(before == 0.0, 1e-3, 1.1 * before), HIGH)
    replaced = np.array([element.startswith(_REPLACED) for element in ELEMENTS])
    other[replaced] = before[replaced]
    after, after_other = (_applied(name, where, values, start) for start in (before, other))
    changed = np.flatnonzero((after != before) | (after_other != other))
    elements = [ELEMENTS[column] for column in changed]
    operations = []
    for column in changed:
        x, y, fx, fy = before[column], other[column], after[column], after_other[column]
        if replaced[column] or math.isclose(fx, fy, rel_tol=1e-9, abs_tol=1e-12):
            operations.append("set")
        elif math.isclose(fx - x, fy - y, rel_tol=1e-6, abs_tol=1e-12):
            operations.append("add")
        else:
            operations.append("scale" if x != 0.0 and math.isclose(fx * y, fy * x, rel_tol=1e-9) else "set")
    return elements, operations, _numbers(name, where, values, robot, elements, operations)


def _numbers(
    name: str, where: Any, values: Mapping[str, float], robot: Parameters, elements: list[str], operations: list[str]
) -> Array:
    """By how much the effect sets, scales or adds to each element."""
    after = Parameters(_applied(name, where, values, robot.values[0])[None])
    pairs = [(float(robot[element][0]), float(after[element][0])) for element in elements]
    by_operation = {"set": lambda x, fx: fx, "add": lambda x, fx: fx - x, "scale": lambda x, fx: fx / x}
    return np.array([by_operation[operation](*pair) for operation, pair in zip(operations, pairs, strict=True)])


def _applied(name: str, where: Any, values: Mapping[str, float], start: Array) -> Array:
    entry = {"name": name, "parameters": dict(values)} | ({} if where is None else {"where": where})
    return effects.apply_patch(effects.load_patch([entry]), Parameters(start[None].copy())).values[0]
