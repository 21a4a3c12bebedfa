"""The MPU-6050 on an I2C bus of this computer (Linux), by register map RM-MPU-6000A revision 4.2."""

from __future__ import annotations

import struct
import time
from collections.abc import Callable
from typing import Any, Protocol

from wlr_gym.base.errors import InputError, require_package
from wlr_gym.hardware.config import ImuPort
from wlr_gym.hardware.imu.reading import Conversion, Counts, ImuGoneError, ImuReading, ImuStatistics
from wlr_gym.hardware.ports import lock

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
#: POWER_1: reset.
_RESET = 0x80
#: POWER_1: clocked by the gyroscope.
_GYRO_CLOCK = 0x01
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
        POWER_1: _GYRO_CLOCK,  # awake, on the gyroscope's oscillator: steadier than the internal one
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
    import smbus2

    try:
        bus: Any = smbus2.SMBus(path)
    except (OSError, TypeError) as error:
        hint = "switch I2C on in the system's settings and join the group 'i2c'"
        raise InputError(f"IMU bus {path}: cannot be opened: {error}; {hint}") from None
    try:
        lock(bus.fd, path, "IMU bus")
    except InputError:
        bus.close()
        raise
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
        self._newest: tuple[Counts, int, Counts, float] | None = None
        self._failures = 0

    def open(self) -> None:
        """Reset the chip, set it up, and read back what was written.

        Raises:
            InputError: nobody answers, another chip answers, or a register did not take its value.
        """
        self._reset()
        self._bus = self._make_bus(self._port.port)
        try:
            self._set_up(self._bus)
        except OSError as error:
            self.close()
            hint = "check wiring, supply and the AD0 pin (low: 0x68, high: 0x69); i2cdetect lists who answers"
            raise InputError(f"{self._where()}: no answer ({error}); {hint}") from None
        except InputError:
            self.close()
            raise

    def _set_up(self, bus: I2cBus) -> None:
        address = self._port.address
        found = bus.read_byte_data(address, WHO_AM_I)
        if found != IDENTITY:
            name = RELATIVES.get(found, "an unknown chip")
            raise InputError(f"{self._where()}: WHO_AM_I is {found:#04x} ({name}), expected {IDENTITY:#04x} (MPU-6050)")
        bus.write_byte_data(address, POWER_1, _RESET)
        self._sleep(RESET_TIME)
        for register, value in registers(self._port).items():
            bus.write_byte_data(address, register, value)
        for register, value in registers(self._port).items():
            if (found := bus.read_byte_data(address, register)) != value:
                raise InputError(f"{self._where()}: register {register:#04x} reads {found:#04x} after {value:#04x} was written")

    def _where(self) -> str:
        return f"IMU at {self._port.address:#04x} on {self._port.port}"

    def close(self) -> None:
        """Close the bus; the chip goes on sampling."""
        if self._bus is not None:
            self._bus.close()
            self._bus = None

    def read(self) -> ImuReading | None:
        """Read the chip; see :class:`wlr_gym.hardware.imu.driver.Imu`.

        A failed burst is repeated once. A chip that has nothing new (it fell asleep in a brown-out) shows as growing age.
        """
        burst = self._burst()
        now = self._clock()
        if burst is not None:
            status, ax, ay, az, temperature, gx, gy, gz = _BURST.unpack(burst)
            if status & _DATA_READY:
                self.statistics.readings += 1
                self._newest = (ax, ay, az), temperature, (gx, gy, gz), now
            else:
                self.statistics.unchanged += 1
        if self._newest is None:
            return None
        accelerometer, temperature, gyro, taken = self._newest
        return self._convert.reading(accelerometer, temperature, gyro, now - taken)

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
