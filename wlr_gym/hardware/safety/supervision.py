"""Does every joint do what it is told, and is what it and the IMU say true? Pure functions; limits in the hardware file.

Servos and sensors that fail without an error bit are found by what they say: registers that are not what was written, readings
no motor can have made, readings that stand still where motion is expected, joints that stay away from their setpoints.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np

from wlr_gym.hardware.dynamixel.tables import error_names
from wlr_gym.hardware.limits import SafetyLimits
from wlr_gym.hardware.safety.state import Array, Level, Mask, Ratings, RobotStatus, Verdict
from wlr_gym.robot import JOINTS, LEGS

#: Part of the no-load speed by which a healthy motor may be off the line between stall torque and no-load speed ...
LINE_ERROR = 0.05
#: ... and part of its torque's share of that line: resistance grows with temperature, constants are nominal.
LINE_SLOPE_ERROR = 0.3
#: rad by which a reading that stands still may rattle, 3 counts, and rad/s that it then shows.
RATTLE, RATTLE_SPEED = 0.005, 0.25
#: rad/s below which a wheel's setpoint need not move it: it may be less than its friction for long.
CREEP = 0.05
#: s in which the wheels' velocity loop follows.
WHEEL_LAG = 0.25
#: Part of the no-load speed: a leg that comes nearer to its setpoint faster than this follows it.
CLOSING = 0.2
_N = len(JOINTS)
_IS_LEG = np.arange(_N) < len(LEGS)


@dataclass(frozen=True)
class JointMemory:
    """What lasts from step to step of joints and IMU.

    Attributes:
        still_at: (8,) rad, reading from which on a joint has stayed the same but for the encoder's last bits.
        position, velocity: (8,) rad, rad/s, last read. A leg that turns back may by chance repeat one of them, not both.
        ramp: (8,) rad/s, speed that the wheels' profile asks for by now; legs 0.
        reference: (8,) rad/s, speed that the wheels should have by now; legs 0.
        unmoved: (8,) rad a joint should have moved since then.
        away: (8,) s for which a joint has stayed away from its setpoint.
        imu: (6,) last rates and specific forces. imu_same: s for which they have not changed at all.
    """

    still_at: Array = field(default_factory=lambda: np.full(_N, np.nan))
    position: Array = field(default_factory=lambda: np.full(_N, np.nan))
    velocity: Array = field(default_factory=lambda: np.full(_N, np.nan))
    ramp: Array = field(default_factory=lambda: np.zeros(_N))
    reference: Array = field(default_factory=lambda: np.zeros(_N))
    unmoved: Array = field(default_factory=lambda: np.zeros(_N))
    away: Array = field(default_factory=lambda: np.zeros(_N))
    imu: Array = field(default_factory=lambda: np.full(6, np.nan))
    imu_same: float = 0.0


# ---- readings that no motor can have made ----


def reach(limits: SafetyLimits, ratings: Ratings, seconds: Array) -> Array:
    """Return how far (8,) in rad joints can have turned in so many seconds (8,)."""
    return limits.jump_speed * ratings.no_load_speed * seconds + limits.jump_noise


def unseen(ratings: Ratings, before: RobotStatus, time: float) -> Array:
    """Return for how long (8,) in s joints were not seen before an answer at ``time``.

    Not longer than until their first reading that was rejected: what stays impossible must not become possible by waiting.
    """
    elapsed = before.silence + np.maximum(time - before.time, ratings.period)
    return np.where(before.suspect, before.unseen, elapsed)


# ---- from step to step ----


def supervised(status: RobotStatus, torque_on: Mask) -> Mask:
    """Return which joints (8,) are driven, heard in this step, and tell their registers."""
    return torque_on & (status.silence == 0.0) & np.isfinite(status.registers.torque)


def remember(
    limits: SafetyLimits, ratings: Ratings, status: RobotStatus, memory: JointMemory, previous: Array, torque_on: Mask
) -> JointMemory:
    """Return the memory after a step.

    Args:
        limits, ratings: the robot's.
        status: what was last seen; arrays of joints may be those of several robots, (N, 8).
        memory: of the step before.
        previous: (8,) setpoints sent in the step before.
        torque_on: (8,) motors that were on.
    """
    seen = supervised(status, torque_on)
    largest = ratings.no_load_speed * ratings.pwm_share * status.voltage / ratings.supply  # no setpoint makes a wheel faster
    ramp = np.where(torque_on, next_ramp(ratings, memory.ramp, np.clip(previous, -largest, largest)), 0.0)
    reference = np.where(torque_on, memory.reference + (ramp - memory.reference) * ratings.period / WHEEL_LAG, 0.0)
    expected = np.where(_IS_LEG, line_speed(ratings, status), np.where(np.abs(reference) > CREEP, reference, 0.0))
    same = (status.position == memory.position) & (status.velocity == memory.velocity)
    rattles = (np.abs(status.position - memory.still_at) <= RATTLE) & (np.abs(status.velocity) <= RATTLE_SPEED)
    moved = seen & ~(same | rattles)
    unmoved = np.where(moved, 0.0, memory.unmoved + np.where(seen, expected * ratings.period, 0.0))
    off = seen & is_away(limits, ratings, status, previous, reference)
    away = np.where(off, memory.away + ratings.period, np.where(seen, 0.0, memory.away))
    imu = np.concatenate([status.gyro, status.accelerometer])
    heard = ratings.period if status.imu_silence <= ratings.period else 0.0  # silence has a rule of its own
    imu_same = memory.imu_same + heard if np.array_equal(imu, memory.imu) else 0.0
    return JointMemory(
        np.where(moved, status.position, memory.still_at),
        status.position,
        status.velocity,
        ramp,
        reference,
        np.where(torque_on, unmoved, 0.0),
        np.where(torque_on, away, 0.0),
        imu,
        imu_same,
    )


def next_ramp(ratings: Ratings, ramp: Array, setpoints: Array) -> Array:
    """Return the speeds (8,) that the wheels' profile asks for a step later; legs 0. Their velocity loop lags behind that."""
    largest = ratings.profile.wheel_acceleration * ratings.period or np.inf
    return np.where(_IS_LEG, 0.0, ramp + np.clip(setpoints - ramp, -largest, largest))


