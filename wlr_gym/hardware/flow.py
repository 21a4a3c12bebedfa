"""The optical-flow sensor in rad/s along the body's axes: a PMW3901 behind a microcontroller, or on this computer's SPI bus.

The microcontroller polls the chip faster than its 121 frames per second, and sends a frame
(:mod:`wlr_gym.hardware.serial_frames`) for each of the chip's, or for several: 20 bytes with sync A5 F1, stamped when the
chip's last one was taken. Content: microseconds from the chip's frame before the first counted to that one (u16), counts along
the chip's x and y (i16), SQUAL (u8), one byte that is 0, Shutter (u16).

The chip itself (by its data sheet; tried on none yet) adds up motion until it is read. Read once per control step, one reading
would hold the motion of two of its frames and the next of three, which no reader can tell apart; so a thread polls faster than
the frames, and counts them by the time since motion came last.
"""

from __future__ import annotations

import ctypes
import os
import struct
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from wlr_gym.base.errors import InputError
from wlr_gym.hardware.config import FlowPort, Hardware
from wlr_gym.hardware.serial_frames import Device, FrameFormat, FrameStream, SerialDevice, lock
from wlr_gym.robot import Robot
from wlr_gym.robot.description import FlowSensor

Array = NDArray[np.float64]

FLOW_FRAMES = FrameFormat(b"\xa5\xf1", "HhhBxH")
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


# ---- behind a microcontroller ----


class FlowStream:
    """The sensor behind a microcontroller.

    Args:
        port: device, baud rate, axes, calibration.
        sensor: of the robot's file.
        clock: s; what ages are told by.
        make_device: opens the port; the emulator in memory puts its own here.
    """

    def __init__(
        self,
        port: FlowPort,
        sensor: FlowSensor,
        clock: Callable[[], float] = time.monotonic,
        make_device: Callable[[str, int, str], Device] = SerialDevice,
    ) -> None:
        self._port, self._sensor, self._clock = port, sensor, clock
        self._stream = FrameStream(FLOW_FRAMES, port.port, port.baud_rate, "flow port", clock, make_device, repeats=False)
        self._reader = FlowReader(port, sensor, clock())

    @property
    def statistics(self) -> FlowStatistics:
        """What came since the port was opened."""
        found, parser = self._reader.statistics, self._stream.parser
        found.lost, found.errors = parser.lost, parser.crc_errors
        return found

    def open(self) -> None:
        """Open the port and throw away what piled up in it.

        Raises:
            InputError: it is not there, cannot be opened, or another program has it.
        """
        self._stream.open()
        self._reader = FlowReader(self._port, self._sensor, self._clock())

    def close(self) -> None:
        """Close the port."""
        self._stream.close()

    def read(self) -> FlowReading:
        """Return the reading of this control step; does not wait. A port that is gone is a reading that is not valid."""
        frames, gone = [], ""
        try:
            frames = self._stream.read()
        except ConnectionError as error:
            gone = f"no port: {self._port.port} is {error}"
        motions = []
        for (_, _, interval, x, y, quality, shutter), end in frames:
            if end is not None:
                motions.append(CountedMotion(x, y, interval * 1e-6, quality, shutter, end))
        return self._reader.read(motions, self._clock(), gone)


# ---- on this computer's SPI bus ----

#: Clock (Hz) and mode of the PMW3901: clock high at rest, taken at its rising edge.
CLOCK = 2_000_000
MODE = 3
#: One part of an exchange (linux/spi/spidev.h): where to send from and receive to, bytes, clock, pause after it (us), bits.
_PART = struct.Struct("=QQIIHBBBBBx")
_WRITE_MODE = 0x40016B01
_WRITE_SPEED = 0x40046B04


class SpiBus(Protocol):
    """A selected chip. Failures are ``OSError``."""

    def exchange(self, parts: Sequence[bytes], pause: float) -> list[bytes]:
        """Send parts under one chip select, ``pause`` (s) between them; return what came back with each."""
        ...

    def close(self) -> None: ...


