"""Tests in which the robot is moved by hand, motors off: signs, zeros, and the IMU's axes."""

from __future__ import annotations

import math

import numpy as np

from wlr_gym.base.errors import InputError
from wlr_gym.hardware.calibration import find_sign
from wlr_gym.hardware.commissioning.contract import Reading, StandQuantity, StandTest
from wlr_gym.hardware.commissioning.errors import TroubleError
from wlr_gym.hardware.commissioning.person import Person
from wlr_gym.hardware.commissioning.stand import PERIOD, Stand
from wlr_gym.robot import JOINTS, LEGS

#: rad that a leg and a wheel are turned by.
_LEG_TURN, _WHEEL_TURN = math.radians(30.0), math.radians(90.0)
#: Times that a turn may go wrong.
_TRIES = 3
#: rad that the body is turned by, s for it, rows at rest after it.
_TILT, _TILT_TIME, _REST_ROWS = math.radians(20.0), 3.0, 25
#: rad: with a smaller turn nothing is measured.
_LEAST_TILT = math.radians(8.0)
_CALIBRATE = "Run wlr calibrate joints; if the sign is wrong, the leg would run away from its setpoint in the start ramp."
_MOUNTING = "Run wlr calibrate imu --mounting (and --poses 6 for the scale); imu.gyro_range must be the sensor's."


def _measure_joints(stand: Stand, person: Person) -> list[Reading]:
    found = []
    for joint in JOINTS:
        found.append(Reading("joint_sign", joint, float(_sign(stand, person, joint) * stand.hardware.joints[joint].sign)))
        if joint in LEGS:
            person.straighten(joint)
            found.append(Reading("joint_zero", joint, float(stand.step().position[JOINTS.index(joint)] - math.pi / 2)))
    return found


def _sign(stand: Stand, person: Person, joint: str) -> int:
    """Return +1 where a joint counts up when it is turned in its positive direction, else -1."""
    reason = ""
    for _ in range(_TRIES):
        before = _counts(stand)
        person.turn(joint, _LEG_TURN if joint in LEGS else _WHEEL_TURN)
        try:
            return find_sign(joint, before, _counts(stand), stand.servos.table(joint).counts.turn)
        except InputError as error:
            reason = str(error)
    raise TroubleError(reason)


def _counts(stand: Stand) -> list[float]:
    stand.step()
    counts = stand.servos.get_all("present_position")
    if len(counts) < len(JOINTS):
        raise TroubleError(f"no answer from {', '.join(joint for joint in JOINTS if joint not in counts)}")
    return [float(counts[joint]) for joint in JOINTS]


SIGNS = StandTest(
    "joints",
    "Sign and zero of every joint",
    "Each joint is to be turned by hand, one after the other; legs then held straight down.",
    "No motor comes on.",
    (
        StandQuantity("joint_sign", "-", "1: the joint turns the way the hardware file says", 0.1, _CALIBRATE),
        StandQuantity("joint_zero", "rad", "reading of a leg that is held straight down, less pi/2", 0.04, _CALIBRATE),
    ),
    _measure_joints,
)


def _measure_imu(stand: Stand, person: Person) -> list[Reading]:
    level = _at_rest(stand)
    found = [
        Reading("gravity", "imu", float(np.linalg.norm(level))),
        Reading("level_tilt", "imu", math.acos(min(1.0, float(level[2] / np.linalg.norm(level))))),
    ]
    for k, name in enumerate(("roll", "pitch", "yaw")):
        person.tilt(_TILT_TIME, **{name: _TILT})
        turned = _turned(stand)
        whole = float(np.linalg.norm(turned))
        if whole < _LEAST_TILT:
            raise TroubleError(f"{name}: the gyroscope saw {math.degrees(whole):.0f} deg only, expected 20: turn the body")
        found.append(Reading(f"gyro_{name}", "imu", float(turned[k] / whole)))
        if name != "yaw":
            found.append(Reading(f"tilt_{name}", "imu", _tilt(name, _at_rest(stand), level) / whole))
        person.tilt(_TILT_TIME)
        stand.run(_TILT_TIME)
    return found


def _turned(stand: Stand) -> np.ndarray:
    """Return by how much (3,) the body turned about its axes by the gyroscope, rad."""
    rows = len(stand.run(_TILT_TIME))
    gyro, _ = stand.imu_rows(rows)
    return gyro.mean(axis=0) * rows * PERIOD


def _at_rest(stand: Stand) -> np.ndarray:
    """Return the accelerometer's mean (3,), m/s2."""
    stand.run(_REST_ROWS * PERIOD)
    return stand.imu_rows(_REST_ROWS)[1].mean(axis=0)


def _tilt(name: str, force: np.ndarray, level: np.ndarray) -> float:
    """Return the roll or pitch (rad) since ``level`` that the accelerometer shows: right side down and nose down positive."""
    angles = [
        math.atan2(up[1], up[2]) if name == "roll" else math.atan2(-up[0], math.hypot(up[1], up[2])) for up in (force, level)
    ]
    return angles[0] - angles[1]


IMU_AXES = StandTest(
    "imu",
    "Axes of the IMU",
    "The robot with its stand is to be tilted to the right, nose down, and turned to the left.",
    "No motor comes on.",
    (
        StandQuantity("gravity", "m/s2", "length of the specific force at rest", 0.5, _MOUNTING),
        StandQuantity("level_tilt", "rad", "angle of the level body to the vertical by the accelerometer", 0.06, _MOUNTING),
        *(
            StandQuantity(
                f"gyro_{name}", "-", f"part of the turn that the gyroscope saw about {axis}, with its sign", 0.1, _MOUNTING
            )
            for name, axis in (("roll", "x"), ("pitch", "y"), ("yaw", "z"))
        ),
        *(
            StandQuantity(f"tilt_{name}", "-", "tilt by the accelerometer over the turn by the gyroscope", 0.2, _MOUNTING)
            for name in ("roll", "pitch")
        ),
    ),
    _measure_imu,
)
