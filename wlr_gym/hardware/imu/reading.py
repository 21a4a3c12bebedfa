"""Readings of the IMU in SI units and the body frame, however it is connected."""

from __future__ import annotations

from dataclasses import dataclass

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
