"""Open a log of any kind: the reader by what the path is."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import closing
from pathlib import Path

from wlr_gym.base.errors import InputError
from wlr_gym.data.logs import bags
from wlr_gym.data.logs.tables import INFO, TABLE, read_lerobot, read_table
from wlr_gym.data.logs.topics import BLOCK, Collector, Log, Message, Share, TopicStore

#: Topic -> fields that are read; None = all topics and all their fields.
Wanted = Mapping[str, Collection[str]]
_KINDS = "an .mcap, .db3, .bag, .csv or .parquet file, a folder of rosbag2, or a LeRobot data set"


def quiet(share: float) -> None:
    """Report no progress."""


def read_logs(path: str | Path, wanted: Wanted | None = None, most: int | None = None, tell: Share = quiet) -> Iterator[Log]:
    """Yield what a file or folder holds, in memory: one recording, or the episodes of a LeRobot data set.

    Args:
        path: what was recorded.
        wanted: topics and fields that are read; None = all.
        most: messages per topic that are kept; None = all.
        tell: called with the share that has been read.

    Raises:
        InputError: no such file, or one that cannot be read.
    """
    for recording in read_recordings(path, wanted, most, tell):
        with closing(recording):
            yield recording.whole()


def read_recordings(
    path: str | Path, wanted: Wanted | None = None, most: int | None = None, tell: Share = quiet
) -> Iterator[TopicStore]:
    """Yield what a file or folder holds, as :func:`read_logs`, in bounded memory. Close each.

    Messages are read one after the other, and of each only its numbers are kept.

    Raises:
        InputError: no such file, or one that cannot be read.
    """
    path = Path(path)
    _require_content(path)
    columns = None if wanted is None else wanted.get(TABLE, ())
    if (path / INFO).is_file():
        yield from read_lerobot(path, columns, tell)
    elif _is_table(path):
        yield read_table(path, columns, most, tell)
    else:
        yield _gathered(path, _reader(path), wanted, most, tell)


def _require_content(path: Path) -> None:
    if not path.exists():
        raise InputError(f"{path}: no such file or folder; expected {_KINDS}")
    if path.is_file() and path.stat().st_size == 0:
        raise InputError(f"{path}: empty file")


def _is_table(path: Path) -> bool:
    return path.is_file() and path.suffix.lower() in (".csv", ".parquet")


def _reader(path: Path) -> Callable[..., Iterator[Message]]:
    if path.is_dir():
        if (path / bags.METADATA).is_file() or any(path.glob("*.db3")) or any(path.glob("*.mcap")):
            return bags.bag_messages
        raise InputError(f"{path}: no bag and no data set in it; expected {_KINDS}")
    if path.suffix.lower() == ".mcap":
        return bags.mcap_messages
    if path.suffix.lower() in (".db3", ".bag"):
        return bags.bag_messages
    raise InputError(f"{path}: '{path.suffix}' files are not read; expected {_KINDS}")


def _gathered(
    path: Path, read: Callable[..., Iterator[Message]], wanted: Wanted | None, most: int | None, tell: Share
) -> TopicStore:
    recording = TopicStore(path)
    collectors: dict[str, Collector] = {}
    counts: dict[str, int] = {}
    kinds: dict[str, str] = {}
    topics = None if wanted is None else {name.partition(" (")[0] for name in wanted}

    def wants(topic: str) -> bool:
        recording.known.add(topic)
        return (topics is None or topic in topics) and (most is None or counts.get(topic, 0) < most)

    try:
        for message in read(path, wants, recording.notes, tell):
            same = kinds.setdefault(message.topic, message.kind) == message.kind
            name = message.topic if same else f"{message.topic} ({message.kind})"
            if (wanted is not None and name not in wanted) or (most is not None and counts.get(name, 0) >= most):
                continue
            if name not in collectors:
                collectors[name] = Collector(message.kind, None if wanted is None else wanted[name])
            collectors[name].add(message)
            counts[name] = counts.get(name, 0) + 1
            if len(collectors[name]) == BLOCK:
                recording.add(collectors.pop(name).topic(name))
        for name, collector in collectors.items():
            recording.add(collector.topic(name))
        recording.notes += [f"two types on one topic: the second is '{name}'" for name in counts if name not in kinds]
        if recording.empty and wanted is None:
            raise InputError(f"{path}: no message that can be read{''.join('; ' + note for note in recording.notes)}")
    except BaseException:
        recording.close()
        raise
    return recording


def first_messages(path: str | Path) -> Iterator[Message]:
    """Yield the messages of a log from its beginning; none of a table.

    Raises:
        InputError: no such file, or one that cannot be read.
    """
    path = Path(path)
    _require_content(path)
    if _is_table(path) or (path / INFO).is_file():
        return iter(())
    return _reader(path)(path, lambda topic: True, [], quiet)