class SpiDevice:
    """A chip on an SPI bus.

    Args:
        path: device, such as ``/dev/spidev0.0``.

    Raises:
        InputError: it is not there, cannot be opened, or another program of this library has it.
    """

    def __init__(self, path: str) -> None:
        import fcntl

        self._ioctl = fcntl.ioctl
        try:
            self._descriptor = os.open(path, os.O_RDWR)
        except OSError as error:
            hint = "switch SPI on in the system's settings and join the group 'spi'"
            raise InputError(f"flow port {path}: cannot be opened: {error}; {hint}") from None
        try:
            lock(self._descriptor, path, "flow port")
            self._ioctl(self._descriptor, _WRITE_MODE, struct.pack("B", MODE))
            self._ioctl(self._descriptor, _WRITE_SPEED, struct.pack("I", CLOCK))
        except OSError as error:
            self.close()
            raise InputError(f"flow port {path}: is no SPI device: {error}") from None
        except InputError:
            self.close()
            raise

    def exchange(self, parts: Sequence[bytes], pause: float) -> list[bytes]:
        """Send parts under one chip select; see :class:`SpiBus`."""
        sent = [ctypes.create_string_buffer(part, len(part)) for part in parts]
        received = [ctypes.create_string_buffer(len(part)) for part in parts]
        message = bytearray()
        for k, part in enumerate(parts):
            after = round(pause * 1e6) if k + 1 < len(parts) else 0
            places = (ctypes.addressof(sent[k]), ctypes.addressof(received[k]))
            message += _PART.pack(*places, len(part), CLOCK, after, 8, 0, 0, 0, 0)
        self._ioctl(self._descriptor, 0x40006B00 | len(message) << 16, message)
        return [buffer.raw for buffer in received]

    def close(self) -> None:
        """Close the device."""
        os.close(self._descriptor)


# Registers.
PRODUCT_ID = 0x00
MOTION = 0x02
MOTION_BURST = 0x16
POWER_UP_RESET = 0x3A
INVERSE_PRODUCT_ID = 0x5F
PAGE = 0x7F
#: What a PMW3901 answers to PRODUCT_ID, and inverted to INVERSE_PRODUCT_ID.
IDENTITY, INVERSE_IDENTITY = 0x49, 0xB6
_RESET = 0x5A
_WRITE = 0x80
#: MOTION, bit 7: motion since the last reading.
_MOVED = 0x80
#: s: between address and data of a read; between a write and what follows; after power, reset, and half of the set-up.
READ_PAUSE, WRITE_PAUSE, POWER_TIME, RESET_TIME, SETTLE_TIME = 35e-6, 45e-6, 0.04, 0.005, 0.01
#: Motion, Observation, Delta_X, Delta_Y, SQUAL, RawData_Sum, Maximum_RawData, Minimum_RawData, Shutter (upper byte first).
_BURST = struct.Struct("<BBhhBBBB2s")
#: Polls per frame of the chip. Polls that may fail in a row before the chip counts as gone.
POLLS, PATIENCE = 2.5, 25

