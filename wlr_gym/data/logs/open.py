"""Open a log of any kind: the reader by what the path is."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping
from pathlib import Path

from wlr_gym.base.errors import InputError
from wlr_gym.data.logs import bags, mcap_file
from wlr_gym.data.logs.tables import LEROBOT_INFO, read_lerobot, read_table
from wlr_gym.data.logs.topics import Collector, Log, Message, Share

#: Topic -> fields that are read; None = all topics and all their fields.
Wanted = Mapping[str, Collection[str]]
_KINDS = "an .mcap, .db3, .bag, .csv or .parquet file, a folder of rosbag2, or a LeRobot data set"


def quiet(share: float) -> None:
    """Report no progress."""


def read_logs(path: str | Path, wanted: Wanted | None = None, most: int | None = None, tell: Share = quiet) -> Iterator[Log]:
    """Yield what a file or folder holds: one recording, or the episodes of a LeRobot data set.

    Messages are read one after the other, and of each only its numbers are kept.

    Args:
        path: what was recorded.
        wanted: topics and fields that are read; None = all.
        most: messages per topic that are kept; None = all.
        tell: called with the share that has been read.

    Raises:
        InputError: no such file, or one that cannot be read.
    """
    path = Path(path)
    if not path.exists():
        raise InputError(f"{path}: no such file or folder; expected {_KINDS}")
    if path.is_file() and path.stat().st_size == 0:
        raise InputError(f"{path}: empty file")
    if (path / LEROBOT_INFO).is_file():
        yield from read_lerobot(path, tell)
    elif path.suffix.lower() in (".csv", ".parquet"):
        yield read_table(path, tell)
    else:
        yield _gathered(path, _reader(path), wanted, most, tell)


def _reader(path: Path) -> Callable[..., Iterator[Message]]:
    if path.is_dir():
        if (path / bags.METADATA).is_file() or any(path.glob("*.db3")) or any(path.glob("*.mcap")):
            return bags.messages
        raise InputError(f"{path}: no bag and no data set in it; expected {_KINDS}")
    if path.suffix.lower() == ".mcap":
        return mcap_file.messages
    if path.suffix.lower() in (".db3", ".bag"):
        return bags.messages
    raise InputError(f"{path}: '{path.suffix}' files are not read; expected {_KINDS}")


def _gathered(path: Path, read: Callable[..., Iterator[Message]], wanted: Wanted | None, most: int | None, tell: Share) -> Log:
    collectors: dict[str, Collector] = {}
    notes: list[str] = []
    known: set[str] = set()

    def wants(topic: str) -> bool:
        known.add(topic)
        if wanted is not None and topic not in wanted:
            return False
        return topic not in collectors or not collectors[topic].full

    for message in read(path, wants, notes, tell):
        if message.topic not in collectors:
            fields = None if wanted is None else wanted[message.topic]
            collectors[message.topic] = Collector(message.kind, fields, most)
        if not collectors[message.topic].full:
            collectors[message.topic].add(message)
    if not collectors and wanted is None:
        raise InputError(f"{path}: no message that can be read{''.join('; ' + note for note in notes)}")
    return Log(
        path, {name: collector.topic(name) for name, collector in collectors.items()}, tuple(notes), known=frozenset(known)
    )


def first_messages(path: str | Path) -> Iterator[Message]:
    """Yield the messages of a log from its beginning; none of a table.

    Raises:
        InputError: no such file, or one that cannot be read.
    """
    path = Path(path)
    if not path.exists():
        raise InputError(f"{path}: no such file or folder; expected {_KINDS}")
    if path.suffix.lower() in (".csv", ".parquet") or (path / LEROBOT_INFO).is_file():
        return iter(())
    return _reader(path)(path, lambda topic: True, [], quiet)
