"""What is safe to ask of the robot: pure functions of what was wanted and what was last seen. No I/O, no clock.

:func:`decide` puts them together once per control step. :mod:`wlr_gym.hardware.safety.limiter` carries its decisions out.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np

from wlr_gym.hardware.imu.frames import STANDARD_GRAVITY
from wlr_gym.hardware.limits import SafetyLimits
from wlr_gym.hardware.safety import supervision
from wlr_gym.hardware.safety.state import FINE, REQUESTS, Array, Level, Mask, Ratings, RobotStatus, Verdict
from wlr_gym.hardware.safety.supervision import JointMemory
from wlr_gym.physics.servo import current_law
from wlr_gym.robot import JOINTS, LEGS, Robot

#: s over which the accelerometer corrects the gyroscope's vertical.
VERTICAL_TIME = 0.5
#: m/s2 that the accelerometer may differ from gravity while it is used for that.
VERTICAL_BAND = 2.0
_N = len(JOINTS)
_IS_LEG = np.arange(_N) < len(LEGS)


@dataclass(frozen=True)
class Memory:
    """What lasts from step to step: how long things have been beyond their limits, s; motors (8,) that are on; joints."""

    loaded: Array = field(default_factory=lambda: np.zeros(_N))
    current: float = 0.0
    sagged: float = 0.0
    tilted: float = 0.0
    tilting: float = 0.0
    torque_on: Mask = field(default_factory=lambda: np.ones(_N, bool))
    joints: JointMemory = field(default_factory=JointMemory)


def ratings_of(robot: Robot, period: float, low: Array | None = None, high: Array | None = None) -> Ratings:
    """Return the ratings of a robot; without register limits (``low``, ``high``) all setpoints are possible."""
    motors = (robot.servo.leg, robot.servo.wheel)
    stall = np.repeat([motor.stall_torque for motor in motors], 4)
    speed = np.repeat([motor.no_load_speed for motor in motors], 4)
    return Ratings(
        np.full(_N, -np.inf) if low is None else low,
        np.full(_N, np.inf) if high is None else high,
        robot.leg_limits,
        stall,
        current_law(robot),
        speed,
        period,
        robot.servo.supply_voltage,
    )


class Decision(NamedTuple):
    """What to send.

    Attributes:
        level: what the robot may do.
        setpoints: (8,) rad and rad/s, finite.
        torque_on: (8,) motors that are on.
        verdicts: findings; those at DRIVE change nothing about the setpoints.
        limited: rule -> joints whose setpoints it changed.
        memory: for the next step.
    """

    level: Level
    setpoints: Array
    torque_on: Mask
    verdicts: tuple[Verdict, ...]
    limited: dict[str, Mask]
    memory: Memory

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
        limits: the robot's.
        ratings: the robot's.
        status: what was last seen.
        memory: of the step before.
        previous: (8,) setpoints of the step before, finite.
        wanted: setpoints asked for: anything; only eight finite numbers are taken.
        torque_on: (8,) motors that are to be on; setpoints of the others are not looked at. None = all.
    """
    on = np.ones(_N, bool) if torque_on is None else np.asarray(torque_on, bool)
    setpoints, refusal = take_request(wanted, on, status.position, previous)
    memory = remember(limits, ratings, status, memory, previous)
    found = list(judge(limits, ratings, status, memory))
    verdicts = (*found, refusal) if refusal else tuple(found)
    level = max((verdict.level for verdict in verdicts), default=Level.DRIVE)
    if level == Level.COAST:
        setpoints = previous
    elif level >= Level.HOLD:
        setpoints = np.where(_IS_LEG, previous, 0.0)
    start = np.where(on, previous, resting(status.position))
    setpoints, limited = limit_setpoints(limits, ratings, setpoints, start, status.position, slow_down(limits, status))
    return Decision(level, setpoints, on, verdicts, limited if level == Level.DRIVE else {}, replace(memory, torque_on=on))


# ---- the request ----


def resting(position: Array) -> Array:
    """Return setpoints (8,) that ask for no motion: legs where they are, wheels still."""
    return np.where(_IS_LEG, position, 0.0)


def take_request(wanted: object, on: Mask, position: Array, previous: Array) -> tuple[Array, Verdict | None]:
    """Return what was asked for as setpoints (8,), or the previous ones and why it was refused."""
    try:
        setpoints = np.asarray(wanted, np.float64)
    except (TypeError, ValueError):
        return previous, Verdict(Level.STOP, "finite", f"setpoints of type {type(wanted).__name__} are no numbers")
    if setpoints.shape != (_N,):
        return previous, Verdict(Level.STOP, "shape", f"setpoints have shape {setpoints.shape}, expected ({_N},)")
    setpoints = np.where(on, setpoints, resting(position))
    if not np.isfinite(setpoints).all():
        bad = int(np.flatnonzero(~np.isfinite(setpoints))[0])
        return previous, Verdict(Level.STOP, "finite", f"setpoint of {JOINTS[bad]} is {setpoints[bad]}")
    return setpoints, None


