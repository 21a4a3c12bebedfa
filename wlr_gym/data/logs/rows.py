"""Make runs of a recording by a map: rows at the true times of one topic, and every sample of every channel beside them.

Long recordings are made part by part: as much of one is in memory as a part needs; cuts are where the robot is quiet.
"""

from __future__ import annotations

import itertools
import math
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from wlr_gym.base.errors import InputError
from wlr_gym.data.format import CAMERA, COLUMNS, COMMANDS, REQUIRED
from wlr_gym.data.logs.map import LogMap, Resolved
from wlr_gym.data.logs.tables import TABLE
from wlr_gym.data.logs.topics import LOG, Log, Share, Topic, TopicStore
from wlr_gym.data.run_states import euler_angles
from wlr_gym.robot import JOINTS, WHEELS
from wlr_gym.robot.parameter_table import XYZ

Array = NDArray[np.float64]
Times = NDArray[np.int64]

#: Angles that can be taken of a quaternion.
ANGLES = ("yaw", "pitch", "roll", "tilt")


def pose_angle(topic: Topic, field: str, use: str, axes: Sequence[str] | None, where: str) -> tuple[Times, Array]:
    """Return times (ns) and an angle (rad) of a quaternion: ``yaw``, ``pitch``, ``roll``, or ``tilt`` off upright.

    Lost frames, whose quaternion is no rotation, are left out.

    Args:
        topic: that has it.
        field: name of the angle.
        use: clock of the topic.
        axes: axes of the log that our x, y and z are, of the floor's frame and of the body's; None = the same.
        where: for messages.

    Raises:
        InputError: no such quaternion.
    """
    stem, _, angle = field.rpartition(".")
    at, quaternion, lost = _rotations(topic, stem, use, where)
    at, quaternion = at[~lost], quaternion[~lost]
    w, *vector = (quaternion / np.linalg.norm(quaternion, axis=1)[:, None]).T
    if axes is not None:  # a proper turn of both frames: the quaternion's vector turns with them
        vector = [vector[XYZ.index(axis[-1])] * (-1.0 if axis.startswith("-") else 1.0) for axis in axes]
    yaw, pitch, roll = euler_angles(np.stack([w, *vector], axis=1))
    x, y, _ = vector
    angles = {"yaw": yaw, "pitch": pitch, "roll": roll, "tilt": np.arccos(np.clip(1 - 2 * (x * x + y * y), -1, 1))}
    values = angles[angle]
    return at, np.unwrap(values) if angle == "yaw" else values


def lost_frames(topic: Topic, field: str, use: str, where: str) -> Times:
    """Return the times (ns) at which the quaternion of an angle is no rotation: not known, or of length 0.

    Its message's position is not one, either. Of a field that is no angle of a quaternion there are none.
    """
    stem, _, angle = field.rpartition(".")
    if field in topic.fields or angle not in ANGLES:
        return np.zeros(0, np.int64)
    at, _, lost = _rotations(topic, stem, use, where)
    return at[lost]


def _rotations(topic: Topic, stem: str, use: str, where: str) -> tuple[Times, Array, NDArray[np.bool_]]:
    """Return times, quaternions (n, 4), and which of them are no rotations: of a table's row some parts may be missing."""
    names = next((names for names in _quaternions(stem) if names[0] in topic.fields), _quaternions(stem)[0])
    parts = [topic.series(name, use, where) for name in names]
    every = np.unique(np.concatenate([at for at, _ in parts]))
    quaternion = np.full((len(every), len(parts)), np.nan)
    for part, (at, values) in enumerate(parts):
        quaternion[np.searchsorted(every, at), part] = values
    return every, quaternion, ~(np.linalg.norm(quaternion, axis=1) >= 0.5)


def quaternion_names(stem: str) -> set[str]:
    """Return the names that the parts of a quaternion may have."""
    return {name for names in _quaternions(stem) for name in names}


def _quaternions(stem: str) -> list[list[str]]:
    """Return names of w, x, y and z of a quaternion.

    Of ``q`` they are ``q.w``, or in tables ``q_w`` or ``qw``; a list without names says its order: ``q[xyzw]`` has its w in
    ``q[3]``.
    """
    ordered = re.fullmatch(r"(.*)\[([wxyz]{4})\]", stem)
    if ordered and sorted(ordered.group(2)) == list("wxyz"):
        return [[f"{ordered.group(1)}[{ordered.group(2).index(part)}]" for part in "wxyz"]]
    return [[f"{stem}{joint}{part}" for part in "wxyz"] for joint in (".", "_", "")]


