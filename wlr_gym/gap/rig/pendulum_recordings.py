"""Recordings of one servo swinging a pendulum: the JSON files of the BAM test bench, decoded, and what is odd about them.

Format: github.com/Rhoban/bam. One file per run: ``mass`` (kg), ``length`` (m), ``kp`` (register), ``vin`` (V), ``motor``,
``trajectory``, optional ``arm_mass`` (kg), and ``entries``, one per reading. Angles are 0 where the pendulum hangs.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import combinations
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
    "load": "PWM counts",
    "input_volts": "V",
    "temp": "deg C",
    "goal_position": "rad",
    "torque_enable": "-",
}
#: What a file says about the whole run, apart from its entries -> unit; all above 0.
HEADER_UNITS: Mapping[str, str] = {"mass": "kg", "length": "m", "kp": "", "vin": "V"}
#: PWM counts at full duty of the servo's present-PWM register.
FULL_DUTY = 885
#: Duty per rad and unit of the Position P Gain register: counts of 2 pi/4096, /256 to PWM counts (the data confirm it).
DUTY_PER_GAIN = 4096 / (2 * math.pi) / (256 * FULL_DUTY)
#: A run shorter than this (rows) holds nothing to fit.
LEAST_ROWS = 50
_SUPPLY_SWING = 0.05  # share of the nominal voltage
_LONGEST_PERIOD = 0.5  # s between rows: more is in another unit
_JITTER = 0.1  # share of the usual period
_GAP = 3.0  # usual periods
_CONFOUNDED = 0.8  # correlation over runs
_LAW_SLOPE = (0.8, 1.25)  # duty over what the gain asks for
_SPEED_SLOPE = (0.5, 2.0)  # reported speed over change of position
_LEAST_RATE = 0.2  # rad/s, scatter of a joint whose speed can be compared
_MOVED = 0.02  # rad: a run in which the joint moves less shows nothing
_LEAST_COMPARED = 4  # runs, for a correlation over them


@dataclass(frozen=True, eq=False)
class Recording:
    """One run of the test rig.

    Attributes:
        name: of its file, without ending.
        trajectory: what was commanded.
        mass, length: of the load, kg and m from the axis; ``arm_mass``: of the arm, kg, None where the file is silent.
        gain: Position P Gain register.
        nominal_voltage: V, as the file's header says.
        t: s from the run's start, strictly increasing.
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
    t: Array
    angle: Array
    speed: Array
    duty: Array
    raw_load: Array
    supply: Array
    temperature: Array
    goal: Array
    enabled: NDArray[np.bool_]

    @property
    def measured(self) -> Array:
        """What a replay is compared with (rows, 1): the angle."""
        return self.angle[:, None]


def decode_load(raw: Array) -> Array:
    """Return the duty (-1..1) behind the PWM register: a signed 16-bit number that was recorded as an unsigned one."""
    return np.where(raw > 32767, raw - 65536, raw) / FULL_DUTY


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
    arm_mass = None if content.get("arm_mass") is None else _number(content, "arm_mass", f"{path}", "kg", above=0.0)
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
        arm_mass=arm_mass,
        gain=header["kp"],
        nominal_voltage=header["vin"],
        t=time,
        angle=columns["position"],
        speed=columns["speed"],
        duty=decode_load(columns["load"]),
        raw_load=columns["load"],
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
    each = [finding for recording in recordings for finding in (*_units(recording), *_odd(recording))]
    return (*each, *_of_all(recordings))


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
    wrapped = np.flatnonzero(recording.raw_load > 32767)
    if len(wrapped):
        first = recording.raw_load[wrapped[0]]
        text = (
            f"{len(wrapped)} of {len(recording.t)} readings of a signed 16-bit register as an unsigned one "
            f"({first:.0f} is {first - 65536:.0f}): decoded before any interpolation"
        )
        yield note("load", "wrap", text)

    low, high, nominal = float(recording.supply.min()), float(recording.supply.max()), recording.nominal_voltage
    if max(nominal - low, high - nominal) > _SUPPLY_SWING * nominal:
        text = f"swings from {low:.1f} to {high:.1f} V, nominally {nominal:.1f} V: the measured supply drives the simulation"
        yield note("input_volts", "supply", text)

    periods = np.diff(recording.t)
    usual = float(np.median(periods))
    if gaps := int((periods > _GAP * usual).sum()):
        text = f"{gaps} gaps, the longest {1e3 * periods.max():.1f} ms; rows are usually {1e3 * usual:.2f} ms apart"
        yield note("timestamp", "gap", text)
    low, high = np.percentile(periods, (1, 99))
    if high - low > _JITTER * usual:
        apart = f"rows are {1e3 * low:.2f} to {1e3 * high:.2f} ms apart (98 % of them)"
        yield note("timestamp", "jitter", f"{apart}: replayed at their own times, not resampled")

    if np.ptp(recording.angle) < _MOVED:
        text = f"moves by {np.ptp(recording.angle):.3g} rad in the whole run: a dead channel, or a joint that is stuck"
        yield note("position", "dead", text)
    if not recording.enabled.all():
        text = f"torque off from {recording.t[np.argmin(recording.enabled)]:.2f} s on: simulated with the winding open"
        yield note("torque_enable", "off", text)

    wish = recording.gain * DUTY_PER_GAIN * (recording.goal - recording.angle)
    free = recording.enabled & (np.abs(wish) < 0.9)
    if free.sum() >= 20 and np.ptp(wish[free]) >= 0.02:
        slope = float(wish[free] @ recording.duty[free] / (wish[free] @ wish[free]))
        if not _LAW_SLOPE[0] < slope < _LAW_SLOPE[1]:
            asked = f"what the P gain {recording.gain:.0f} asks for"
            yield note("load", "control_law", f"duty is {slope:.2f} times {asked}: another gain, or another register?")


def _of_all(recordings: Sequence[Recording]) -> Iterator[IntakeFinding]:
    if recordings and all(np.ptp(recording.angle) < _MOVED for recording in recordings):
        yield IntakeFinding("", "position", "dead", "the joint moves in no run: record runs in which it does", fatal=True)
    silent = sum(recording.arm_mass is None for recording in recordings)
    if silent:
        text = f"mass of the arm not recorded in {silent} of {len(recordings)} runs: fitted, within a wide tolerance"
        yield IntakeFinding("", "arm_mass", "missing", text)
    if len(recordings) < _LEAST_COMPARED:
        return
    per_run: Mapping[str, Array] = {
        "P gain": np.log([recording.gain for recording in recordings]),
        "temperature": np.array([recording.temperature.mean() for recording in recordings]),
        "order of recording": np.arange(len(recordings), dtype=np.float64),
        "supply": np.array([recording.supply.mean() for recording in recordings]),
    }
    varied = {name: values for name, values in per_run.items() if np.ptp(values) > 1e-9}
    for (a, x), (b, y) in combinations(varied.items(), 2):
        correlation = float(np.corrcoef(x, y)[0, 1])
        if abs(correlation) > _CONFOUNDED:
            text = f"{a} and {b} are correlated over the runs ({correlation:+.2f}): their effects are not distinguishable"
            yield IntakeFinding("", f"{a}, {b}", "confounded", text)
