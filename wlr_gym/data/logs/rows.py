"""Make runs of a recording by a map: rows at the true times of one topic, in which every channel gets its value."""

from __future__ import annotations

import itertools
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from wlr_gym.base.errors import InputError
from wlr_gym.data.format import CAMERA, COLUMNS, COMMANDS, REQUIRED
from wlr_gym.data.logs.map import LogMap, Resolved
from wlr_gym.data.logs.readers import TABLE
from wlr_gym.data.logs.topics import LOG, Log, Topic
from wlr_gym.data.run_states import euler_angles
from wlr_gym.robot import JOINTS, WHEELS
from wlr_gym.robot.parameter_table import XYZ

Array = NDArray[np.float64]
Times = NDArray[np.int64]
#: Times (ns) and values of a channel.
Series = tuple[Times, Array]

#: Angles that can be taken of a quaternion.
ANGLES = ("yaw", "pitch", "roll")


def pose_angle(topic: Topic, field: str, use: str, axes: Sequence[str] | None, where: str) -> tuple[Times, Array, Times]:
    """Return times (ns) and an angle (rad) of a quaternion: ``yaw``, ``pitch`` or ``roll``.

    Frames whose quaternion is no rotation (not known, or of length 0) are lost: their times (ns) come last.

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
    names = next((names for names in _quaternions(stem) if names[0] in topic.fields), _quaternions(stem)[0])
    parts = [topic.series(name, use, where) for name in names]
    at = np.unique(np.concatenate([times for times, _ in parts]))
    quaternion = np.full((len(at), len(parts)), np.nan)  # of a table's row some parts may be missing
    for part, (times, values) in enumerate(parts):
        quaternion[np.searchsorted(at, times), part] = values
    seen = np.linalg.norm(quaternion, axis=1) >= 0.5
    w, *vector = (quaternion[seen] / np.linalg.norm(quaternion[seen], axis=1)[:, None]).T
    if axes is not None:  # a proper turn of both frames: the quaternion's vector turns with them
        vector = [vector[XYZ.index(axis[-1])] * (-1.0 if axis.startswith("-") else 1.0) for axis in axes]
    yaw, pitch, roll = euler_angles(np.stack([w, *vector], axis=1))
    values = {"yaw": np.unwrap(yaw), "pitch": pitch, "roll": roll}[angle]
    return at[seen], values, at[~seen]


def has_angle(topic: Topic, field: str) -> bool:
    """Whether a field that a topic does not have is to be taken of a quaternion."""
    return field not in topic.fields and field.rpartition(".")[2] in ANGLES


def quaternion_names(stem: str) -> set[str]:
    """Return the names that the parts of a quaternion may have."""
    return {name for names in _quaternions(stem) for name in names}


def _quaternions(stem: str) -> list[list[str]]:
    """Return names of w, x, y and z of a quaternion.

    Of ``q`` they are ``q.w``, or in tables ``q_w`` or ``qw``; a list without names says its order: ``q[xyzw]`` has its w in
    ``q[3]``.
    """
    ordered = re.fullmatch(r"(.*)\[([wxyz]{4})\]", stem)
    if ordered and sorted(ordered[2]) == list("wxyz"):
        return [[f"{ordered[1]}[{ordered[2].index(part)}]" for part in "wxyz"]]
    return [[f"{stem}{joint}{part}" for part in "wxyz"] for joint in (".", "_", "")]


# ---- values at the times of rows that are not a channel's own --------------------------------------------------------


#: Usual steps between a channel's samples beyond which nothing is said of what lies between.
_BRIDGED = 5.0
#: s; holes up to this are bridged whatever the channel's rate.
_SHORT = 0.1


def hole(at: Times) -> float:
    """Return how far samples (ns) may be apart, at most, so that they say what is between them, ns."""
    return max(_BRIDGED * float(np.median(np.diff(at))), _SHORT * 1e9)


def bridged(times: Times, at: Times) -> NDArray[np.bool_]:
    """Whether the samples before and after each time say what was between them; a sample at the time itself does."""
    after = np.clip(np.searchsorted(at, times), 1, len(at) - 1)
    usual = float(np.median(np.diff(at)))
    width = (at[after] - at[after - 1]).astype(np.float64)
    share = (times - at[after - 1]) / width
    edge = 0.5 * usual / width  # the first and last half step are read off the line
    inside = (share >= -edge) & (share <= 1.0 + edge) & (width <= hole(at))
    return inside | (at[after] == times) | (at[after - 1] == times)


def _next_to(times: Times, at: Times) -> NDArray[np.intp]:
    after = np.clip(np.searchsorted(at, times), 1, len(at) - 1)
    return after - ((times - at[after - 1]) < (at[after] - times))


#: Way that rows get a value -> what is said of it.
HOW = {
    "interpolate": "interpolated",
    "hold": "held at mid-step",
    "nearest": "nearest sample",
    "frames": "next to frames",
}


def at_rows(times: Times, at: Times, values: Array, take: str, period: float) -> tuple[Array, str, float]:
    """Return a channel's values at the rows, how they came about, and how far they were moved, s rms.

    Args:
        times: of the rows, ns.
        at, values: of the channel's samples.
        take: one of :data:`HOW`; a sample at a row's own time is taken as it is.
        period: s between rows.
    """
    place = np.minimum(np.searchsorted(at, times), len(at) - 1)
    exact = at[place] == times
    if exact.all():
        return values[place], "as recorded", 0.0
    if take == "hold":
        last = np.clip(np.searchsorted(at, times + round(0.5e9 * period), side="right") - 1, 0, len(at) - 1)
        result, moved = values[last], at[last] - times
        moved = moved[np.abs(moved) < 1e9 * period]
    else:
        moved = at[_next_to(times, at)] - times
        if take == "nearest":
            result = np.where(np.abs(moved) <= hole(at), values[_next_to(times, at)], np.nan)
        else:
            after = np.clip(np.searchsorted(at, times), 1, len(at) - 1)
            share = (times - at[after - 1]) / (at[after] - at[after - 1]).astype(np.float64)
            result = values[after - 1] + share * (values[after] - values[after - 1])
            result = np.where(bridged(times, at), result, np.nan)
        if take == "frames":  # each goes to the row next to it, moved along the line to the next; the other rows get none
            inside = (at >= times[0] - 0.5e9 * period) & (at <= times[-1] + 0.5e9 * period)
            rows = np.isin(np.arange(len(times)), _next_to(at[inside], times))
            result, moved = np.where(rows, result, np.nan), moved[rows]
    rms = float(np.sqrt(np.mean(np.square(moved.astype(np.float64))))) * 1e-9 if len(moved) else 0.0
    return np.where(exact, values[place], result), HOW[take], rms


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


def without_wraps(series: Mapping[str, Series], joint: str) -> tuple[Array, str]:
    """Return a joint's angles, jumps undone where they start anew after a turn or half of one; and what is to be said of it."""
    at, values = series[f"pos_{joint}"]
    steps, gaps = np.abs(np.diff(values)), np.diff(at)
    if np.ptp(values) >= _TURN or not (steps > np.pi).any():
        return values, ""
    if not ((steps > _JUMP) & (gaps <= hole(at))).any():
        return values, f"'pos_{joint}': {(steps > np.pi).sum()} jumps of more than half a turn are left in"
    rates = [np.abs(series[name][1]) for name in (f"cmd_{joint}", f"vel_{joint}") if name in series and joint in WHEELS]
    rate = max((float(one[np.isfinite(one)].max(initial=0.0)) for one in rates), default=0.0)
    unsure = gaps[rate * gaps * 1e-9 > np.pi]
    if not len(unsure):
        return np.unwrap(values), ""
    where = f"between {len(unsure)} pairs of samples, up to {unsure.max() * 1e-9:.2g} s apart"
    return np.unwrap(values), f"'pos_{joint}': turns are a guess {where}: at {rate:.3g} rad/s that may be more than half a turn"