#: What the data sheet writes before motion is read (its table of registers for best performance): register, value.
FIRST_SETTINGS = ((PAGE, 0x00), (0x55, 0x01), (0x50, 0x07), (PAGE, 0x0E), (0x43, 0x10))
SECOND_SETTINGS = ((PAGE, 0x00), (0x51, 0x7B), (0x50, 0x00), (0x55, 0x00), (PAGE, 0x0E))
THIRD_SETTINGS = (
    (PAGE, 0x00), (0x61, 0xAD), (PAGE, 0x03), (0x40, 0x00), (PAGE, 0x05), (0x41, 0xB3), (0x43, 0xF1), (0x45, 0x14),
    (0x5B, 0x32), (0x5F, 0x34), (0x7B, 0x08), (PAGE, 0x06), (0x44, 0x1B), (0x40, 0xBF), (0x4E, 0x3F), (PAGE, 0x08),
    (0x65, 0x20), (0x6A, 0x18), (PAGE, 0x09), (0x4F, 0xAF), (0x5F, 0x40), (0x48, 0x80), (0x49, 0x80), (0x57, 0x77),
    (0x60, 0x78), (0x61, 0x78), (0x62, 0x08), (0x63, 0x50), (PAGE, 0x0A), (0x45, 0x60), (PAGE, 0x00), (0x4D, 0x11),
    (0x55, 0x80), (0x74, 0x21), (0x75, 0x1F), (0x4A, 0x78), (0x4B, 0x78), (0x44, 0x08), (0x45, 0x50), (0x64, 0xFF),
    (0x65, 0x1F), (PAGE, 0x14), (0x65, 0x67), (0x66, 0x08), (0x63, 0x70), (PAGE, 0x15), (0x48, 0x48), (PAGE, 0x07),
    (0x41, 0x0D), (0x43, 0x14), (0x4B, 0x0E), (0x45, 0x0F), (0x44, 0x42), (0x4C, 0x80), (PAGE, 0x10), (0x5B, 0x02),
    (PAGE, 0x07), (0x40, 0x41), (0x70, 0x00),
)  # fmt: skip
LAST_SETTINGS = (
    (0x32, 0x44), (PAGE, 0x07), (0x40, 0x40), (PAGE, 0x06), (0x62, 0xF0), (0x63, 0x00), (PAGE, 0x0D), (0x48, 0xC0),
    (0x6F, 0xD5), (PAGE, 0x00), (0x5B, 0xA0), (0x4E, 0xA8), (0x5A, 0x50), (0x40, 0x80),
)  # fmt: skip


