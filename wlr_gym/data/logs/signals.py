"""What a log shows, as signals that can be compared: raw numbers of candidate fields on clocks that are roughly one."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from wlr_gym.data.format import CAMERA
from wlr_gym.data.logs.candidates import FieldCandidate
from wlr_gym.data.logs.map import LogMap, TopicClock
from wlr_gym.data.logs.rows import lost_frames, pose_angle
from wlr_gym.data.logs.topics import HEADER, LOG, Log
from wlr_gym.robot import Robot

Array = NDArray[np.float64]

#: s over which motions are compared.
WINDOW = 0.5
#: s; differences of clocks that no delay of a recorder makes.
_GROSS = 0.1
#: Share of headers not later than the one before, from which on they are no times.
_NO_TIMES = 0.02
#: ns; a header that is so much before the one before comes from a clock that began anew.
_ANEW = -1_000_000_000
#: Words for how sure a proposal is.
SURE, LIKELY, GUESS = "sure", "likely", "guess"


@dataclass(frozen=True)
class Reason:
    """Why something is in a proposed map: what, how sure, and by what."""

    what: str
    sure: str
    why: str


@dataclass(frozen=True, eq=False)
class BodyMotion:
    """How the body moved: distance along its heading (m) and heading (rad) over time.

    ``straight`` is 1 where it drove straight on or stood, legs still, else 0; None = not known.
    """

    t: Array
    forward: Array
    heading: Array
    straight: Array | None = None


@dataclass(eq=False)
class LogSignals:
    """A log that is being looked at.

    Attributes:
        log: with all its fields.
        robot: that the run is of.
        chosen: column -> the field that it comes from.
        given: what the user's map says.
        clocks: topic -> clock, gross differences already in the offset.
        reasons: what was found.
        frames: ``imu``, ``cam`` -> axes, where they are not ours.
        acc_sign: -1 = the accelerometer reads gravity, not the floor's push.
        sided: whether it is known which way the wheels of each side count.
    """

    log: Log
    robot: Robot
    chosen: dict[str, FieldCandidate]
    given: LogMap
    clocks: dict[str, TopicClock] = field(default_factory=dict)
    reasons: list[Reason] = field(default_factory=list)
    frames: dict[str, Sequence[str]] = field(default_factory=dict)
    acc_sign: int = 1
    sided: bool = True

    def __post_init__(self) -> None:
        topics = {one.topic for one in self.chosen.values()}
        self._origin = min((int(self.log.topics[name].received[0]) for name in topics), default=0)

    def has(self, *columns: str) -> bool:
        """Whether all these columns have a field."""
        return all(column in self.chosen for column in columns)

    def clock(self, topic: str) -> TopicClock:
        """Return the clock of a topic, as far as it is known."""
        return self.clocks.get(topic, TopicClock())

    def raw(self, column: str) -> tuple[Array, Array]:
        """Return times (s, from the log's start) and values of a column's field, as the log has them."""
        chosen = self.chosen[column]
        topic, clock = self.log.topics[chosen.topic], self.clock(chosen.topic)
        if chosen.field not in topic.fields:
            at, values = pose_angle(topic, chosen.field, clock.use, self.frames.get("cam"), self.log.name)
        else:
            at, values = topic.series(chosen.field, clock.use, self.log.name)
        known = np.isfinite(values)
        if column in CAMERA:
            known &= ~np.isin(at, self.lost(chosen.topic))
        at, values = at[known], values[known]
        keep = np.concatenate([[True], np.diff(at) > 0]) if len(at) else np.zeros(0, bool)
        return np.asarray((at[keep] - self._origin) * 1e-9 + clock.offset, np.float64), values[keep]

    def lost(self, name: str) -> NDArray[np.int64]:
        """Return the times (ns) of a topic's frames without a rotation, by the heading that is chosen."""
        yaw = self.chosen.get("cam_yaw")
        if yaw is None or yaw.topic != name:
            return np.zeros(0, np.int64)
        return lost_frames(self.log.topics[name], yaw.field, self.clock(name).use, self.log.name)

    def note(self, what: str, sure: str, why: str) -> None:
        """Keep a reason."""
        self.reasons.append(Reason(what, sure, why))


def roughly_one_clock(log: Log, topics: Sequence[str], given: Mapping[str, TopicClock], rows: str) -> dict[str, TopicClock]:
    """Return a clock for each topic: headers where they are times, moved by what the recorder's clock shows to be amiss.

    A header that counts from another moment than the row topic's (an IMU's own uptime) is moved by the median difference.
    """
    late = {name: behind(log, name) for name in topics}
    base = late.get(rows)
    clocks = {}
    for name in topics:
        if name in given:
            clocks[name] = given[name]
        elif late[name] is None:
            clocks[name] = TopicClock(use=LOG)
        else:
            reference = base if base is not None else 0.0
            apart = float(late[name] or 0.0) - reference
            clocks[name] = TopicClock(use=HEADER, offset=round(apart, 6) if abs(apart) > _GROSS else 0.0)
    return clocks


def behind(log: Log, name: str) -> float | None:
    """Return how far the recorder's clock is ahead of a topic's headers, s; None where they are no times."""
    topic = log.topics[name]
    if topic.stamped is None or len(topic.stamped) < 2:
        return None
    steps = np.diff(topic.stamped)
    if (steps <= 0).mean() > _NO_TIMES or steps.min() < _ANEW:
        return None
    return float(np.median(topic.received - topic.stamped)) * 1e-9


# ---- comparing -------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Likeness:
    """How one motion goes with another: ``ratio`` of sizes (with sign), and their correlation."""

    ratio: float
    correlation: float


def over_windows(t: Array, angle: Array, grid: Array) -> Array:
    """Return how far a quantity went in each window that begins on the grid."""
    return np.interp(grid + WINDOW, t, angle) - np.interp(grid, t, angle)


def common_grid(*times: Array) -> Array:
    """Return where windows begin that all signals cover, 0.1 s apart."""
    begin, end = max(t[0] for t in times), min(t[-1] for t in times)
    return np.arange(begin, end - WINDOW, 0.1)


def likeness(measured: Array, expected: Array) -> Likeness | None:
    """Return how ``measured`` goes with ``expected``, both per window; None where one of them stands still."""
    if len(measured) < 10 or np.std(expected) < 1e-9 or np.std(measured) < 1e-12:
        return None
    product = float(measured @ expected)
    sizes = float(measured @ measured), float(expected @ expected)
    return Likeness(product / sizes[1], product / np.sqrt(sizes[0] * sizes[1]))


def unit_of(ratio: float, units: Mapping[str, float]) -> tuple[str, float]:
    """Return the unit in which ``ratio`` units are nearest to one, and by what factor it is still off."""
    name = min(units, key=lambda unit: abs(np.log(abs(ratio) * units[unit])))
    return name, float(abs(ratio) * units[name])
