"""The IMU behind a microcontroller that streams frames over a serial port (``wlr_gym.hardware.imu.frames`` has the format)."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Protocol

from wlr_gym.base.errors import require_package
from wlr_gym.hardware.config import ImuPort
from wlr_gym.hardware.imu.frames import FrameParser, ImuFrame
from wlr_gym.hardware.imu.reading import Conversion, ImuGoneError, ImuReading, ImuStatistics
from wlr_gym.hardware.ports import open_serial

#: Bytes taken at once; systems give 4 kB at a time, and keep more for a port that nobody reads.
_CHUNK = 65536
#: Reads until the port must be empty: 256 kB.
_LARGEST_BACKLOG = 64
#: s since the port was last empty, up to which frames are hardly older than that: they relate the clocks.
RECENT = 0.1


class Device(Protocol):
    """What is used of ``serial.Serial`` with a time-out of 0. Failures are ``OSError``."""

    def read(self, size: int) -> bytes: ...
    def reset_input_buffer(self) -> None: ...
    def close(self) -> None: ...


def open_device(port: ImuPort) -> Device:
    """Open the serial port.

    Raises:
        InputError: it is not there, cannot be opened, or another program has it.
    """
    require_package("serial", "robot")
    return open_serial(port.port, port.baud_rate, "IMU port")


class StreamClock:
    """Tells how old a frame is from the microcontroller's microseconds (modulo 2^32) and our clock.

    The frame that came soonest after its stamp sets the offset between the clocks, so ages are short by at most what that one
    took: at a poll, up to one frame period. The microcontroller's clock may be wrong by ``drift`` (a ceramic resonator is by
    0.5 %, an RC oscillator by 2 %). A clock that goes back, or that is ahead of ours by more than ``jump``, restarted.
    """

    drift: float = 0.02  #: part by which the microcontroller's clock may be wrong
    jump: float = 0.1  #: s
    _turn = 2**32 * 1e-6  #: s after which the clock wraps

    def __init__(self) -> None:
        self._offset: float | None = None
        self._time = 0.0
        self._last = 0

    def age(self, microseconds: int, now: float, *, is_recent: bool = True) -> tuple[float | None, bool]:
        """Return the age (s) of a frame that is here at ``now`` (s), and whether the microcontroller restarted.

        Args:
            microseconds: the frame's stamp.
            now: s.
            is_recent: the port was empty a moment ago, so the frame is hardly older. Only such a frame can relate the clocks:
                in a backlog nobody knows how old the newest is. The age is None while they are not related.
        """
        sample = microseconds * 1e-6 - now
        if self._offset is None:
            return self._relate(microseconds, now, is_recent), False
        ahead = (sample - self._offset + self._turn / 2) % self._turn - self._turn / 2
        drift = self.drift * (now - self._time)
        is_back = (microseconds - self._last) % 2**32 > 2**31
        if is_back or ahead > self.jump + drift:
            return self._relate(microseconds, now, is_recent), True
        self._last = microseconds
        if ahead > -drift:
            self._offset, self._time = self._offset + ahead, now
        return max(0.0, -ahead - drift), False

    def _relate(self, microseconds: int, now: float, is_recent: bool) -> float | None:
        self._last, self._time = microseconds, now
        self._offset = microseconds * 1e-6 - now if is_recent else None
        return 0.0 if is_recent else None


class ImuStream:
    """Serial stream of frames.

    Args:
        port: device, baud rate, ranges, calibration.
        clock: s; what ages are told by.
        make_device: opens the port; the emulator in memory puts its own here.

    Attributes:
        statistics: what came since the port was opened.
    """

    def __init__(
        self,
        port: ImuPort,
        clock: Callable[[], float] = time.monotonic,
        make_device: Callable[[ImuPort], Device] = open_device,
    ) -> None:
        self._port = port
        self._clock = clock
        self._make_device = make_device
        self._convert = Conversion(port)
        self._device: Device | None = None
        self._reset()

    def _reset(self) -> None:
        self.statistics = ImuStatistics()
        self._parser = FrameParser()
        self._frame_clock = StreamClock()
        self._newest: tuple[ImuFrame, float] | None = None
        self._emptied_at = self._clock()

    def open(self) -> None:
        """Open the port and throw away what piled up in it.

        Raises:
            InputError: it is not there, or cannot be opened.
        """
        self._reset()
        self._device = self._make_device(self._port)
        self._device.reset_input_buffer()
        self._emptied_at = self._clock()

    def close(self) -> None:
        """Close the port."""
        if self._device is not None:
            self._device.close()
            self._device = None

    def __enter__(self) -> ImuStream:
        self.open()
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def frames(self) -> list[ImuFrame]:
        """Return all frames that came since the last call; does not wait.

        Raises:
            ImuGoneError: the port is gone.
        """
        frames = self._parser.feed(self._received())
        self.statistics.readings += len(frames)
        self.statistics.lost, self.statistics.errors = self._parser.lost, self._parser.crc_errors
        return frames

    def read(self) -> ImuReading | None:
        """Return the newest frame; see :class:`wlr_gym.hardware.imu.driver.Imu`. None also while nobody knows how old it is."""
        frames = self.frames()
        now = self._clock()
        is_recent, self._emptied_at = now - self._emptied_at <= RECENT, now
        if frames:
            age, restarted = self._frame_clock.age(frames[-1].microseconds, now, is_recent=is_recent)
            self.statistics.restarts += restarted
            self._newest = None if age is None else (frames[-1], now - age)
        if self._newest is None:
            return None
        frame, taken = self._newest
        return self._convert.reading(frame.accelerometer, frame.temperature, frame.gyroscope, now - taken)

    def _received(self) -> bytes:
        if self._device is None:
            raise ImuGoneError(f"IMU port {self._port.port}: not open")
        data = b""
        try:
            for _ in range(_LARGEST_BACKLOG):
                part = self._device.read(_CHUNK)
                data += part
                if not part:
                    break
            return data
        except (OSError, TypeError) as error:  # pyserial's exceptions are OSErrors; TypeError: its port was closed
            raise ImuGoneError(f"IMU port {self._port.port} is gone: {error}") from None
