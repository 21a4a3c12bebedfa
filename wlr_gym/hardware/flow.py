"""The optical-flow sensor in rad/s along the body's axes: a PMW3901 behind a microcontroller's serial stream.

The microcontroller (``firmware/``) polls the chip faster than its 121 frames per second, and sends a frame
(:data:`wlr_gym.hardware.serial_frames.FLOW_FRAMES`) for each of the chip's, or for several, stamped when the chip's last one
was taken. Its ``interval`` is from the chip's frame before the first counted to that one.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from wlr_gym.hardware.config import FlowPort
from wlr_gym.hardware.serial_frames import FLOW_FRAMES, Device, FrameStream, SerialDevice
from wlr_gym.robot.description import FlowSensor

Array = NDArray[np.float64]

#: Greatest value of the PMW3901's register SQUAL.
FULL_QUALITY = 255
#: s: what was counted before is no part of a reading: control steps were missed.
OLDEST = 0.1
#: s without a frame after which the sensor counts as silent.
SILENCE = 0.1
#: The chip's frames that repeat the same motion and quality after which its values count as frozen (0.3 s).
FROZEN = 40


@dataclass(frozen=True)
class FlowReading:
    """Optical flow at a control step."""

    flow: Array  #: (2,) rad/s along body x and y, the last valid one: v_x/h - w_y, v_y/h + w_x
    quality: float  #: surface quality, 0 to 1; 0 = no valid reading in this control step
    age: float  #: s since the end of the valid one's interval
    is_new: bool  #: this control step brought a valid one
    trouble: str = ""  #: why there is none; empty = there is, or none was due
    note: str = ""  #: what is odd about it; empty = nothing


@dataclass
class FlowStatistics:
    """What came since the sensor was opened."""

    readings: int = 0  #: valid ones
    lost: int = 0  #: frames missing between those received
    errors: int = 0  #: broken frames
    refused: dict[str, int] = field(default_factory=dict)  #: reason, without its numbers -> readings that were not valid

    def refuse(self, trouble: str) -> None:
        """Count a reading that is not valid."""
        kind = trouble.partition(":")[0]
        self.refused[kind] = self.refused.get(kind, 0) + 1


class FlowConversion:
    """Counts to calibrated flow along the body's axes, and back.

    Args:
        port: the chip's axes and calibration.
        sensor: of the robot's file: size of a count.
    """

    def __init__(self, port: FlowPort, sensor: FlowSensor) -> None:
        self._axes = np.zeros((2, 2))
        for row, axis in enumerate(port.axes):
            self._axes[row, "xy".index(axis[-1])] = -1.0 if axis.startswith("-") else 1.0
        c, s = np.cos(port.calibration.mount_yaw), np.sin(port.calibration.mount_yaw)
        turn = np.array([[c, -s], [s, c]])
        self._to_flow = sensor.count / port.calibration.scale * turn @ self._axes
        self._count = sensor.count

    def flow(self, x: float, y: float, interval: float) -> Array:
        """Return flow (2,) in rad/s along body x and y of counts over ``interval`` (s)."""
        return self._to_flow @ np.array([x, y]) / interval

    def counts(self, flow: Array, interval: float) -> tuple[int, int]:
        """Return what the chip counts over ``interval`` (s) where its own frame, mapped by ``axes``, sees ``flow`` (2,)."""
        x, y = np.clip(np.rint(self._axes.T @ flow * interval / self._count), -32768, 32767).astype(int).tolist()
        return x, y


class CountedMotion(NamedTuple):
    """What the chip counted from one of its frames to a later one."""

    interval: float  #: s from one frame to the other
    x: int  #: counts along the chip's axis
    y: int
    quality: int  #: register SQUAL at the end
    shutter: int  #: register Shutter at the end
    end: float  #: s, our clock


class FlowStream(FrameStream):
    """A connected flow sensor. One thread owns it.

    Args:
        port: device, baud rate, axes, calibration.
        sensor: of the robot's file.
        clock, make_device: see :class:`wlr_gym.hardware.serial_frames.FrameStream`.

    Attributes:
        statistics: what came since the port was opened.
    """

    def __init__(
        self,
        port: FlowPort,
        sensor: FlowSensor,
        clock: Callable[[], float] = time.monotonic,
        make_device: Callable[[str, int, str], Device] = SerialDevice,
    ) -> None:
        super().__init__(FLOW_FRAMES, port.port, port.baud_rate, "flow port", clock, make_device, repeats=False)
        self._sensor, self._convert = sensor, FlowConversion(port, sensor)

    def _begin(self) -> None:
        super()._begin()
        self.statistics = FlowStatistics()
        self._flow = np.zeros(2)
        self._end = self._last_frame = self._clock()
        self._seen: tuple[int, int, int, int] | None = None
        self._repeats = 0

    def read(self) -> FlowReading:
        """Return the mean over what came since the last reading, for a control step; does not wait.

        A port that is gone is a reading that is not valid.
        """
        frames, trouble = [], ""
        try:
            frames = self.frames()
        except ConnectionError as error:
            trouble = f"no port: {self.path} is {error}"
        found, now = self.statistics, self._clock()
        found.lost, found.errors = self.parser.lost, self.parser.crc_errors
        good: list[CountedMotion] = []
        for (_, _, microseconds, x, y, quality, shutter), end in frames:
            if end is None:
                continue
            self._last_frame = now
            motion = CountedMotion(microseconds * 1e-6, x, y, quality, shutter, end)
            if fault := self._fault(motion):
                trouble = fault
            elif motion.end > now - OLDEST:
                good.append(motion)
        if good:
            interval = sum(motion.interval for motion in good)
            self._flow = self._convert.flow(sum(motion.x for motion in good), sum(motion.y for motion in good), interval)
            self._end = good[-1].end
            found.readings += 1
            return FlowReading(self._flow, good[-1].quality / FULL_QUALITY, max(0.0, now - self._end), is_new=True)
        if not trouble and (silent := now - self._last_frame) > SILENCE:
            trouble = f"silent: no frame for {silent:.1f} s"
        if trouble:
            found.refuse(trouble)
        return FlowReading(self._flow, 0.0, max(0.0, now - self._end), is_new=False, trouble=trouble)

    def _fault(self, motion: CountedMotion) -> str:
        """Return why what was counted is not valid; empty = it is."""
        seen = (motion.x, motion.y, motion.quality, motion.shutter)
        self._repeats = self._repeats + 1 if seen == self._seen and (motion.x or motion.y) else 0
        self._seen = seen
        sensor = self._sensor
        if not 0.0 < motion.interval <= OLDEST:
            return f"interval: {1e3 * motion.interval:.1f} ms between two frames, expected up to {1e3 * OLDEST:g}"
        if motion.quality < sensor.least_quality * FULL_QUALITY:
            least = sensor.least_quality * FULL_QUALITY
            return f"poor texture: surface quality {motion.quality} of {FULL_QUALITY}, expected {least:.0f} or more"
        fastest = max(abs(motion.x), abs(motion.y)) * sensor.count / motion.interval
        if fastest > sensor.greatest_rate:
            return f"too fast: {fastest:.1f} rad/s, the sensor measures up to {sensor.greatest_rate:g}"
        if self._repeats >= FROZEN:
            return f"frozen: the same counts ({motion.x}, {motion.y}) and quality for {self._repeats + 1} frames"
        return ""