# ---- values at the times of rows that are not a channel's own --------------------------------------------------------


#: Usual steps between a channel's samples beyond which nothing is said of what lies between.
_BRIDGED = 5.0
#: s; holes up to this are bridged whatever the channel's rate.
_SHORT = 0.1


def hole(at: Times) -> float:
    """Return how far samples (ns) may be apart, at most, so that they say what is between them, ns."""
    return max(_BRIDGED * float(np.median(np.diff(at))), _SHORT * 1e9)


def interpolated(times: Times, at: Times, values: Array, period: float) -> tuple[Array, float]:
    after = np.clip(np.searchsorted(at, times), 1, len(at) - 1)
    width = (at[after] - at[after - 1]).astype(np.float64)
    share = (times - at[after - 1]) / width
    result = values[after - 1] + share * (values[after] - values[after - 1])
    return np.where(bridged(times, at), result, np.nan), _rms(np.minimum(np.abs(share), np.abs(1.0 - share)) * width)


def bridged(times: Times, at: Times) -> NDArray[np.bool_]:
    """Whether the samples before and after each time say what was between them; a sample at the time itself does."""
    after = np.clip(np.searchsorted(at, times), 1, len(at) - 1)
    usual = float(np.median(np.diff(at)))
    width = (at[after] - at[after - 1]).astype(np.float64)
    share = (times - at[after - 1]) / width
    edge = 0.5 * usual / width  # the first and last half step are read off the line
    inside = (share >= -edge) & (share <= 1.0 + edge) & (width <= hole(at))
    return inside | (at[after] == times) | (at[after - 1] == times)


def held(times: Times, at: Times, values: Array, period: float) -> tuple[Array, float]:
    middle = times + round(0.5e9 * period)
    place = np.clip(np.searchsorted(at, middle, side="right") - 1, 0, len(at) - 1)
    return values[place], _rms((at[place] - times)[np.abs(at[place] - times) < 1e9 * period])


def nearest(times: Times, at: Times, values: Array, period: float) -> tuple[Array, float]:
    place = _next_to(times, at)
    distance = np.abs(at[place] - times)
    return np.where(distance <= hole(at), values[place], np.nan), _rms(distance)


def framed(times: Times, at: Times, values: Array, period: float) -> tuple[Array, float]:
    """Each frame goes to the row next to it, moved along the line to the next frame; the other rows get none."""
    inside = (at >= times[0] - 0.5e9 * period) & (at <= times[-1] + 0.5e9 * period)
    rows = np.unique(_next_to(at[inside], times))
    result = np.full(len(times), np.nan)
    result[rows] = interpolated(times[rows], at, values, period)[0]
    distance = np.abs(times[rows] - at[_next_to(times[rows], at)])
    return result, _rms(distance)


def _next_to(times: Times, at: Times) -> NDArray[np.intp]:
    after = np.clip(np.searchsorted(at, times), 1, len(at) - 1)
    return after - ((times - at[after - 1]) < (at[after] - times))


def _rms(nanoseconds: NDArray[np.generic]) -> float:
    return float(np.sqrt(np.mean(np.square(nanoseconds.astype(np.float64))))) * 1e-9 if len(nanoseconds) else 0.0


#: Way -> function of rows' times, samples' times (ns), their values, and s between rows, which returns values at the rows and
#: how far they were moved (s, rms); and what is said of it.
TAKES = {
    "interpolate": (interpolated, "interpolated"),
    "hold": (held, "held at mid-step"),
    "nearest": (nearest, "nearest sample"),
    "frames": (framed, "next to frames"),
}


# ---- what a log leaves open about joints -----------------------------------------------------------------------------


#: rad; an angle that stays within a turn, or little more, and jumps by so much between two samples starts anew after a turn.
_TURN, _JUMP = 2.2 * np.pi, 1.5 * np.pi