def line_speed(ratings: Ratings, status: RobotStatus) -> Array:
    """Return the speed (8,) in rad/s that voltage and current of a leg's motor tell; 0 where it may stand.

    A motor turns at ``no-load speed * (voltage share - torque / stall torque)``. So a leg that stands or is blocked draws what
    keeps this at 0, and one that turns does not, whatever its encoder says. Wheels have no current sensor.
    """
    strain = status.effort / ratings.stall_torque
    share = status.registers.voltage_share * status.voltage / ratings.supply
    speed = ratings.no_load_speed * (share - strain)
    unsure = ratings.no_load_speed * (LINE_ERROR + LINE_SLOPE_ERROR * np.abs(strain))
    return np.nan_to_num(np.sign(speed) * np.maximum(np.abs(speed) - unsure, 0.0))


def is_away(limits: SafetyLimits, ratings: Ratings, status: RobotStatus, setpoints: Array, reference: Array) -> Mask:
    """Return which joints (8,) are away from where, or how fast, they should be, and do not come nearer."""
    behind = setpoints - status.position
    comes_nearer = status.velocity * np.sign(behind) > closing_speed(ratings)
    leg = (np.abs(behind) > limits.leg_error) & ~comes_nearer
    return np.where(_IS_LEG, leg, np.abs(reference - status.velocity) > limits.wheel_error)


def closing_speed(ratings: Ratings) -> Array:
    """Return the speed (8,) in rad/s above which a leg follows its setpoint; a velocity profile is slower."""
    speed = CLOSING * ratings.no_load_speed
    profile = ratings.profile.leg_velocity
    return np.minimum(speed, 0.5 * profile) if profile > 0.0 else speed


def error_time(limits: SafetyLimits, ratings: Ratings) -> Array:
    """Return for how long (8,) in s joints may be away; a leg's acceleration profile is given its time, to turn back too."""
    profile = ratings.profile
    is_ramped = profile.leg_velocity > 0.0 and profile.leg_acceleration > 0.0
    more = (profile.leg_velocity + closing_speed(ratings)) / profile.leg_acceleration if is_ramped else np.zeros(_N)
    return np.where(_IS_LEG, limits.leg_error_time + more, limits.wheel_error_time)


# ---- verdicts ----


def frozen_limit(limits: SafetyLimits) -> Array:
    """Return by how many rad (8,) a joint should have turned, when it has not moved, at most."""
    return np.where(_IS_LEG, limits.frozen_leg, limits.frozen_wheel)


def is_frozen(limits: SafetyLimits, memory: JointMemory) -> Mask:
    """Return which joints (..., 8) repeat their reading while they should turn."""
    return np.abs(memory.unmoved) > frozen_limit(limits)


