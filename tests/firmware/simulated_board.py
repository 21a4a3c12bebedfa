"""The firmware's binary on a simulated ATmega328P with simulated sensors (``firmware/simulator``), in lock step with a test."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import numpy as np

from wlr_gym.hardware.config import FlowPort, ImuPort
from wlr_gym.hardware.flow import FlowStream
from wlr_gym.hardware.imu import ImuStream
from wlr_gym.robot import load_robot

FIRMWARE = Path(__file__).resolve().parents[2] / "firmware"


def missing_packages() -> str:
    """Return why the firmware cannot be built and simulated here; empty = it can."""
    needed = {
        "gcc-avr": shutil.which("avr-gcc"),
        "avr-libc": any(Path(path).exists() for path in ("/usr/lib/avr/include/avr/io.h", "/usr/avr/include/avr/io.h")),
        "make": shutil.which("make"),
        "gcc": shutil.which("cc"),
        "libsimavr-dev": Path("/usr/include/simavr/sim_avr.h").exists(),
        "libelf-dev": Path("/usr/include/libelf.h").exists(),
    }
    absent = [name for name, found in needed.items() if not found]
    return f"firmware: not installed: {', '.join(absent)}" if absent else ""


def build(folder: Path, source: Path = FIRMWARE, **settings: int) -> Path:
    """Build firmware and simulator into ``folder``; return it."""
    words = ["make", "-s", "-C", str(source), f"OUT={folder}", *(f"{name}={value}" for name, value in settings.items())]
    done = subprocess.run([*words, "firmware", "simulator"], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return folder


class SimulatedBoard:
    """A running simulation. Time passes in :meth:`run` only.

    Args:
        folder: of :func:`build`.
        log: folder for the true moments of samples and frames; None = they are not kept.
    """

    def __init__(self, folder: Path, log: Path | None = None) -> None:
        self._files = [] if log is None else [str(log / "samples"), str(log / "frames")]
        words = [str(folder / "simulator"), str(folder / "wlr_board.elf"), *self._files]
        self._process = subprocess.Popen(words, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
        assert self._process.stdout is not None
        line = ""
        while not line.startswith("/dev/"):
            line = self._process.stdout.readline()
            assert line, "the simulator has ended"
        self.path = line.strip()
        self.time = 0.0

    def __enter__(self) -> SimulatedBoard:
        return self

    def __exit__(self, *error: object) -> None:
        self._process.kill()
        self._process.communicate()

    def command(self, text: str) -> str:
        """Send one line and return the answer."""
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._process.stdin.write(text + "\n")
        self._process.stdin.flush()
        answer = self._process.stdout.readline().strip()
        assert answer, "the simulator has ended"
        assert not answer.startswith("unknown"), answer
        return answer

    def run(self, seconds: float) -> None:
        """Let true time pass."""
        self.time = float(self.command(f"run {seconds}"))

    def set(self, **values: float) -> None:
        """Set names of the simulator's table."""
        for name, value in values.items():
            self.command(f"set {name} {value}")

    def get(self, name: str) -> float:
        """Return a value of the simulator's table."""
        return float(self.command(f"get {name}"))

    def clock(self) -> float:
        """Return true time, s: the reader's clock."""
        return self.time

    def moments(self, kind: int = 0) -> np.ndarray:
        """Return the true moments (s) of the IMU's samples (0), or of the flow sensor's frames (1)."""
        return np.fromfile(self._files[kind])

    def imu(self, baud_rate: int = 115200, **port: float) -> ImuStream:
        """Return the product's reader on this board's line, open."""
        settings = ImuPort.model_validate({"port": self.path, "baud_rate": baud_rate, "rate": 200.0, **port})
        stream = ImuStream(settings, self.clock)
        stream.open()
        return stream

    def flow(self, baud_rate: int = 115200) -> FlowStream:
        """Return the product's reader of optical flow on this board's line, open."""
        sensor = load_robot("flow").sensors.flow
        assert sensor is not None
        stream = FlowStream(FlowPort(port=self.path, baud_rate=baud_rate), sensor, self.clock)
        stream.open()
        return stream
