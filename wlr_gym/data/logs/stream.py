"""Write a run into an MCAP file while it goes on, without holding up what makes it."""

from __future__ import annotations

import queue
import sys
import threading
import time
from collections.abc import Sequence
from pathlib import Path
from types import TracebackType

from wlr_gym.base.errors import InputError
from wlr_gym.data.format import COMMANDS, RunMeta
from wlr_gym.data.logs.messages import clock_offset, definition, nanoseconds, row_messages, run_message
from wlr_gym.data.logs.write import McapSink
from wlr_gym.data.robot_file import is_shipped
from wlr_gym.robot import Robot

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
        self._thread = threading.Thread(target=self._write_all, name="mcap", daemon=True)

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

    def _write_all(self) -> None:
        try:
            self._write_rows()
        except Exception as error:  # whatever it is, it stops no robot
            self.trouble = f"{self.path}: {error or type(error).__name__}"

    def _write_rows(self) -> None:
        try:
            while (row := self._next()) is not None:
                self._write(*row)
            self._sink.finish()
        finally:
            self._file.close()
            if self._offset is None:  # no row came: there is no run
                self.path.unlink(missing_ok=True)

    def _next(self) -> tuple[float, list[float]] | None:
        """Wait for a row and return it; None = the run is over, and all its rows are written."""
        while True:
            over = self._over.is_set()  # asked first: what came before is in the queue
            try:
                return self._rows.get(timeout=0.05)
            except queue.Empty:
                if over:
                    return None

    def _write(self, t: float, values: Sequence[float]) -> None:
        if self._offset is None:
            self._offset = clock_offset(t)
            self._sink.add(
                run_message(
                    ["t", *self.columns],
                    nanoseconds(t, self._offset),
                    self._offset,
                    self.meta,
                    name=self.path.stem,
                    robot=self._robot,
                )
            )
        for message in row_messages(dict(zip(self.columns, values, strict=True)), nanoseconds(t, self._offset)):
            self._sink.add(message)
        if time.monotonic() - self._flushed > FLUSH:
            self._sink.flush()
            self._flushed = time.monotonic()
