"""Write runs as MCAP files and rosbag2, for Foxglove, PlotJuggler and ROS: whole, or while they go on; and read them back."""

from __future__ import annotations

import queue
import shutil
import sys
import tempfile
import threading
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from wlr_gym.base.errors import InputError, require_package
from wlr_gym.base.files import replace_file
from wlr_gym.base.settings import parse_config
from wlr_gym.base.text import row_words
from wlr_gym.data.format import COMMANDS, RunMeta
from wlr_gym.data.logs.messages import (
    JOINT_STATES,
    PLACES,
    RUN,
    Sent,
    clock_offset,
    definition,
    display_messages,
    nanoseconds,
    read_content,
    row_messages,
    run_message,
    seconds,
    typestore,
)
from wlr_gym.data.logs.readers import quiet, read_logs
from wlr_gym.data.logs.topics import LOG, Share
from wlr_gym.data.runs import Run, Simulation, is_shipped, own_robot
from wlr_gym.robot import Robot, load_robot

Array = NDArray[np.float64]

#: Formats by name, and the suffix of what is written.
FORMATS = {"mcap": ".mcap", "rosbag2": ".bag2"}


class McapSink:
    """Writes messages of ROS 2 into an MCAP file.

    Args:
        file: open for writing, binary.

    Attributes:
        writer: of the package ``mcap``: ``flush`` it, and what has come so far can be read; ``finish`` it at the end.
    """

    def __init__(self, file: IO[bytes]) -> None:
        require_package("mcap", "logs")
        require_package("rosbags", "logs")
        from mcap.writer import Writer

        self.writer = Writer(file)
        self.writer.start(profile="ros2", library="wlr_gym")
        self._schemas: dict[str, int] = {}
        self._channels: dict[str, int] = {}

    def add(self, message: Sent) -> None:
        """Write a message; a topic's first one writes its definition, too."""
        topic, kind, time, data = message
        if kind not in self._schemas:
            self._schemas[kind] = self.writer.register_schema(kind, "ros2msg", definition(kind).encode())
        if topic not in self._channels:
            qos = {"offered_qos_profiles": ""}
            self._channels[topic] = self.writer.register_channel(topic, "cdr", self._schemas[kind], qos)
        self.writer.add_message(self._channels[topic], time, data, time)


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
    if form == "rosbag2":
        _write_rosbag(path, run)
        return path

    def write(temporary: Path) -> None:
        with temporary.open("wb") as file:
            sink = McapSink(file)
            for message in messages_of(run):
                sink.add(message)
            sink.writer.finish()

    replace_file(path, write)
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
    for at, row in zip(times, values, strict=True):
        yield from row_messages(dict(zip(names, row, strict=True)), at)
        yield from shown.get(at, ())


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


# ---- while a run goes on, without holding up what makes it -----------------------------------------------------------


#: Rows that may wait to be written: 20 s at 50 Hz. Beyond, rows are left out: whoever makes them never waits.
WAITING = 1000
#: s between two flushes: of a process that is killed, all before the last one can be read.
FLUSH = 0.5
#: s after which the writing thread gives way to the one that drives the robot; Python's own choice is 5 ms.
SWITCH = 0.0005
#: s that the rest may take to be written at the end.
_LAST = 10.0


