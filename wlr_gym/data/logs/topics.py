"""What a log holds, whatever wrote it: topics, the times of their messages, and their numeric fields."""

from __future__ import annotations

from array import array
from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import dataclass
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
        """Return times (ns) and values of one field, in the order of time; another name is refused."""
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
        """Return a topic; another name is refused with the nearest."""
        if name not in self.topics:
            raise unknown_name("topic", name, self.known | set(self.topics), self.name)
        return self.topics[name]


class Collector:
    """Gathers the numbers of one topic's messages.

    Args:
        name, kind: of the topic, and type of its messages.
        wanted: fields that are kept; None = all.
    """

    def __init__(self, name: str, kind: str, wanted: Collection[str] | None = None) -> None:
        self.name, self.kind, self.wanted = name, kind, wanted
        self._received, self._stamped = array("q"), array("q")
        self._fields: dict[str, tuple[array[int], array[float]]] = {}
        self._text = ""
        self._known: set[str] = set()

    def __len__(self) -> int:
        return len(self._received)

    def add(self, message: Message) -> None:
        """Keep a message."""
        row = len(self)
        self._received.append(message.time)
        if (stamp := stamp_of(message.content)) is not None:
            self._stamped.append(stamp)
        text = _items(message.content).get("data")
        self._text = text if isinstance(text, str) else ""
        for name, value in numbers(message.content):
            self._known.add(name)
            if self.wanted is None or name in self.wanted:
                rows, values = self._fields.setdefault(name, (array("q"), array("d")))
                rows.append(row)
                values.append(value)

    def topic(self) -> Topic:
        """Return what was gathered, in the order in which it was received; files that were merged have another."""
        received = np.array(self._received, np.int64)
        stamped = np.array(self._stamped, np.int64) if len(self._stamped) == len(received) else None
        every = np.arange(len(received))  # shared by all fields that every message has
        order = np.argsort(received, kind="stable")
        is_sorted = bool((order == every).all())
        place = np.argsort(order)
        fields = {}
        for name in list(self._fields):
            rows, values = map(np.array, self._fields.pop(name))
            if not is_sorted:
                turn = np.argsort(place[rows])
                rows, values = place[rows][turn], values[turn]
            fields[name] = (every if len(rows) == len(every) else rows, values)
        if not is_sorted:
            received, stamped = received[order], None if stamped is None else stamped[order]
        return Topic(self.name, self.kind, received, stamped, fields, self._text, frozenset(self._known))


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
    if _is_message(values[0]) and "interface_names" in _items(values[0]):  # control_msgs/DynamicJointState
        for joint, state in zip(names or range(len(values)), map(_items, values), strict=False):
            for kind, value in zip(state["interface_names"], state.get("values", ()), strict=False):
                yield f"{name}.{kind}[{joint}]", float(value)
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
