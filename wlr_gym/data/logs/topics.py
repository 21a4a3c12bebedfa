"""What a log holds, whatever wrote it: topics, the times of their messages, and their numeric fields.

A recording of any length is kept as blocks of its topics, beyond some memory in a temporary file, and given back whole or by
time.
"""

from __future__ import annotations

import pickle
import tempfile
from array import array
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from wlr_gym.base.errors import InputError, unknown_name

Array = NDArray[np.float64]
#: Called with the share of a file that has been read.
Share = Callable[[float], None]

#: Elements of an array or list that become fields; longer ones are pictures, point clouds and the like, and are left out.
LONGEST = 64
#: Clocks of a message: when it says that it was measured, and when the recorder received it.
HEADER, LOG = "header", "log"


class Message(NamedTuple):
    """One message: topic, type, when it was received (ns) and what it says: an object with fields, or a mapping."""

    topic: str
    kind: str
    time: int
    content: Any


@dataclass(frozen=True, eq=False)
class Topic:
    """The messages of one topic.

    Attributes:
        name: as in the log.
        kind: type of its messages, such as ``sensor_msgs/msg/Imu``.
        received: (n,) ns; the recorder's clock.
        stamped: (n,) ns; what the messages say of themselves; None = they do not.
        fields: name -> messages that have it (m,), and its values (m,).
        text: what the last message says, where it is a text (``std_msgs/String``).
        known: names of all fields, those that were not asked for included.
    """

    name: str
    kind: str
    received: NDArray[np.int64]
    stamped: NDArray[np.int64] | None
    fields: Mapping[str, tuple[NDArray[np.int64], Array]]
    text: str = ""
    known: frozenset[str] = frozenset()

    def clock(self, use: str) -> NDArray[np.int64]:
        """Return the times (n,) of the messages in ns, by ``header`` or ``log``."""
        if use == LOG or self.stamped is None:
            return self.received
        return self.stamped

    def series(self, name: str, use: str, where: str) -> tuple[NDArray[np.int64], Array]:
        """Return times (ns) and values of one field, in the order of time.

        Raises:
            InputError: no such field.
        """
        if name not in self.fields:
            raise unknown_name("field", name, self.known | set(self.fields), f"{where}: topic '{self.name}'")
        rows, values = self.fields[name]
        times = self.clock(use)
        times = times if len(rows) == len(times) else times[rows]
        if (np.diff(times) >= 0).all():  # nothing is copied, as a rule
            return times, values
        order = np.argsort(times, kind="stable")
        return times[order], values[order]


@dataclass(frozen=True, eq=False)
class Log:
    """One recording.

    Attributes:
        path: file or folder.
        topics: by name.
        notes: what was odd about the file, or left out.
        part: which part of the file; empty = all of it.
        known: names of all topics, those that were not asked for included.
    """

    path: Path
    topics: Mapping[str, Topic]
    notes: tuple[str, ...] = ()
    part: str = ""
    known: frozenset[str] = frozenset()

    @property
    def name(self) -> str:
        """Path and part, for messages."""
        return f"{self.path}{self.part and ', '}{self.part}"

    def topic(self, name: str) -> Topic:
        """Return a topic.

        Raises:
            InputError: there is none of that name.
        """
        if name not in self.topics:
            raise unknown_name("topic", name, self.known | set(self.topics), self.name)
        return self.topics[name]


@dataclass
class _Buffer:
    """Values of one field; ``rows`` stays None as long as every message has it: their numbers are counted then."""

    values: array[float] = field(default_factory=lambda: array("d"))
    rows: array[int] | None = None

    def add(self, row: int, value: float) -> None:
        if self.rows is None and row != len(self.values):
            self.rows = array("q", range(len(self.values)))
        if self.rows is not None:
            self.rows.append(row)
        self.values.append(value)