# ---- one run ---------------------------------------------------------------------------------------------------------


#: ns; channels that begin or end within this of the others shorten the run.
_END = 1_000_000_000
#: Rates of joints' messages from which on not every one makes a row, Hz.
_QUICK = 75.0


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
        facts: how the rows came about.
        origin: ns on the log's clock where the run's ``t`` is 0.
        notes: what was left out or changed.
    """

    table: dict[str, Array]
    facts: tuple[ChannelFact, ...]
    origin: int
    notes: tuple[str, ...]


def wanted_fields(resolved: Mapping[str, Resolved]) -> dict[str, set[str]]:
    """Return topic -> fields that a map needs."""
    wanted: dict[str, set[str]] = {}
    for source in resolved.values():
        stem, _, last = source.field.rpartition(".")
        wanted.setdefault(source.topic, set()).update({source.field}, quaternion_names(stem) if last in ANGLES else ())
    return wanted


_WHEEL_ANGLES = {f"pos_{wheel}" for wheel in WHEELS}
_MISSING = {
    "cmd": "the setpoints that drove the robot, which every replay needs; without them no simulator can be compared",
    "pos": "the joints' angles, which every replay is compared with",
}


def make_run(log: Log, found: LogMap, resolved: Mapping[str, Resolved]) -> MadeRun:
    """Return the run that a map makes of a log.

    Every message of one topic makes a row, at its true time; a channel with a sample at that time has it as it is. Of the
    others the map, which ``resolved`` has for each channel, says how rows get a value. Nothing is brought to a raster.

    Raises:
        InputError: a required channel, a topic or a field is missing, or no two rows have all that a row needs.
    """
    missing = [name for name in REQUIRED if name != "t" and name not in resolved]
    if missing:
        raise InputError(f"{log.name}: no source for {', '.join(missing)}: {_MISSING[missing[0].partition('_')[0]]}")
    notes: list[str] = []
    _note_odd_times(log, found, resolved, notes)
    infinite: dict[str, Times] = {}
    series = _read_series(log, found, resolved, notes, infinite)
    times = _row_times(log, found, resolved, series, notes)
    times = _complete(log, resolved, series, times, notes)
    times = _without_holes(log, resolved, series, times, notes)
    origin, period = int(times[0]), float(np.median(np.diff(times))) * 1e-9
    table: dict[str, Array] = {"t": np.asarray((times - origin) * 1e-9, np.float64)}
    facts = []
    for column, source in resolved.items():
        at, values = series[column]
        values = np.unwrap(values) if column == "cam_yaw" else values
        table[column], how, moved = at_rows(times, at, values, source.take, period)
        table[column][np.searchsorted(times[:-1], infinite[column])] = np.inf  # refused, in its row or the next
        rate, known = 1e9 / float(np.median(np.diff(at))), float(np.isfinite(table[column]).mean())
        facts.append(ChannelFact(column, source.topic, source.field, source.unit, rate, how, moved, known))
    _note_silent(resolved, series, times, notes)
    off = np.isnan([table[name] for name in COMMANDS])
    if off.any():
        column = COMMANDS[int(np.argmax(off.any(axis=1)))]
        notes.append(f"{off.any(axis=0).sum()} rows have no setpoint, '{column}' among them: torque off")
    table = _from_start({name: table[name] for name in COLUMNS if name in table})
    return MadeRun(table, tuple(facts), origin, tuple(notes))


def _from_start(table: Mapping[str, Array]) -> dict[str, Array]:
    """Return a run's table whose wheels' angles count from its start."""
    return {name: values - values[0] if name in _WHEEL_ANGLES else values for name, values in table.items()}


# ---- samples of a channel --------------------------------------------------------------------------------------------


def _note_odd_times(log: Log, found: LogMap, resolved: Mapping[str, Resolved], notes: list[str]) -> None:
    """Note of which topics messages have the time of the one before, of which only the later counts, or go back in time."""
    for name in dict.fromkeys(source.topic for source in resolved.values()):
        topic, use = log.topic(name), found.use(name).use
        times = topic.clock(use)
        repeated, received = (len(one) - len(np.unique(one)) for one in (times, topic.received))
        if repeated:
            hint = f": in the map, clocks: {{{name}: {{use: log}}}}" if use != LOG and received < repeated else ""
            notes.append(f"topic '{name}': {repeated} of {len(times)} messages repeat a time and are left out{hint}")
        back = np.diff(times)
        if (back < 0).any():
            much = f"{(back < 0).sum()} times, by up to {-back.min() * 1e-9:.3g} s"
            anew = "; a clock that began anew mixes two recordings: 'use: log'" if back.min() < -1e9 and use != LOG else ""
            notes.append(f"topic '{name}': its times go back {much}: sorted by time{anew}")


def _read_series(
    log: Log, found: LogMap, resolved: Mapping[str, Resolved], notes: list[str], infinite: dict[str, Times]
) -> dict[str, Series]:
    """Return each channel's samples in SI units on the common clock, in the order of time; times once only.

    Times (ns) of infinite values go to ``infinite``.
    """
    lost: Times = np.zeros(0, np.int64)
    yaw = resolved.get("cam_yaw")
    if yaw is not None and has_angle(topic := log.topic(yaw.topic), yaw.field):
        _, _, lost = pose_angle(topic, yaw.field, found.use(yaw.topic).use, None, f"{log.name}: channel 'cam_yaw'")
        if len(lost):  # their positions are none, either
            notes.append(f"topic '{yaw.topic}': {len(lost)} lost frame{'s are' if len(lost) > 1 else ' is'} left out")
    series = {}
    for column, source in resolved.items():
        topic, clock = log.topic(source.topic), found.use(source.topic)
        where = f"{log.name}: channel '{column}'"
        if column in COMMANDS and (angle := resolved[column.replace("cmd", "pos")]).topic == source.topic:
            topic = with_torque_off(topic, source.field, angle.field)
        if has_angle(topic, source.field):
            at, raw, _ = pose_angle(topic, source.field, clock.use, found.frames.get("cam"), where)
        else:
            at, raw = topic.series(source.field, clock.use, where)
        offset = round(clock.offset * 1e9)
        infinite[column] = at[np.isinf(raw)] + offset
        keep = np.concatenate([np.diff(at) > 0, [True]])  # of two at one time, the later message
        keep &= np.isfinite(raw) if column not in COMMANDS else ~np.isinf(raw)
        if yaw is not None and column in CAMERA and source.topic == yaw.topic:
            keep &= ~np.isin(at, lost)
        at, raw = at[keep] + offset, raw[keep]
        if len(at) < 2:
            text = f"topic '{source.topic}', field '{source.field}': {len(at)} samples, expected at least 2"
            raise InputError(f"{where}: {text}")
        series[column] = at, source.sign * (source.factor * raw - source.zero)
    for joint in JOINTS:
        angles, said = without_wraps(series, joint)
        series[f"pos_{joint}"] = series[f"pos_{joint}"][0], angles
        notes += [said] if said else []
    return series


# ---- times of rows ---------------------------------------------------------------------------------------------------


def _row_times(
    log: Log, found: LogMap, resolved: Mapping[str, Resolved], series: Mapping[str, Series], notes: list[str]
) -> Times:
    topic = found.rows or resolved[f"pos_{JOINTS[0]}"].topic
    of_rows = [series[column][0] for column, source in resolved.items() if source.topic == topic]
    if not of_rows:
        raise InputError(f"{log.name}: rows = '{topic}': no channel comes from that topic")
    times = max(of_rows, key=len)[:: found.every]
    if len(times) < 2:
        raise InputError(f"{log.name}: topic '{topic}': {len(times)} messages; a run has at least 2")
    rate = 1e9 / float(np.median(np.diff(times)))
    if rate > _QUICK:
        hint = f"'every: {round(rate / 50)}' takes 50"
        notes.append(f"rows come {rate:.0f} times a second, from topic '{topic}': {hint}")
    return times


def _complete(
    log: Log, resolved: Mapping[str, Resolved], series: Mapping[str, Series], times: Times, notes: list[str]
) -> Times:
    """Return the rows that have all required channels, less up to a second at the ends where others begin later.

    The last setpoint holds to the end of the rows: some robots are sent one only when it changes.
    """
    half = int(np.median(np.diff(times)) / 2)
    required = [name for name in REQUIRED if name in series]
    begins = {name: int(series[name][0][0]) - half for name in required}
    ends = {name: int(series[name][0][-1]) + half for name in required if resolved[name].take != "hold"}
    first, last = max(begins.values()), min(ends.values(), default=int(times[-1]))
    for name in (one for one in series if resolved[one].take in ("interpolate", "nearest")):
        at = series[name][0]
        reach = int(np.median(np.diff(at)) / 2)
        if at[0] - reach < first + _END:
            begins[name] = int(at[0]) - reach
        if at[-1] + reach > last - _END:
            ends[name] = int(at[-1]) + reach
    first, last = max(begins.values()), min(ends.values(), default=int(times[-1]))
    kept = times[(times >= first) & (times <= last)]
    if len(kept) < 2:
        known = {name: series[name][0][[0, -1]] * 1e-9 for name in REQUIRED[1::8]}
        spans = [f"{name} from {begin:.3f} to {end:.3f} s" for name, (begin, end) in known.items()]
        raise InputError(f"{log.name}: setpoints and positions are never known together ({'; '.join(spans)}): check 'clocks'")
    for count, side, name in (
        ((times < first).sum(), "beginning", max(begins, key=lambda name: begins[name])),
        ((times > last).sum(), "end", min(ends, key=lambda name: ends[name], default="")),
    ):
        if count:
            text = f"'{name}' (topic '{resolved[name].topic}') is not known there"
            notes.append(f"{count} rows ({count * 2e-9 * half:.1f} s) at the {side} are left out: {text}")
    return kept


def _without_holes(
    log: Log, resolved: Mapping[str, Resolved], series: Mapping[str, Series], times: Times, notes: list[str]
) -> Times:
    """Return the rows at which all angles are known: where another topic than the rows' is silent, some are not."""
    said, keep, step = [], np.ones(len(times), bool), float(np.median(np.diff(times))) * 1e-9
    for name in (one for one in REQUIRED if one in series and resolved[one].take == "interpolate"):
        missing = keep & ~bridged(times, series[name][0])
        keep &= ~missing
        if missing.any():
            text = f"'{name}' (topic '{resolved[name].topic}') has a hole there"
            said.append(f"{missing.sum()} rows ({missing.sum() * step:.1f} s) are left out: {text}")
    if keep.sum() < 2:
        raise InputError(f"{log.name}: no two rows have all that a row needs: {'; '.join(said)}")
    notes += said
    return times[keep]


