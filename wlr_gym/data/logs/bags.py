"""Read bags of ROS without ROS: MCAP files, rosbag2 (folders, ``.db3``, ``.mcap``) and rosbag1 (``.bag``).

MCAP is read from front to back, chunk by chunk, with what a recorder left that was killed. Message definitions are taken from
the file, as it has them; where it has none, from what is generally known.
"""

from __future__ import annotations

import json
import struct
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import IO, Any, NamedTuple

from wlr_gym.base.errors import InputError, require_package
from wlr_gym.base.settings import read_yaml
from wlr_gym.data.logs.topics import Message, Share, cannot_read

#: Types that ROS itself does not define and that old bags, which hold no definitions, are likely to have.
KNOWN = {
    "dynamixel_workbench_msgs/msg/DynamixelStateList": "DynamixelState[] dynamixel_state",
    "dynamixel_workbench_msgs/msg/DynamixelState": (
        "string name\nuint8 id\nint32 present_position\nint32 present_velocity\nint16 present_current"
    ),
}


class _Channel(NamedTuple):
    """Where messages come from: topic, type, and what decodes them (ValueError: bytes that do not fit)."""

    topic: str
    kind: str
    decode: Callable[[bytes], Any]


def _messages(records: Iterable[tuple[_Channel, int, bytes]], notes: list[str]) -> Iterator[Message]:
    """Yield decoded messages; note how many cannot be decoded."""
    broken = Counter[str]()
    for channel, time, data in records:
        try:
            content = channel.decode(data)
        except ValueError:
            broken[channel.topic] += 1
        else:
            yield Message(channel.topic, channel.kind, time, content)
    notes += [f"topic '{topic}': {count} messages do not fit their definition; left out" for topic, count in broken.items()]


def _note_writers(topics: Iterable[str], notes: list[str]) -> None:
    counts = Counter(topics).items()
    notes += [f"topic '{topic}' has {count} writers: their messages are mixed" for topic, count in counts if count > 1]


# ---- types of ROS ----------------------------------------------------------------------------------------------------


class UnknownTypeError(InputError):
    """A type without a definition, in a file and in what is generally known."""


def full_name(kind: str) -> str:
    """Return a type's name as ROS 2 writes it: ``sensor_msgs/msg/Imu``."""
    parts = kind.split("/")
    return kind if len(parts) != 2 else f"{parts[0]}/msg/{parts[1]}"


def decoder(kind: str, ros2: bool, text: str = "", language: str = "ros2msg") -> Callable[[bytes], Any]:
    """Return what decodes the messages of a type of ROS 2, else 1; it raises ValueError where bytes do not fit the definition.

    Args:
        kind: type.
        ros2: whether it is of ROS 2.
        text: its definition, with those of the types in it, as a file holds it; empty = what is generally known of it.
        language: of the text: ``ros2msg``, ``ros1msg`` or ``ros2idl``.

    Raises:
        UnknownTypeError: a definition that cannot be understood, or none that is known.
    """
    from rosbags.serde import SerdeError
    from rosbags.typesys import Stores, TypesysError, get_types_from_idl, get_types_from_msg, get_typestore

    name = full_name(kind)
    if text:
        store = get_typestore(Stores.EMPTY)
        try:
            found = _idl(text, get_types_from_idl) if language == "ros2idl" else get_types_from_msg(text, name)
            store.register({one: fields for one, fields in found.items() if one not in store.fielddefs})
        except (TypesysError, KeyError, ValueError, AssertionError, TypeError) as error:
            raise UnknownTypeError(f"type '{kind}': its definition in the file cannot be understood: {error}") from None
    else:
        store = get_typestore(Stores.ROS2_HUMBLE if ros2 else Stores.ROS1_NOETIC)
        if name in KNOWN and name not in store.fielddefs:
            for known, definition in KNOWN.items():
                store.register(get_types_from_msg(definition, known))
        if name not in store.fielddefs:
            raise UnknownTypeError(f"type '{kind}': the file does not define it, and it is none that ROS comes with")
    deserialize = store.deserialize_cdr if ros2 else store.deserialize_ros1

    def decode(data: bytes) -> Any:
        try:
            return deserialize(data, name)
        except (SerdeError, struct.error, IndexError, AssertionError, UnicodeDecodeError, MemoryError, KeyError) as error:
            raise ValueError(f"{type(error).__name__}: {error}") from None

    return decode


def _idl(text: str, parse: Callable[[str], dict[str, Any]]) -> dict[str, Any]:
    line = "=" * 80 + "\n"
    if not text.startswith(f"{line}IDL: "):
        return parse(text)
    found: dict[str, Any] = {}
    for part in text.split(line)[1:]:
        found |= parse(part.partition("\n")[2])
    return found


