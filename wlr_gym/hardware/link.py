"""What a control loop is connected to: servos, sensors and clock."""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from wlr_gym.hardware.camera.live import LiveCamera
from wlr_gym.hardware.camera.reading import CameraFile, CameraReader
from wlr_gym.hardware.config import Hardware
from wlr_gym.hardware.flow import Flow, make_flow
from wlr_gym.hardware.imu import Imu, make_imu
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
        camera: above the floor; None = there is none.
        seed: of an emulated robot's noise; None = not one of this process.
    """

    servos: Servos
    imu: Imu
    clock: Clock
    is_serial: bool
    finish: Callable[[], None] = lambda: None
    flow: Flow | None = None
    camera: CameraReader | None = None
    seed: int | None = None

    def _devices(self) -> list[Servos | Imu | Flow | CameraReader]:
        return [device for device in (self.servos, self.imu, self.flow, self.camera) if device is not None]

    def open(self) -> None:
        """Open all ports, or none.

        Raises:
            InputError: a port is not there, or cannot be opened.
        """
        with contextlib.ExitStack() as stack:
            for device in self._devices():
                device.open()
                stack.callback(device.close)
            stack.pop_all()

    def close(self) -> None:
        """Close all ports; servos stay as they are."""
        for device in self._devices():
            device.close()
        self.finish()


def serial_link(robot: Robot, hardware: Hardware, camera: CameraFile | None = None, poses: Path | None = None) -> Link:
    """Return a link over the hardware file's ports.

    Args:
        robot: the robot.
        hardware: wiring and mounting.
        camera: above the floor; None = there is none.
        poses: where an emulated robot writes its true pose, for a camera that films it by rendering; None = a real camera.
    """
    clock = MonotonicClock()
    servos = Servos(robot, hardware, hardware.safety.patience, clock.now)
    flow = make_flow(robot, hardware, clock.now)
    eye = None if camera is None else LiveCamera(camera, robot, poses)
    return Link(servos, make_imu(hardware.imu, clock.now), clock, is_serial=True, flow=flow, camera=eye)