class Collector:
    """Gathers the messages of one topic: 8 bytes per number, 16 of a field that not every message has.

    Args:
        kind: type of the messages.
        wanted: fields that are kept; None = all.
    """

    def __init__(self, kind: str, wanted: Collection[str] | None = None) -> None:
        self.kind, self.wanted = kind, wanted
        self._received = array("q")
        self._stamped = array("q")
        self._buffers: dict[str, _Buffer] = {}
        self._text = ""
        self._known: set[str] = set()

    def __len__(self) -> int:
        return len(self._received)

    def add(self, message: Message) -> None:
        """Keep a message."""
        row = len(self._received)
        self._received.append(message.time)
        stamp = stamp_of(message.content)
        if stamp is not None:
            self._stamped.append(stamp)
        text = _items(message.content).get("data")
        self._text = text if isinstance(text, str) else ""
        for name, value in numbers(message.content):
            self._known.add(name)
            if self.wanted is None or name in self.wanted:
                self._buffers.setdefault(name, _Buffer()).add(row, value)

    def topic(self, name: str) -> Topic:
        """Return what was gathered; nothing is copied, and nothing may be added any more."""
        received, stamped = _array(self._received, np.int64), _array(self._stamped, np.int64)
        every = np.arange(len(received))  # shared by all fields that every message has
        fields = {}
        for key, one in self._buffers.items():
            rows = every if len(one.values) == len(every) else every[: len(one.values)]
            fields[key] = (rows if one.rows is None else _array(one.rows, np.int64), _array(one.values, np.float64))
        known = len(stamped) == len(received)
        return Topic(name, self.kind, received, stamped if known else None, fields, self._text, frozenset(self._known))


def _array(values: array[Any], kind: type[np.generic]) -> NDArray[Any]:
    return np.frombuffer(values, kind) if values else np.zeros(0, kind)


# ---- what a message says ---------------------------------------------------------------------------------------------


def stamp_of(content: Any) -> int | None:
    """Return the time (ns) in a message's header; of a list of messages without one, that of the first."""
    header = _items(content).get("header")
    found = _nanoseconds(_items(content if header is None else header).get("stamp"))
    if found is None and header is None:
        first = next((value for value in _items(content).values() if isinstance(value, list) and value), None)
        return stamp_of(first[0]) if first and _is_message(first[0]) and "header" in _items(first[0]) else None
    return found


def numbers(content: Any, prefix: str = "", outer: list[str] | None = None) -> Iterator[tuple[str, float]]:
    """Yield name and value of every number in a message: ``orientation.x``, ``data[2]``, ``position[left_wheel]``.

    Elements of arrays beside a list of as many names go by name, as in ``sensor_msgs/JointState``; so do lists of messages
    that have a name. Where the names stand beside a list of messages (``outer``), as in ``trajectory_msgs/JointTrajectory``,
    the arrays in them go by name and by place. Headers, texts, covariances and what is longer than :data:`LONGEST` are left
    out.
    """
    items = _items(content)
    names = _names(items)
    for key, value in items.items():
        if key == "header" or key.endswith("covariance") or isinstance(value, str):
            continue
        name = f"{prefix}{key}"
        if isinstance(value, bool | int | float | np.number):
            yield name, float(value)
        elif isinstance(value, list | np.ndarray):
            yield from _elements(name, value, names or outer)
            if names is None and outer is not None:
                yield from _elements(name, value, None)
        elif _is_message(value) and _nanoseconds(value) is None:
            yield from numbers(value, f"{name}.")


def _elements(name: str, values: Any, names: list[str] | None) -> Iterator[tuple[str, float]]:
    if len(values) == 0 or len(values) > LONGEST or isinstance(values[0], str):
        return
    if _is_message(values[0]):
        for k, value in enumerate(values):
            yield from numbers(value, f"{name}[{_label(value, k)}].", names)
        return
    labels = names if names is not None and len(names) == len(values) else range(len(values))
    for label, value in zip(labels, values, strict=True):
        if isinstance(value, bool | int | float | np.number):
            yield f"{name}[{label}]", float(value)


