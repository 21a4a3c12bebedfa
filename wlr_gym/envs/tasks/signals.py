"""Named signals that rewards, terminations, measures and computed observations are written with.

The same term runs on numpy arrays (one value per robot) and on trace nodes: only ``read`` differs.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from wlr_gym.base.errors import unknown_name
from wlr_gym.perception.observer import ESTIMATE_LAYOUT
from wlr_gym.physics.codegen import ops
from wlr_gym.physics.plants.base import SENSOR_LAYOUT, TRUTH_LAYOUT, Layout
from wlr_gym.robot import JOINTS

Value = Any  # float, numpy array (N,) or trace node

#: Pose of the body origin where the episode began, floor frame: m, m, rad.
START = ("x", "y", "yaw")
#: Sensors that a robot may have or not: 1 or 0.
PRESENCE = ("camera", "flow")


class Signals:
    """Access to one control step's signals.

    Args:
        read: returns the value of one scalar signal, such as ``truth.position[x]``, ``command.yaw_rate``,
            ``estimate.yaw``, ``action[leg_lf]``, ``robot.leg.length``, ``time`` or ``task.control_period``.
    """

    def __init__(self, read: Callable[[str], Value]) -> None:
        self._read = read
        #: 1 where a termination term ended the episode in this step, else 0.
        self.terminated: Value = 0.0

    def sensors(self, channel: str) -> list[Value]:
        """Elements of a channel of ``SENSOR_LAYOUT``."""
        return self._channel(SENSOR_LAYOUT, "sensors", channel)

    def truth(self, channel: str) -> list[Value]:
        """Elements of a channel of ``TRUTH_LAYOUT``."""
        return self._channel(TRUTH_LAYOUT, "truth", channel)

    def estimate(self, channel: str) -> list[Value]:
        """Elements of a channel of ``ESTIMATE_LAYOUT``: what the slip observer makes of the sensors."""
        return self._channel(ESTIMATE_LAYOUT, "estimate", channel)

    @property
    def start(self) -> list[Value]:
        """Where the body origin was when the episode began: x, y (m) and yaw (rad) in the floor frame."""
        return [self._read(f"start[{name}]") for name in START]

    def is_present(self, sensor: str) -> Value:
        """Whether the robot has a sensor of :data:`PRESENCE`: 1 or 0."""
        return self._read(f"presence[{sensor}]")

    @property
    def time(self) -> Value:
        """Time since the episode began, s."""
        return self._read("time")

    def _channel(self, layout: Layout, source: str, channel: str) -> list[Value]:
        if channel not in layout.channels:
            raise unknown_name(f"channel of {source}", channel, layout.channels)
        return [self._read(f"{source}.{element}") for element in layout.channels[channel].elements]

    def command(self, name: str) -> Value:
        """Commanded value the robot should have followed in this step."""
        return self._read(f"command.{name}")

    @property
    def action(self) -> list[Value]:
        """This step's action, 8 elements in [-1, 1]."""
        return [self._read(f"action[{joint}]") for joint in JOINTS]

    @property
    def previous_action(self) -> list[Value]:
        """The action of the step before (zeros in the first)."""
        return [self._read(f"previous_action[{joint}]") for joint in JOINTS]

    def remembered(self, element: str) -> Value:
        """What a computed observation's element was in the step before; 0 at the start of an episode."""
        return self._read(f"remembered.{element}")

    def gain(self, name: str) -> Value:
        """A gain of the task's hand-written controller."""
        return self._read(f"controller.{name}")

    def task(self, name: str) -> Value:
        """A number of the task: ``action.leg_scale``."""
        return self._read(f"task.{name}")

    def robot(self, path: str) -> Value:
        """A number of the nominal robot by its dotted path: ``leg.length``."""
        return self._read(f"robot.{path}")

    @property
    def control_period(self) -> Value:
        """Length of a control step, s."""
        return self._read("task.control_period")


def signals_of(function: Callable[..., Any]) -> set[str]:
    """Return the names of the signals that a term's function reads."""
    names: set[str] = set()

    def read(name: str) -> np.float64:
        names.add(name)
        return np.float64(1.0)

    with np.errstate(all="ignore"):
        function(Signals(read))
    return names


def mean(values: list[Value]) -> Value:
    """Arithmetic mean of a list of signals."""
    return sum(values[1:], values[0]) * (1.0 / len(values))


def norm(x: Value, y: Value) -> Value:
    """Length of a plane vector."""
    return ops.sqrt(x * x + y * y)
