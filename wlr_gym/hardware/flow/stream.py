"""The flow sensor behind a microcontroller that streams frames (``wlr_gym.hardware.flow`` has the format)."""

from __future__ import annotations

import time
from collections.abc import Callable

from wlr_gym.hardware.config import FlowPort
from wlr_gym.hardware.flow import FlowFrame, FlowFrameParser
from wlr_gym.hardware.flow.reading import CountedMotion, FlowReader, FlowReading, FlowStatistics
from wlr_gym.hardware.serial_frames import RECENT, Device, StreamClock, drained, open_serial
from wlr_gym.robot.description import FlowSensor


class FlowStream:
    """Serial stream of frames.

    Args:
        port: device, baud rate, axes, calibration.
        sensor: of the robot's file.
        clock: s; what ages are told by.
        make_device: opens the port, of its path, bit/s and name; the emulator in memory puts its own here.
    """

    def __init__(
        self,
        port: FlowPort,
        sensor: FlowSensor,
        clock: Callable[[], float] = time.monotonic,
        make_device: Callable[[str, int, str], Device] = open_serial,
    ) -> None:
        self._port, self._sensor, self._clock, self._make_device = port, sensor, clock, make_device
        self._device: Device | None = None
        self._reset()

    def _reset(self) -> None:
        self._parser = FlowFrameParser()
        self._frame_clock = StreamClock()
        self._reader = FlowReader(self._port, self._sensor, self._clock())
        self._emptied_at = self._clock()
        self._gone = ""

    @property
    def statistics(self) -> FlowStatistics:
        """What came since the port was opened."""
        found = self._reader.statistics
        found.lost, found.errors = self._parser.lost, self._parser.crc_errors
        return found

    def open(self) -> None:
        """Open the port and throw away what piled up in it.

        Raises:
            InputError: it is not there, cannot be opened, or another program has it.
        """
        self._device = self._make_device(self._port.port, self._port.baud_rate, "flow port")
        self._device.reset_input_buffer()
        self._reset()

    def close(self) -> None:
        """Close the port."""
        if self._device is not None:
            self._device.close()
            self._device = None

    def read(self) -> FlowReading:
        """Return the reading of this control step; does not wait. A port that is gone is a reading that is not valid."""
        frames = self._parser.feed(self._received())
        now = self._clock()
        is_recent, self._emptied_at = now - self._emptied_at <= RECENT, now
        return self._reader.read(self._motions(frames, now, is_recent), now, self._gone)

    def _motions(self, frames: list[FlowFrame], now: float, is_recent: bool) -> list[CountedMotion]:
        if not frames:
            return []
        last = frames[-1].microseconds
        age, _ = self._frame_clock.age(last, now, is_recent=is_recent)
        if age is None:  # a backlog: nobody knows how old it is
            return []
        ends = [now - age - ((last - frame.microseconds) % 2**32) * 1e-6 for frame in frames]
        return [
            CountedMotion(frame.x, frame.y, frame.interval * 1e-6, frame.quality, frame.shutter, end)
            for frame, end in zip(frames, ends, strict=True)
        ]

    def _received(self) -> bytes:
        if self._device is None or self._gone:
            self._gone = self._gone or f"no port: {self._port.port} is not open"
            return b""
        try:
            return drained(self._device)
        except (OSError, TypeError) as error:  # pyserial's exceptions are OSErrors; TypeError: its port was closed
            self._gone = f"no port: {self._port.port} is gone ({error})"
            return b""