def is_lost(limits: SafetyLimits, ratings: Ratings, memory: JointMemory) -> Mask:
    """Return which joints (..., 8) have stayed away from their setpoints for too long."""
    return memory.away > error_time(limits, ratings)


def judge(limits: SafetyLimits, ratings: Ratings, status: RobotStatus, memory: JointMemory, on: Mask) -> Iterator[Verdict]:
    """Yield what is wrong with joints and IMU.

    A joint that does not do what it is told cannot be stopped by setpoints either: torque goes off at once.
    """
    yield from _judge_registers(ratings, status, on)
    for k in np.flatnonzero(status.jump):
        yield Verdict(Level.OFF, "jump", _jump_text(limits, ratings, status, int(k)))
    frozen = frozen_limit(limits)
    for k in np.flatnonzero(is_frozen(limits, memory)):
        yield Verdict(
            Level.OFF,
            "frozen",
            f"{JOINTS[k]} reads {status.position[k]:.3f} rad again and again while it should have turned by "
            f"{abs(memory.unmoved[k]):.2f} rad (limit {frozen[k]:g} rad): is it blocked? If not, its encoder has failed: "
            f"exchange the servo",
        )
    for k in np.flatnonzero(is_lost(limits, ratings, memory)):
        yield Verdict(Level.OFF, "tracking", _tracking_text(limits, ratings, status, memory, int(k)))
    if memory.imu_same > limits.imu_frozen:
        text = f"imu repeats the same six values for {memory.imu_same:.2f} s (limit {limits.imu_frozen:g} s): "
        yield Verdict(Level.STOP, "imu frozen", text + "restart its microcontroller, check the wires to the chip")


def _judge_registers(ratings: Ratings, status: RobotStatus, on: Mask) -> Iterator[Verdict]:
    registers = status.registers
    explained = status.restarted | status.alert  # these have rules of their own
    for k in np.flatnonzero(np.isfinite(registers.torque) & ~explained & (status.silence == 0.0)):
        joint, torque, watchdog, pwm = JOINTS[k], registers.torque[k], registers.watchdog[k], registers.goal_pwm[k]
        if torque != on[k]:
            text = (
                f"{joint}: Torque Enable is {torque:.0f}, expected {on[k]:d}: it was switched or rebooted by something else; "
            )
            yield Verdict(Level.OFF, "torque", text + "check its supply and cable, end other programs on its bus")
        elif watchdog >= 0.0 and watchdog != ratings.watchdog:
            text = (
                f"{joint}: Bus Watchdog is {watchdog:.0f}, expected {ratings.watchdog:.0f}: it would not stop if this program "
            )
            yield Verdict(Level.STOP, "register", text + "died; end other programs on its bus")
        if torque and pwm != ratings.goal_pwm[k]:
            text = f"{joint}: Goal PWM is {pwm:.0f}, expected {ratings.goal_pwm[k]:.0f}: something else changed its limit; "
            yield Verdict(Level.STOP, "register", text + "end other programs on its bus")


def _jump_text(limits: SafetyLimits, ratings: Ratings, status: RobotStatus, k: int) -> str:
    reading, possible = status.position[k] + status.jump[k], reach(limits, ratings, status.unseen)[k]
    return (
        f"{JOINTS[k]} reads {reading:.2f} rad, {abs(status.jump[k]):.2f} rad from its reading {status.unseen[k]:.3f} s before: "
        f"no motor turns that far (limit {possible:.2f} rad); check horn and encoder, exchange the servo"
    )


def _tracking_text(limits: SafetyLimits, ratings: Ratings, status: RobotStatus, memory: JointMemory, k: int) -> str:
    seconds = f"for {memory.away[k]:.2f} s (limit {error_time(limits, ratings)[k]:.2f} s)"
    if _IS_LEG[k]:
        found = f"is at {status.position[k]:.2f} rad, more than {limits.leg_error:g} rad from its setpoint {seconds}"
    else:
        expected = f"expected {memory.reference[k]:.2f} within {limits.wheel_error:g}"
        found = f"turns at {status.velocity[k]:.2f} rad/s, {expected} {seconds}"
    return f"{JOINTS[k]} {found}: is it blocked, or its motor weak? Turn it by hand with torque off, check supply and gears"


def error_text(status: RobotStatus, k: int) -> str:
    """Return a joint's hardware errors in words."""
    bits = status.registers.error[k]
    return ", ".join(error_names(int(bits))) if np.isfinite(bits) else "not read"