def with_torque_off(topic: Topic, setpoint: str, angle: str) -> Topic:
    """Return a table whose rows with a joint's angle and an empty setpoint have NaN as setpoint: torque off.

    Not where most setpoints stand in rows of their own, or alone between empty cells: those have another rate, and hold.
    """
    if topic.kind != TABLE or not {setpoint, angle} <= set(topic.fields):
        return topic
    (rows, values), measured = topic.fields[setpoint], topic.fields[angle][0]
    off = np.setdiff1d(measured, rows)
    place = np.searchsorted(measured, rows[np.isin(rows, measured)])
    if len(rows) and (len(place) < max(2, len(rows) / 2) or np.median(np.diff(place)) > 1.0):
        return topic
    rows, values = np.concatenate([rows, off]), np.concatenate([values, np.full(len(off), np.nan)])
    order = np.argsort(rows)
    return replace(topic, fields={**topic.fields, setpoint: (rows[order], values[order])})


def without_wraps(series: Mapping[str, tuple[Times, Array]], joint: str) -> tuple[Array, str]:
    """Return a joint's angles, jumps undone where they start anew after a turn or half of one; and what is to be said of it.

    Args:
        series: channel -> times (ns) and values, SI units.
        joint: name.
    """
    at, values = series[f"pos_{joint}"]
    steps, gaps = np.abs(np.diff(values)), np.diff(at)
    if np.ptp(values) >= _TURN or not (steps > np.pi).any():
        return values, ""
    if not ((steps > _JUMP) & (gaps <= hole(at))).any():
        return values, f"'pos_{joint}': {(steps > np.pi).sum()} jumps of more than half a turn are left in"
    rate = max(_fastest(series, f"{kind}_{joint}") for kind in ("cmd", "vel")) if joint in WHEELS else 0.0
    unsure = gaps[rate * gaps * 1e-9 > np.pi]
    if not len(unsure):
        return np.unwrap(values), ""
    where = f"between {len(unsure)} pairs of samples, up to {unsure.max() * 1e-9:.2g} s apart"
    return np.unwrap(values), f"'pos_{joint}': turns are a guess {where}: at {rate:.3g} rad/s that may be more than half a turn"


def _fastest(series: Mapping[str, tuple[Times, Array]], channel: str) -> float:
    """Return the highest rate of a channel, rad/s; 0 where it is not known."""
    rates = np.abs(series[channel][1]) if channel in series else np.zeros(0)
    return float(rates[np.isfinite(rates)].max(initial=0.0))


# ---- one run ---------------------------------------------------------------------------------------------------------


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
    return _Making(log, found, dict(resolved), between).run()


_MISSING = {
    "cmd": "the setpoints that drove the robot, which every replay needs; without them no simulator can be compared",
    "pos": "the joints' angles, which every replay is compared with",
}


def check_sources(log: str, resolved: Mapping[str, Resolved]) -> None:
    """Refuse a map that lacks a required channel.

    Raises:
        InputError: naming the log and the channels, and what they are for.
    """
    missing = [name for name in REQUIRED if name != "t" and name not in resolved]
    if missing:
        raise InputError(f"{log}: no source for {', '.join(missing)}: {_MISSING[missing[0].partition('_')[0]]}")


def rows_topic(found: LogMap, resolved: Mapping[str, Resolved]) -> str:
    """Return the topic whose messages make the rows."""
    return found.rows or resolved[f"pos_{JOINTS[0]}"].topic


