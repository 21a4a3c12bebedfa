"""Make a run of a log by a map: rows at the true times of one topic, and every sample of every channel beside them."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from wlr_gym.base.errors import InputError
from wlr_gym.data.format import CAMERA, COLUMNS, COMMANDS, REQUIRED
from wlr_gym.data.logs.joint_series import with_torque_off, without_wraps
from wlr_gym.data.logs.map import LogMap, Resolved
from wlr_gym.data.logs.poses import ANGLES, lost_frames, pose_angle, quaternion_names
from wlr_gym.data.logs.takes import TAKES, bridged, hole
from wlr_gym.data.logs.topics import LOG, Log
from wlr_gym.robot import JOINTS, WHEELS

Array = NDArray[np.float64]
Times = NDArray[np.int64]

#: ns; channels that begin or end within this of the others shorten the run.
_END = 1_000_000_000
#: Rates of joints' messages from which on not every one makes a row, Hz.
_QUICK = 75.0


@dataclass(frozen=True, eq=False)
class Samples:
    """A channel's samples, all of them: seconds on the run's clock, and values in SI units."""

    t: Array
    values: Array


@dataclass(frozen=True)
class ChannelFact:
    """How the rows of a channel came about.

    Attributes:
        column, topic, field: which, and from where.
        unit: that the log has it in.
        rate: samples per second.
        how: ``as recorded``: rows are at the samples' own times; else how they got their value: ``interpolated`` on the line
            between the samples before and after, ``held at mid-step``: the setpoint that held in the middle of the row's step,
            ``nearest sample``, or ``next to frames``: only the row next to each sample has one, on the line between samples.
        moved: s, rms: how far the samples' times are from the rows' they gave.
        known: share of the rows that have a value.
    """

    column: str
    topic: str
    field: str
    unit: str
    rate: float
    how: str
    moved: float
    known: float


@dataclass(frozen=True, eq=False)
class MadeRun:
    """A run made of a log.

    Attributes:
        table: columns of a run, (rows,).
        samples: channel -> every sample, at its own time.
        facts: how the rows came about.
        origin: ns on the log's clock where the run's ``t`` is 0.
        notes: what was left out or changed.
    """

    table: dict[str, Array]
    samples: dict[str, Samples]
    facts: tuple[ChannelFact, ...]
    origin: int
    notes: tuple[str, ...] = field(default=())


def wanted_fields(resolved: Mapping[str, Resolved]) -> dict[str, set[str]]:
    """Return topic -> fields that a map needs."""
    wanted: dict[str, set[str]] = {}
    for source in resolved.values():
        stem, _, last = source.field.rpartition(".")
        wanted.setdefault(source.topic, set()).update({source.field}, quaternion_names(stem) if last in ANGLES else ())
    return wanted


class NoRowsError(InputError):
    """Nowhere, or nowhere between the times that were asked for, is there all that a row needs."""


def make_run(log: Log, found: LogMap, resolved: Mapping[str, Resolved], between: tuple[int, int] | None = None) -> MadeRun:
    """Return the run that a map makes of a log.

    Every message of one topic makes a row, at its true time; a channel with a sample at that time has it as it is. Of the
    others the map says how rows get a value. Nothing is brought to a raster.

    Args:
        log: what was recorded.
        found: the map.
        resolved: what it means for each channel.
        between: ns; rows from the first to before the second only: what the log has around them says what holds at their ends,
            and channels that are unknown all that time are left out. None = all.

    Raises:
        InputError: a required channel, a topic or a field is missing.
        NoRowsError: no two rows have all that a row needs.
    """
    check_sources(log.name, resolved)
    lost = _lost(log, found, resolved)
    series: dict[str, tuple[Times, Array]] = {}
    odd = [*_odd_times(log, found, resolved, between), *_said_lost(lost, found, between)]
    for column, source in resolved.items():
        at, values = _series(log, found, resolved, column, lost)
        if len(at) < 2:
            text = f"topic '{source.topic}', field '{source.field}': {len(at)} samples, expected at least 2"
            if between is None or column in REQUIRED:
                raise NoRowsError(f"{log.name}: channel '{column}': {text}")
            odd.append(f"'{column}' is left out: {text}")
            continue
        series[column] = (_known(at, series.values()), values)
    for joint in JOINTS:
        angles, said = without_wraps(series, joint)
        series[f"pos_{joint}"] = (series[f"pos_{joint}"][0], angles)
        odd += [said] if said else []
    resolved = {column: source for column, source in resolved.items() if column in series}
    times, notes = _row_times(log, found, resolved, series, between)
    times, more = _complete(times, series, resolved, log)
    origin = int(times[0])
    period = float(np.median(np.diff(times))) * 1e-9
    table: dict[str, Array] = {"t": _seconds(times, origin)}
    facts, samples = [], {}
    seconds = {id(at): _seconds(at, origin) for at, _ in series.values()}
    for column, source in resolved.items():
        at, values = series[column]
        values = np.unwrap(values) if column == "cam_yaw" else values
        table[column], fact = _taken(times, at, values, source, period)
        samples[column] = Samples(seconds[id(at)], values)
        facts.append(fact)
    for wheel in (f"pos_{wheel}" for wheel in WHEELS):
        start = table[wheel][0]
        table[wheel] = table[wheel] - start
        samples[wheel] = Samples(samples[wheel].t, samples[wheel].values - start)
    notes = [*odd, *notes, *more, *_silent(times, series, resolved), *_off(table)]
    table = {name: table[name] for name in COLUMNS if name in table}
    return MadeRun(table, samples, tuple(facts), origin, tuple(notes))


def check_sources(log: str, resolved: Mapping[str, Resolved]) -> None:
    """Refuse a map that lacks a required channel.

    Raises:
        InputError: naming the log and the channels, and what they are for.
    """
    missing = [name for name in REQUIRED if name != "t" and name not in resolved]
    if missing:
        raise InputError(f"{log}: no source for {', '.join(missing)}: {_MISSING[missing[0].partition('_')[0]]}")


def _known(at: Times, series: Iterable[tuple[Times, Array]]) -> Times:
    """Return the same times of another channel, where there are such: a topic's channels share them."""
    return next((other for other, _ in series if len(other) == len(at) and np.array_equal(other, at)), at)


