"""Read logs of any kind as topics of numbers, without ROS: the reader by what the path is.

Bags are MCAP files, rosbag2 (folders, ``.db3``, ``.mcap``) and rosbag1 (``.bag``); MCAP is read from front to back, chunk by
chunk, with what a recorder left that was killed. Message definitions are taken from the file, as it has them; where it has
none, from what is generally known. Tables are CSV and Parquet with any columns, one of them the time, and LeRobot data sets
of version 3. CSV is read as other programs write it: whatever separates, whichever encoding, wherever the names are.
"""

from __future__ import annotations

import codecs
import csv
import json
import re
import struct
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from wlr_gym.base.errors import InputError, require_package, unknown_name
from wlr_gym.base.settings import read_yaml
from wlr_gym.data.logs.topics import LONGEST, Collector, Log, Message, Share, Topic, cannot_read

if TYPE_CHECKING:
    import pandas

#: Topic -> fields that are read; None = all topics and all their fields.
Wanted = Mapping[str, Collection[str]]
_KINDS = "an .mcap, .db3, .bag, .csv or .parquet file, a folder of rosbag2, or a LeRobot data set"


def quiet(share: float) -> None:
    """Report no progress."""


def read_logs(
    path: str | Path, wanted: Wanted | None = None, most: int | None = None, tell: Share = quiet, time: str | None = None
) -> Iterator[Log]:
    """Yield what a file or folder holds: one recording, or the episodes of a LeRobot data set.

    Of messages, which are read one after the other, only the numbers are kept, 8 bytes each.

    Args:
        path: what was recorded.
        wanted: topics and fields that are read; None = all.
        most: messages per topic that are kept; None = all.
        tell: called with the share that has been read.
        time: column of a table's times; None = by its name (:data:`TIME_NAMES`).

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
        yield read_table(path, columns, most, time)


def first_messages(path: Path) -> Iterator[Message]:
    """Yield the messages of a log from its beginning; none of a table."""
    read = _reader(path)
    return iter(()) if read is None else read(path, lambda topic: True, [], quiet)


def _reader(path: Path) -> Callable[..., Iterator[Message]] | None:
    """Return what reads a log's messages; None = it is a table."""
    if not path.exists():
        raise InputError(f"{path}: no such file or folder; expected {_KINDS}")
    if path.is_dir():
        if (path / INFO).is_file():
            return None
        if (path / METADATA).is_file() or any(path.glob("*.db3")) or any(path.glob("*.mcap")):
            return bag_messages
        raise InputError(f"{path}: no bag and no data set in it; expected {_KINDS}")
    if path.stat().st_size == 0:
        raise InputError(f"{path}: empty file")
    readers = {".mcap": mcap_messages, **dict.fromkeys((".db3", ".bag"), bag_messages)}
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


# ---- messages --------------------------------------------------------------------------------------------------------


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
    """Yield the messages of the topics that ``wants`` asks for; see :func:`mcap_messages`."""
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


# ---- tables ----------------------------------------------------------------------------------------------------------


#: Name of the topic that a table's columns make.
TABLE = "table"
#: Columns that hold the time, by what is looked for first; the unit by ending, else by how far rows are apart.
TIME_NAMES = ("t", "time", "timestamp", "stamp", "times", "clock", "seconds", "log_time", "elapsed")
_ENDINGS = {"_ns": 1, "_us": 1_000, "_ms": 1_000_000, "_s": 1_000_000_000, "_sec": 1_000_000_000, "_nsec": 1}
_UNITS = {10**9: "s", 10**6: "ms", 10**3: "us", 1: "ns"}
#: ns; how far rows of a recording are apart: where the size says the unit, and where the name does.
_BY_SIZE, _BY_NAME = (5e5, 5e8), (1e4, 1e10)