@dataclass(eq=False)
class _Making:
    """A run that is being made: each channel's samples (ns on the common clock, SI units), and what is to be said of it."""

    log: Log
    map: LogMap
    sources: dict[str, Resolved]
    between: tuple[int, int] | None
    series: dict[str, tuple[Times, Array]] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)

    def run(self) -> MadeRun:
        self._say_odd_times()
        self._read(self._lost_frames())
        times = self._without_holes(self._complete(self._row_times()))
        origin, period = int(times[0]), float(np.median(np.diff(times))) * 1e-9
        table: dict[str, Array] = {"t": _seconds(times, origin)}
        facts, samples = [], {}
        seconds = {id(at): _seconds(at, origin) for at, _ in self.series.values()}
        for column, source in self.sources.items():
            at, values = self.series[column]
            values = np.unwrap(values) if column == "cam_yaw" else values
            table[column], fact = _taken(times, at, values, source, period)
            samples[column] = Samples(seconds[id(at)], values)
            facts.append(fact)
        for wheel in (f"pos_{wheel}" for wheel in WHEELS):
            start = table[wheel][0]
            table[wheel] = table[wheel] - start
            samples[wheel] = Samples(samples[wheel].t, samples[wheel].values - start)
        self._say_silent(times)
        off = np.isnan([table[name] for name in COMMANDS])
        if off.any():
            column = COMMANDS[int(np.argmax(off.any(axis=1)))]
            self.notes.append(f"{off.any(axis=0).sum()} rows have no setpoint, '{column}' among them: torque off")
        return MadeRun(
            {name: table[name] for name in COLUMNS if name in table}, samples, tuple(facts), origin, tuple(self.notes)
        )

    # ---- samples ----------------------------------------------------------------------------------------------------

    def _say_odd_times(self) -> None:
        """Say of which topics messages have the time of the one before, of which only the later counts, or go back in time."""
        for name in dict.fromkeys(source.topic for source in self.sources.values()):
            topic, use = self.log.topic(name), self.map.use(name).use
            times = self._within(topic.clock(use), name)
            count = _repetitions(times)
            received = _repetitions(topic.received) if self.between is None else 0
            hint = f": in the map, clocks: {{{name}: {{use: log}}}}" if use != LOG and received < count else ""
            if count:
                self.notes.append(f"topic '{name}': {count} of {len(times)} messages repeat a time and are left out{hint}")
            back = np.diff(times)
            if (back < 0).any():
                much = f"{(back < 0).sum()} times, by up to {-back.min() * 1e-9:.3g} s"
                anew = "; a clock that began anew mixes two recordings: 'use: log'" if back.min() < -1e9 and use != LOG else ""
                self.notes.append(f"topic '{name}': its times go back {much}: sorted by time{anew}")

    def _within(self, at: Times, topic: str) -> Times:
        """Return those of a topic's times (ns, its own clock) that are in the span of rows."""
        if self.between is None:
            return at
        moved = at + round(self.map.use(topic).offset * 1e9)
        return at[(moved >= self.between[0]) & (moved < self.between[1])]

    def _lost_frames(self) -> dict[str, Times]:
        """Return topic -> times (ns) of frames without a rotation, where there are any."""
        yaw = self.sources.get("cam_yaw")
        if yaw is None:
            return {}
        where = f"{self.log.name}: channel 'cam_yaw'"
        at = lost_frames(self.log.topic(yaw.topic), yaw.field, self.map.use(yaw.topic).use, where)
        if count := len(self._within(at, yaw.topic)):
            self.notes.append(f"topic '{yaw.topic}': {count} lost frame{'s are' if count > 1 else ' is'} left out")
        return {yaw.topic: at}

    def _read(self, lost: Mapping[str, Times]) -> None:
        for column, source in list(self.sources.items()):
            at, values = self._series(column, lost)
            if len(at) < 2:
                text = f"topic '{source.topic}', field '{source.field}': {len(at)} samples, expected at least 2"
                if self.between is None or column in REQUIRED:
                    raise NoRowsError(f"{self.log.name}: channel '{column}': {text}")
                self.notes.append(f"'{column}' is left out: {text}")
                del self.sources[column]
                continue
            same = (other for other, _ in self.series.values() if np.array_equal(other, at))
            self.series[column] = (next(same, at), values)  # a topic's channels share their times
        for joint in JOINTS:
            angles, said = without_wraps(self.series, joint)
            self.series[f"pos_{joint}"] = (self.series[f"pos_{joint}"][0], angles)
            self.notes += [said] if said else []

    def _series(self, column: str, lost: Mapping[str, Times]) -> tuple[Times, Array]:
        """Return a channel's samples in SI units on the common clock, in the order of time; times once only."""
        source = self.sources[column]
        topic, clock = self.log.topic(source.topic), self.map.use(source.topic)
        if column in COMMANDS and (angle := self.sources[column.replace("cmd", "pos")]).topic == source.topic:
            topic = with_torque_off(topic, source.field, angle.field)
        where = f"{self.log.name}: channel '{column}'"
        if source.field in topic.fields or source.field.rpartition(".")[2] not in ANGLES:
            at, raw = topic.series(source.field, clock.use, where)
        else:
            at, raw = pose_angle(topic, source.field, clock.use, self.map.frames.get("cam"), where)
        if column in CAMERA and source.topic in lost:
            seen = ~np.isin(at, lost[source.topic])
            at, raw = at[seen], raw[seen]
        at = at + round(clock.offset * 1e9)
        keep = np.concatenate([np.diff(at) > 0, [True]])  # of two at one time, the later message
        if column not in COMMANDS:
            keep &= np.isfinite(raw)
        if not keep.all():
            at, raw = at[keep], raw[keep]
        return at, source.sign * (source.factor * raw - source.zero)

    # ---- times of rows ----------------------------------------------------------------------------------------------

    def _row_times(self) -> Times:
        rows = rows_topic(self.map, self.sources)
        of_rows = [self.series[column][0] for column, source in self.sources.items() if source.topic == rows]
        if not of_rows:
            raise InputError(f"{self.log.name}: rows = '{rows}': no channel comes from that topic")
        times = max(of_rows, key=len)
        if self.between is not None:
            times = times[(times >= self.between[0]) & (times < self.between[1])]
        times = times[:: self.map.every]
        if len(times) < 2:
            raise NoRowsError(f"{self.log.name}: topic '{rows}': {len(times)} messages; a run has at least 2")
        rate = 1e9 / float(np.median(np.diff(times)))
        if rate > _QUICK:
            hint = f"'every: {round(rate / 50)}' takes 50"
            self.notes.append(f"rows come {rate:.0f} times a second, from topic '{rows}': {hint}")
        return times

    def _complete(self, times: Times) -> Times:
        """Return the rows that have all required channels, less up to a second at the ends where others begin later.

        The last setpoint holds to the end of the rows: some robots are sent one only when it changes.
        """
        half = int(np.median(np.diff(times)) / 2)
        begins = {name: int(self.series[name][0][0]) - half for name in REQUIRED if name in self.series}
        ends = {
            name: int(at[-1]) + half
            for name, (at, _) in self.series.items()
            if name in REQUIRED and self.sources[name].take != "hold"
        }
        first, last = max(begins.values()), min(ends.values(), default=int(times[-1]))
        for name, (at, _) in self.series.items():
            if self.sources[name].take in ("interpolate", "nearest"):
                reach = int(np.median(np.diff(at)) / 2)
                if at[0] - reach < first + _END:
                    begins[name] = int(at[0]) - reach
                if at[-1] + reach > last - _END:
                    ends[name] = int(at[-1]) + reach
        first, last = max(begins.values()), min(ends.values(), default=int(times[-1]))
        kept = times[(times >= first) & (times <= last)]
        if len(kept) < 2:
            spans = [
                f"{name} from {self.series[name][0][0] * 1e-9:.3f} to {self.series[name][0][-1] * 1e-9:.3f} s"
                for name in REQUIRED[1::8]
            ]
            together = f"setpoints and positions are never known together ({'; '.join(spans)}): check 'clocks'"
            raise NoRowsError(f"{self.log.name}: {together}")
        sides = (
            (times[times < first], "beginning", max(begins, key=lambda name: begins[name])),
            (times[times > last], "end", min(ends, key=lambda name: ends[name], default="")),
        )
        for rows, side, name in sides:
            if len(rows):
                text = f"'{name}' (topic '{self.sources[name].topic}') is not known there"
                self.notes.append(f"{len(rows)} rows ({len(rows) * 2e-9 * half:.1f} s) at the {side} are left out: {text}")
        return kept

    def _without_holes(self, times: Times) -> Times:
        """Return the rows at which all angles are known: where another topic than the rows' is silent, some are not."""
        said, keep, step = [], np.ones(len(times), bool), float(np.median(np.diff(times))) * 1e-9
        for name in (one for one in REQUIRED if one in self.series and self.sources[one].take == "interpolate"):
            missing = keep & ~bridged(times, self.series[name][0])
            keep &= ~missing
            if missing.any():
                text = f"'{name}' (topic '{self.sources[name].topic}') has a hole there"
                said.append(f"{missing.sum()} rows ({missing.sum() * step:.1f} s) are left out: {text}")
        if keep.sum() < 2:
            raise NoRowsError(f"{self.log.name}: no two rows have all that a row needs: {'; '.join(said)}")
        self.notes += said
        return times[keep]

    def _say_silent(self, times: Times) -> None:
        """Say where a setpoint is held for longer than usual: nothing came, or nothing changed."""
        said = set()
        step = float(np.median(np.diff(times)))
        for name, (at, _) in self.series.items():
            topic = self.sources[name].topic
            if self.sources[name].take != "hold" or topic in said:
                continue
            age = times - at[np.clip(np.searchsorted(at, times + round(0.5 * step), side="right") - 1, 0, len(at) - 1)]
            held = age > hole(at)
            if held.any():
                said.add(topic)
                text = f"its last message is held over {held.sum()} rows ({held.sum() * step * 1e-9:.1f} s)"
                self.notes.append(f"topic '{topic}': silent for up to {age.max() * 1e-9:.1f} s: {text}")


