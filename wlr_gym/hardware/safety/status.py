"""What is known of the robot at a control step, and what its motors are rated for."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from wlr_gym.data.format import Profile
from wlr_gym.hardware.config import MeasuredValues
from wlr_gym.hardware.flow import FlowReading
from wlr_gym.hardware.servos import UNREAD, ServoRegisters
from wlr_gym.physics.servo import CurrentLaw, current_law, idle_effort, measures_current
from wlr_gym.robot import JOINTS, LEGS, Robot

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
IS_LEG: Mask = np.arange(len(JOINTS)) < len(LEGS)
#: Part by which a warm motor's torque-speed line may be off: copper at 75 degC has a fifth more resistance than at 25.
WARM_WINDING = 0.2
#: Slope of Present Load over PWM of a free wheel below which it is torque.
LOAD_IS_TORQUE = 0.3


def each(value: float) -> Callable[[], NDArray[Any]]:
    """Return what makes an array of a value for each joint (8,)."""
    return lambda: np.full(len(JOINTS), value)


def between(low: ArrayLike, values: Array, high: ArrayLike) -> Array:
    """Return values within bounds; of 8 of them, four times faster than ``np.clip``."""
    return np.minimum(np.maximum(values, low), high)


@dataclass(frozen=True)
class CameraStatus:
    """What the camera says."""

    pose: Array = field(default_factory=lambda: np.zeros(3))  #: (3,) believed last: m, rad (unwrapped), from the start
    time: float = 0.0  #: s at which it was exposed; the run's start before the first
    is_new: bool = False  #: it came in this control step
    reason: str = ""  #: why no pose comes; empty = nothing is wrong
    is_wrong: bool = False  #: there are poses, and they contradict the robot's other sensors: they are kept back
    doubt: str = ""  #: what is not known of the camera that its poses suffer from; empty = nothing


@dataclass(frozen=True)
class RobotStatus:
    """What is known of the robot at a control step. Arrays are in joint order."""

    time: float  #: s
    position: Array  #: (8,) rad, last good readings
    velocity: Array  #: (8,) rad/s
    effort: Array  #: (8,) N m
    silence: Array  #: (8,) s since the joint's last good reading; 0 = it answered in this step
    alert: Mask  #: (8,) hardware error
    restarted: Mask  #: (8,) rebooted since the last reading
    voltage: Array  #: (8,) V, as last read
    temperature: Array  #: (8,) degC, as last read
    gyro: Array  #: (3,) rad/s, body frame
    accelerometer: Array  #: (3,) m/s2, body frame
    imu_silence: float  #: s since the IMU's last reading
    up: Array  #: (3,) the vertical in the body frame
    imu_counts: tuple[int, ...] = ()  #: of the reading, see :data:`wlr_gym.hardware.imu.IMU_AXES`; empty = not known
    late_ticks: int = 0  #: control steps in a row that started a period late or more
    late_share: float = 0.0  #: of the last second's
    operator_silence: float = 0.0  #: s since the operator's last sign
    idle: float = 0.0  #: s for which nothing was sent to the servos
    asleep: float = 0.0  #: s for which the computer was suspended since the start
    lost: str = ""  #: ports that are gone, in words
    trouble: str = ""  #: why log or terminal failed
    asked_to_stop: str = ""  #: why a stop was asked for
    asked_off: str = ""  #: why torque is to go off at once
    broken: int = 0  #: packets with a wrong checksum since all joints answered last
    flow: FlowReading | None = None  #: of the optical-flow sensor in this step; None = the robot has none
    registers: ServoRegisters = UNREAD  #: of the servos, as last read
    suspect: Mask = field(default_factory=each(False))  #: (8,) the last reading was impossible, and is not confirmed
    unseen: Array = field(default_factory=each(0.0))  #: (8,) s not seen before the last answer, or the first impossible
    jump: Array = field(default_factory=each(0.0))  #: (8,) rad that readings jumped for good, beyond a motor; 0 = not
    reach: Array = field(default_factory=each(0.0))  #: (8,) rad that a motor can have turned that way meanwhile
    camera: CameraStatus | None = None  #: what the camera says; None = there is none


@dataclass(frozen=True)
class Ratings:
    """Ratings of the robot's motors, and what its servos' registers allow."""

    leg_limits: tuple[float, float]  #: rad, of the robot file
    stall_torque: Array  #: (8,) N m
    no_load_speed: Array  #: (8,) rad/s
    currents: CurrentLaw  #: of torques and rates
    tells_load: Mask  #: (8,) motors that measure their current, or whose Present Load was found to be torque
    line_error: Array  #: (8,) part of speed and load by which the nominal line may be off
    unknown_load: Array  #: (8,) part of stall torque that the other motors may give unseen
    acceleration: Array  #: (8,) rad/s2, of a motor alone at stall torque
    idle_effort: Array  #: (8,) N m s/rad, see :func:`wlr_gym.physics.servo.idle_effort`
    period: float  #: s of a control step
    supply: float  #: V that these hold at
    low: Array = field(default_factory=each(-np.inf))  #: (8,) rad and rad/s, lowest setpoints that the servos' registers take
    high: Array = field(default_factory=each(np.inf))  #: (8,) and highest
    watchdog: float = np.nan  #: count that Bus Watchdog is armed with
    goal_pwm: Array = field(default_factory=each(np.nan))  #: (8,) counts that Goal PWM is set to
    pwm_share: Array = field(default_factory=each(1.0))  #: (8,) part of the supply that this is
    profile: Profile = field(default_factory=Profile)  #: of the servos


def ratings_of(robot: Robot, period: float, load_per_pwm: MeasuredValues | None = None, **registers: Any) -> Ratings:
    """Return the ratings of a robot.

    Args:
        robot: the robot.
        period: s of a control step.
        load_per_pwm: joint -> what ``wlr commission`` found: 0 = Present Load is torque, 1 = it is PWM.
        registers: what its servos' registers allow (:class:`Ratings`).
    """
    slopes = load_per_pwm or {}
    is_torque = [joint in slopes and abs(slopes[joint].value) < LOAD_IS_TORQUE for joint in JOINTS]
    tells_load = np.repeat(measures_current(robot), 4) | is_torque
    leg, wheel = robot.servo.leg, robot.servo.wheel
    stall = np.repeat([leg.stall_torque, wheel.stall_torque], 4)
    grip = 0.5 * robot.total_mass * robot.gravity * robot.wheel.radius  # of a tyre under half of the weight
    tolerances = [robot.tolerances.get(key) for key in ("servo.stall_torque", "servo.no_load_speed")]
    sigma = np.repeat(np.max([[known.legs, known.wheels] if known else [0.05] * 2 for known in tolerances], axis=0), 4)
    line_error = np.where(IS_LEG, WARM_WINDING + 2.0 * sigma, 3.0 * sigma)
    return Ratings(
        leg_limits=robot.leg_limits,
        line_error=line_error / (1.0 - np.minimum(line_error, 0.5)),
        unknown_load=np.where(tells_load, 0.0, np.where(IS_LEG, 1.0, (grip + wheel.coulomb_friction) / stall)),
        tells_load=tells_load,
        acceleration=stall / np.repeat([leg.armature, wheel.armature], 4),
        idle_effort=idle_effort(robot),
        stall_torque=stall,
        no_load_speed=np.repeat([leg.no_load_speed, wheel.no_load_speed], 4),
        currents=current_law(robot),
        period=period,
        supply=robot.servo.supply_voltage,
        **registers,
    )