def read_table(path: Path, wanted: Collection[str] | None = None, most: int | None = None, time: str | None = None) -> Log:
    """Read a CSV or Parquet file: one topic, whose fields are the columns that hold numbers.

    Args:
        path: the file.
        wanted: columns that are kept; None = all.
        most: rows that are read; None = all.
        time: column of the times; None = by its name.

    Raises:
        InputError: not such a file, no column of times, or times that go back.
    """
    notes: list[str] = []
    times = np.zeros(0, np.int64)
    frame, decimal = _csv(path, most, notes) if path.suffix.lower() == ".csv" else (_parquet(path, most), ".")
    name = _time_column([str(column) for column in frame.columns], path, time)
    if len(frame):
        frame, times = _with_times(frame, name, decimal, path, notes)
    if len(frame) < 2:
        raise InputError(f"{path}: {len(frame)} rows; a recording has at least 2")
    if (back := np.diff(times) < 0).any():
        raise InputError(f"{path}: row {frame.index[int(np.argmax(back)) + 1]}, column '{name}': times must increase")
    topic = numeric_topic(_with_numbers(frame.drop(columns=name), decimal, notes), times, wanted)
    return Log(path, {TABLE: topic}, tuple(notes), known=frozenset([TABLE]))


def _parquet(path: Path, most: int | None) -> pandas.DataFrame:
    import pandas
    import pyarrow

    try:
        frame: Any = pandas.read_parquet(path)
    except (OSError, ValueError, pyarrow.ArrowException) as error:
        raise cannot_read(path, "parquet", error) from None
    if frame.index.name is not None:
        frame = frame.reset_index()
    frame.columns = [str(column).strip() for column in frame.columns]
    return frame[:most].reset_index(drop=True)


def numeric_topic(frame: pandas.DataFrame, times: NDArray[np.int64], wanted: Collection[str] | None) -> Topic:
    """Return a table's columns that hold numbers as fields; of times (ns) that are given."""
    import pandas

    rows = np.arange(len(frame), dtype=np.int64)
    fields = {}
    names = [str(name) for name in frame.columns if pandas.api.types.is_numeric_dtype(frame[name])]
    for name in names if wanted is None else [name for name in names if name in wanted]:
        values = frame[name].to_numpy(np.float64, na_value=np.nan)
        known = ~np.isnan(values)
        fields[name] = (rows, values) if known.all() else (rows[known], values[known])
    return Topic(TABLE, TABLE, np.asarray(times, np.int64), None, fields, known=frozenset(names))


# ---- texts of a table: times and numbers -----------------------------------------------------------------------------


def _with_numbers(frame: pandas.DataFrame, decimal: str, notes: list[str]) -> pandas.DataFrame:
    """Return a table whose texts are numbers where they can be; note which columns hold others."""
    import pandas

    changed: dict[str, Any] = {}
    texts, mixed = [], []
    for name in map(str, frame.columns):
        if _is_read(frame[name]):
            continue
        numbers: Any = pandas.to_numeric(_texts(frame[name], decimal), errors="coerce")
        if not numbers.notna().any():
            texts += [name] if name.lower() not in TIME_NAMES else []
            continue
        changed[name] = numbers
        if (numbers.isna() & frame[name].notna()).any():
            mixed.append(name)
    notes += [f"columns that hold no numbers: {', '.join(texts)}; left out"] if texts else []
    notes += [f"columns that hold texts beside numbers: {', '.join(mixed)}; the texts are left out"] if mixed else []
    return frame.assign(**changed)


def _is_read(column: Any) -> bool:
    """Whether a column holds numbers or dates already."""
    import pandas

    return pandas.api.types.is_numeric_dtype(column) or pandas.api.types.is_datetime64_any_dtype(column)


def _texts(column: Any, decimal: str) -> Any:
    """Return a column's texts with a decimal point; a column that is read already as it is."""
    if _is_read(column):
        return column
    text = column.astype(str).str.strip()
    return text.str.replace(",", ".", regex=False) if decimal == "," else text


def _time_column(columns: list[str], path: Path, time: str | None) -> str:
    if time is not None:
        if time not in columns:
            raise unknown_name("column", time, columns, f"{path}: time")
        return time
    lowered = {column.lower().split("[")[0].split("(")[0].strip(" _"): column for column in reversed(columns)}
    for wanted in TIME_NAMES:
        for ending in ("", *_ENDINGS):
            if wanted + ending in lowered:
                return lowered[wanted + ending]
    likely = next((name for name in columns if name.lower().replace("[", "_").rstrip("]").endswith((*_ENDINGS,))), columns[0])
    expected = f"expected one of {', '.join(TIME_NAMES)}, or its name in the map (--map), such as: time: '{likely}'"
    raise InputError(f"{path}: no column of times: {expected}; it has {', '.join(columns[:12])}")


