"""Readings of the optical-flow sensor in rad/s along the body's axes, however it is connected, and why there is none."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from wlr_gym.hardware.config import FlowPort
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
class CountedMotion:
    """What the chip counted from one of its frames to a later one.

    Attributes:
        x, y: counts along the chip's axes.
        interval: s from one frame to the other.
        quality, shutter: registers SQUAL and Shutter at the end.
        end: s, our clock.
    """

    x: int
    y: int
    interval: float
    quality: int
    shutter: int
    end: float


@dataclass(frozen=True)
class FlowReading:
    """Optical flow at a control step.

    Attributes:
        flow: (2,) rad/s along body x and y, the last valid one: v_x/h - w_y, v_y/h + w_x.
        quality: surface quality, 0 to 1; 0 = no valid reading in this control step.
        age: s since the end of the valid one's interval.
        is_new: whether this control step brought a valid one.
        trouble: why there is none; empty = there is, or none was due.
        note: what is odd about it; empty = nothing.
    """

    flow: Array
    quality: float
    age: float
    is_new: bool
    trouble: str = ""
    note: str = ""


@dataclass
class FlowStatistics:
    """What came since the sensor was opened.

    Attributes:
        readings: valid ones. lost: frames missing between those received, or polls that failed. errors: broken frames.
        refused: reason, without its numbers -> readings that were not valid.
    """

    readings: int = 0
    lost: int = 0
    errors: int = 0
    refused: dict[str, int] = field(default_factory=dict)

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


class FlowReader:
    """Turns what the chip counted into readings.

    Args:
        port: axes and calibration.
        sensor: of the robot's file.
        now: s.

    Attributes:
        statistics: what came.
    """

    def __init__(self, port: FlowPort, sensor: FlowSensor, now: float) -> None:
        self.statistics = FlowStatistics()
        self._convert, self._sensor = FlowConversion(port, sensor), sensor
        self._flow = np.zeros(2)
        self._end = self._last_frame = now
        self._seen: tuple[int, int, int, int] | None = None
        self._repeats = 0

    def read(self, motions: Sequence[CountedMotion], now: float, gone: str = "") -> FlowReading:
        """Return the reading of a control step: the mean over what came since the last one.

        Args:
            motions: what came, oldest first.
            now: s.
            gone: why nothing can come any more; empty = it can.
        """
        faults = [(motion, self._fault(motion)) for motion in motions]
        if motions:
            self._last_frame = now
        good = [motion for motion, fault in faults if not fault and motion.end > now - OLDEST]
        if good:
            interval = sum(motion.interval for motion in good)
            self._flow = self._convert.flow(sum(m.x for m in good), sum(m.y for m in good), interval)
            self._end = good[-1].end
            self.statistics.readings += 1
            quality = good[-1].quality / FULL_QUALITY
            return FlowReading(self._flow, quality, max(0.0, now - self._end), is_new=True)
        trouble = gone or next((fault for _, fault in reversed(faults) if fault), "")
        if not trouble and (silent := now - self._last_frame) > SILENCE:
            trouble = f"silent: no frame for {silent:.1f} s"
        if trouble:
            self.statistics.refuse(trouble)
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