def _seconds(times: Times, origin: int) -> Array:
    return np.asarray((times - origin) * 1e-9, np.float64)


def _repetitions(times: Times) -> int:
    return len(times) - len(np.unique(times))


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


# ---- part by part ----------------------------------------------------------------------------------------------------


#: s, and numbers of the log, that a part may have (250 s of 40 channels at 200 Hz); ``split`` may ask for longer ones.
LONGEST, NUMBERS = 600.0, 2_000_000
#: Share of a part's length by which a cut may be moved to where the robot is quieter.
_PLAY = 0.25
#: s that samples of a part go on at its ends.
_AROUND = 0.1
#: Usual steps, and s, from which on what is between two rows is a hole; s below which a piece between holes is no run.
_HOLE, _LEAST_HOLE, _LEAST_PIECE = 5.0, 0.5, 1.0


def runs_of(
    recording: TopicStore, found: LogMap, resolved: Mapping[str, Resolved], split: float | None, tell: Share
) -> Iterator[MadeRun]:
    """Yield the runs that a map makes of a recording.

    One, or of one that is longer than :data:`LONGEST`, or has more than :data:`NUMBERS`, several; with ``split``, runs of about
    so many seconds, none of them across a hole. What is to be said of all of them goes into the recording's notes.

    Raises:
        InputError: what :func:`wlr_gym.data.logs.rows.make_run` raises; parts without rows are left out, and said.
    """
    check_sources(recording.name, resolved)
    edges = _edges(recording, found, resolved, split)
    if len(edges) < 3:
        yield from _parts(make_run(recording.whole(), found, resolved), split)
        return
    recording.notes.append(f"cut into {len(edges) - 1} parts, where the robot is quietest")
    start, begin, refused = edges[0], edges[0], 0
    for k, edge in enumerate(edges[1:], 1):
        here = f"{(begin - start) * 1e-9:.0f} s on: "
        play = round(_PLAY * min(edge - edges[k - 1], edges[k + 1] - edge)) if k + 1 < len(edges) else 0
        try:
            made, begin = _part_until(recording, found, resolved, (begin, edge), play)
        except NoRowsError as error:
            refused, begin = refused + 1, edge
            if refused == len(edges) - 1:
                raise
            recording.notes.append(f"{here}no run: {str(error).partition(': ')[2]}")
        else:
            yield from _parts(replace(made, notes=tuple(here + note for note in made.notes)), split)
        tell(k / (len(edges) - 1))