def _names(items: Mapping[str, Any]) -> list[str] | None:
    for key in ("name", "names", "joint_names"):
        value = items.get(key)
        if isinstance(value, list) and value and all(isinstance(one, str) for one in value):
            return value
    return None


def _label(message: Any, place: int) -> str:
    items = _items(message)
    for key in ("name", "child_frame_id", "id"):
        value = items.get(key)
        if isinstance(value, str) and value:
            return value
        if isinstance(value, int | np.integer) and not isinstance(value, bool):
            return str(int(value))
    return str(place)


def _is_message(value: Any) -> bool:
    return isinstance(value, Mapping) or hasattr(value, "__dataclass_fields__")


def _items(content: Any) -> Mapping[str, Any]:
    if isinstance(content, Mapping):
        return content
    return {key: getattr(content, key) for key in getattr(content, "__dataclass_fields__", ())}


def _nanoseconds(time: Any) -> int | None:
    """Return a time of a message in ns: of ROS 1 and 2, and of JSON schemas."""
    items = _items(time)
    fraction = next((items[key] for key in ("nanosec", "nsec", "nsecs", "nanos") if key in items), None)
    whole = next((items[key] for key in ("sec", "secs", "seconds") if key in items), None)
    return None if whole is None or fraction is None else int(whole) * 1_000_000_000 + int(fraction)


def cannot_read(path: Path, what: str, error: object) -> InputError:
    """Return the error for a file that is not what it seems to be."""
    text = " ".join(str(error).split()) or type(error).__name__
    return InputError(f"{path}: cannot be read as {what}: {text}")


# ---- recordings of any length ----------------------------------------------------------------------------------------


#: Bytes that are kept in memory; what is more goes to a temporary file.
IN_MEMORY = 2**25
#: Messages of one topic in a block.
BLOCK = 4096


class _Block(NamedTuple):
    """Where it lies, how many bytes it has, and for each clock when its messages begin and end, ns."""

    place: int
    length: int
    spans: dict[str, tuple[int, int]]