class McapStream:
    """Writes rows into an MCAP file, in a thread of its own. Use as a context manager.

    Args:
        path: a new file.
        columns: names of the channels of each row, without ``t``.
        meta: of the run.
        robot: whose run it is.

    Attributes:
        left_out: rows that came while too many waited.
        trouble: why nothing is written any more; empty = all is well.

    Raises:
        InputError: the file is there, or cannot be made.
    """

    def __init__(self, path: Path, columns: Sequence[str], meta: RunMeta, robot: Robot | None = None) -> None:
        self.path, self.columns, self.meta = path, tuple(columns), meta
        self._robot = None if robot is None or is_shipped(robot) else robot
        self.left_out = 0
        self.trouble = ""
        self._offset: int | None = None
        self._rows: queue.Queue[tuple[float, list[float]]] = queue.Queue(WAITING)
        self._over = threading.Event()
        self._flushed = time.monotonic()
        run = run_message(columns, 0, 0, meta)  # what first messages compile and look up is done now, not while it drives
        for message in (run, *row_messages(dict.fromkeys((*COMMANDS, *columns), 0.0), 0)):
            definition(message.kind)
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            self._file = path.open("xb")
        except FileExistsError:
            raise InputError(f"{path}: is there already; a stream goes into a new file") from None
        except OSError as error:
            raise InputError(f"{path}: cannot be written: {error.strerror}") from None
        self._sink = McapSink(self._file)
        self._thread = threading.Thread(target=self._work, name="mcap", daemon=True)

    def __enter__(self) -> McapStream:
        self._thread.start()
        self._switch = sys.getswitchinterval()
        sys.setswitchinterval(SWITCH)
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        sys.setswitchinterval(self._switch)
        self._over.set()  # no word in the queue: it may be full, and nobody left to empty it
        self._thread.join(_LAST)
        if self._thread.is_alive():
            self.trouble = f"{self.path}: not all is written after {_LAST:g} s"

    def add(self, t: float, values: Sequence[float]) -> None:
        """Hand over a row: time (s), and a value per channel. Never waits."""
        try:
            self._rows.put_nowait((t, list(values)))
        except queue.Full:
            self.left_out += 1

    def _work(self) -> None:
        try:
            while True:
                over = self._over.is_set()  # asked first: what came before is in the queue
                try:
                    self._write(*self._rows.get(timeout=0.05))
                except queue.Empty:
                    if over:
                        break
            self._sink.writer.finish()
        except Exception as error:  # whatever it is, it stops no robot
            self.trouble = f"{self.path}: {error or type(error).__name__}"
        finally:
            self._file.close()
            if self._offset is None:  # no row came: there is no run
                self.path.unlink(missing_ok=True)

    def _write(self, t: float, values: Sequence[float]) -> None:
        if self._offset is None:
            self._offset = offset = clock_offset(t)
            columns, begin = ["t", *self.columns], nanoseconds(t, offset)
            self._sink.add(run_message(columns, begin, offset, self.meta, name=self.path.stem, robot=self._robot))
        for message in row_messages(dict(zip(self.columns, values, strict=True)), nanoseconds(t, self._offset)):
            self._sink.add(message)
        if time.monotonic() - self._flushed > FLUSH:
            self._sink.writer.flush()
            self._flushed = time.monotonic()


# ---- reading back: channels to the bit, times to 1 ns ----------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class ExportedRun:
    """A run as it was exported.

    Attributes:
        table: columns by name, (rows,).
        meta, simulation: what stood beside it.
        robot: whose run it is, where it travelled by content.
        notes: what is odd about the file.
    """

    table: dict[str, Array]
    meta: RunMeta
    simulation: Simulation | None
    robot: Robot | None
    notes: tuple[str, ...]


def read_exported(path: str | Path, tell: Share = quiet) -> ExportedRun:
    """Read a run back from an MCAP file or a rosbag2 of :func:`wlr_gym.data.logs.write.export_run`.

    Raises:
        InputError: no such file, or another program's.
    """
    fields: dict[str, set[str]] = {RUN: set()}
    for topic, field in PLACES.values():
        fields.setdefault(topic, set()).add(field)
    (log,) = read_logs(path, fields, tell=tell)
    if RUN not in log.topics or not log.topics[RUN].text:
        raise InputError(f"{path}: no message on '{RUN}': another program's log; import it with a map")
    content = read_content(log.topics[RUN].text, log.name)
    if JOINT_STATES not in log.topics:
        raise InputError(f"{log.name}: no message on '{JOINT_STATES}': the run has no row")
    times = log.topics[JOINT_STATES].clock(LOG)
    table = {"t": np.array([seconds(int(time), content["clock_offset"]) for time in times])}
    for column in (name for name in content["columns"] if name != "t"):
        topic, field = PLACES[column]
        table[column] = np.full(len(times), np.nan)
        if topic in log.topics and field in log.topics[topic].fields:
            at, found = log.topics[topic].series(field, LOG, log.name)
            rows = np.minimum(np.searchsorted(times, at), len(times) - 1)
            mine = times[rows] == at  # of a file that was cut off, a row may lack some of its messages
            table[column][rows[mine]] = found[mine]
    meta = parse_config(RunMeta, content["meta"], f"{log.name}, topic '{RUN}', meta")
    record = content["simulation"]
    simulation = parse_config(Simulation, record, f"{log.name}, topic '{RUN}', simulation") if record else None
    robot = load_robot(content["robot"]) if content.get("robot") else None
    return ExportedRun(table, meta, simulation, robot, log.notes)
