"""Write runs as MCAP files and as rosbag2: for Foxglove, PlotJuggler and ROS, and to be read back."""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import IO, Any

import numpy as np

from wlr_gym.base.errors import InputError, require_package
from wlr_gym.base.files import replace_file
from wlr_gym.base.text import row_words
from wlr_gym.data.logs.display import display_messages
from wlr_gym.data.logs.messages import Sent, clock_offset, definition, nanoseconds, row_messages, run_message, typestore
from wlr_gym.data.read import Run
from wlr_gym.data.robot_file import own_robot

#: Formats by name, and the suffix of what is written.
FORMATS = {"mcap": ".mcap", "rosbag2": ".bag2"}


class McapSink:
    """Writes messages of ROS 2 into an MCAP file.

    Args:
        file: open for writing, binary.
    """

    def __init__(self, file: IO[bytes]) -> None:
        require_package("mcap", "logs")
        require_package("rosbags", "logs")
        from mcap.writer import Writer

        self._writer = Writer(file)
        self._writer.start(profile="ros2", library="wlr_gym")
        self._schemas: dict[str, int] = {}
        self._channels: dict[str, int] = {}

    def add(self, message: Sent) -> None:
        """Write a message; a topic's first one writes its definition, too."""
        topic, kind, time, data = message
        if kind not in self._schemas:
            self._schemas[kind] = self._writer.register_schema(kind, "ros2msg", definition(kind).encode())
        if topic not in self._channels:
            qos = {"offered_qos_profiles": ""}
            self._channels[topic] = self._writer.register_channel(topic, "cdr", self._schemas[kind], qos)
        self._writer.add_message(self._channels[topic], time, data, time)

    def flush(self) -> None:
        """Write out what has come so far: a reader finds it even if nothing comes after it."""
        self._writer.flush()

    def finish(self) -> None:
        """Write the index; the file stays open."""
        self._writer.finish()


def export_run(run: Run, path: Path, form: str = "mcap") -> Path:
    """Write a run, with poses and markers of slip where it has a camera's pose; return ``path``.

    Args:
        run: a run.
        path: the file, or for ``rosbag2`` the folder, of the bag.
        form: one of :data:`FORMATS`.

    Raises:
        InputError: another format, a bag that is there already, rows less than 1 ns apart, or no room for it.
    """
    if form not in FORMATS:
        raise InputError(f"format '{form}': expected {' or '.join(FORMATS)}")
    if form == "mcap":
        replace_file(path, lambda temporary: _write_mcap(temporary, run))
    else:
        _write_rosbag(path, run)
    return path


def messages_of(run: Run) -> Iterator[Sent]:
    """Yield a run's messages in the order of time.

    Raises:
        InputError: rows less than 1 ns apart.
    """
    offset = clock_offset(float(run["t"][0]))
    times = [nanoseconds(t, offset) for t in run["t"].tolist()]
    close = np.flatnonzero(np.diff(np.array(times, np.int64)) <= 0)
    if len(close):
        raise InputError(f"{run.path}: {row_words(run.path, close[0] + 1)}, column 't': less than 1 ns after the row before")
    columns = [str(name) for name in run.table.columns]
    robot = own_robot(run.meta, run.path.parent)
    yield run_message(columns, times[0], offset, run.meta, run.simulation, run.name, robot)
    shown = display_messages(run, times)
    names = [name for name in columns if name != "t"]
    values = np.stack([run[name] for name in names], axis=1).tolist()
    for time, row in zip(times, values, strict=True):
        yield from row_messages(dict(zip(names, row, strict=True)), time)
        yield from shown.get(time, ())


def _write_mcap(path: Path, run: Run) -> None:
    with path.open("wb") as file:
        sink = McapSink(file)
        for message in messages_of(run):
            sink.add(message)
        sink.finish()


def _write_rosbag(path: Path, run: Run) -> None:
    """A folder cannot be replaced in one step: the bag is made beside its place and moved there when complete."""
    if path.exists():
        raise InputError(f"{path}: is there already; a bag is written to a new folder")
    require_package("rosbags", "logs")
    from rosbags.rosbag2 import Writer

    connections: dict[str, Any] = {}
    try:
        with tempfile.TemporaryDirectory(dir=path.parent, prefix=f".{path.name}-") as made:
            bag = Path(made) / path.name
            with Writer(bag, version=8) as writer:
                for message in messages_of(run):
                    if message.topic not in connections:
                        connections[message.topic] = writer.add_connection(message.topic, message.kind, typestore=typestore())
                    writer.write(connections[message.topic], message.time, message.data)
            shutil.move(bag, path)
    except OSError as error:
        raise InputError(f"{path}: cannot be written: {error.strerror or error}") from error