class TopicStore:
    """One recording, as blocks of its topics. ``close`` it: its temporary file goes with it.

    Args:
        path: file or folder.
        part: which part of the file; empty = all of it.

    Attributes:
        notes: what was odd about the file, or left out.
        known: names of all topics, those that were not asked for included.
        numbers: count of all numbers in it.
    """

    def __init__(self, path: Path, part: str = "") -> None:
        self.path, self.part = path, part
        self.notes: list[str] = []
        self.known: set[str] = set()
        self.numbers = 0
        self._file = tempfile.SpooledTemporaryFile(IN_MEMORY)  # noqa: SIM115
        self._end = 0
        self._blocks: dict[str, list[_Block]] = {}
        self._stamped: dict[str, tuple[bool, bool]] = {}

    def add(self, topic: Topic) -> None:
        """Keep the next messages of a topic."""
        content = pickle.dumps(topic, protocol=pickle.HIGHEST_PROTOCOL)
        try:
            self._file.seek(self._end)
            self._file.write(content)
        except OSError as error:
            text = f"no room for its numbers in {tempfile.gettempdir()} (TMPDIR): {error.strerror}"
            raise InputError(f"{self.name}: {text}") from None
        spans = {use: (int(topic.clock(use).min()), int(topic.clock(use).max())) for use in (HEADER, LOG)}
        self._blocks.setdefault(topic.name, []).append(_Block(self._end, len(content), spans))
        self._end += len(content)
        self.numbers += sum(len(values) for _, values in topic.fields.values())
        every, some = self._stamped.get(topic.name, (True, False))
        stamped = topic.stamped is not None and bool((topic.stamped > 0).any())
        self._stamped[topic.name] = every and topic.stamped is not None, some or stamped

    @property
    def name(self) -> str:
        """Path and part, for messages."""
        return Log(self.path, {}, part=self.part).name

    def __contains__(self, name: str) -> bool:
        return name in self._blocks

    @property
    def empty(self) -> bool:
        """Whether no message was kept."""
        return not self._blocks

    def spans(self, name: str, use: str) -> list[tuple[int, int]]:
        """Return when each block of a topic begins and ends, ns by ``header`` or ``log``."""
        return [block.spans[self._clock(name, use)] for block in self._blocks[name]]

    def whole(self) -> Log:
        """Return all of it."""
        return self._log(self._blocks)

    def between(self, when: Callable[[str], tuple[str, int, int]]) -> Log:
        """Return the blocks of a time, and of each topic the one before and the one after: they say what holds at its ends.

        Args:
            when: topic -> clock, and ns on it from when to when.
        """
        found = {}
        for name, blocks in self._blocks.items():
            use, begin, end = when(name)
            found[name] = list(_about(blocks, self._clock(name, use), begin, end))
        return self._log(found)

    def close(self) -> None:
        """Give up what is kept."""
        self._file.close()

    def _clock(self, name: str, use: str) -> str:
        return use if all(self._stamped[name]) else LOG

    def _log(self, found: Mapping[str, Sequence[_Block]]) -> Log:
        topics = {name: self._topic(name, blocks) for name, blocks in found.items()}
        return Log(self.path, topics, tuple(self.notes), self.part, frozenset(self.known))

    def _topic(self, name: str, blocks: Iterable[_Block]) -> Topic:
        parts = []
        for block in blocks:
            self._file.seek(block.place)
            parts.append(pickle.loads(self._file.read(block.length)))
        topic = in_order(joined(parts))
        return topic if all(self._stamped[name]) else replace(topic, stamped=None)


def _about(blocks: Sequence[_Block], clock: str, begin: int, end: int) -> Iterable[_Block]:
    spans = [block.spans[clock] for block in blocks]
    before = max((last for _, last in spans if last < begin), default=begin)
    after = min((first for first, _ in spans if first > end), default=end)
    return (block for block, (first, last) in zip(blocks, spans, strict=True) if last >= before and first <= after)


def joined(parts: Sequence[Topic]) -> Topic:
    """Return parts of one topic, in their order, as one."""
    if len(parts) == 1:
        return parts[0]
    starts = np.cumsum([0, *(len(part.received) for part in parts)])
    every = np.arange(starts[-1])
    fields = {}
    for name in dict.fromkeys(name for part in parts for name in part.fields):
        having = [(part.fields[name], start) for part, start in zip(parts, starts[:-1], strict=True) if name in part.fields]
        values = np.concatenate([one[1] for one, _ in having])
        rows = every if len(values) == len(every) else np.concatenate([one[0] + start for one, start in having])
        fields[name] = (rows, values)
    stamped = [part.stamped for part in parts if part.stamped is not None]
    return Topic(
        parts[0].name,
        parts[0].kind,
        np.concatenate([part.received for part in parts]),
        np.concatenate(stamped) if len(stamped) == len(parts) else None,
        fields,
        parts[-1].text,
        frozenset[str]().union(*(part.known for part in parts)),
    )


def in_order(topic: Topic) -> Topic:
    """Return a topic with its messages in the order in which they were received; files that were merged have another."""
    if (np.diff(topic.received) >= 0).all():
        return topic
    order = np.argsort(topic.received, kind="stable")
    place = np.empty(len(order), np.int64)
    place[order] = np.arange(len(order))
    fields = {}
    for name, (rows, values) in topic.fields.items():
        turn = np.argsort(place[rows])
        fields[name] = (place[rows][turn], values[turn])
    stamped = None if topic.stamped is None else topic.stamped[order]
    return replace(topic, received=topic.received[order], stamped=stamped, fields=fields)
