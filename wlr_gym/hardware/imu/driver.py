"""The IMU, however it is connected: one interface over the serial stream and the chip on I2C."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Protocol

from wlr_gym.hardware.config import ImuPort
from wlr_gym.hardware.imu.mpu6050 import Mpu6050
from wlr_gym.hardware.imu.reading import ImuReading, ImuStatistics
from wlr_gym.hardware.imu.stream import ImuStream


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


def make_imu(port: ImuPort, clock: Callable[[], float] = time.monotonic) -> Imu:
    """Return the IMU the hardware file names, not yet connected.

    Args:
        port: driver, device, ranges, calibration.
        clock: s; what ages are told by.
    """
    return Mpu6050(port, clock) if port.driver == "i2c" else ImuStream(port, clock)
