"""What the safety rules look at and say: the robot as last seen, its motors' ratings, verdicts. Data only."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import IntEnum
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from wlr_gym.data.format import Profile
from wlr_gym.hardware.flow.reading import FlowReading
from wlr_gym.hardware.servos import UNREAD, ServoRegisters
from wlr_gym.physics.servo import CurrentLaw
from wlr_gym.robot import JOINTS

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]


class Level(IntEnum):
    """What the robot may do, from harmless to worst; the worst verdict counts."""

    DRIVE = 0  #: as asked, within limits
    COAST = 1  #: the last setpoints hold
    HOLD = 2  #: wheels stop, legs stay; goes on when the reason is over
    STOP = 3  #: as HOLD, then torque off for good
    OFF = 4  #: torque off now


class Verdict(NamedTuple):
    """One finding: how bad it is, which rule, what was found."""

    level: Level
    rule: str
    text: str


#: The verdict where nothing is found.
FINE = Verdict(Level.DRIVE, "", "")
#: Rules that somebody asks for: they are no faults.
REQUESTS = ("stop", "emergency stop")


@dataclass(frozen=True)
class CameraStatus:
    """What the camera says.

    Attributes:
        pose: (3,) x, y (m) and yaw (rad, unwrapped) that was believed last, from the start pose; 0 before the first.
        time: s at which it was exposed; the run's start before the first.
        is_new: it came in this control step.
        reason: why no pose comes; empty = nothing is wrong.
        is_wrong: there are poses, and they contradict the robot's other sensors: they are kept back.
        doubt: what is not known of the camera that its poses suffer from; empty = nothing.
    """

    pose: Array = field(default_factory=lambda: np.zeros(3))
    time: float = 0.0
    is_new: bool = False
    reason: str = ""
    is_wrong: bool = False
    doubt: str = ""


@dataclass(frozen=True)
class RobotStatus:
    """What is known of the robot at a control step. Arrays are in joint order.

    Attributes:
        time: s.
        position, velocity, effort: (8,) last good readings, rad, rad/s, N m.
        silence: (8,) s since the joint's last good reading; 0 = it answered in this step.
        alert, restarted: (8,) hardware error; rebooted since the last reading.
        voltage, temperature: (8,) V, degC, as last read.
        gyro, accelerometer: (3,) rad/s, m/s2, body frame.
        imu_silence: s since the IMU's last reading.
        up: (3,) the vertical in the body frame.
        late_ticks: control steps in a row that started a period late or more. late_share: of the last second's.
        operator_silence: s since the operator's last sign. idle: s for which nothing was sent to the servos.
        lost: ports that are gone, in words..
        trouble: why log or terminal failed.
        broken: packets with a wrong checksum since all joints answered last.
        registers: of the servos, as last read.
        suspect: (8,) the joint's last reading was impossible, and has not been confirmed.
        unseen: (8,) s that the joint was not seen before its last answer, or before the first impossible one.
        jump: (8,) rad by which a joint's readings jumped for good, further than a motor can turn; 0 = not.
        flow: of the optical-flow sensor in this step; None = the robot has none.
        camera: what the camera says; None = there is none.
        asked_to_stop: why a stop was asked for. asked_off: why torque is to go off at once.
    """

    time: float
    position: Array
    velocity: Array
    effort: Array
    silence: Array
    alert: Mask
    restarted: Mask
    voltage: Array
    temperature: Array
    gyro: Array
    accelerometer: Array
    imu_silence: float
    up: Array
    late_ticks: int = 0
    late_share: float = 0.0
    operator_silence: float = 0.0
    idle: float = 0.0
    lost: str = ""
    trouble: str = ""
    asked_to_stop: str = ""
    asked_off: str = ""
    broken: int = 0
    flow: FlowReading | None = None
    registers: ServoRegisters = UNREAD
    suspect: Mask = field(default_factory=lambda: np.zeros(len(JOINTS), bool))
    unseen: Array = field(default_factory=lambda: np.zeros(len(JOINTS)))
    jump: Array = field(default_factory=lambda: np.zeros(len(JOINTS)))
    camera: CameraStatus | None = None


@dataclass(frozen=True)
class Ratings:
    """Ratings of the robot's motors, and what its servos' registers allow.

    Attributes:
        low, high: (8,) setpoints the servos take, rad and rad/s.
        leg_limits: rad, of the robot file.
        stall_torque: (8,) N m. no_load_speed: (8,) rad/s.
        currents: of torques and rates.
        period: s of a control step.
        supply: V that these hold at.
        watchdog: count that Bus Watchdog is armed with. goal_pwm: (8,) counts that Goal PWM is set to.
        pwm_share: (8,) part of the supply that this is.
        profile: of the servos.
    """

    low: Array
    high: Array
    leg_limits: tuple[float, float]
    stall_torque: Array
    currents: CurrentLaw
    no_load_speed: Array
    period: float
    supply: float
    watchdog: float = np.nan
    goal_pwm: Array = field(default_factory=lambda: np.full(len(JOINTS), np.nan))
    pwm_share: Array = field(default_factory=lambda: np.ones(len(JOINTS)))
    profile: Profile = field(default_factory=Profile)