def _seconds(times: Times, origin: int) -> Array:
    return np.asarray((times - origin) * 1e-9, np.float64)


_MISSING = {
    "cmd": "the setpoints that drove the robot, which every replay needs; without them no simulator can be compared",
    "pos": "the joints' angles, which every replay is compared with",
}


def _lost(log: Log, found: LogMap, resolved: Mapping[str, Resolved]) -> dict[str, Times]:
    """Return topic -> times (ns) of frames without a rotation, where there are any."""
    yaw = resolved.get("cam_yaw")
    if yaw is None:
        return {}
    at = lost_frames(log.topic(yaw.topic), yaw.field, found.use(yaw.topic).use, f"{log.name}: channel 'cam_yaw'")
    return {yaw.topic: at} if len(at) else {}


def _said_lost(lost: Mapping[str, Times], found: LogMap, between: tuple[int, int] | None) -> Iterator[str]:
    for name, at in lost.items():
        count = len(_within(at, found, name, between))
        if count:
            yield f"topic '{name}': {count} lost frame{'s are' if count > 1 else ' is'} left out"


def _within(at: Times, found: LogMap, topic: str, between: tuple[int, int] | None) -> Times:
    """Return those of a topic's times (ns, its own clock) that are in a span of the common clock."""
    if between is None:
        return at
    moved = at + round(found.use(topic).offset * 1e9)
    return at[(moved >= between[0]) & (moved < between[1])]


