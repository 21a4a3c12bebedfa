"""The IMU in SI units and the body frame: an MPU-6050 behind a microcontroller's serial stream, or on this computer's I2C bus.

The stream's frames (:data:`wlr_gym.hardware.serial_frames.IMU_FRAMES`) hold the chip's burst in its own counts and axes;
``firmware/`` sends them. On I2C the chip is driven by register map RM-MPU-6000A revision 4.2 (Linux).
"""

from __future__ import annotations

import struct
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from wlr_gym.base.errors import InputError, require_package
from wlr_gym.hardware.config import ImuCalibration, ImuPort
from wlr_gym.hardware.serial_frames import IMU_FRAMES, TAKEN, Device, FrameStream, PortInUseError, SerialDevice
from wlr_gym.physics.plants.sensors import rotation

Array = NDArray[np.float64]
Counts = tuple[int, int, int]

#: One g as the MPU-6050's data sheet counts it, m/s2.
STANDARD_GRAVITY = 9.80665
#: Axes of the chip, in the order of :attr:`ImuReading.counts`.
IMU_AXES = tuple(f"{sensor} {axis}" for sensor in ("accelerometer", "gyroscope") for axis in "xyz")
#: Counts at the ends of an axis' range.
COUNT_ENDS = (-32768, 32767)


class ImuGoneError(ConnectionError):
    """The IMU's port does not work any more: unplugged, dead driver."""


@dataclass(frozen=True)
class ImuReading:
    """One reading of gyroscope and accelerometer, calibrated, body frame."""

    gyro: Array  #: (3,) rad/s
    accelerometer: Array  #: (3,) m/s2, specific force (+9.81 on z at rest)
    temperature: float  #: degC, of the chip
    age: float  #: s since the sensor was read; grows when nothing new comes
    counts: tuple[int, ...] = ()  #: (6,) as the chip gave them, along its own axes: :data:`IMU_AXES`


@dataclass
class ImuStatistics:
    """What came since the IMU was opened."""

    readings: int = 0  #: good ones
    lost: int = 0  #: frames missing between those received (stream), readings that failed after their retry (I2C)
    errors: int = 0  #: frames with a wrong CRC (stream), bus errors (I2C)
    restarts: int = 0  #: times the microcontroller's clock began anew
    unchanged: int = 0  #: times the chip had nothing new (I2C)


def gyro_per_count(gyro_range: int) -> float:
    """Return rad/s per count at a full scale of ``gyro_range`` deg/s."""
    return float(np.deg2rad(gyro_range)) / 32768


def accel_per_count(accel_range: int) -> float:
    """Return m/s2 per count at a full scale of ``accel_range`` g."""
    return accel_range * STANDARD_GRAVITY / 32768


def to_counts(values: ArrayLike, per_count: float) -> Counts:
    """Return three SI values as counts, clipped to the sensor's range as the sensor does."""
    low, high = COUNT_ENDS
    x, y, z = (round(min(max(value / per_count, low), high)) for value in np.asarray(values, np.float64).tolist())
    return x, y, z


def to_body(calibration: ImuCalibration) -> Array:
    """Return the rotation (3, 3) from sensor to body axes."""
    roll, pitch, yaw = (np.array([angle]) for angle in calibration.mounting)
    return rotation(yaw, pitch, roll)[0]


class Conversion:
    """Counts to calibrated SI values in the body frame, and back.

    Args:
        port: ranges and calibration.
    """

    def __init__(self, port: ImuPort) -> None:
        known = port.calibration
        self._gyro_count, self._accel_count = gyro_per_count(port.gyro_range), accel_per_count(port.accel_range)
        self._gyro_bias, self._accel_offset = np.array(known.gyro_bias), np.array(known.accel_offset)
        self._accel_scale = np.array(known.accel_scale)
        self._to_body = to_body(known)

    def reading(self, burst: Sequence[int], age: float) -> ImuReading:
        """Return a reading from the chip's seven counts: accelerometer x, y, z, temperature, gyroscope x, y, z."""
        counts = np.asarray(burst, np.float64)
        force = self._accel_scale * (counts[:3] * self._accel_count - self._accel_offset)
        rate = counts[4:] * self._gyro_count - self._gyro_bias
        celsius = burst[3] / 340.0 + 36.53  # register map
        return ImuReading(self._to_body @ rate, self._to_body @ force, celsius, age, (*burst[:3], *burst[4:]))

    def counts(self, accelerometer: ArrayLike, gyro: ArrayLike) -> tuple[Counts, Counts]:
        """Return what the chip counts at a specific force (m/s2) and a rate (rad/s) in the body frame."""
        force = self._to_body.T @ np.asarray(accelerometer) / self._accel_scale + self._accel_offset
        rate = self._to_body.T @ np.asarray(gyro) + self._gyro_bias
        return to_counts(force, self._accel_count), to_counts(rate, self._gyro_count)


