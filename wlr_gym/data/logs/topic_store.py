"""Recordings of any length: their topics in blocks, beyond some memory in a temporary file, given back whole or by time."""

from __future__ import annotations

import pickle
import tempfile
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from wlr_gym.base.errors import InputError
from wlr_gym.data.logs.topics import HEADER, LOG, Log, Topic

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
