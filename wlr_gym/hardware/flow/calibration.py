"""Scale and mounting of an optical-flow sensor from a straight drive or push: against the wheels, or a tape measure.

Pure functions on a measured run. Flow is turned into way with the nominal height of the lens over the floor, so what the
height is off comes out as scale, too, and is right again at that height.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from wlr_gym.base.errors import InputError
from wlr_gym.data.read import Run
from wlr_gym.hardware.config import FlowCalibration
from wlr_gym.hardware.flow.supervision import floor_velocity, lens_height, wheel_velocity
from wlr_gym.robot import JOINTS, LEGS, WHEELS, Robot

Array = NDArray[np.float64]

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
    """What was found.

    Attributes:
        calibration: for the hardware file.
        scale_sigma, yaw_sigma: 1 sigma of its scale and its mounting (rad).
        way: m that was driven. windows: how many were compared.
    """

    calibration: FlowCalibration
    scale_sigma: float
    yaw_sigma: float
    way: float
    windows: int


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