class Pmw3901:
    """The chip's registers.

    Args:
        bus: the chip.
        sleep: waits s.
    """

    def __init__(self, bus: SpiBus, sleep: Callable[[float], None] = time.sleep) -> None:
        self._bus, self._sleep = bus, sleep

    def write(self, register: int, value: int) -> None:
        """Write a register."""
        self._bus.exchange([bytes([register | _WRITE, value])], 0.0)
        self._sleep(WRITE_PAUSE)

    def read(self, register: int) -> int:
        """Return a register."""
        return self._bus.exchange([bytes([register]), b"\0"], READ_PAUSE)[1][0]

    def set_up(self, where: str) -> None:
        """Reset the chip and set it up.

        Raises:
            InputError: another chip answers, or nobody.
        """
        self._sleep(POWER_TIME)
        self.write(POWER_UP_RESET, _RESET)
        self._sleep(RESET_TIME)
        found, inverse = self.read(PRODUCT_ID), self.read(INVERSE_PRODUCT_ID)
        if (found, inverse) != (IDENTITY, INVERSE_IDENTITY):
            raise InputError(
                f"{where}: Product_ID is {found:#04x} and its inverse {inverse:#04x}, expected {IDENTITY:#04x} and "
                f"{INVERSE_IDENTITY:#04x} (PMW3901): check wiring and supply"
            )
        for register in range(MOTION, MOTION + 5):  # once, whatever they say
            self.read(register)
        self._write_all(FIRST_SETTINGS)
        self.write(0x48, 0x04 if self.read(0x67) & 0x80 else 0x02)
        self._write_all(SECOND_SETTINGS)
        if self.read(0x73) == 0x00:  # two values depend on what the chip was trimmed to
            first, second = self.read(0x70), self.read(0x71)
            first = min(first + (0x0E if first <= 0x1C else 0x0B), 0x3F)
            gains = ((0x70, first), (0x71, second * 45 // 100))
            self._write_all(((PAGE, 0x00), (0x61, 0xAD), (0x51, 0x70), (PAGE, 0x0E), *gains))
        self._write_all(THIRD_SETTINGS)
        self._sleep(SETTLE_TIME)
        self._write_all(LAST_SETTINGS)

    def _write_all(self, settings: Iterable[tuple[int, int]]) -> None:
        for register, value in settings:
            self.write(register, value)

    def motion(self) -> tuple[bool, int, int, int, int]:
        """Read the burst: whether there was motion since the last one, counts along x and y, SQUAL, Shutter."""
        status, _, x, y, quality, _, _, _, shutter = _BURST.unpack(
            self._bus.exchange([bytes([MOTION_BURST]), bytes(_BURST.size)], READ_PAUSE)[1]
        )
        return bool(status & _MOVED), x, y, quality, int.from_bytes(shutter, "big")


class ChipPoller:
    """Polls the chip in a thread of its own, and hands over readings without waiting.

    Args:
        port: device, axes, calibration.
        sensor: of the robot's file.
        clock: s.
        make_bus: path -> chip; tests put an emulated one here.
        sleep: waits s.
    """

    def __init__(
        self,
        port: FlowPort,
        sensor: FlowSensor,
        clock: Callable[[], float] = time.monotonic,
        make_bus: Callable[[str], SpiBus] = SpiDevice,
        sleep: Callable[[float], None] = time.sleep,
    ) -> None:
        self._port, self._sensor, self._clock, self._make_bus, self._sleep = port, sensor, clock, make_bus, sleep
        self._reader = FlowReader(port, sensor, clock())
        self._motions: deque[CountedMotion] = deque(maxlen=256)
        self._bus: SpiBus | None = None
        self._thread: threading.Thread | None = None
        self._over = threading.Event()
        self._gone = ""
        self._failures = 0
        self._frame_at = 0.0

    @property
    def statistics(self) -> FlowStatistics:
        """What came since it was opened."""
        return self._reader.statistics

    def open(self) -> None:
        """Set the chip up and begin to poll.

        Raises:
            InputError: it is not there, cannot be opened, or another chip answers.
        """
        self.close()
        where = f"flow sensor on {self._port.port}"
        self._bus = self._make_bus(self._port.port)
        try:
            self._chip = Pmw3901(self._bus, self._sleep)
            self._chip.set_up(where)
        except OSError as error:
            self._release()
            raise InputError(f"{where}: no answer ({error}); check wiring and supply") from None
        except InputError:
            self._release()
            raise
        self._reader = FlowReader(self._port, self._sensor, self._clock())
        self._motions.clear()
        self._over.clear()
        self._gone, self._failures, self._frame_at = "", 0, self._clock()
        self._thread = threading.Thread(target=self._poll_all, name="flow", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Stop polling and release the bus."""
        self._over.set()
        if self._thread is not None:
            self._thread.join()
            self._thread = None
        self._release()

    def _release(self) -> None:
        if self._bus is not None:
            self._bus.close()
            self._bus = None

    def read(self) -> FlowReading:
        """Return the reading of this control step; does not wait. A chip that is gone is a reading that is not valid."""
        motions = []
        while self._motions:
            motions.append(self._motions.popleft())
        gone = self._gone or ("" if self._bus is not None else f"no port: {self._port.port} is not open")
        return self._reader.read(motions, self._clock(), gone)

    def _poll_all(self) -> None:
        period = 1.0 / (POLLS * self._sensor.rate)
        while not self._over.is_set() and not self._gone:
            self.poll()
            self._sleep(period)

    def poll(self) -> None:
        """Read the chip once; note the motion, or, where there was none for a frame's time, that there was none."""
        try:
            moved, x, y, quality, shutter = self._chip.motion()
            self._failures = 0
        except OSError as error:  # motors disturb the line
            self._failures += 1
            self._reader.statistics.lost += 1
            if self._failures >= PATIENCE:
                self._gone = f"no port: {self._port.port} is gone ({error})"
            return
        now, rate = self._clock(), self._sensor.rate
        if moved or now - self._frame_at >= 1.0 / rate:
            frames = max(1, round((now - self._frame_at) * rate))  # the chip's time is not the polls'
            self._motions.append(CountedMotion(x, y, frames / rate, quality, shutter, now))
            self._frame_at = now


#: A connected flow sensor. One thread owns it.
Flow = FlowStream | ChipPoller


def make_flow(robot: Robot, hardware: Hardware, clock: Callable[[], float] = time.monotonic) -> Flow | None:
    """Return the flow sensor that the hardware file names, not yet connected; None = it names none. ``clock``: s."""
    port, sensor = hardware.flow, robot.sensors.flow
    if port is None or sensor is None:
        return None
    return ChipPoller(port, sensor, clock) if port.driver == "spi" else FlowStream(port, sensor, clock)