def _with_times(
    frame: Any, name: str, decimal: str, path: Path, notes: list[str]
) -> tuple[pandas.DataFrame, NDArray[np.int64]]:
    """Return the rows that have a time, and their times in ns: comments and repeated names of columns have none."""
    import pandas

    column: Any = _texts(frame[name], decimal)
    found: Any = pandas.to_numeric(column, errors="coerce")
    are_dates = pandas.api.types.is_datetime64_any_dtype(column) or found.isna().mean() > 0.5
    if are_dates:
        found = pandas.to_datetime(column, utc=True, format="ISO8601", errors="coerce").dt.tz_localize(None)
    known = found.notna()
    if not known.any():
        text = f"'{str(column.iloc[0])[:40]}' is neither a number nor a date"
        raise InputError(f"{path}: row {frame.index[0]}, column '{name}': {text}")
    if not known.all():
        row = known.index[int(np.argmin(known))]
        first = f"first row {row}: '{name}' is '{str(column[row])[:40]}'"
        notes.append(f"{(~known).sum()} rows without a time are left out ({first})")
    if are_dates:
        return frame[known], found[known].astype("datetime64[ns]").astype("int64").to_numpy()
    times: Any = pandas.to_numeric(column[known])  # whole numbers stay whole
    step = _step(name, times.to_numpy(np.float64), path) if len(times) > 1 else 1
    if pandas.api.types.is_integer_dtype(times):
        return frame[known], times.to_numpy(np.int64) * step
    whole, part = np.divmod(times.to_numpy(np.float64), 1.0)
    return frame[known], whole.astype(np.int64) * step + np.round(part * step).astype(np.int64)


def _step(name: str, times: NDArray[np.float64], path: Path) -> int:
    """Return how many ns a unit of a column of times is: by its name's ending, else as rows are 0.5 ms to 0.5 s apart.

    Rows that are so far apart, or so close, that it is another unit are refused.
    """
    lowered = name.lower().replace("[", "_").replace("(", "_").rstrip("])")
    by_name = next((step for ending, step in _ENDINGS.items() if lowered.endswith(ending)), None)
    apart = float(np.median(np.abs(np.diff(times))))
    if apart == 0.0:  # most times repeat: what is left of them says more
        apart = float(np.diff(np.unique(times)).min(initial=np.inf))
    low, high = _BY_SIZE if by_name is None else _BY_NAME
    step = next((one for one in ([by_name] if by_name else _UNITS) if low <= apart * one < high), None)
    if step is None:
        unit = f"read as {_UNITS[by_name]}" if by_name else "in no unit of time that is known"
        hint = "name the column by its unit: t_s, t_ms, t_us or t_ns"
        raise InputError(f"{path}: column '{name}': rows are {apart:g} apart, {unit}; {hint}")
    return step


# ---- CSV as other programs write it ----------------------------------------------------------------------------------


#: First bytes of a file -> its encoding.
_MARKS = (
    (codecs.BOM_UTF8, "utf-8-sig"), (codecs.BOM_UTF32_LE, "utf-32"),
    (codecs.BOM_UTF16_LE, "utf-16"), (codecs.BOM_UTF16_BE, "utf-16"),
)  # fmt: skip
#: What comment lines begin with.
_COMMENTS = ("#", "%", "//")
#: Bytes at the beginning and at the end that are looked at.
_ENDS = 2**16
#: As Excel states it.
_SEPARATOR = re.compile(r"\"?sep=(.)\"?")
_NUMBER = re.compile(r"[-+]?[\d.,]+([eE][-+]?\d+)?|nan|NaN|")


class _Dialect(NamedTuple):
    """How a CSV file is written: encoding, separator, decimal sign, lines before the rows, and the names of the columns."""

    encoding: str
    separator: str
    decimal: str
    skipped: int
    names: list[str]


