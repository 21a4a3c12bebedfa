"""What is safe to ask of the robot: pure functions of what was wanted and what was last seen. No I/O, no clock.

:func:`decide` puts them together once per control step: take the request, count how long things have been beyond their limits,
judge, limit. :mod:`wlr_gym.hardware.safety.limiter` carries its decisions out. Limits are the hardware file's.

Servos and sensors that fail without an error bit are found by what they say: :mod:`wlr_gym.hardware.safety.joints` and
:mod:`wlr_gym.hardware.safety.imu`.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from enum import IntEnum
from typing import NamedTuple

import numpy as np

from wlr_gym.hardware.config import SafetyLimits
from wlr_gym.hardware.dynamixel.tables import error_names
from wlr_gym.hardware.imu import STANDARD_GRAVITY
from wlr_gym.hardware.safety.imu import ImuMemory, is_blind, judge_imu, remember_imu
from wlr_gym.hardware.safety.joints import JointMemory, judge_joints, remember_joints
from wlr_gym.hardware.safety.status import IS_LEG, Array, Mask, Ratings, RobotStatus, between, each
from wlr_gym.robot import JOINTS

#: s over which the accelerometer corrects the gyroscope's vertical.
VERTICAL_TIME = 0.5
#: m/s2 that the accelerometer may differ from gravity while it is used for that.
VERTICAL_BAND = 2.0
#: s for which a computer may have been suspended, beyond which two clocks are not read at the same time.
LONGEST_SLEEP = 0.05


# ---- what is known, and what is said about it ----


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
class Memory:
    """What lasts from step to step: how long (s) things have been beyond their limits, and more."""

    loaded: Array = field(default_factory=each(0.0))
    current: float = 0.0
    sagged: float = 0.0
    tilted: float = 0.0
    tilting: float = 0.0
    torque_on: Mask = field(default_factory=each(True))  #: (8,) motors that are on
    joints: JointMemory = field(default_factory=JointMemory)
    imu: ImuMemory = field(default_factory=ImuMemory)


class Decision(NamedTuple):
    """What to send."""

    level: Level  #: what the robot may do
    setpoints: Array  #: (8,) rad and rad/s, finite
    torque_on: Mask  #: (8,) motors that are on
    verdicts: tuple[Verdict, ...]  #: findings; those at DRIVE change nothing about the setpoints
    limited: dict[str, Mask]  #: rule -> joints whose setpoints it changed
    memory: Memory  #: for the next step

    @property
    def worst(self) -> Verdict:
        """The worst verdict; of equals, what was asked for: a stop in good order is one whatever else would have stopped."""
        return max(self.verdicts, key=lambda verdict: (verdict.level, verdict.rule in REQUESTS, verdict), default=FINE)


def decide(
    limits: SafetyLimits,
    ratings: Ratings,
    status: RobotStatus,
    memory: Memory,
    previous: Array,
    wanted: object,
    torque_on: Mask | None = None,
) -> Decision:
    """Decide on one control step.

    Args:
        limits, ratings: the robot's.
        status: what was last seen.
        memory: of the step before.
        previous: (8,) setpoints of the step before, finite.
        wanted: setpoints asked for: anything; only eight finite numbers are taken.
        torque_on: (8,) motors that are to be on; setpoints of the others are not looked at. None = all.
    """
    on = np.ones(len(JOINTS), bool) if torque_on is None else np.asarray(torque_on, bool)
    setpoints, refusal = take_request(wanted, on, status.position, previous)
    memory = remember(limits, ratings, status, memory, previous)
    found = list(judge(limits, ratings, status, memory))
    verdicts = (*found, refusal) if refusal else tuple(found)
    level = max((verdict.level for verdict in verdicts), default=Level.DRIVE)
    if level == Level.COAST:
        setpoints = previous
    elif level >= Level.HOLD:
        setpoints = np.where(IS_LEG, previous, 0.0)
    start = np.where(on, previous, resting(status.position))
    hottest = float(np.fmax.reduce(status.temperature, initial=-np.inf))
    wheel_share = min(1.0, max(0.0, (limits.hot - hottest) / (limits.hot - limits.warm)))
    setpoints, limited = limit_setpoints(limits, ratings, setpoints, start, status.position, wheel_share)
    return Decision(level, setpoints, on, verdicts, limited if level == Level.DRIVE else {}, replace(memory, torque_on=on))


# ---- the request ----


def resting(position: Array) -> Array:
    """Return setpoints (8,) that ask for no motion: legs where they are, wheels still."""
    return np.where(IS_LEG, position, 0.0)


def take_request(wanted: object, on: Mask, position: Array, previous: Array) -> tuple[Array, Verdict | None]:
    """Return what was asked for as setpoints (8,), or the previous ones and why it was refused."""
    try:
        setpoints = np.asarray(wanted, np.float64)
    except (TypeError, ValueError):
        return previous, Verdict(Level.STOP, "finite", f"setpoints of type {type(wanted).__name__} are no numbers")
    if setpoints.shape != (len(JOINTS),):
        return previous, Verdict(Level.STOP, "shape", f"setpoints have shape {setpoints.shape}, expected ({len(JOINTS)},)")
    setpoints = np.where(on, setpoints, resting(position))
    if not np.isfinite(setpoints).all():
        bad = int(np.flatnonzero(~np.isfinite(setpoints))[0])
        return previous, Verdict(Level.STOP, "finite", f"setpoint of {JOINTS[bad]} is {setpoints[bad]}")
    return setpoints, None


def limit_setpoints(
    limits: SafetyLimits, ratings: Ratings, setpoints: Array, previous: Array, position: Array, wheel_share: float
) -> tuple[Array, dict[str, Mask]]:
    """Return setpoints within all limits, and rule -> joints that it changed.

    The slew limit comes last, so no setpoint ever jumps: not even back into range from outside. ``position`` is (8,) rad, as
    last read; ``wheel_share`` is what a hot servo leaves of the wheel speed limit, 1 to 0.
    """
    low = np.where(IS_LEG, ratings.leg_limits[0] + limits.leg_margin, -limits.wheel_speed * wheel_share)
    high = np.where(IS_LEG, ratings.leg_limits[1] - limits.leg_margin, limits.wheel_speed * wheel_share)
    low, high = np.maximum(low, ratings.low), np.minimum(high, ratings.high)
    middle = (low + high) / 2.0  # both ends of a range that is inverted: clipping to it would pass a leg's end
    low, high = np.minimum(low, middle), np.maximum(high, middle)
    inside = between(low, setpoints, high)
    near = between(position - limits.leg_lead, inside, position + limits.leg_lead)
    near = np.where(IS_LEG, between(low, near, high), inside)
    step = ratings.period * np.where(IS_LEG, limits.leg_speed, limits.wheel_acceleration)
    to_low, to_high = np.where(IS_LEG, (previous - low, high - previous), np.inf)
    down, up = (step * between(0.0, way / limits.leg_taper, 1.0) for way in (to_low, to_high))
    tapered = between(previous - down, near, previous + up)
    slewed = between(previous - step, near, previous + step)
    # beyond a limit the way back is never barred
    final = np.where(IS_LEG & (previous >= low) & (previous <= high), tapered, slewed)
    changes = {"limit": setpoints != inside, "lead": inside != near, "slew": near != slewed, "taper": final != slewed}
    return final, {rule: mask for rule, mask in changes.items() if mask.any()}


# ---- how long it has been so ----


def remember(limits: SafetyLimits, ratings: Ratings, status: RobotStatus, memory: Memory, previous: Array) -> Memory:
    """Count on how long things have been beyond their limits; loads and currents cool down as fast as they heat up."""
    period = ratings.period
    over = np.abs(status.effort) > limits.load * ratings.stall_torque
    loaded = np.maximum(memory.loaded + np.where(over, period, -period), 0.0)
    amperes = float(np.abs(ratings.currents.current(status.effort, status.velocity)).sum())
    current = max(memory.current + (period if amperes > limits.current else -period), 0.0)
    sagging = bool(np.fmin.reduce(status.voltage) < limits.low_voltage)
    imu = remember_imu(status, memory.imu, period)
    tilt = 0.0 if is_blind(imu) else tilt_of(status.up)
    ahead = 0.0 if is_blind(imu) else tilt_of(turned(status.up, status.gyro, limits.tilt_horizon))
    return Memory(
        loaded,
        current,
        memory.sagged + period if sagging else 0.0,
        memory.tilted + period if tilt > limits.tilt else 0.0,
        memory.tilting + period if max(tilt, ahead) > limits.tilt else 0.0,
        memory.torque_on,
        remember_joints(limits, ratings, status, memory.joints, previous, memory.torque_on),
        imu,
    )


# ---- verdicts ----


def judge(limits: SafetyLimits, ratings: Ratings, status: RobotStatus, memory: Memory) -> Iterator[Verdict]:
    """Yield every finding of a control step."""
    if status.asked_off:
        yield Verdict(Level.OFF, "emergency stop", status.asked_off)
    if status.asked_to_stop:
        yield Verdict(Level.STOP, "stop", status.asked_to_stop)
    if status.lost:
        yield Verdict(Level.OFF, "port", status.lost)
    if status.asleep > LONGEST_SLEEP:
        text = f"the computer was suspended for {status.asleep:.2f} s: forbid it meanwhile (systemd-inhibit wlr deploy ...)"
        yield Verdict(Level.OFF, "suspend", text)
    if status.idle > limits.watchdog:
        text = f"nothing was sent for {status.idle:.2f} s: the servos' watchdog has stopped them, and they refuse setpoints"
        yield Verdict(Level.OFF, "idle", text)
    if latched := ", ".join(JOINTS[k] for k in np.flatnonzero(status.registers.watchdog < 0.0)):
        text = f"{latched} heard nothing for too long: the servos' watchdog has stopped them, and they refuse setpoints"
        yield Verdict(Level.STOP, "watchdog", text)
    if status.trouble:
        yield Verdict(Level.STOP, "computer", status.trouble)
    yield from _judge_answers(limits, status)
    yield from _judge_servos(limits, status, memory)
    for rule, text, is_gentle in judge_joints(limits, ratings, status, memory.joints, memory.torque_on):
        yield Verdict(Level.STOP if is_gentle else Level.OFF, rule, text)
    for rule, text, _ in judge_imu(limits, memory.imu):
        yield Verdict(Level.STOP, rule, text)
    lean = f"{tilt_of(status.up):.2f} rad, turning at {np.linalg.norm(status.gyro[:2]):.1f} rad/s"
    if memory.tilted > limits.tilt_time:
        yield Verdict(Level.OFF, "tilt", f"{lean}, limit {limits.tilt:g}")
    elif memory.tilting > limits.tilt_time:
        yield Verdict(Level.STOP, "tilt ahead", f"{lean}, will pass {limits.tilt:g}")
    if limits.deadman is not None and status.operator_silence > limits.deadman:
        yield Verdict(Level.HOLD, "deadman", f"no sign of the operator for {status.operator_silence:.1f} s")
    if status.camera is not None and status.camera.is_wrong:  # no camera is no finding: estimates go on without
        yield Verdict(Level.DRIVE, "camera", f"its pose {status.camera.reason}, and is kept back")
    # lost answers make ticks late: the silence is judged then, not the lateness
    if not status.silence.any() and (status.late_ticks >= limits.late or status.late_share > limits.late_share):
        text = f"{status.late_ticks} ticks in a row late, {status.late_share:.0%} of the last second's"
        yield Verdict(Level.STOP, "deadlines", text)


def _judge_answers(limits: SafetyLimits, status: RobotStatus) -> Iterator[Verdict]:
    """Communication ladder: coast, hold, off."""
    longest = float(status.silence.max())
    if longest > 0.0:
        joints = ", ".join(JOINTS[k] for k in np.flatnonzero(status.silence > 0.0))
        text = f"no answer from {joints} for {longest:.2f} s (limit {limits.silence:g} s): check cable and power"
        if status.broken:
            text += f"; {status.broken} broken packets came instead: two servos with the same id, or a bad line"
        level = Level.OFF if longest > limits.silence else Level.HOLD if longest > limits.coast else Level.COAST
        yield Verdict(level, "silence", text)
    if status.imu_silence > limits.imu_silence:
        text = f"no reading for {status.imu_silence:.2f} s (limit {limits.imu_silence:g} s): check cable and power"
        yield Verdict(Level.STOP, "imu", text)


def _judge_servos(limits: SafetyLimits, status: RobotStatus, memory: Memory) -> Iterator[Verdict]:
    for k in np.flatnonzero(status.restarted & (status.asleep <= LONGEST_SLEEP)):  # their clocks went on, ours did not
        yield Verdict(Level.OFF, "restart", f"{JOINTS[k]} was rebooted or had no power")
    for k in np.flatnonzero(status.alert):
        bits = status.registers.error[k]
        found = ", ".join(error_names(int(bits))) if np.isfinite(bits) else "not read"
        yield Verdict(Level.STOP, "alert", f"{JOINTS[k]} has a hardware error: {found}")
    for k in np.flatnonzero(status.temperature >= limits.hot):
        yield Verdict(Level.STOP, "temperature", f"{JOINTS[k]} has {status.temperature[k]:.0f} degC, limit {limits.hot:g}")
    for k in np.flatnonzero(memory.loaded > limits.load_time):
        text = f"{JOINTS[k]} gives {abs(status.effort[k]):.2f} N m, above {limits.load:.0%} of stall for {limits.load_time:g} s"
        yield Verdict(Level.STOP, "load", text)
    if memory.current > limits.current_time:
        yield Verdict(Level.STOP, "current", f"motors above {limits.current:g} A for {limits.current_time:g} s")
    if memory.sagged > limits.low_voltage_time:
        lowest = np.nanmin(status.voltage)
        yield Verdict(Level.STOP, "voltage", f"supply at {lowest:.1f} V, limit {limits.low_voltage:g}")


# ---- the vertical ----


def turned(up: Array, gyro: Array, time: float) -> Array:
    """Return the vertical in the body frame after turning at ``gyro`` for ``time`` (s)."""
    x, y, z = up.tolist()
    p, q, r = (gyro * time).tolist()
    moved = np.array([x - q * z + r * y, y - r * x + p * z, z - p * y + q * x])
    return moved / math.sqrt(moved @ moved)


def next_up(up: Array, gyro: Array, accelerometer: Array, time: float) -> Array:
    """Return the vertical in the body frame ``time`` (s) later: the gyroscope's, slowly pulled to the accelerometer's.

    The accelerometer counts only while it reads about one g.
    """
    up = turned(up, gyro, time)
    size = float(np.linalg.norm(accelerometer))
    if abs(size - STANDARD_GRAVITY) < VERTICAL_BAND:
        up = up + min(1.0, time / VERTICAL_TIME) * (accelerometer / size - up)
    return up / np.linalg.norm(up)


def tilt_of(up: Array) -> float:
    """Return the angle (rad) between the body's z axis and the vertical."""
    return math.acos(min(1.0, max(-1.0, float(up[2]))))