class ImuStream(FrameStream):
    """The IMU behind a microcontroller.

    Args:
        port: device, baud rate, ranges, calibration.
        clock, make_device: see :class:`wlr_gym.hardware.serial_frames.FrameStream`.

    Attributes:
        statistics: what came since the port was opened.
    """

    def __init__(
        self,
        port: ImuPort,
        clock: Callable[[], float] = time.monotonic,
        make_device: Callable[[str, int, str], Device] = SerialDevice,
    ) -> None:
        super().__init__(IMU_FRAMES, port.port, port.baud_rate, "IMU port", clock, make_device)
        self._convert = Conversion(port)

    def _begin(self) -> None:
        super()._begin()
        self.statistics = ImuStatistics()
        self._newest: tuple[Sequence[int], float] | None = None

    def read(self) -> ImuReading | None:
        """Return the newest reading without waiting for one; None = nothing has come yet, or nobody knows how old it is.

        Raises:
            ImuGoneError: the port is gone.
        """
        try:
            frames = self.frames()
        except ConnectionError as error:
            raise ImuGoneError(f"IMU port {self.path} is {error}") from None
        found = self.statistics
        found.readings += len(frames)
        found.lost, found.errors, found.restarts = self.parser.lost, self.parser.crc_errors, self.restarts
        if frames:
            (_, _, *burst), taken = frames[-1]
            self._newest = None if taken is None else (burst, taken)
        if self._newest is None:
            return None
        burst, taken = self._newest
        return self._convert.reading(burst, self._clock() - taken)


# ---- the chip on I2C ----

# Registers.
SAMPLE_RATE_DIVIDER = 0x19
CONFIG = 0x1A
GYRO_CONFIG = 0x1B
ACCEL_CONFIG = 0x1C
INTERRUPT_ENABLE = 0x38
INTERRUPT_STATUS = 0x3A
POWER_1 = 0x6B
WHO_AM_I = 0x75
#: What an MPU-6050 answers to WHO_AM_I.
IDENTITY = 0x68
#: What pin-compatible chips answer to WHO_AM_I: their accelerometer's filter is set in another register.
RELATIVES = {0x70: "MPU-6500", 0x71: "MPU-9250", 0x73: "MPU-9255", 0x98: "ICM-20689", 0x12: "ICM-20602"}
#: Accelerometer bandwidth (Hz) -> DLPF_CFG. With any of them the chip samples at 1 kHz before the divider.
FILTERS = {184: 1, 94: 2, 44: 3, 21: 4, 10: 5, 5: 6}
#: Hz before the divider.
_SAMPLING = 1000.0
#: POWER_1: reset; awake, on the gyroscope's oscillator: steadier than the internal one.
_RESET, _GYRO_CLOCK = 0x80, 0x01
#: INTERRUPT_STATUS: new values.
_DATA_READY = 0x01
#: s the chip needs after a reset.
RESET_TIME = 0.1
#: INT_STATUS and the seven values behind it, big-endian, in one burst: only then do the axes belong together.
_BURST = struct.Struct(">B7h")
#: Readings that may fail in a row before the bus counts as gone.
_PATIENCE = 25


class I2cBus(Protocol):
    """What is used of ``smbus2.SMBus`` once it is open. Failures are ``OSError``."""

    def read_byte_data(self, address: int, register: int) -> int: ...
    def write_byte_data(self, address: int, register: int, value: int) -> None: ...
    def read_i2c_block_data(self, address: int, register: int, length: int) -> list[int]: ...
    def close(self) -> None: ...


def registers(port: ImuPort) -> dict[int, int]:
    """Return register -> value of a set-up, in the order they are written."""
    return {
        POWER_1: _GYRO_CLOCK,
        CONFIG: FILTERS[port.bandwidth],
        SAMPLE_RATE_DIVIDER: round(_SAMPLING / port.rate) - 1,
        GYRO_CONFIG: (250, 500, 1000, 2000).index(port.gyro_range) << 3,
        ACCEL_CONFIG: (2, 4, 8, 16).index(port.accel_range) << 3,
        INTERRUPT_ENABLE: _DATA_READY,
    }


