"""What a control loop is connected to: servos, sensors and clock."""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from dataclasses import dataclass

from wlr_gym.hardware.config import Hardware
from wlr_gym.hardware.flow.driver import Flow, make_flow
from wlr_gym.hardware.imu.driver import Imu, make_imu
from wlr_gym.hardware.servos import Servos
from wlr_gym.hardware.timing import Clock, MonotonicClock
from wlr_gym.robot import Robot


@dataclass
class Link:
    """Connections of one robot.

    Attributes:
        servos: closed at first.
        imu: closed at first.
        clock: what deadlines and ages are told by.
        flow: optical-flow sensor, closed at first; None = there is none.
        is_serial: there are real ports, which a watchdog process can open.
        finish: called after closing.
    """

    servos: Servos
    imu: Imu
    clock: Clock
    is_serial: bool
    finish: Callable[[], None] = lambda: None
    flow: Flow | None = None

    def open(self) -> None:
        """Open all ports, or none.

        Raises:
            InputError: a port is not there, or cannot be opened.
        """
        with contextlib.ExitStack() as stack:
            self.servos.open()
            stack.callback(self.servos.close)
            self.imu.open()
            stack.callback(self.imu.close)
            if self.flow is not None:
                self.flow.open()
            stack.pop_all()

    def close(self) -> None:
        """Close all ports; servos stay as they are."""
        self.servos.close()
        self.imu.close()
        if self.flow is not None:
            self.flow.close()
        self.finish()


def serial_link(robot: Robot, hardware: Hardware) -> Link:
    """Return a link over the hardware file's ports."""
    clock = MonotonicClock()
    servos = Servos(robot, hardware, hardware.safety.patience, clock.now)
    flow = make_flow(robot, hardware, clock.now)
    return Link(servos, make_imu(hardware.imu, clock.now), clock, is_serial=True, flow=flow)
