"""Read MCAP files from front to back, chunk by chunk: bounded memory, and what a recorder left that was killed."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import IO, Any

from wlr_gym.base.errors import require_package
from wlr_gym.data.logs.definitions import Definitions, UnknownTypeError, full_name
from wlr_gym.data.logs.topics import Message, Share, cannot_read

#: Schema encodings of ROS, by message encoding.
_ROS = {"cdr": ("ros2msg", "ros2idl"), "ros1": ("ros1msg",)}


def messages(path: Path, wants: Callable[[str], bool], notes: list[str], tell: Share) -> Iterator[Message]:
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