def open_bus(path: str) -> I2cBus:
    """Open an I2C device such as ``/dev/i2c-1``.

    Raises:
        InputError: it is not there, cannot be opened, or another program of this library has it.
    """
    require_package("smbus2", "robot")
    import fcntl

    import smbus2

    try:
        bus: Any = smbus2.SMBus(path)
    except (OSError, TypeError) as error:
        hint = "switch I2C on in the system's settings and join the group 'i2c'"
        raise InputError(f"IMU bus {path}: cannot be opened: {error}; {hint}") from None
    try:
        fcntl.flock(bus.fd, fcntl.LOCK_EX | fcntl.LOCK_NB)  # until it is closed
    except OSError as error:
        if error.errno in TAKEN:
            bus.close()
            raise PortInUseError(path, "IMU bus") from None
    return bus


class Mpu6050:
    """The chip, read directly. A reading takes about 0.4 ms at 400 kHz.

    Args:
        port: bus, address, rate, filter, ranges, calibration.
        clock: s; what ages are told by.
        make_bus: path -> bus; tests put an emulated one here.
        sleep: waits s.

    Attributes:
        statistics: what came since it was opened.
    """

    def __init__(
        self,
        port: ImuPort,
        clock: Callable[[], float] = time.monotonic,
        make_bus: Callable[[str], I2cBus] = open_bus,
        sleep: Callable[[float], None] = time.sleep,
    ) -> None:
        self._port = port
        self._clock = clock
        self._make_bus = make_bus
        self._sleep = sleep
        self._convert = Conversion(port)
        self._bus: I2cBus | None = None
        self._reset()

    def _reset(self) -> None:
        self.statistics = ImuStatistics()
        self._newest: tuple[Sequence[int], float] | None = None
        self._failures = 0

    def open(self) -> None:
        """Reset the chip, set it up, and read back what was written.

        Raises:
            InputError: nobody answers, another chip answers, or a register did not take its value.
        """
        self._reset()
        self._bus = bus = self._make_bus(self._port.port)
        address, where = self._port.address, self._where()
        try:
            found = bus.read_byte_data(address, WHO_AM_I)
            if found != IDENTITY:
                name = RELATIVES.get(found, "an unknown chip")
                raise InputError(f"{where}: WHO_AM_I is {found:#04x} ({name}), expected {IDENTITY:#04x} (MPU-6050)")
            bus.write_byte_data(address, POWER_1, _RESET)
            self._sleep(RESET_TIME)
            for register, value in registers(self._port).items():
                bus.write_byte_data(address, register, value)
            for register, value in registers(self._port).items():
                if (found := bus.read_byte_data(address, register)) != value:
                    raise InputError(f"{where}: register {register:#04x} reads {found:#04x} after {value:#04x} was written")
        except OSError as error:
            self.close()
            hint = "check wiring, supply and the AD0 pin (low: 0x68, high: 0x69); i2cdetect lists who answers"
            raise InputError(f"{where}: no answer ({error}); {hint}") from None
        except InputError:
            self.close()
            raise

    def _where(self) -> str:
        return f"IMU at {self._port.address:#04x} on {self._port.port}"

    def close(self) -> None:
        """Close the bus; the chip goes on sampling."""
        if self._bus is not None:
            self._bus.close()
            self._bus = None

    def read(self) -> ImuReading | None:
        """Return the newest reading; None = there was none yet.

        A failed burst is repeated once. A chip that has nothing new (it fell asleep in a brown-out) shows as growing age.

        Raises:
            ImuGoneError: it has not answered for long.
        """
        burst = self._burst()
        now = self._clock()
        if burst is not None:
            status, *counts = _BURST.unpack(burst)
            if status & _DATA_READY:
                self.statistics.readings += 1
                self._newest = counts, now
            else:
                self.statistics.unchanged += 1
        if self._newest is None:
            return None
        counts, taken = self._newest
        return self._convert.reading(counts, now - taken)

    def _burst(self) -> bytes | None:
        if self._bus is None:
            raise ImuGoneError(f"{self._where()}: not open")
        for attempt in range(2):
            try:
                data = bytes(self._bus.read_i2c_block_data(self._port.address, INTERRUPT_STATUS, _BURST.size))
                self._failures = 0
                return data
            except OSError as error:  # motors disturb the line: seen as errno 121
                self.statistics.errors += 1
                if attempt == 1 and self._failures + 1 >= _PATIENCE:
                    raise ImuGoneError(f"{self._where()} is gone: {error}") from None
        self.statistics.lost += 1
        self._failures += 1
        return None


#: A connected IMU. One thread owns it.
Imu = ImuStream | Mpu6050


def make_imu(
    port: ImuPort,
    clock: Callable[[], float] = time.monotonic,
    make_device: Callable[[str, int, str], Device] = SerialDevice,
) -> Imu:
    """Return the IMU the hardware file names, not yet connected; see :class:`ImuStream` for the arguments."""
    return Mpu6050(port, clock) if port.driver == "i2c" else ImuStream(port, clock, make_device)
