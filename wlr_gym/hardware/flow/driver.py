"""The flow sensor, however it is connected: one interface over the serial stream and the chip on SPI."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Protocol

from wlr_gym.hardware.config import Hardware
from wlr_gym.hardware.flow.pmw3901 import ChipPoller
from wlr_gym.hardware.flow.reading import FlowReading, FlowStatistics
from wlr_gym.hardware.flow.stream import FlowStream
from wlr_gym.robot import Robot


class Flow(Protocol):
    """A connected flow sensor. One thread owns it."""

    @property
    def statistics(self) -> FlowStatistics:
        """What came since it was opened."""
        ...

    def open(self) -> None:
        """Connect and set up.

        Raises:
            InputError: nothing there, or not what the hardware file says.
        """
        ...

    def close(self) -> None:
        """Disconnect."""
        ...

    def read(self) -> FlowReading:
        """Return the reading of this control step; never waits and never fails: why there is none stands in it."""
        ...


def make_flow(robot: Robot, hardware: Hardware, clock: Callable[[], float] = time.monotonic) -> Flow | None:
    """Return the flow sensor that the hardware file names, not yet connected; None = it names none.

    Args:
        robot: whose file has the sensor's numbers.
        hardware: port, axes, calibration.
        clock: s; what ages are told by.
    """
    port, sensor = hardware.flow, robot.sensors.flow
    if port is None or sensor is None:
        return None
    return ChipPoller(port, sensor, clock) if port.driver == "spi" else FlowStream(port, sensor, clock)