def _odd_times(log: Log, found: LogMap, resolved: Mapping[str, Resolved], between: tuple[int, int] | None) -> Iterator[str]:
    """Say of which topics messages have the time of the one before, of which only the later counts, or go back in time."""
    for name in dict.fromkeys(source.topic for source in resolved.values()):
        topic = log.topic(name)
        use = found.use(name).use
        times = _within(topic.clock(use), found, name, between)
        count = _repetitions(times)
        received = _repetitions(topic.received) if between is None else 0
        hint = f": in the map, clocks: {{{name}: {{use: log}}}}" if use != LOG and received < count else ""
        if count:
            yield f"topic '{name}': {count} of {len(times)} messages repeat a time and are left out{hint}"
        back = np.diff(times)
        if (back < 0).any():
            much = f"{(back < 0).sum()} times, by up to {-back.min() * 1e-9:.3g} s"
            restarted = "; a clock that began anew mixes two recordings: 'use: log'" if back.min() < -1e9 and use != LOG else ""
            yield f"topic '{name}': its times go back {much}: sorted by time{restarted}"


def _repetitions(times: Times) -> int:
    return len(times) - len(np.unique(times))


def _series(
    log: Log, found: LogMap, resolved: Mapping[str, Resolved], column: str, lost: Mapping[str, Times]
) -> tuple[Times, Array]:
    """Return a channel's samples in SI units on the common clock, in the order of time; times once only."""
    source = resolved[column]
    topic, clock = log.topic(source.topic), found.use(source.topic)
    if column in COMMANDS and (angle := resolved[column.replace("cmd", "pos")]).topic == source.topic:
        topic = with_torque_off(topic, source.field, angle.field)
    where = f"{log.name}: channel '{source.column}'"
    if source.field in topic.fields or source.field.rpartition(".")[2] not in ANGLES:
        at, raw = topic.series(source.field, clock.use, where)
    else:
        at, raw = pose_angle(topic, source.field, clock.use, found.frames.get("cam"), where)
    if source.column in CAMERA and source.topic in lost:
        seen = ~np.isin(at, lost[source.topic])
        at, raw = at[seen], raw[seen]
    at = at + round(clock.offset * 1e9)
    keep = np.concatenate([np.diff(at) > 0, [True]])  # of two at one time, the later message
    if source.column not in COMMANDS:
        keep &= np.isfinite(raw)
    if not keep.all():
        at, raw = at[keep], raw[keep]
    return at, source.sign * (source.factor * raw - source.zero)


def rows_topic(found: LogMap, resolved: Mapping[str, Resolved]) -> str:
    """Return the topic whose messages make the rows."""
    return found.rows or resolved[f"pos_{JOINTS[0]}"].topic


def _row_times(
    log: Log,
    found: LogMap,
    resolved: Mapping[str, Resolved],
    series: Mapping[str, tuple[Times, Array]],
    between: tuple[int, int] | None,
) -> tuple[Times, list[str]]:
    rows = rows_topic(found, resolved)
    of_rows = [series[column][0] for column, source in resolved.items() if source.topic == rows]
    if not of_rows:
        raise InputError(f"{log.name}: rows = '{rows}': no channel comes from that topic")
    times = max(of_rows, key=len)
    if between is not None:
        times = times[(times >= between[0]) & (times < between[1])]
    times = times[:: found.every]
    if len(times) < 2:
        raise NoRowsError(f"{log.name}: topic '{rows}': {len(times)} messages; a run has at least 2")
    rate = 1e9 / float(np.median(np.diff(times)))
    if rate > _QUICK:
        return times, [f"rows come {rate:.0f} times a second, from topic '{rows}': 'every: {round(rate / 50)}' takes 50"]
    return times, []