def limit_setpoints(
    limits: SafetyLimits, ratings: Ratings, setpoints: Array, previous: Array, position: Array, wheel_share: float
) -> tuple[Array, dict[str, Mask]]:
    """Return setpoints within all limits, and rule -> joints that it changed.

    The slew limit comes last, so no setpoint ever jumps: not even back into range from outside.

    Args:
        limits, ratings: the robot's.
        setpoints, previous: (8,) finite.
        position: (8,) rad, as last read.
        wheel_share: of the wheel speed limit that is left.
    """
    low = np.where(_IS_LEG, ratings.leg_limits[0] + limits.leg_margin, -limits.wheel_speed * wheel_share)
    high = np.where(_IS_LEG, ratings.leg_limits[1] - limits.leg_margin, limits.wheel_speed * wheel_share)
    low, high = _in_order(np.maximum(low, ratings.low), np.minimum(high, ratings.high))
    inside = np.clip(setpoints, low, high)
    near = np.clip(inside, position - limits.leg_lead, position + limits.leg_lead)
    near = np.where(_IS_LEG, np.clip(near, low, high), inside)
    step = ratings.period * np.where(_IS_LEG, limits.leg_speed, limits.wheel_acceleration)
    to_low, to_high = np.where(_IS_LEG, (previous - low, high - previous), np.inf)
    tapered = np.clip(
        near,
        previous - step * np.clip(to_low / limits.leg_taper, 0.0, 1.0),
        previous + step * np.clip(to_high / limits.leg_taper, 0.0, 1.0),
    )
    slewed = np.clip(near, previous - step, previous + step)
    # beyond a limit the way back is never barred
    final = np.where(_IS_LEG & (previous >= low) & (previous <= high), tapered, slewed)
    changes = {"limit": setpoints != inside, "lead": inside != near, "slew": near != slewed, "taper": final != slewed}
    return final, {rule: mask for rule, mask in changes.items() if mask.any()}


def _in_order(low: Array, high: Array) -> tuple[Array, Array]:
    """Return the ends of ranges, both at the middle of one that is inverted: clipping to it would pass a leg's end."""
    middle = (low + high) / 2.0
    return np.minimum(low, middle), np.maximum(high, middle)


def slow_down(limits: SafetyLimits, status: RobotStatus) -> float:
    """Return the share of the wheel speed limit that the hottest servo leaves, 1 to 0."""
    hottest = np.nanmax(status.temperature, initial=-np.inf)
    return float(np.clip((limits.hot - hottest) / (limits.hot - limits.warm), 0.0, 1.0))


# ---- supervision ----


def remember(limits: SafetyLimits, ratings: Ratings, status: RobotStatus, memory: Memory, previous: Array) -> Memory:
    """Count on how long things have been beyond their limits; loads and currents cool down as fast as they heat up."""
    period = ratings.period
    over = np.abs(status.effort) > limits.load * ratings.stall_torque
    loaded = np.maximum(memory.loaded + np.where(over, period, -period), 0.0)
    amperes = float(np.abs(ratings.currents.current(status.effort, status.velocity)).sum())
    current = max(memory.current + (period if amperes > limits.current else -period), 0.0)
    sagging = bool(np.nanmin(status.voltage, initial=np.inf) < limits.low_voltage)
    tilting = max(tilt_of(status.up), tilt_of(turned(status.up, status.gyro, limits.tilt_horizon))) > limits.tilt
    return Memory(
        loaded,
        current,
        memory.sagged + period if sagging else 0.0,
        memory.tilted + period if tilt_of(status.up) > limits.tilt else 0.0,
        memory.tilting + period if tilting else 0.0,
        memory.torque_on,
        supervision.remember(limits, ratings, status, memory.joints, previous, memory.torque_on),
    )


def judge(limits: SafetyLimits, ratings: Ratings, status: RobotStatus, memory: Memory) -> Iterator[Verdict]:
    """Yield every finding of a control step."""
    if status.asked_off:
        yield Verdict(Level.OFF, "emergency stop", status.asked_off)
    if status.asked_to_stop:
        yield Verdict(Level.STOP, "stop", status.asked_to_stop)
    if status.lost:
        yield Verdict(Level.OFF, "port", status.lost)
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
    yield from supervision.judge(limits, ratings, status, memory.joints, memory.torque_on)
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
    for k in np.flatnonzero(status.restarted):
        yield Verdict(Level.OFF, "restart", f"{JOINTS[k]} was rebooted or had no power")
    for k in np.flatnonzero(status.alert):
        yield Verdict(Level.STOP, "alert", f"{JOINTS[k]} has a hardware error: {supervision.error_text(status, int(k))}")
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
    moved = up - np.cross(gyro, up) * time
    return moved / np.linalg.norm(moved)


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
    return float(np.arccos(np.clip(up[2], -1.0, 1.0)))
