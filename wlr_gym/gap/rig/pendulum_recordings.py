"""Recordings of one servo swinging a pendulum: the JSON files of the BAM test bench, decoded, and what is odd about them.

Format: github.com/Rhoban/bam. One file per run: ``mass`` (kg), ``length`` (m), ``kp`` (register), ``trajectory``, and
``entries``, one per reading; what else there is is not read. Angles are 0 where the pendulum hangs.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wlr_gym.base.errors import InputError, check_folder, check_number, nearest
from wlr_gym.base.settings import read_json
from wlr_gym.gap.analysis import IntakeFinding
from wlr_gym.gap.rig.problem import smoothed_state

Array = NDArray[np.float64]

#: Key of an entry -> unit.
ENTRY_UNITS: Mapping[str, str] = {
    "timestamp": "s",
    "position": "rad",
    "speed": "rad/s",
    "input_volts": "V",
    "temp": "deg C",
    "goal_position": "rad",
    "torque_enable": "-",
}
#: What a file says about the whole run, apart from its entries -> unit; all above 0.
HEADER_UNITS: Mapping[str, str] = {"mass": "kg", "length": "m", "kp": ""}
#: PWM counts at full duty of the servo's present-PWM register.
FULL_DUTY = 885
#: Duty per rad and unit of the Position P Gain register: counts of 2 pi/4096, /256 to PWM counts (the data confirm it).
DUTY_PER_GAIN = 4096 / (2 * math.pi) / (256 * FULL_DUTY)
#: A run shorter than this (rows) holds nothing to fit.
LEAST_ROWS = 50
_LONGEST_PERIOD = 0.5  # s between rows: more is in another unit
_GAP = 3.0  # usual periods
_SPEED_SLOPE = (0.5, 2.0)  # reported speed over change of position
_LEAST_RATE = 0.2  # rad/s, scatter of a joint whose speed can be compared
_MOVED = 0.02  # rad: a run in which the joint moves less shows nothing


@dataclass(frozen=True, eq=False)
class Recording:
    """One run of the test rig.

    Attributes:
        name: of its file, without ending.
        trajectory: what was commanded.
        mass, length: of the load, kg and m from the axis.
        gain: Position P Gain register.
        t: s from the run's start, strictly increasing.
        angle: rad; 0 = hanging.
        speed: rad/s, the servo's own estimate.
        supply: V.
        temperature: deg C.
        goal: rad, written just before its row was read.
        enabled: torque on.
    """

    name: str
    trajectory: str
    mass: float
    length: float
    gain: float
    t: Array
    angle: Array
    speed: Array
    supply: Array
    temperature: Array
    goal: Array
    enabled: NDArray[np.bool_]

    @property
    def measured(self) -> Array:
        """What a replay is compared with (rows, 1): the angle."""
        return self.angle[:, None]


def read_recordings(folder: str | Path) -> list[Recording]:
    """Read every ``*.json`` of a folder, in the order of their names.

    Raises:
        InputError: no folder, no such files, or one that is not such a recording.
    """
    folder = Path(folder)
    check_folder(folder)
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
    content = read_json(path)
    entries = content.get("entries") if isinstance(content, dict) else None
    if not isinstance(entries, list) or not all(isinstance(entry, dict) for entry in entries):
        raise InputError(f"{path}: expected a mapping with a list 'entries', one mapping per reading")
    if len(entries) < LEAST_ROWS:
        raise InputError(f"{path}: {len(entries)} entries; a run needs {LEAST_ROWS} or more")
    header = {key: _number(content, key, f"{path}", unit, above=0.0) for key, unit in HEADER_UNITS.items()}
    columns = {}
    for key, unit in ENTRY_UNITS.items():
        least = 0.0 if key == "input_volts" else None
        values = [_number(entry, key, f"{path}: entry {row}", unit, above=least) for row, entry in enumerate(entries)]
        columns[key] = np.array(values)
    time = columns["timestamp"]
    if (np.diff(time) <= 0).any():
        row = int(np.argmax(np.diff(time) <= 0)) + 1
        raise InputError(f"{path}: entry {row}: timestamp {time[row]:g} s is not after {time[row - 1]:g} s")
    return Recording(
        name=path.stem,
        trajectory=str(content.get("trajectory", "unknown")),
        mass=header["mass"],
        length=header["length"],
        gain=header["kp"],
        t=time,
        angle=columns["position"],
        speed=columns["speed"],
        supply=columns["input_volts"],
        temperature=columns["temp"],
        goal=columns["goal_position"],
        enabled=columns["torque_enable"] > 0.5,
    )


def _number(entry: Mapping[str, Any], key: str, place: str, unit: str, above: float | None = None) -> float:
    if key not in entry:
        raise InputError(f"{place}: has no '{key}'{nearest(key, entry)}")
    value = int(entry[key]) if isinstance(entry[key], bool) else entry[key]
    check_number(f"{place}: {key}", value, unit, above=above)
    return float(value)


# ---- what is odd about them ------------------------------------------------------------------------------------------


def findings(recordings: Sequence[Recording]) -> tuple[IntakeFinding, ...]:
    """Return what is odd about each recording, then about all together."""
    found = [finding for recording in recordings for finding in (*_units(recording), *_odd(recording))]
    if recordings and all(np.ptp(recording.angle) < _MOVED for recording in recordings):
        text = "the joint moves in no run: record runs in which it does"
        found.append(IntakeFinding("", "position", "dead", text, fatal=True))
    return tuple(found)


def _units(recording: Recording) -> Iterator[IntakeFinding]:
    wrong = partial(IntakeFinding, recording.name, kind="units", fatal=True)
    for column, values in (("position", recording.angle), ("goal_position", recording.goal)):
        middle = float(np.median(np.abs(values)))
        if middle > 2.0 * np.pi:
            yield wrong(column, text=f"{middle:.3g} in the median: degrees, not rad? Write rad and run again")
    period = float(np.median(np.diff(recording.t)))
    if period > _LONGEST_PERIOD:
        yield wrong("timestamp", text=f"{period:.3g} s between rows: milliseconds, not s? Write s and run again")
        return
    _, rate = smoothed_state(recording.t, recording.angle)
    if np.std(rate) < _LEAST_RATE:
        return
    slope = float(rate @ recording.speed / (rate @ rate))
    if not _SPEED_SLOPE[0] < slope < _SPEED_SLOPE[1]:
        reason = "the signs differ" if slope < 0 else "rad/s expected"
        text = f"speed is {slope:.3g} times the change of position ({reason}): mend the recording and run again"
        yield wrong("speed", text=text)


def _odd(recording: Recording) -> Iterator[IntakeFinding]:
    note = partial(IntakeFinding, recording.name)
    periods = np.diff(recording.t)
    usual = float(np.median(periods))
    if gaps := int((periods > _GAP * usual).sum()):
        text = f"{gaps} gaps, the longest {1e3 * periods.max():.1f} ms; rows are usually {1e3 * usual:.2f} ms apart"
        yield note("timestamp", "gap", text)
    if np.ptp(recording.angle) < _MOVED:
        text = f"moves by {np.ptp(recording.angle):.3g} rad in the whole run: a dead channel, or a joint that is stuck"
        yield note("position", "dead", text)
    if not recording.enabled.all():
        text = f"torque off from {recording.t[np.argmin(recording.enabled)]:.2f} s on: simulated with the winding open"
        yield note("torque_enable", "off", text)