# ---- MCAP ------------------------------------------------------------------------------------------------------------


#: Schema encodings of ROS, by message encoding.
_ROS = {"cdr": ("ros2msg", "ros2idl"), "ros1": ("ros1msg",)}


def mcap_messages(path: Path, wants: Callable[[str], bool], notes: list[str], tell: Share) -> Iterator[Message]:
    """Yield the messages of the topics that ``wants`` asks for, in the file's order.

    Args:
        path: an ``.mcap`` file.
        wants: whether a topic is decoded.
        notes: gets what is odd: a cut end, a broken chunk, types that cannot be decoded.
        tell: called with the share of the file that was read.

    Raises:
        InputError: no MCAP file at all.
    """
    require_package("mcap", "logs")
    require_package("rosbags", "logs")
    with path.open("rb") as file:
        yield from _messages(_mcap_records(file, path, wants, notes, tell), notes)


def _mcap_records(
    file: IO[bytes], path: Path, wants: Callable[[str], bool], notes: list[str], tell: Share
) -> Iterator[tuple[_Channel, int, bytes]]:
    from mcap.records import Channel, Schema

    schemas: dict[int, Schema] = {}
    channels: dict[int, Channel] = {}
    chosen: dict[int, _Channel | None] = {}
    for record in _records(file, path, notes, tell):
        if isinstance(record, Schema):
            schemas[record.id] = record
        elif isinstance(record, Channel):
            channels[record.id] = record
        elif (channel := channels.get(record.channel_id)) is not None and wants(channel.topic):
            if channel.id not in chosen:
                chosen[channel.id] = _channel(channel, schemas.get(channel.schema_id), notes)
            if (found := chosen[channel.id]) is not None:
                yield found, record.log_time, record.data
    _note_writers((channel.topic for channel in channels.values()), notes)


def _records(file: IO[bytes], path: Path, notes: list[str], tell: Share) -> Iterator[Any]:
    """Yield schemas, channels and messages; note where the file ends early or is broken."""
    from mcap.records import Channel, Chunk, DataEnd, Footer, Schema
    from mcap.records import Message as McapMessage
    from mcap.stream_reader import StreamReader

    size, is_begun = path.stat().st_size, False
    reader = StreamReader(file, emit_chunks=True, record_size_limit=2**30)  # bytes; beyond is a broken length
    try:
        for record in reader.records:
            tell(min(file.tell() / size, 1.0))
            if isinstance(record, DataEnd | Footer):  # the summary repeats what was read
                break
            for inner in _inside(record, file.tell(), notes) if isinstance(record, Chunk) else (record,):
                if isinstance(inner, Schema | Channel | McapMessage):
                    is_begun = True
                    yield inner
    except Exception as error:  # of mcap, and of bytes that are no record any of Python's
        if file.tell() <= 16 and not is_begun:
            raise cannot_read(path, "MCAP", error) from None
        notes.append(f"cut off or broken near byte {file.tell()} of {size} ({_short(error)}): read up to there")


def _inside(chunk: Any, place: int, notes: list[str]) -> list[Any]:
    from mcap.stream_reader import breakup_chunk

    try:
        return breakup_chunk(chunk, validate_crc=True)
    except Exception as error:  # what a decompressor raises is its own
        seconds = (chunk.message_end_time - chunk.message_start_time) * 1e-9
        notes.append(f"the chunk before byte {place} is broken ({_short(error)}): {seconds:.2f} s left out")
        return []


def _short(error: Exception) -> str:
    return " ".join(f"{type(error).__name__}: {error}".split())[:120].rstrip(": ")


def _channel(channel: Any, schema: Any, notes: list[str]) -> _Channel | None:
    """Return a channel of MCAP with what decodes it; None, and a note, where nothing does."""
    encoding, kind = channel.message_encoding, schema.name if schema else ""
    if encoding == "json":
        return _Channel(channel.topic, full_name(kind) or "json", _json)
    if encoding not in _ROS or schema is None:
        notes.append(f"topic '{channel.topic}': messages in '{encoding}' are not read; left out")
        return None
    try:
        text = schema.data.decode("utf-8") if schema.encoding in _ROS[encoding] else ""
        return _Channel(channel.topic, full_name(kind), decoder(kind, encoding == "cdr", text, schema.encoding))
    except (UnknownTypeError, UnicodeDecodeError) as error:
        notes.append(f"topic '{channel.topic}': {error}; left out")
        return None


def _json(data: bytes) -> Any:
    content = json.loads(data)
    return content if isinstance(content, dict) else {"data": content}