def _complete(
    times: Times, series: Mapping[str, tuple[Times, Array]], resolved: Mapping[str, Resolved], log: Log
) -> tuple[Times, list[str]]:
    """Return the rows that have all required channels, less up to a second at the ends where others begin later.

    The last setpoint holds to the end of the rows: some robots are sent one only when it changes.
    """
    half = int(np.median(np.diff(times)) / 2)
    begins = {name: int(series[name][0][0]) - half for name in REQUIRED if name in series}
    ends = {name: int(at[-1]) + half for name, (at, _) in series.items() if name in REQUIRED and resolved[name].take != "hold"}
    first, last = max(begins.values()), min(ends.values(), default=int(times[-1]))
    for name, (at, _) in series.items():
        if resolved[name].take in ("interpolate", "nearest"):
            reach = int(np.median(np.diff(at)) / 2)
            if at[0] - reach < first + _END:
                begins[name] = int(at[0]) - reach
            if at[-1] + reach > last - _END:
                ends[name] = int(at[-1]) + reach
    first, last = max(begins.values()), min(ends.values(), default=int(times[-1]))
    kept = times[(times >= first) & (times <= last)]
    if len(kept) < 2:
        spans = [
            f"{name} from {series[name][0][0] * 1e-9:.3f} to {series[name][0][-1] * 1e-9:.3f} s" for name in REQUIRED[1::8]
        ]
        raise NoRowsError(f"{log.name}: setpoints and positions are never known together ({'; '.join(spans)}): check 'clocks'")
    notes = [
        *_cut(times[times < first], "beginning", max(begins, key=lambda name: begins[name]), resolved, half),
        *_cut(times[times > last], "end", min(ends, key=lambda name: ends[name], default=""), resolved, half),
    ]
    kept, more = _without_holes(kept, series, resolved, log, half)
    return kept, [*notes, *more]


def _cut(rows: Times, side: str, name: str, resolved: Mapping[str, Resolved], half: int) -> Iterator[str]:
    if len(rows):
        text = f"'{name}' (topic '{resolved[name].topic}') is not known there"
        yield f"{len(rows)} rows ({len(rows) * 2e-9 * half:.1f} s) at the {side} are left out: {text}"


def _without_holes(
    times: Times, series: Mapping[str, tuple[Times, Array]], resolved: Mapping[str, Resolved], log: Log, half: int
) -> tuple[Times, list[str]]:
    """Return the rows at which all angles are known: where another topic than the rows' is silent, some are not."""
    notes, keep = [], np.ones(len(times), bool)
    for name in (one for one in REQUIRED if one in series and resolved[one].take == "interpolate"):
        missing = keep & ~bridged(times, series[name][0])
        keep &= ~missing
        if missing.any():
            text = f"'{name}' (topic '{resolved[name].topic}') has a hole there"
            notes.append(f"{missing.sum()} rows ({missing.sum() * 2e-9 * half:.1f} s) are left out: {text}")
    if keep.sum() < 2:
        raise NoRowsError(f"{log.name}: no two rows have all that a row needs: {'; '.join(notes)}")
    return times[keep], notes


def _silent(times: Times, series: Mapping[str, tuple[Times, Array]], resolved: Mapping[str, Resolved]) -> Iterator[str]:
    """Say where a setpoint is held for longer than usual: nothing came, or nothing changed."""
    said = set()
    step = float(np.median(np.diff(times)))
    for name in (one for one in series if resolved[one].take == "hold" and resolved[one].topic not in said):
        at = series[name][0]
        age = times - at[np.clip(np.searchsorted(at, times + round(0.5 * step), side="right") - 1, 0, len(at) - 1)]
        held = age > hole(at)
        if held.any():
            said.add(resolved[name].topic)
            text = f"its last message is held over {held.sum()} rows ({held.sum() * step * 1e-9:.1f} s)"
            yield f"topic '{resolved[name].topic}': silent for up to {age.max() * 1e-9:.1f} s: {text}"


def _off(table: Mapping[str, Array]) -> Iterator[str]:
    off = np.isnan([table[name] for name in COMMANDS])
    if off.any():
        column = COMMANDS[int(np.argmax(off.any(axis=1)))]
        yield f"{off.any(axis=0).sum()} rows have no setpoint, '{column}' among them: torque off"


# ---- values at the rows' times ---------------------------------------------------------------------------------------


def _taken(times: Times, at: Times, values: Array, source: Resolved, period: float) -> tuple[Array, ChannelFact]:
    place = np.minimum(np.searchsorted(at, times), len(at) - 1)
    exact = at[place] == times
    if exact.all():
        result, how, moved = values[place], "as recorded", 0.0
    else:
        take, how = TAKES[source.take]
        result, moved = take(times, at, values, period)
        result = np.where(exact, values[place], result)
    rate = 1e9 / float(np.median(np.diff(at)))
    known = float(np.isfinite(result).mean())
    return result, ChannelFact(source.column, source.topic, source.field, source.unit, rate, how, moved, known)
