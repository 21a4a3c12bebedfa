"""Read bags of ROS: rosbag2 (folders, ``.db3``, ``.mcap``) and rosbag1 (``.bag``), without ROS."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from wlr_gym.base.errors import InputError, require_package
from wlr_gym.base.settings import read_yaml
from wlr_gym.data.logs import mcap_file
from wlr_gym.data.logs.definitions import Definitions, UnknownTypeError, full_name
from wlr_gym.data.logs.topics import Message, Share, cannot_read

METADATA = "metadata.yaml"
#: How every file of rosbag1 begins.
ROSBAG1 = b"#ROSBAG V"


def messages(path: Path, wants: Callable[[str], bool], notes: list[str], tell: Share) -> Iterator[Message]:
    """Yield the messages of the topics that ``wants`` asks for; see :func:`wlr_gym.data.logs.mcap_file.messages`.

    Raises:
        InputError: no bag, or one that cannot be opened.
    """
    require_package("rosbags", "logs")
    files = _mcap_files(path)
    if not files:
        yield from _by_rosbags(path, wants, notes, tell)
        return
    for k, file in enumerate(files):
        yield from mcap_file.messages(file, wants, notes, lambda share, k=k: tell((k + share) / len(files)))


def _mcap_files(path: Path) -> list[Path]:
    """Return the MCAP files of a bag's folder, in their order; none where it is of another kind."""
    if not path.is_dir():
        return []
    found = sorted(path.glob("*.mcap"))
    if not (path / METADATA).is_file():
        return found
    bag = (read_yaml(path / METADATA) or {}).get("rosbag2_bagfile_information")
    if not isinstance(bag, dict):
        raise InputError(f"{path / METADATA}: expected the key 'rosbag2_bagfile_information'")
    named = [path / Path(str(name)).name for name in bag.get("relative_file_paths") or []]
    missing = [file.name for file in named if not file.is_file()]
    if missing:
        raise InputError(f"{path}: its {METADATA} names {', '.join(missing)}, which is not there")
    plain = not bag.get("compression_mode") or str(bag["compression_mode"]).lower() == "none"
    return named if bag.get("storage_identifier") == "mcap" and plain else []


def _by_rosbags(path: Path, wants: Callable[[str], bool], notes: list[str], tell: Share) -> Iterator[Message]:
    what = "rosbag1" if _is_rosbag1(path) else "rosbag2"
    try:
        reader = _open(path)
    except Exception as error:  # of four libraries: sqlite, YAML, MCAP, rosbags
        raise cannot_read(path, what, _hint(error)) from None
    definitions, ros2 = Definitions(), what == "rosbag2"
    decodable = _decodable(reader, definitions, wants, notes, ros2)
    chosen = [connection for connection in reader.connections if connection.topic in decodable]
    total, count, broken = max(sum(one.msgcount for one in chosen), 1), 0, Counter[str]()
    try:
        for connection, time, data in reader.messages(connections=chosen) if chosen else ():
            count += 1
            if count % 500 == 0:
                tell(min(count / total, 1.0))
            kind = connection.msgtype
            try:
                yield Message(connection.topic, full_name(kind), time, definitions.decode(bytes(data), kind, ros2))
            except ValueError:
                broken[connection.topic] += 1
    except GeneratorExit:
        raise
    except Exception as error:  # as above
        if not count:
            raise cannot_read(path, what, error) from None
        notes.append(f"broken after {count} of {total} messages ({str(error)[:120]}): read up to there")
    finally:
        reader.close()
    notes += [f"topic '{topic}': {number} messages do not fit their definition; left out" for topic, number in broken.items()]


def _open(path: Path) -> Any:
    from rosbags.rosbag1 import Reader as Reader1
    from rosbags.rosbag2 import Reader as Reader2

    if path.is_dir() and not (path / METADATA).is_file():
        files = sorted(path.glob("*.db3"))
        if len(files) != 1:
            raise ValueError(f"no {METADATA}, and {len(files)} .db3 files: name one of them")
        path = files[0]
    if _is_rosbag1(path) and not _begins_with(path, ROSBAG1):
        raise ValueError(f"it does not begin with {ROSBAG1.decode()}")
    reader = Reader1(path) if _is_rosbag1(path) else Reader2(path)
    reader.open()
    return reader


def _begins_with(path: Path, magic: bytes) -> bool:
    with path.open("rb") as file:
        return file.read(len(magic)) == magic


def _is_rosbag1(path: Path) -> bool:
    return path.is_file() and path.suffix.lower() == ".bag"


def _hint(error: Exception) -> str:
    text = str(error)
    if "index" in text.lower():
        return f"{text} (a recording that was killed: 'rosbag reindex' mends it)"
    return text or type(error).__name__


def _decodable(reader: Any, definitions: Definitions, wants: Callable[[str], bool], notes: list[str], ros2: bool) -> set[str]:
    """Return the topics that are wanted and whose messages can be decoded; note the others."""
    from rosbags.interfaces import MessageDefinitionFormat

    found = set()
    for connection in reader.connections:
        if not wants(connection.topic):
            continue
        text, language = connection.msgdef.data, connection.msgdef.format
        try:
            if definitions.knows(connection.msgtype):
                pass
            elif language == MessageDefinitionFormat.NONE or not text:
                definitions.use_common(connection.msgtype, ros2)
            else:
                definitions.define(
                    connection.msgtype, text, "ros2idl" if language == MessageDefinitionFormat.IDL else "ros2msg"
                )
            found.add(connection.topic)
        except UnknownTypeError as error:
            notes.append(f"topic '{connection.topic}': {error}; left out")
    writers = Counter(connection.topic for connection in reader.connections)
    notes += [f"topic '{topic}' has {count} writers: their messages are mixed" for topic, count in writers.items() if count > 1]
    return found
