"""One piece of shared memory that always holds the newest packet: the writer never waits, and neither does the reader."""

from __future__ import annotations

import contextlib
import json
import mmap
import os
import select
import struct
import subprocess
import sys
import tempfile
from pathlib import Path

from wlr_gym.base.errors import InputError
from wlr_gym.hardware.camera.reading import SIZE, CameraFile, CameraReading, unpack
from wlr_gym.robot import Robot

_COUNT = struct.Struct("<Q")
#: Times a packet is read that is being written meanwhile.
_TRIES = 3


class Slot:
    """A packet of a fixed size in a file that two processes map into their memory. One writes, one reads.

    The count before the packet is odd while it is written (a sequence lock); what a packet is worth, its own checksum says.

    Args:
        path: of the file. size: bytes of a packet.
        create: make the file, with zeros; else it must be there.
    """

    def __init__(self, path: Path, size: int, *, create: bool = False) -> None:
        if create:
            path.write_bytes(bytes(_COUNT.size + size))
        with path.open("r+b") as file:
            self._memory = mmap.mmap(file.fileno(), _COUNT.size + size)
        self._size = size

    def write(self, packet: bytes) -> None:
        """Put a packet in place of the last one."""
        memory = self._memory
        (count,) = _COUNT.unpack_from(memory)
        _COUNT.pack_into(memory, 0, count + 1)
        memory[_COUNT.size : _COUNT.size + self._size] = packet
        _COUNT.pack_into(memory, 0, count + 2)

    def read(self) -> bytes | None:
        """Return the newest packet; None where it is being written all the time."""
        memory = self._memory
        for _ in range(_TRIES):
            (before,) = _COUNT.unpack_from(memory)
            packet = memory[_COUNT.size : _COUNT.size + self._size]
            (after,) = _COUNT.unpack_from(memory)
            if before == after and before % 2 == 0:
                return packet
        return None

    @property
    def count(self) -> int:
        """Twice the number of packets written so far; odd while one is being written."""
        return _COUNT.unpack_from(self._memory)[0]

    def close(self) -> None:
        """Unmap the file."""
        self._memory.close()


# --- the camera process, seen from the one that drives the robot ------------------------------------------------------


#: s that the camera may take until its first frame.
START_TIME = 60.0


class LiveCamera:
    """A camera in a process of its own; see :class:`wlr_gym.hardware.camera.reading.CameraReader`.

    Args:
        file: the camera. robot: what it films where it is an emulated one.
        feed: file with the poses of an emulated robot, which is filmed by rendering.

    Attributes:
        process: None = not open.
        stamps: whose time stamps count: ``driver``, ``driver's own clock`` or ``arrival``.
    """

    def __init__(self, file: CameraFile, robot: Robot, feed: Path | None = None) -> None:
        self.file = file
        self.process: subprocess.Popen[bytes] | None = None
        self.stamps = ""
        self._spec = {
            "camera": file.model_dump(mode="json"),
            "robot": robot.model_dump(mode="json"),
            "feed": None if feed is None else str(feed),
        }
        self._stack = contextlib.ExitStack()
        self._slot: Slot | None = None
        self._count = 0

    def open(self) -> None:
        """Start the process, and wait for its first frame.

        Raises:
            InputError: the camera gives none.
        """
        with contextlib.ExitStack() as stack:
            folder = stack.enter_context(tempfile.TemporaryDirectory(prefix="wlr-camera-"))
            self._slot = Slot(Path(folder) / "slot", SIZE, create=True)
            stack.callback(self._slot.close)
            command = [sys.executable, "-m", "wlr_gym.hardware.camera.process"]
            self.process = subprocess.Popen(
                command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, bufsize=0, start_new_session=True
            )
            stack.callback(self._end)
            assert self.process.stdin is not None
            assert self.process.stdout is not None
            with contextlib.suppress(OSError):
                self.process.stdin.write(json.dumps(self._spec | {"slot": str(Path(folder) / "slot")}).encode() + b"\n")
            is_up = select.select([self.process.stdout], [], [], START_TIME)[0]
            answer = self.process.stdout.readline().decode("utf-8", "replace").strip() if is_up else ""
            if not answer.startswith("ready"):
                raise InputError(answer.removeprefix("error: ") or f"camera '{self.file.name}': no frame in {START_TIME:g} s")
            self.stamps, self._count = answer.removeprefix("ready "), 0
            os.set_blocking(self.process.stdout.fileno(), False)
            self._stack = stack.pop_all()

    def _end(self) -> None:
        process, self.process = self.process, None
        if process is None:
            return
        assert process.stdin is not None
        assert process.stdout is not None
        with contextlib.suppress(OSError):
            process.stdin.close()
        try:
            process.wait(0.5)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
        process.stdout.close()

    def close(self) -> None:
        """End the process."""
        self._stack.close()
        self._slot = None

    def read(self, now: float) -> CameraReading | None:
        """Return the newest reading that was not returned yet; None = there is none."""
        slot = self._slot
        if slot is None or (count := slot.count) == self._count:
            return None
        reading = None if (packet := slot.read()) is None else unpack(packet)
        self._count = count if reading is not None else self._count
        return reading

    @property
    def trouble(self) -> str:
        """Why no reading will come any more; empty = the process runs."""
        if self.process is None:
            return "the camera process does not run"
        if self.process.poll() is None:
            return ""
        return f"the camera process has ended (exit code {self.process.returncode})"
