"""The flow sensor against wheels and gyroscope: is it plausible while the robot drives, how is it mounted, what is its scale.

Over way that the wheels roll, slip is small as a rule and along the wheels' heading: flow that points elsewhere is no slip.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from wlr_gym.base.errors import InputError
from wlr_gym.data.runs import Run
from wlr_gym.hardware.config import FlowCalibration
from wlr_gym.hardware.flow import FlowReading, FlowStream
from wlr_gym.robot import JOINTS, LEG_SLICE, LEGS, WHEEL_SLICE, WHEELS, Robot

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

    def __init__(self, flow: FlowStream, robot: Robot) -> None:
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


# ---- scale and mounting from a straight drive ----


#: rad/s of yaw up to which a row counts: then all wheels roll alike.
STRAIGHT = 0.3
#: s of a window whose ways are compared.
WINDOW = 0.2
#: m that must be driven in all; m that a window must hold.
LEAST_WAY, LEAST_WINDOW = 0.5, 0.01
#: Share of the rows that must have a valid reading.
LEAST_SHARE = 0.5


@dataclass(frozen=True)
class FlowFit:
    """What was found."""

    calibration: FlowCalibration  #: for the hardware file
    scale_sigma: float  #: 1 sigma
    yaw_sigma: float  #: rad, 1 sigma of the mounting
    way: float  #: m that was driven
    windows: int  #: how many were compared


def calibrate_flow(run: Run, robot: Robot, known: FlowCalibration, distance: float | None = None) -> FlowFit:
    """Find scale and mounting from a straight run; drive or push it on a floor that grips.

    Args:
        run: with flow, gyroscope and joints.
        robot: whose it is.
        known: calibration that the run was recorded with.
        distance: m that the robot moved straight ahead (negative: back), by a tape measure; None = what the wheels rolled.

    Raises:
        InputError: no flow in the run, too little way, or numbers that no mounting explains.
    """
    seen, rolled, t = _velocities(run, robot)
    windows = _windows(seen, rolled, t)
    way = float(np.abs(windows[:, 2]).sum())
    if way < LEAST_WAY:
        raise InputError(
            f"{run.path}: {way:.2f} m of straight way, expected {LEAST_WAY:g} or more: drive or push it straight on"
        )
    z = windows[:, 0] + 1j * windows[:, 1]
    true = windows[:, 2]
    ratio = complex(np.sum(true * z) / np.sum(true * true))
    spread = float(np.sum(np.abs(z - ratio * true) ** 2)) / max(2 * len(true) - 2, 1)  # of one component of a window
    sigma = math.sqrt(spread / float(np.sum(true * true)))
    scale = abs(ratio)
    if distance is not None:
        total = float(true.sum())
        if abs(total) < LEAST_WAY or total * distance <= 0.0:
            raise InputError(
                f"--distance {distance:g}: the wheels rolled {total:+.2f} m: one straight way, in the same direction"
            )
        scale *= total / distance
    if not 0.3 < scale < 3.0:
        raise InputError(f"{run.path}: the flow is {scale:.2f} of the way: are sensors.flow and the port's axes right?")
    found = known.model_copy(
        update={
            "scale": round(known.scale * scale, 4),
            "mount_yaw": round(math.remainder(known.mount_yaw - math.atan2(ratio.imag, ratio.real), 2.0 * math.pi), 4),
        }
    )
    return FlowFit(found, known.scale * sigma, sigma / abs(ratio), way, len(windows))


def _velocities(run: Run, robot: Robot) -> tuple[Array, Array, Array]:
    """Velocity (rows, 2) over the floor that the flow means, NaN without a reading; that of the wheels (rows); times."""
    needed = ("flow_x", "flow_y", "gyro_x", "gyro_y", "gyro_z", *(f"vel_{joint}" for joint in JOINTS))
    missing = [name for name in needed if name not in run]
    if missing:
        raise InputError(f"{run.path}: column '{missing[0]}' is missing: record it on a robot with an optical-flow sensor")
    if robot.sensors.flow is None:
        raise InputError(f"robot '{robot.name}' has no optical-flow sensor: expected a section sensors.flow in its file")
    flow, gyro = (np.stack([run[name] for name in names], axis=1) for names in (needed[:2], needed[2:5]))
    if (share := np.isfinite(flow).all(axis=1).mean()) < LEAST_SHARE:
        raise InputError(f"{run.path}: valid flow in {100 * share:.0f} % of the rows, expected {100 * LEAST_SHARE:.0f} or more")
    legs = np.stack([run[f"pos_{leg}"] for leg in LEGS], axis=1)
    wheels = np.stack([run[f"vel_{wheel}"] for wheel in WHEELS], axis=1)
    lens = np.array(robot.sensors.flow.position)
    seen = np.array([floor_velocity(f, w, lens_height(robot, leg), lens) for f, w, leg in zip(flow, gyro, legs, strict=True)])
    rolled = np.array([wheel_velocity(robot, rates) for rates in wheels])
    rolled[np.abs(gyro[:, 2]) > STRAIGHT] = np.nan
    return seen, rolled, run["t"]


def _windows(seen: Array, rolled: Array, t: Array) -> Array:
    """Ways (windows, 3): seen along x and y, rolled; m. Rows with a gap are left out, and windows that hardly move."""
    known = np.isfinite(seen).all(axis=1) & np.isfinite(rolled)
    step = np.gradient(t)
    ways = np.where(known[:, None], np.column_stack([seen, rolled]), 0.0) * step[:, None]
    window = ((t - t[0]) / WINDOW).astype(int)
    sums = np.zeros((window[-1] + 1, 3))
    np.add.at(sums, window, ways)
    return sums[np.abs(sums[:, 2]) > LEAST_WINDOW]
