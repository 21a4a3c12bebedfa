"""Recordings of one servo swinging a pendulum: the JSON files of the BAM test bench, decoded.

Format: github.com/Rhoban/bam. One file per run: ``mass`` (kg), ``length`` (m), ``kp`` (register), ``vin`` (V), ``motor``,
``trajectory``, optional ``arm_mass`` (kg), and ``entries``, one per reading. Angles are 0 where the pendulum hangs.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wlr_gym.base.errors import InputError, nearest

Array = NDArray[np.float64]

#: Key of an entry -> unit.
ENTRY_UNITS: Mapping[str, str] = {
    "timestamp": "s",
    "position": "rad",
    "speed": "rad/s",
    "load": "PWM counts",
    "input_volts": "V",
    "temp": "deg C",
    "goal_position": "rad",
    "torque_enable": "-",
}
#: What a file says about the whole run, apart from its entries.
HEADER = ("mass", "length", "kp", "vin")
#: PWM counts at full duty of the servo's present-PWM register.
FULL_DUTY = 885
#: A run shorter than this (rows) holds nothing to fit.
LEAST_ROWS = 50


@dataclass(frozen=True, eq=False)
class Recording:
    """One run of the test rig.

    Attributes:
        name: of its file, without ending.
        trajectory: what was commanded.
        mass, length: of the load, kg and m from the axis; ``arm_mass``: of the arm, kg, None where the file is silent.
        gain: Position P Gain register.
        nominal_voltage: V, as the file's header says.
        time: s from the run's start, strictly increasing.
        angle: rad; 0 = hanging.
        speed: rad/s, the servo's own estimate.
        duty: -1..1, decoded from ``load``.
        raw_load: the register as recorded.
        supply: V.
        temperature: deg C.
        goal: rad, written just before its row was read.
        enabled: torque on.
    """

    name: str
    trajectory: str
    mass: float
    length: float
    arm_mass: float | None
    gain: float
    nominal_voltage: float
    time: Array
    angle: Array
    speed: Array
    duty: Array
    raw_load: Array
    supply: Array
    temperature: Array
    goal: Array
    enabled: NDArray[np.bool_]


def decode_load(raw: Array) -> Array:
    """Return the duty (-1..1) behind the PWM register: a signed 16-bit number that was recorded as an unsigned one."""
    return np.where(raw > 32767, raw - 65536, raw) / FULL_DUTY


def read_recordings(folder: str | Path) -> list[Recording]:
    """Read every ``*.json`` of a folder, in the order of their names.

    Raises:
        InputError: no folder, no such files, or one that is not such a recording.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise InputError(f"{folder}: no such folder: expected one of JSON recordings of the test rig")
    paths = sorted(folder.glob("*.json"))
    if not paths:
        raise InputError(f"{folder}: holds no *.json: expected recordings of the test rig, one file per run")
    return [read_recording(path) for path in paths]


def read_recording(path: str | Path) -> Recording:
    """Read one file.

    Raises:
        InputError: it cannot be read, a key is missing, a value is not a finite number, or time does not run forward.
    """
    path = Path(path)
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, json.JSONDecodeError) as error:
        raise InputError(f"{path}: cannot be read as JSON: {error}") from None
    if not isinstance(content, dict) or not isinstance(content.get("entries"), list):
        raise InputError(f"{path}: expected a mapping with a list 'entries', one mapping per reading")
    columns = _columns(path, content["entries"])
    header = {key: _positive(path, content, key) for key in HEADER}
    return Recording(
        name=path.stem,
        trajectory=str(content.get("trajectory", "unknown")),
        mass=header["mass"],
        length=header["length"],
        arm_mass=_positive(path, content, "arm_mass") if content.get("arm_mass") is not None else None,
        gain=header["kp"],
        nominal_voltage=header["vin"],
        time=columns["timestamp"],
        angle=columns["position"],
        speed=columns["speed"],
        duty=decode_load(columns["load"]),
        raw_load=columns["load"],
        supply=columns["input_volts"],
        temperature=columns["temp"],
        goal=columns["goal_position"],
        enabled=columns["torque_enable"] > 0.5,
    )


def _columns(path: Path, entries: list[Any]) -> dict[str, Array]:
    if len(entries) < LEAST_ROWS:
        raise InputError(f"{path}: {len(entries)} entries; a run needs {LEAST_ROWS} or more")
    columns = {key: _column(path, entries, key) for key in ENTRY_UNITS}
    time = columns["timestamp"]
    if (np.diff(time) <= 0).any():
        row = int(np.argmax(np.diff(time) <= 0)) + 1
        raise InputError(f"{path}: entry {row}: timestamp {time[row]:g} s is not after {time[row - 1]:g} s")
    if (columns["input_volts"] <= 0).any():
        row = int(np.argmax(columns["input_volts"] <= 0))
        raise InputError(f"{path}: entry {row}: input_volts {columns['input_volts'][row]:g} V; expected a supply above 0 V")
    return columns


def _column(path: Path, entries: list[Any], key: str) -> Array:
    values = np.empty(len(entries))
    for row, entry in enumerate(entries):
        if not isinstance(entry, dict):
            raise InputError(f"{path}: entry {row} is {entry!r}: expected a mapping of {', '.join(ENTRY_UNITS)}")
        if key not in entry:
            raise InputError(f"{path}: entry {row} has no '{key}'{nearest(key, entry)} ({ENTRY_UNITS[key]})")
        values[row] = _number(path, f"entry {row}: {key}", entry[key], ENTRY_UNITS[key])
    return values


def _positive(path: Path, content: Mapping[str, Any], key: str) -> float:
    if key not in content:
        raise InputError(f"{path}: has no '{key}'{nearest(key, content)}")
    value = _number(path, key, content[key], "positive")
    if value <= 0:
        raise InputError(f"{path}: {key} {value:g}: expected a positive number")
    return value


def _number(path: Path, what: str, value: Any, unit: str) -> float:
    if not isinstance(value, int | float) or not np.isfinite(value):
        raise InputError(f"{path}: {what} is {value!r}: expected a finite number ({unit})")
    return float(value)
