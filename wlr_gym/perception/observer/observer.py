"""The slip observer of a batch of robots."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from wlr_gym.base.errors import InputError
from wlr_gym.base.snapshot import RowStore
from wlr_gym.perception.observer import slip_filter
from wlr_gym.perception.observer.layout import ESTIMATE_LAYOUT
from wlr_gym.perception.observer.state import constants, state_type
from wlr_gym.perception.observer.trust import WORK
from wlr_gym.physics.plants.base import SENSOR_LAYOUT
from wlr_gym.robot import Robot
from wlr_gym.robot.parameter_table import SPECS

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]


class SlipObserver:
    """Estimates of ``count`` robots; a robot's are the same bits alone or in any batch.

    Args:
        robot: as its file describes it; how the real one differs is what the filter's noise stands for.
        control_period: s between two readings.
        count: N.
        camera: use camera poses where the sensors bring them.

    Attributes:
        values: (N, ESTIMATE_LAYOUT.width), overwritten by ``reset`` and ``update``.
    """

    def __init__(self, robot: Robot, control_period: float, count: int, camera: bool) -> None:
        if robot.gravity == 0.0:
            raise InputError(f"robot '{robot.name}': gravity = 0: the slip observer tells the attitude by it, expected more")
        history = math.ceil(SPECS["camera.delay"].high / control_period) + 3
        self.count = count
        self.values: Array = np.zeros((count, ESTIMATE_LAYOUT.width))
        self._constants = constants(robot, control_period, camera)
        self._states = np.zeros(count, state_type(history))
        self._work = np.zeros(1, WORK)

    def reset(self, mask: Mask, sensors: Array) -> None:
        """Start the masked robots anew from their first readings (N, SENSOR_LAYOUT.width): at rest, or nearly."""
        self._require(mask, sensors)
        slip_filter.reset(self._constants, self._states, mask, sensors, self.values)

    def update(self, mask: Mask, sensors: Array) -> None:
        """Take in the readings of one control step later of the masked robots. A reading that is no number is the last one."""
        self._require(mask, sensors)
        slip_filter.update(self._constants, self._states, mask, sensors, self.values, self._work)

    def stores(self) -> dict[str, RowStore]:
        """Return everything that decides the estimates to come."""
        return {"estimate": self.values, "filter": self._states}

    def _require(self, mask: Mask, sensors: Array) -> None:
        if mask.shape != (self.count,) or sensors.shape != (self.count, SENSOR_LAYOUT.width):
            raise InputError(
                f"observer of {self.count} robots takes a mask ({self.count},) and sensors ({self.count}, "
                f"{SENSOR_LAYOUT.width}), got {mask.shape} and {sensors.shape}"
            )
