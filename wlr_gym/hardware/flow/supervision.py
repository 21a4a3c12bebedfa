"""Is what the flow sensor says plausible beside wheels and gyroscope? One that is mounted turned or measures wrong is found.

Over way that the wheels roll, slip is small as a rule and along the wheels' heading: flow that points elsewhere is no slip.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from wlr_gym.hardware.flow.driver import Flow
from wlr_gym.hardware.flow.reading import FlowReading
from wlr_gym.robot import LEG_SLICE, WHEEL_SLICE, Robot

Array = NDArray[np.float64]

#: m after which the flow's direction is compared, and its size.
WAY, LONG_WAY = 0.05, 0.25
#: rad/s of yaw up to which the way counts: in tight turns wheels slip sideways.
LARGEST_YAW_RATE = 1.0
#: m/s from which it counts.
LEAST_SPEED = 0.05
#: rad between flow and the wheels' heading beyond which the sensor is turned.
LARGEST_TURN = 0.6
#: Way seen over the wheels' way below which it has no direction: wheels that spin in place.
LEAST_RATIO = 0.3
#: The same outside which scale or slip is told.
RATIO = (0.85, 1.15)


def floor_velocity(reading: Array, gyro: Array, height: float, lens: Array) -> Array:
    """Return the body origin's velocity (2,) over the floor, m/s, that a flow (2,) means for a level body.

    Args:
        reading: flow along body x and y, rad/s.
        gyro: (3,) rad/s.
        height: m from the lens to the floor.
        lens: (3,) in the body frame, m.
    """
    at_lens = height * np.array([reading[0] + gyro[1], reading[1] - gyro[0]])
    turning = np.cross(gyro, lens)[:2]
    return at_lens - turning


def lens_height(robot: Robot, legs: Array) -> float:
    """Return the height (m) of the flow sensor's lens over a level floor at leg angles (4,), rad."""
    assert robot.sensors.flow is not None
    body = robot.leg.length * float(np.mean(np.sin(legs))) + robot.wheel.radius - robot.hip_position.z
    return body + robot.sensors.flow.position[2]


def wheel_velocity(robot: Robot, wheels: Array) -> float:
    """Return the forward velocity (m/s) of a body whose wheels (4,), rad/s against their legs, roll without slip."""
    return robot.wheel.radius * float(np.mean(wheels))


class FlowSupervision:
    """Reads the flow sensor, and takes what it says for a dropout while it contradicts wheels and gyroscope.

    Args:
        flow: open.
        robot: whose it is.
    """

    def __init__(self, flow: Flow, robot: Robot) -> None:
        self._flow, self._robot = flow, robot
        assert robot.sensors.flow is not None
        self._lens = np.array(robot.sensors.flow.position)
        self._forget()

    def _forget(self) -> None:
        self._way, self._long_way = np.zeros(3), np.zeros(3)  # m: seen along x and y, rolled
        self._verdict = self._note = ""

    def first(self) -> FlowReading:
        """Read while the robot stands; what was thought before is forgotten."""
        self._forget()
        return self._flow.read()

    def next(self, position: Array, velocity: Array, gyro: Array, elapsed: float) -> FlowReading:
        """Return the reading of a control step.

        Args:
            position, velocity: (8,) of the joints, rad and rad/s.
            gyro: (3,) rad/s.
            elapsed: s since the step before.
        """
        reading = self._flow.read()
        if not reading.is_new:
            return reading
        rolling = wheel_velocity(self._robot, velocity[WHEEL_SLICE])
        if abs(gyro[2]) < LARGEST_YAW_RATE and abs(rolling) > LEAST_SPEED:
            height = lens_height(self._robot, position[LEG_SLICE])
            way = elapsed * math.copysign(1.0, rolling)
            moved = np.append(way * floor_velocity(reading.flow, gyro, height, self._lens), way * rolling)
            self._way, self._long_way = self._way + moved, self._long_way + moved
            self._judge()
        if not self._verdict:
            return replace(reading, note=self._note) if self._note else reading
        self._flow.statistics.refuse(self._verdict)
        return replace(reading, quality=0.0, is_new=False, trouble=self._verdict)

    def _judge(self) -> None:
        """Compare the ways seen with the ways rolled; each begins anew then."""
        x, y, rolled = self._way.tolist()
        if rolled > WAY:
            self._way = np.zeros(3)
            if math.hypot(x, y) / rolled > LEAST_RATIO:
                turn = math.atan2(y, x)
                turned = abs(turn) > LARGEST_TURN
                self._verdict = (
                    f"turned: {math.degrees(turn):.0f} deg against the wheels; see wlr calibrate flow" if turned else ""
                )
        x, y, rolled = self._long_way.tolist()
        if rolled > LONG_WAY:
            self._long_way = np.zeros(3)
            ratio = math.hypot(x, y) / rolled
            self._note = "" if RATIO[0] < ratio < RATIO[1] else f"way: {ratio:.2f} of the wheels' (slip, or a wrong scale)"
