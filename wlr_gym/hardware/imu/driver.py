"""The IMU, however it is connected: one interface over the serial stream and the chip on I2C."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from wlr_gym.hardware.config import ImuCalibration, ImuPort
from wlr_gym.hardware.imu.frames import accel_per_count, from_counts, gyro_per_count, to_counts
from wlr_gym.physics.plants.sensors import rotation

Array = NDArray[np.float64]
Counts = tuple[int, int, int]


class ImuGoneError(ConnectionError):
    """The IMU's port does not work any more: unplugged, dead driver."""


@dataclass(frozen=True)
class ImuReading:
    """One reading of gyroscope and accelerometer, calibrated, body frame.

    Attributes:
        gyro: (3,) rad/s.
        accelerometer: (3,) m/s2, specific force (+9.81 on z at rest).
        temperature: degC, of the chip.
        age: s since the sensor was read; grows when nothing new comes.
    """

    gyro: Array
    accelerometer: Array
    temperature: float
    age: float


@dataclass
class ImuStatistics:
    """What came since the IMU was opened.

    Attributes:
        readings: good ones.
        lost: frames missing between those received (stream), readings that failed after their retry (I2C).
        errors: frames with a wrong CRC (stream), bus errors (I2C).
        restarts: times the microcontroller's clock began anew.
        unchanged: times the chip had nothing new (I2C).
    """

    readings: int = 0
    lost: int = 0
    errors: int = 0
    restarts: int = 0
    unchanged: int = 0


class Imu(Protocol):
    """A connected IMU. One thread owns it."""

    statistics: ImuStatistics

    def open(self) -> None:
        """Connect and set up.

        Raises:
            InputError: nothing there, or not what the hardware file says.
        """
        ...

    def close(self) -> None:
        """Disconnect."""
        ...

    def read(self) -> ImuReading | None:
        """Return the newest reading without waiting for one; None = nothing has come yet.

        Raises:
            ImuGoneError: the port is gone.
        """
        ...

    def __enter__(self) -> Imu: ...

    def __exit__(self, *error: object) -> None: ...


def make_imu(port: ImuPort, clock: Callable[[], float] = time.monotonic) -> Imu:
    """Return the IMU the hardware file names, not yet connected.

    Args:
        port: driver, device, ranges, calibration.
        clock: s; what ages are told by.
    """
    if port.driver == "i2c":
        from wlr_gym.hardware.imu.mpu6050 import Mpu6050

        return Mpu6050(port, clock)
    from wlr_gym.hardware.imu.stream import ImuStream

    return ImuStream(port, clock)


def open_imu(port: ImuPort, clock: Callable[[], float] = time.monotonic) -> Imu:
    """Connect to the IMU the hardware file names; see :func:`make_imu`.

    Raises:
        InputError: nothing there, or another chip than the file says.
    """
    imu = make_imu(port, clock)
    imu.open()
    return imu


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

    def reading(self, accelerometer: Counts, temperature: int, gyro: Counts, age: float) -> ImuReading:
        """Return a reading from the chip's counts."""
        force = self._accel_scale * (from_counts(accelerometer, self._accel_count) - self._accel_offset)
        rate = from_counts(gyro, self._gyro_count) - self._gyro_bias
        return ImuReading(self._to_body @ rate, self._to_body @ force, temperature / 340.0 + 36.53, age)  # register map

    def counts(self, accelerometer: ArrayLike, gyro: ArrayLike) -> tuple[Counts, Counts]:
        """Return what the chip counts at a specific force (m/s2) and a rate (rad/s) in the body frame."""
        force = self._to_body.T @ np.asarray(accelerometer) / self._accel_scale + self._accel_offset
        rate = self._to_body.T @ np.asarray(gyro) + self._gyro_bias
        return to_counts(force, self._accel_count), to_counts(rate, self._gyro_count)
