"""The IMU behind a microcontroller that streams frames over a serial port (``wlr_gym.hardware.imu.frames`` has the format)."""

from __future__ import annotations

import time
from collections.abc import Callable

from wlr_gym.hardware.config import ImuPort
from wlr_gym.hardware.framing import RECENT, Device, StreamClock, drained
from wlr_gym.hardware.imu.frames import FrameParser, ImuFrame
from wlr_gym.hardware.imu.reading import Conversion, ImuGoneError, ImuReading, ImuStatistics
from wlr_gym.hardware.ports import open_serial


class ImuStream:
    """Serial stream of frames.

    Args:
        port: device, baud rate, ranges, calibration.
        clock: s; what ages are told by.
        make_device: opens the port, of its path, bit/s and name; the emulator in memory puts its own here.

    Attributes:
        statistics: what came since the port was opened.
    """

    def __init__(
        self,
        port: ImuPort,
        clock: Callable[[], float] = time.monotonic,
        make_device: Callable[[str, int, str], Device] = open_serial,
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
            InputError: it is not there, cannot be opened, or another program has it.
        """
        self._reset()
        self._device = self._make_device(self._port.port, self._port.baud_rate, "IMU port")
        self._device.reset_input_buffer()
        self._emptied_at = self._clock()

    def close(self) -> None:
        """Close the port."""
        if self._device is not None:
            self._device.close()
            self._device = None

    def read(self) -> ImuReading | None:
        """Return the newest frame; see :class:`wlr_gym.hardware.imu.driver.Imu`. None also while nobody knows how old it is."""
        frames = self._parser.feed(self._received())
        self.statistics.readings += len(frames)
        self.statistics.lost, self.statistics.errors = self._parser.lost, self._parser.crc_errors
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
        try:
            return drained(self._device)
        except (OSError, TypeError) as error:  # pyserial's exceptions are OSErrors; TypeError: its port was closed
            raise ImuGoneError(f"IMU port {self._port.port} is gone: {error}") from None
