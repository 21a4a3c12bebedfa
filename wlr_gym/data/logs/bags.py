"""Read bags of ROS without ROS: MCAP files, rosbag2 (folders, ``.db3``, ``.mcap``) and rosbag1 (``.bag``).

MCAP is read from front to back, chunk by chunk: in bounded memory, and with what a recorder left that was killed. Message
definitions are taken from the file, as it has them; where it has none, from what is generally known.
"""

from __future__ import annotations

import json
import struct
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import IO, Any

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


class UnknownTypeError(InputError):
    """A type without a definition, in a file and in what is generally known."""


class Definitions:
    """Decodes messages of ROS 1 and 2."""

    def __init__(self) -> None:
        self._stores: dict[str, Any] = {}  # by type: two files may define one differently

    def define(self, kind: str, text: str, language: str = "ros2msg") -> None:
        """Take the definition of a type, with those of the types in it, as a file holds it.

        Raises:
            UnknownTypeError: it cannot be understood.
        """
        from rosbags.typesys import Stores, TypesysError, get_types_from_idl, get_types_from_msg, get_typestore

        store = get_typestore(Stores.EMPTY)
        try:
            found = _idl(text, get_types_from_idl) if language == "ros2idl" else get_types_from_msg(text, full_name(kind))
            store.register({name: fields for name, fields in found.items() if name not in store.fielddefs})
        except (TypesysError, KeyError, ValueError, AssertionError, TypeError) as error:
            raise UnknownTypeError(f"type '{kind}': its definition in the file cannot be understood: {error}") from None
        self._stores[full_name(kind)] = store

    def knows(self, kind: str) -> bool:
        """Whether a type is defined."""
        return full_name(kind) in self._stores

    def use_common(self, kind: str, ros2: bool) -> None:
        """Take the definition of a type that the file does not define from what is generally known of ROS 2, else 1.

        Raises:
            UnknownTypeError: it is not.
        """
        from rosbags.typesys import Stores, get_types_from_msg, get_typestore

        name = full_name(kind)
        store = get_typestore(Stores.ROS2_HUMBLE if ros2 else Stores.ROS1_NOETIC)
        if name not in store.fielddefs and name in KNOWN:
            for known, text in KNOWN.items():
                store.register(get_types_from_msg(text, known))
        if name not in store.fielddefs:
            raise UnknownTypeError(f"type '{kind}': the file does not define it, and it is none that ROS comes with")
        self._stores[name] = store

    def decode(self, data: bytes, kind: str, ros2: bool) -> Any:
        """Return a message of ROS 2, else 1.

        Raises:
            ValueError: its bytes do not fit its definition.
        """
        from rosbags.serde import SerdeError

        name = full_name(kind)
        try:
            store = self._stores[name]
            return store.deserialize_cdr(data, name) if ros2 else store.deserialize_ros1(data, name)
        except (SerdeError, struct.error, IndexError, AssertionError, UnicodeDecodeError, MemoryError, KeyError) as error:
            raise ValueError(f"{type(error).__name__}: {error}") from None


def full_name(kind: str) -> str:
    """Return a type's name as ROS 2 writes it: ``sensor_msgs/msg/Imu``."""
    parts = kind.split("/")
    return kind if len(parts) != 2 else f"{parts[0]}/msg/{parts[1]}"


def _idl(text: str, parse: Any) -> dict[str, Any]:
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
    from mcap.records import Channel, Schema

    schemas: dict[int, Schema] = {}
    channels: dict[int, Channel] = {}
    decoders: dict[int, Callable[[bytes], Any] | None] = {}
    definitions = Definitions()
    broken = Counter[str]()
    with path.open("rb") as file:
        for record in _records(file, path, notes, tell):
            if isinstance(record, Schema):
                schemas[record.id] = record
            elif isinstance(record, Channel):
                channels[record.id] = record
            elif (channel := channels.get(record.channel_id)) is not None and wants(channel.topic):
                if channel.id not in decoders:
                    decoders[channel.id] = _decoder(channel, schemas.get(channel.schema_id), definitions, notes)
                decode = decoders[channel.id]
                if decode is None:
                    continue
                try:
                    content = decode(record.data)
                except ValueError:
                    broken[channel.topic] += 1
                    continue
                schema = schemas.get(channel.schema_id)
                yield Message(channel.topic, full_name(schema.name) if schema else "json", record.log_time, content)
    notes += [f"topic '{topic}': {count} messages do not fit their definition; left out" for topic, count in broken.items()]
    writers = Counter(channel.topic for channel in channels.values())
    notes += [f"topic '{topic}' has {count} writers: their messages are mixed" for topic, count in writers.items() if count > 1]


def _records(file: IO[bytes], path: Path, notes: list[str], tell: Share) -> Iterator[Any]:
    """Yield schemas, channels and messages; note where the file ends early or is broken."""
    from mcap.exceptions import McapError
    from mcap.records import Channel, Chunk, DataEnd, Footer, Schema
    from mcap.records import Message as McapMessage
    from mcap.stream_reader import StreamReader

    size = max(path.stat().st_size, 1)
    reader = StreamReader(file, emit_chunks=True, record_size_limit=2**30)  # bytes; beyond is a broken length
    count, ended = 0, False
    try:
        for record in reader.records:
            tell(min(file.tell() / size, 1.0))
            ended = ended or isinstance(record, DataEnd | Footer)
            if ended:  # the summary repeats what was read
                break
            for inner in _inside(record, file.tell(), notes) if isinstance(record, Chunk) else (record,):
                if isinstance(inner, Schema | Channel | McapMessage):
                    count += isinstance(inner, McapMessage)
                    yield inner
    except (McapError, ValueError, OSError, MemoryError, KeyError) as error:
        if file.tell() <= 16 and not count:
            raise cannot_read(path, "MCAP", error) from None
        notes.append(f"cut off or broken near byte {file.tell()} of {size} ({_short(error)}): read up to there")
    except Exception as error:  # struct.error and the like, of bytes that are no record
        if not count:
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


def _decoder(channel: Any, schema: Any, definitions: Definitions, notes: list[str]) -> Callable[[bytes], Any] | None:
    """Return what decodes a channel's messages; None, and a note, where nothing does."""
    encoding, kind = channel.message_encoding, schema.name if schema else ""
    if encoding == "json":
        return _json
    if encoding not in _ROS or schema is None:
        notes.append(f"topic '{channel.topic}': messages in '{encoding}' are not read; left out")
        return None
    try:
        if schema.encoding in _ROS[encoding] and schema.data:
            definitions.define(kind, schema.data.decode("utf-8"), schema.encoding)
        else:
            definitions.use_common(kind, encoding == "cdr")
    except (UnknownTypeError, UnicodeDecodeError) as error:
        notes.append(f"topic '{channel.topic}': {error}; left out")
        return None
    return lambda data: definitions.decode(data, kind, encoding == "cdr")


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
    files = _mcap_files(path)
    if not files:
        yield from _by_rosbags(path, wants, notes, tell)
        return
    for k, file in enumerate(files):
        yield from mcap_messages(file, wants, notes, lambda share, k=k: tell((k + share) / len(files)))


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