def _csv(path: Path, most: int | None, notes: list[str]) -> tuple[pandas.DataFrame, str]:
    """Return a CSV file's rows, texts as they are, and its decimal sign.

    Commas, semicolons, tabs or blanks separate; with all but the first, numbers may have a decimal comma. Comment lines before
    the names are left out, and so is a last row that was cut off.
    """
    import pandas

    try:
        dialect = _dialect(path)
        separator = r"\s+" if dialect.separator == " " else dialect.separator
        frame: Any = pandas.read_csv(
            path, nrows=most, skipinitialspace=True, encoding=dialect.encoding, sep=separator, decimal=dialect.decimal,
            header=None, names=dialect.names, skiprows=dialect.skipped, index_col=False, low_memory=False,
        )  # fmt: skip
        if (most is None or len(frame) < most) and len(frame) and _is_cut(path, dialect):
            notes.append(f"the last row was cut off: left out (row {len(frame) - 1})")
            frame = frame[:-1]
    except (OSError, ValueError, pandas.errors.ParserError, pandas.errors.EmptyDataError) as error:
        raise error if isinstance(error, InputError) else cannot_read(path, "csv", error) from None
    return frame, dialect.decimal


def _dialect(path: Path) -> _Dialect:
    with path.open("rb") as file:
        head = file.read(_ENDS)
    encoding, text = _decoded(head)
    if "\0" in text:
        raise InputError(f"{path}: holds bytes that are no text")
    lines = text.splitlines()
    skipped = next((k for k, line in enumerate(lines) if _may_hold_names(line.strip())), None)
    if skipped is None:
        raise InputError(f"{path}: no row in it")
    stated = [said[1] for line in lines[:skipped] if (said := _SEPARATOR.fullmatch(line.strip()))]
    found = max(",;\t", key=lines[skipped].count)
    separator = stated[-1] if stated else found if found in lines[skipped] else " "
    names = _split(lines[skipped], separator)
    first = next(filter(None, names), "")
    if skipped and first and _all_numbers([first]):  # names in the last comment, as numpy and rostopic write them
        comment = _split(lines[skipped - 1].lstrip("#%/ "), separator)
        if len(comment) == len(names):
            names, skipped = comment, skipped - 1
    if _all_numbers(names):
        raise InputError(f"{path}: its first line holds numbers, not the names of columns: '{lines[skipped][:60]}'")
    names = [name or f"column {k}" for k, name in enumerate(names)]
    if repeated := [name for name in names if names.count(name) > 1]:
        raise InputError(f"{path}: column '{repeated[0]}' occurs twice")
    decimal = "." if separator == "," else _decimal(lines[skipped + 1 :], separator)
    return _Dialect(encoding, separator, decimal, skipped + 1, names)


def _may_hold_names(line: str) -> bool:
    return bool(line) and not line.startswith(_COMMENTS) and _SEPARATOR.fullmatch(line) is None


def _decoded(head: bytes) -> tuple[str, str]:
    """Return a file's encoding, by its mark or its first bytes, and its beginning as a text."""
    encoding = next((name for mark, name in _MARKS if head.startswith(mark)), "utf-8")
    if encoding == "utf-8" and head[:200].count(0) > 50:
        encoding = "utf-16-le" if head[1:200:2].count(0) > head[0:200:2].count(0) else "utf-16-be"
    try:
        return encoding, codecs.getincrementaldecoder(encoding)().decode(head)
    except UnicodeDecodeError:
        if encoding != "utf-8":
            raise
        return "cp1252", head.decode("cp1252", errors="replace")


def _decimal(rows: list[str], separator: str) -> str:
    """Return the sign that more fields of some rows have in a number; a row of whole numbers, or a remark, says nothing."""
    cells = [cell for row in rows for cell in _split(row, separator)]
    found = [number[1] for cell in cells if (number := re.fullmatch(r"[-+]?\d*([.,])\d+([eE][-+]?\d+)?", cell))]
    return max(".,", key=found.count)


def _split(line: str, separator: str) -> list[str]:
    if separator == " ":
        return line.split()
    return [field.strip() for field in next(csv.reader([line], delimiter=separator, skipinitialspace=True), [])]


def _all_numbers(fields: list[str]) -> bool:
    return all(_NUMBER.fullmatch(field) for field in fields)


