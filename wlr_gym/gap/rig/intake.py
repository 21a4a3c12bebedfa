"""What is odd about recordings of the test rig, said before anything is fitted."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from wlr_gym.gap.analysis import IntakeFinding
from wlr_gym.gap.rig.model import DUTY_PER_GAIN
from wlr_gym.gap.rig.recording import Recording
from wlr_gym.gap.rig.replay import smoothed_state

Array = NDArray[np.float64]

_SUPPLY_SWING = 0.05  # share of the nominal voltage
_LONGEST_PERIOD = 0.5  # s between rows: more is in another unit
_JITTER = 0.1  # share of the usual period
_GAP = 3.0  # usual periods
_CONFOUNDED = 0.8  # correlation over runs
_LAW_SLOPE = (0.8, 1.25)  # duty over what the gain asks for
_SPEED_SLOPE = (0.5, 2.0)  # reported speed over change of position
_MOVED = 0.02  # rad: a run in which the joint moves less shows nothing
_LEAST_COMPARED = 4  # runs, for a correlation over them


def findings(recordings: Sequence[Recording]) -> tuple[IntakeFinding, ...]:
    """Return what is odd about each recording, then about all together."""
    each = [finding for recording in recordings for finding in _of_one(recording)]
    return (*each, *_of_all(recordings))


def _units(recording: Recording) -> Iterator[IntakeFinding]:
    for column, values in (("position", recording.angle), ("goal_position", recording.goal)):
        middle = float(np.median(np.abs(values)))
        if middle > 2.0 * np.pi:
            text = f"{middle:.3g} in the median: degrees, not rad? Write rad and run again"
            yield IntakeFinding(recording.name, column, "units", text, fatal=True)
    period = float(np.median(np.diff(recording.time)))
    if period > _LONGEST_PERIOD:
        text = f"{period:.3g} s between rows: milliseconds, not s? Write s and run again"
        yield IntakeFinding(recording.name, "timestamp", "units", text, fatal=True)
        return
    slope = _speed_slope(recording)
    if slope is not None and not _SPEED_SLOPE[0] < slope < _SPEED_SLOPE[1]:
        reason = "the signs differ" if slope < 0 else "rad/s expected"
        text = f"speed is {slope:.3g} times the change of position ({reason}): mend the recording and run again"
        yield IntakeFinding(recording.name, "speed", "units", text, fatal=True)


def _speed_slope(recording: Recording) -> float | None:
    """Slope of the reported speed over the change of position; None where the joint hardly moves."""
    _, rate = smoothed_state(recording.time, recording.angle)
    if np.std(rate) < 0.2:
        return None
    return float(rate @ recording.speed / (rate @ rate))


def _of_one(recording: Recording) -> Iterator[IntakeFinding]:
    yield from _units(recording)
    yield from _wrap(recording)
    yield from _supply(recording)
    yield from _clock(recording)
    yield from _motion(recording)
    yield from _control_law(recording)


def _wrap(recording: Recording) -> Iterator[IntakeFinding]:
    wrapped = np.flatnonzero(recording.raw_load > 32767)
    if len(wrapped):
        first = recording.raw_load[wrapped[0]]
        text = (
            f"{len(wrapped)} of {len(recording.time)} readings of a signed 16-bit register as an unsigned one "
            f"({first:.0f} is {first - 65536:.0f}): decoded before any interpolation"
        )
        yield IntakeFinding(recording.name, "load", "wrap", text)


def _supply(recording: Recording) -> Iterator[IntakeFinding]:
    low, high = float(recording.supply.min()), float(recording.supply.max())
    nominal = recording.nominal_voltage
    if max(nominal - low, high - nominal) > _SUPPLY_SWING * nominal:
        text = f"swings from {low:.1f} to {high:.1f} V, nominally {nominal:.1f} V: the measured supply drives the simulation"
        yield IntakeFinding(recording.name, "input_volts", "supply", text)


def _clock(recording: Recording) -> Iterator[IntakeFinding]:
    periods = np.diff(recording.time)
    usual = float(np.median(periods))
    gaps = np.flatnonzero(periods > _GAP * usual)
    if len(gaps):
        text = f"{len(gaps)} gaps, the longest {1e3 * periods.max():.1f} ms; rows are usually {1e3 * usual:.2f} ms apart"
        yield IntakeFinding(recording.name, "timestamp", "gap", text)
    low, high = np.percentile(periods, (1, 99))
    if high - low > _JITTER * usual:
        text = (
            f"rows are {1e3 * low:.2f} to {1e3 * high:.2f} ms apart (98 % of them): replayed at their own times, not resampled"
        )
        yield IntakeFinding(recording.name, "timestamp", "jitter", text)


def _motion(recording: Recording) -> Iterator[IntakeFinding]:
    if np.ptp(recording.angle) < _MOVED:
        text = f"moves by {np.ptp(recording.angle):.3g} rad in the whole run: a dead channel, or a joint that is stuck"
        yield IntakeFinding(recording.name, "position", "dead", text)
    if not recording.enabled.all():
        text = f"torque off from {recording.time[np.argmin(recording.enabled)]:.2f} s on: simulated with the winding open"
        yield IntakeFinding(recording.name, "torque_enable", "off", text)


def _control_law(recording: Recording) -> Iterator[IntakeFinding]:
    wish = recording.gain * DUTY_PER_GAIN * (recording.goal - recording.angle)
    free = recording.enabled & (np.abs(wish) < 0.9)
    if free.sum() < 20 or np.ptp(wish[free]) < 0.02:
        return
    slope = float(wish[free] @ recording.duty[free] / (wish[free] @ wish[free]))
    if not _LAW_SLOPE[0] < slope < _LAW_SLOPE[1]:
        text = f"duty is {slope:.2f} times what the P gain {recording.gain:.0f} asks for: another gain, or another register?"
        yield IntakeFinding(recording.name, "load", "control_law", text)


def _of_all(recordings: Sequence[Recording]) -> Iterator[IntakeFinding]:
    if recordings and all(np.ptp(recording.angle) < _MOVED for recording in recordings):
        yield IntakeFinding("", "position", "dead", "the joint moves in no run: record runs in which it does", fatal=True)
    silent = sum(recording.arm_mass is None for recording in recordings)
    if silent:
        text = f"mass of the arm not recorded in {silent} of {len(recordings)} runs: fitted, within a wide tolerance"
        yield IntakeFinding("", "arm_mass", "missing", text)
    if len(recordings) >= _LEAST_COMPARED:
        yield from _confounding(recordings)


def _confounding(recordings: Sequence[Recording]) -> Iterator[IntakeFinding]:
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
