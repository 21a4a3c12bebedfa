"""The PMW3901MB on an SPI bus of this computer, by its data sheet: registers, power-up, motion burst. Tried on no chip yet.

The chip adds up motion until it is read, and takes 121 frames per second. Read once per control step, one reading would hold
the motion of two frames and the next of three, which no reader can tell apart; so a thread polls faster than the frames, and
counts them by the time since motion came last.
"""

from __future__ import annotations

import struct
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable

from wlr_gym.base.errors import InputError
from wlr_gym.hardware.config import FlowPort
from wlr_gym.hardware.flow import SpiBus, SpiDevice
from wlr_gym.hardware.flow.reading import CountedMotion, FlowReader, FlowReading, FlowStatistics
from wlr_gym.robot.description import FlowSensor

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