def _note_silent(resolved: Mapping[str, Resolved], series: Mapping[str, Series], times: Times, notes: list[str]) -> None:
    """Note where a setpoint is held for longer than usual: nothing came, or nothing changed."""
    said, step = set(), float(np.median(np.diff(times)))
    for name, (at, _) in series.items():
        topic = resolved[name].topic
        if resolved[name].take != "hold" or topic in said:
            continue
        age = times - at[np.clip(np.searchsorted(at, times + round(0.5 * step), side="right") - 1, 0, len(at) - 1)]
        rows = int((age > hole(at)).sum())
        if rows:
            said.add(topic)
            text = f"its last message is held over {rows} rows ({rows * step * 1e-9:.1f} s)"
            notes.append(f"topic '{topic}': silent for up to {age.max() * 1e-9:.1f} s: {text}")


# ---- several runs of one recording -----------------------------------------------------------------------------------


#: s; a longer recording becomes several runs.
LONGEST = 600.0
#: Share of a part's length by which a cut may be moved to where the robot is quieter.
_PLAY = 0.25
#: Usual steps, and s, from which on what is between two rows is a hole; s below which a piece between holes is no run.
_HOLE, _LEAST_HOLE, _LEAST_PIECE = 5.0, 0.5, 1.0


def split_run(made: MadeRun, split: float | None) -> Iterator[MadeRun]:
    """Yield a run, or several of about :data:`LONGEST` or ``split`` seconds, cut where the robot is quietest.

    Runs of a cut recording go across no hole.
    """
    t = made.table["t"]
    if split is None and t[-1] <= LONGEST:
        yield made
        return
    split = split or LONGEST
    holes = np.flatnonzero(np.diff(t) > max(_HOLE * float(np.median(np.diff(t))), _LEAST_HOLE)) + 1
    pieces = list(itertools.pairwise([0, *holes.tolist(), len(t)]))
    kept = [(first, last) for first, last in pieces if t[last - 1] - t[first] >= _LEAST_PIECE] or pieces
    if len(kept) < len(pieces):
        text = f"{len(pieces) - len(kept)} pieces between holes are shorter than {_LEAST_PIECE:g} s and are left out"
        made = replace(made, notes=(*made.notes, text))
    for first, last in kept:
        piece = made if len(pieces) == 1 else part_of(made, first, last)
        whole = float(piece.table["t"][-1])
        count = max(round(whole / split), 1)
        cuts = [_quiet_row(piece, k * whole / count, whole / count) for k in range(1, count)]
        for begin, end in itertools.pairwise([0, *cuts, len(piece.table["t"])]):
            yield part_of(piece, begin, end) if cuts else piece


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


def part_of(made: MadeRun, first: int, last: int) -> MadeRun:
    """Return rows of a run as a run."""
    table = _from_start({name: values[first:last] for name, values in made.table.items()})
    begin = float(table["t"][0])
    table["t"] = table["t"] - begin
    return replace(made, table=table, origin=made.origin + round(begin * 1e9))
