"""Open a log of any kind: the reader by what the path is."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping
from pathlib import Path

from wlr_gym.base.errors import InputError
from wlr_gym.data.logs import bags
from wlr_gym.data.logs.tables import INFO, TABLE, read_lerobot, read_table
from wlr_gym.data.logs.topics import Collector, Log, Message, Share

#: Topic -> fields that are read; None = all topics and all their fields.
Wanted = Mapping[str, Collection[str]]
_KINDS = "an .mcap, .db3, .bag, .csv or .parquet file, a folder of rosbag2, or a LeRobot data set"


def quiet(share: float) -> None:
    """Report no progress."""


def read_logs(path: str | Path, wanted: Wanted | None = None, most: int | None = None, tell: Share = quiet) -> Iterator[Log]:
    """Yield what a file or folder holds: one recording, or the episodes of a LeRobot data set.

    Of messages, which are read one after the other, only the numbers are kept, 8 bytes each.

    Args:
        path: what was recorded.
        wanted: topics and fields that are read; None = all.
        most: messages per topic that are kept; None = all.
        tell: called with the share that has been read.

    Raises:
        InputError: no such file, or one that cannot be read.
    """
    path = Path(path)
    read = _reader(path)
    columns = None if wanted is None else wanted.get(TABLE, ())
    tell(0.0)
    if read is not None:
        yield _gathered(path, read, wanted, most, tell)
    elif path.is_dir():
        yield from read_lerobot(path, columns, tell)
    else:
        yield read_table(path, columns, most)


def first_messages(path: Path) -> Iterator[Message]:
    """Yield the messages of a log from its beginning; none of a table.

    Raises:
        InputError: no such file, or one that cannot be read.
    """
    read = _reader(path)
    return iter(()) if read is None else read(path, lambda topic: True, [], quiet)


def _reader(path: Path) -> Callable[..., Iterator[Message]] | None:
    """Return what reads a log's messages; None = it is a table."""
    if not path.exists():
        raise InputError(f"{path}: no such file or folder; expected {_KINDS}")
    if path.is_dir():
        if (path / INFO).is_file():
            return None
        if (path / bags.METADATA).is_file() or any(path.glob("*.db3")) or any(path.glob("*.mcap")):
            return bags.bag_messages
        raise InputError(f"{path}: no bag and no data set in it; expected {_KINDS}")
    if path.stat().st_size == 0:
        raise InputError(f"{path}: empty file")
    readers = {".mcap": bags.mcap_messages, **dict.fromkeys((".db3", ".bag"), bags.bag_messages)}
    suffix = path.suffix.lower()
    if suffix not in (*readers, ".csv", ".parquet"):
        raise InputError(f"{path}: '{path.suffix}' files are not read; expected {_KINDS}")
    return readers.get(suffix)


def _gathered(path: Path, read: Callable[..., Iterator[Message]], wanted: Wanted | None, most: int | None, tell: Share) -> Log:
    """Gather a bag's messages; those of a second type on a topic become a topic ``/name (type)``."""
    notes: list[str] = []
    known: set[str] = set()
    collectors: dict[str, Collector] = {}
    topics = None if wanted is None else {name.partition(" (")[0] for name in wanted}

    def is_full(name: str) -> bool:
        return most is not None and name in collectors and len(collectors[name]) >= most

    def wants(topic: str) -> bool:
        known.add(topic)
        return (topics is None or topic in topics) and not is_full(topic)

    kinds: dict[str, str] = {}
    for message in read(path, wants, notes, tell):
        first = kinds.setdefault(message.topic, message.kind)
        name = message.topic if message.kind == first else f"{message.topic} ({message.kind})"
        if (wanted is not None and name not in wanted) or is_full(name):
            continue
        if name not in collectors:
            collectors[name] = Collector(name, message.kind, None if wanted is None else wanted[name])
        collectors[name].add(message)
    notes += [f"two types on one topic: the second is '{name}'" for name in collectors if name not in kinds]
    if not collectors and wanted is None:
        raise InputError(f"{path}: no message that can be read{''.join('; ' + note for note in notes)}")
    found = {name: collectors.pop(name).topic() for name in list(collectors)}
    return Log(path, found, tuple(notes), known=frozenset(known))