def _part_until(
    recording: TopicStore, found: LogMap, resolved: Mapping[str, Resolved], span: tuple[int, int], play: int
) -> tuple[MadeRun, int]:
    """Return the rows of a span (ns), its end moved by up to ``play`` to where the robot is quiet, and that end."""
    begin, edge = span
    end = edge + play

    def when(topic: str) -> tuple[str, int, int]:
        clock = found.use(topic)
        offset = round(clock.offset * 1e9)
        return clock.use, begin - offset, end - offset

    made = make_run(recording.between(when), found, resolved, (begin, end))
    t, middle = made.table["t"], (edge - made.origin) * 1e-9
    last = _quiet_row(made, middle, play * 1e-9 / _PLAY) if play and 0.0 < middle < t[-1] else 0
    if last < 2:  # nothing to be cut
        return _part(made, 0, len(t)), end
    return _part(made, 0, last), made.origin + round(float(t[last]) * 1e9)


def _edges(recording: TopicStore, found: LogMap, resolved: Mapping[str, Resolved], split: float | None) -> list[int]:
    """Return where parts begin and end, ns on the common clock; none where the recording is a part itself."""
    rows = rows_topic(found, resolved)
    if rows not in recording:
        return []
    clock = found.use(rows)
    spans = recording.spans(rows, clock.use)
    seconds = len(spans) * float(np.median([last - first for first, last in spans])) * 1e-9  # whatever a stray header says
    longest = max(min(LONGEST, seconds * NUMBERS / max(recording.numbers, 1)), split or 0.0)
    count = min(math.ceil(seconds / longest), len(spans)) if longest > 0.0 else 1
    begins = sorted({first for first, _ in spans})
    inner = [begins[k * len(begins) // count] for k in range(1, count)]
    edges = sorted({begins[0], *inner, max(last for _, last in spans) + 1})
    return [edge + round(clock.offset * 1e9) for edge in edges]


# ---- cutting what is in memory ---------------------------------------------------------------------------------------


def _parts(made: MadeRun, split: float | None) -> Iterator[MadeRun]:
    """Yield a recording whole, or in parts of about ``split`` seconds, none of them across a hole."""
    if split is None:
        yield made
        return
    t = made.table["t"]
    holes = np.flatnonzero(np.diff(t) > max(_HOLE * float(np.median(np.diff(t))), _LEAST_HOLE)) + 1
    pieces = list(itertools.pairwise([0, *holes.tolist(), len(t)]))
    kept = [(first, last) for first, last in pieces if t[last - 1] - t[first] >= _LEAST_PIECE] or pieces
    if len(kept) < len(pieces):
        text = f"{len(pieces) - len(kept)} pieces between holes are shorter than {_LEAST_PIECE:g} s and are left out"
        made = replace(made, notes=(*made.notes, text))
    for first, last in kept:
        piece = made if len(pieces) == 1 else _part(made, first, last)
        whole = float(piece.table["t"][-1])
        count = max(round(whole / split), 1)
        cuts = [_quiet_row(piece, k * whole / count, whole / count) for k in range(1, count)]
        edges = [0, *cuts, len(piece.table["t"])]
        for begin, end in itertools.pairwise(edges):
            yield piece if len(edges) == 2 else _part(piece, begin, end)


def _quiet_row(made: MadeRun, middle: float, length: float) -> int:
    """Return the row near a time at which the joints are asked to move least."""
    t = made.table["t"]
    rows = np.flatnonzero(np.abs(t - middle) <= _PLAY * length)
    motion = np.zeros(len(t))
    for joint in JOINTS:
        motion += np.abs(np.gradient(made.table[f"pos_{joint}"], t))
    width = max(int(0.3 / float(np.median(np.diff(t)))), 1)
    smooth = np.convolve(motion, np.ones(width) / width, mode="same")
    cost = smooth[rows] + 0.01 * np.abs(t[rows] - middle) / length
    return int(rows[np.argmin(cost)])


def _part(made: MadeRun, first: int, last: int) -> MadeRun:
    table = {name: values[first:last].copy() for name, values in made.table.items()}
    begin, end = float(table["t"][0]), float(table["t"][-1])
    samples = {}
    for name, one in made.samples.items():
        inside = (one.t >= begin - _AROUND) & (one.t <= end + _AROUND)
        samples[name] = Samples(one.t[inside] - begin, one.values[inside])
    for wheel in (f"pos_{wheel}" for wheel in WHEELS):  # wheels count from the run's start
        start = table[wheel][0]
        table[wheel] -= start
        samples[wheel] = Samples(samples[wheel].t, samples[wheel].values - start)
    table["t"] -= begin
    return replace(made, table=table, samples=samples, origin=made.origin + round(begin * 1e9))


def write_samples(path: Path, made: MadeRun) -> None:
    """Write every sample at its own time: channel, t (s, the run's clock), value (SI units)."""
    import pyarrow
    import pyarrow.parquet

    schema = pyarrow.schema([("channel", pyarrow.string()), ("t", pyarrow.float64()), ("value", pyarrow.float64())])
    with pyarrow.parquet.ParquetWriter(path, schema, compression="zstd") as writer:
        for name, one in made.samples.items():
            columns = [pyarrow.array([name] * len(one.t)), pyarrow.array(one.t), pyarrow.array(one.values)]
            writer.write_table(pyarrow.table(columns, schema=schema))