# ---- rosbag ----------------------------------------------------------------------------------------------------------


METADATA = "metadata.yaml"
#: How every file of rosbag1 begins.
ROSBAG1 = b"#ROSBAG V"


def bag_messages(path: Path, wants: Callable[[str], bool], notes: list[str], tell: Share) -> Iterator[Message]:
    """Yield the messages of the topics that ``wants`` asks for; see :func:`wlr_gym.data.logs.bags.mcap_messages`.

    Raises:
        InputError: no bag, or one that cannot be opened.
    """
    require_package("rosbags", "logs")
    files = _mcap_files(path) if path.is_dir() else []
    if not files:
        yield from _messages(_bag_records(path, wants, notes, tell), notes)
    for k, file in enumerate(files):
        yield from mcap_messages(file, wants, notes, lambda share, k=k: tell((k + share) / len(files)))


def _mcap_files(path: Path) -> list[Path]:
    """Return the MCAP files of a bag's folder, in their order; none where it is of another kind."""
    if not (path / METADATA).is_file():
        return sorted(path.glob("*.mcap"))
    bag = (read_yaml(path / METADATA) or {}).get("rosbag2_bagfile_information")
    if not isinstance(bag, dict):
        raise InputError(f"{path / METADATA}: expected the key 'rosbag2_bagfile_information'")
    named = [path / Path(str(name)).name for name in bag.get("relative_file_paths") or []]
    missing = [file.name for file in named if not file.is_file()]
    if missing:
        raise InputError(f"{path}: its {METADATA} names {', '.join(missing)}, which is not there")
    is_plain = str(bag.get("compression_mode") or "none").lower() == "none"
    return named if bag.get("storage_identifier") == "mcap" and is_plain else []


def _bag_records(
    path: Path, wants: Callable[[str], bool], notes: list[str], tell: Share
) -> Iterator[tuple[_Channel, int, bytes]]:
    what = "rosbag1" if path.is_file() and path.suffix.lower() == ".bag" else "rosbag2"
    try:
        reader = _open(path, what)
    except Exception as error:  # of four libraries: sqlite, YAML, MCAP, rosbags
        hint = " (a recording that was killed: 'rosbag reindex' mends it)" if "index" in str(error).lower() else ""
        raise cannot_read(path, what, f"{error}{hint}" or type(error).__name__) from None
    _note_writers((connection.topic for connection in reader.connections), notes)
    chosen = {}
    for connection in reader.connections:
        if wants(connection.topic) and (channel := _connection(connection, what == "rosbag2", notes)):
            chosen[connection.id] = connection, channel
    total, count = max(sum(one.msgcount for one, _ in chosen.values()), 1), 0
    try:
        for connection, time, data in reader.messages(connections=[one for one, _ in chosen.values()]) if chosen else ():
            count += 1
            if count % 500 == 0:
                tell(min(count / total, 1.0))
            yield chosen[connection.id][1], time, bytes(data)
    except Exception as error:  # as above
        if not count:
            raise cannot_read(path, what, error) from None
        notes.append(f"broken after {count} of {total} messages ({str(error)[:120]}): read up to there")
    finally:
        reader.close()


def _open(path: Path, what: str) -> Any:
    from rosbags.rosbag1 import Reader as Reader1
    from rosbags.rosbag2 import Reader as Reader2

    if path.is_dir() and not (path / METADATA).is_file():
        files = sorted(path.glob("*.db3"))
        if len(files) != 1:
            raise ValueError(f"no {METADATA}, and {len(files)} .db3 files: name one of them")
        path = files[0]
    if what == "rosbag1":
        with path.open("rb") as file:
            if file.read(len(ROSBAG1)) != ROSBAG1:
                raise ValueError(f"it does not begin with {ROSBAG1.decode()}")
    reader = Reader1(path) if what == "rosbag1" else Reader2(path)
    reader.open()
    return reader


def _connection(connection: Any, ros2: bool, notes: list[str]) -> _Channel | None:
    """Return a connection of rosbags with what decodes it; None, and a note, where nothing does."""
    from rosbags.interfaces import MessageDefinitionFormat

    kind, definition = connection.msgtype, connection.msgdef
    text = "" if definition.format == MessageDefinitionFormat.NONE else definition.data
    language = "ros2idl" if definition.format == MessageDefinitionFormat.IDL else "ros2msg"
    try:
        return _Channel(connection.topic, full_name(kind), decoder(kind, ros2, text, language))
    except UnknownTypeError as error:
        notes.append(f"topic '{connection.topic}': {error}; left out")
        return None
