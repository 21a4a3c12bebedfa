"""The camera process (:mod:`wlr_gym.hardware.camera.process`), seen from the one that drives the robot."""

from __future__ import annotations

import contextlib
import json
import os
import select
import subprocess
import sys
from pathlib import Path

from wlr_gym.base.errors import InputError
from wlr_gym.hardware.camera.reading import SIZE, CameraFile, CameraReading, unpack
from wlr_gym.robot import Robot

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

    def open(self) -> None:
        """Start the process, and wait for its first frame.

        Raises:
            InputError: the camera gives none.
        """
        command = [sys.executable, "-m", "wlr_gym.hardware.camera.process"]
        pipe = subprocess.PIPE
        self.process = process = subprocess.Popen(command, stdin=pipe, stdout=pipe, bufsize=0, start_new_session=True)
        try:
            assert process.stdin is not None
            assert process.stdout is not None
            with contextlib.suppress(OSError):
                process.stdin.write(json.dumps(self._spec).encode() + b"\n")
            is_up = select.select([process.stdout], [], [], START_TIME)[0]
            answer = process.stdout.readline().decode("utf-8", "replace").strip() if is_up else ""
            if not answer.startswith("ready"):
                raise InputError(answer.removeprefix("error: ") or f"camera '{self.file.name}': no frame in {START_TIME:g} s")
            os.set_blocking(process.stdout.fileno(), False)
        except BaseException:
            self.close()
            raise
        self.stamps = answer.removeprefix("ready ")

    def close(self) -> None:
        """End the process."""
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

    def read(self, now: float) -> CameraReading | None:
        """Return the newest reading that was not returned yet; None = there is none."""
        newest = b""
        if self.process is not None and self.process.stdout is not None:
            with contextlib.suppress(BlockingIOError):
                while data := os.read(self.process.stdout.fileno(), 100 * SIZE):
                    newest = data[-SIZE:]
        return unpack(newest) if newest else None

    @property
    def trouble(self) -> str:
        """Why no reading will come any more; empty = the process runs."""
        if self.process is None:
            return "the camera process does not run"
        if self.process.poll() is None:
            return ""
        return f"the camera process has ended (exit code {self.process.returncode})"
