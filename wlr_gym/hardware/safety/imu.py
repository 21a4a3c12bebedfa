"""What an IMU's readings say of itself: each axis on its own, and all of them against gravity.

A chip's noise moves every axis' last bits. So an axis that repeats its count is dead, and one at the end of its range measures
nothing. Over a second a robot does not speed up: its mean specific force is gravity, and turns with the integrated rates.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np

from wlr_gym.hardware.config import SafetyLimits
from wlr_gym.hardware.imu import COUNT_ENDS, IMU_AXES, STANDARD_GRAVITY
from wlr_gym.hardware.safety.joints import Suspicion
from wlr_gym.hardware.safety.status import Array, RobotStatus

#: s for which an axis may repeat its count: noise of one count, a gyroscope's at 2000 deg/s, repeats 25 by chance in 1e12.
AXIS_TIME = 0.5
#: s over which gravity is averaged, and for which it may be off.
GRAVITY_TIME, GRAVITY_LASTS = 0.5, 1.0
#: m/s2 that its length may be off, and rad that the accelerometer's vertical may be off the gyroscope's: 0.5 rad/s for long.
GRAVITY_BAND, VERTICAL_ERROR = 2.0, 0.25


@dataclass(frozen=True)
class ImuMemory:
    """What lasts from step to step of the IMU."""

    values: Array = field(default_factory=lambda: np.full(6, np.nan))  #: (6,) last rates and specific forces
    same: float = 0.0  #: s for which they have not changed at all
    counts: tuple[int, ...] = ()  #: last ones, see :data:`wlr_gym.hardware.imu.IMU_AXES`
    axis_same: tuple[float, ...] = (0.0,) * 6  #: s for which each has not changed
    gravity: Array = field(default_factory=lambda: np.array([0.0, 0.0, STANDARD_GRAVITY]))  #: (3,) m/s2, mean specific force
    error: Array = field(default_factory=lambda: np.zeros(3))  #: (3,) mean of its direction less the vertical
    wrong_length: float = 0.0  #: s for which its length has been off
    wrong_direction: float = 0.0  #: s for which its direction has been off


def remember_imu(status: RobotStatus, memory: ImuMemory, period: float) -> ImuMemory:
    """Return the memory after a step of ``period`` seconds; a silent IMU, which has a rule of its own, changes nothing."""
    if status.imu_silence > period:
        return memory
    values = np.concatenate([status.gyro, status.accelerometer])
    counts, last = status.imu_counts, memory.counts
    axis_same = memory.axis_same
    if counts and last:
        axis_same = tuple(
            time + period if now == then else 0.0 for time, now, then in zip(axis_same, counts, last, strict=True)
        )
    share = period / GRAVITY_TIME
    gravity = memory.gravity + share * (status.accelerometer - memory.gravity)
    length = float(np.sqrt(gravity @ gravity))
    error = memory.error + share * (status.accelerometer / max(length, 1.0) - status.up - memory.error)
    is_off, is_aside = abs(length - STANDARD_GRAVITY) > GRAVITY_BAND, float(error @ error) > VERTICAL_ERROR**2
    return ImuMemory(
        values,
        memory.same + period if (values == memory.values).all() else 0.0,
        counts,
        axis_same,
        gravity,
        error,
        memory.wrong_length + period if is_off else 0.0,
        memory.wrong_direction + period if is_aside else 0.0,
    )


def is_blind(memory: ImuMemory) -> bool:
    """Return whether an axis stays at the end of its range: no lean can be told from it."""
    return any(same > 0.0 and count in COUNT_ENDS for same, count in zip(memory.axis_same, memory.counts, strict=False))


def judge_imu(limits: SafetyLimits, memory: ImuMemory) -> Iterator[Suspicion]:
    """Yield what is wrong with the IMU."""
    remedy = "restart its microcontroller, check the wires to the chip"
    if memory.same > limits.imu_frozen:
        text = f"imu repeats the same six values for {memory.same:.2f} s (limit {limits.imu_frozen:g} s): "
        yield Suspicion("imu frozen", text + remedy)
        return
    for axis, count, seconds in zip(IMU_AXES, memory.counts, memory.axis_same, strict=False):
        is_at_end = count in COUNT_ENDS
        if seconds > (limits.imu_frozen if is_at_end else AXIS_TIME):
            what = "the end of its range" if is_at_end else "the same count"
            text = f"imu: its {axis} reads {count} counts, {what}, for {seconds:.2f} s: it measures nothing; exchange the chip"
            yield Suspicion("imu axis", text)
    if memory.wrong_length > GRAVITY_LASTS:
        text = f"imu: the mean specific force is {np.linalg.norm(memory.gravity):.1f} m/s2 for {memory.wrong_length:.1f} s, "
        yield Suspicion("imu gravity", f"{text}expected {STANDARD_GRAVITY:.1f}: an axis measures wrong; look with wlr doctor")
    elif memory.wrong_direction > GRAVITY_LASTS:
        text = f"imu: the accelerometer's vertical is {np.linalg.norm(memory.error):.2f} rad off the gyroscope's for "
        yield Suspicion("imu gravity", f"{text}{memory.wrong_direction:.1f} s: an axis measures wrong; look with wlr doctor")