def _is_cut(path: Path, dialect: _Dialect) -> bool:
    """Whether the last line has no end, and fewer fields than there are columns."""
    with path.open("rb") as file:
        file.seek(max(path.stat().st_size - _ENDS, 0))
        tail = file.read()
    if dialect.encoding == "utf-16":  # its mark is at the beginning
        encoding = "utf-16-be" if tail[:1] == b"\0" else "utf-16-le"
    else:
        encoding = dialect.encoding.removesuffix("-sig")
    last = tail.decode(encoding, errors="ignore").splitlines(keepends=True)[-1:]
    return not last[0].endswith(("\n", "\r")) and len(_split(last[0], dialect.separator)) < len(dialect.names)


# ---- LeRobot: each episode is a recording, each feature some fields --------------------------------------------------


INFO = Path("meta") / "info.json"
_INDEX = {"timestamp", "frame_index", "episode_index", "index", "task_index"}


def read_lerobot(folder: Path, wanted: Collection[str] | None, tell: Share) -> Iterator[Log]:
    """Yield the episodes of a LeRobot data set of version 3, each as one table.

    A feature of several numbers gives one field for each: ``action[left_wheel]`` where ``meta/info.json`` names them, else
    ``action[0]``. Videos are left out.

    Raises:
        InputError: no such data set, or of another version.
    """
    import pandas

    features = _features(folder / INFO)
    names = {key: _names_of(feature) for key, feature in features.items()}
    videos = [key for key, feature in features.items() if feature.get("dtype") in ("video", "image")]
    notes = (f"pictures are not read: {', '.join(videos)}",) if videos else ()
    files = sorted((folder / "data").glob("chunk-*/file-*.parquet"))
    if not files:
        raise InputError(f"{folder}: no data/chunk-*/file-*.parquet")
    for k, file in enumerate(files):
        try:
            frame = pandas.read_parquet(file)
        except (OSError, ValueError) as error:
            raise cannot_read(file, "Parquet", error) from None
        missing = {"timestamp", "episode_index"} - set(frame.columns)
        if missing:
            raise InputError(f"{file}: column '{min(missing)}' is missing")
        for episode, rows in frame.groupby("episode_index", sort=True):
            times = np.round(rows["timestamp"].to_numpy(np.float64) * 1e9).astype(np.int64)
            topic = numeric_topic(_flat(rows, names), times, wanted)
            yield Log(folder, {TABLE: topic}, notes, f"episode {episode}", frozenset([TABLE]))
        tell((k + 1) / len(files))


def _features(path: Path) -> dict[str, Any]:
    try:
        info = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise cannot_read(path, "the description of a LeRobot data set", error) from None
    version = str(info.get("codebase_version", "?")) if isinstance(info, dict) else "?"
    if not version.startswith("v3"):
        raise InputError(f"{path}: codebase_version = {version}: expected v3.0; LeRobot has a converter")
    if not isinstance(info.get("features"), dict):
        raise InputError(f"{path}: 'features' is missing")
    return info["features"]


def _names_of(feature: dict[str, Any]) -> list[str]:
    """Return the names of a feature's numbers; they may stand below a key, as in ``{"motors": [...]}``."""
    names = feature.get("names")
    if isinstance(names, dict):
        names = next((value for value in names.values() if isinstance(value, list)), None)
    return [str(name) for name in names] if isinstance(names, list) else []


def _flat(rows: pandas.DataFrame, names: dict[str, list[str]]) -> pandas.DataFrame:
    """Return a table with a column for each number of a feature."""
    import pandas

    columns: dict[str, Any] = {}
    for key in rows.columns:
        first = rows[key].iloc[0]
        if key in _INDEX or isinstance(first, str | bytes | dict):
            continue
        if np.ndim(first) == 0:
            columns[key] = rows[key].to_numpy(np.float64)
        elif np.ndim(first) == 1 and len(first) <= LONGEST:
            values = np.stack(rows[key].to_list()).astype(np.float64)
            labels = names.get(key, [])
            labels = labels if len(labels) == values.shape[1] else range(values.shape[1])
            columns |= {f"{key}[{label}]": values[:, k] for k, label in enumerate(labels)}
    return pandas.DataFrame(columns)
