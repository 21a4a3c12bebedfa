"""What is safe to ask of the robot: pure functions of what was wanted and what was last seen. No I/O, no clock.

:func:`decide` puts them together once per control step: take the request, count how long things have been beyond their limits,
judge, limit. :mod:`wlr_gym.hardware.safety.limiter` carries its decisions out. Limits are the hardware file's.

Servos and sensors that fail without an error bit are found by what they say: registers that are not what was written, readings
no motor can have made, readings that stand still where motion is expected, joints that stay away from their setpoints.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from enum import IntEnum
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from wlr_gym.data.format import Profile
from wlr_gym.hardware.config import SafetyLimits
from wlr_gym.hardware.dynamixel.tables import error_names
from wlr_gym.hardware.flow import FlowReading
from wlr_gym.hardware.imu import STANDARD_GRAVITY
from wlr_gym.hardware.servos import UNREAD, ServoRegisters
from wlr_gym.physics.servo import CurrentLaw, current_law
from wlr_gym.robot import JOINTS, LEGS, Robot

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
_N = len(JOINTS)
_IS_LEG = np.arange(_N) < len(LEGS)

#: s over which the accelerometer corrects the gyroscope's vertical.
VERTICAL_TIME = 0.5
#: m/s2 that the accelerometer may differ from gravity while it is used for that.
VERTICAL_BAND = 2.0
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


def _each(value: float) -> Callable[[], NDArray[Any]]:
    """Return what makes an array of a value for each joint (8,)."""
    return lambda: np.full(_N, value)


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
    late_ticks: int = 0  #: control steps in a row that started a period late or more
    late_share: float = 0.0  #: of the last second's
    operator_silence: float = 0.0  #: s since the operator's last sign
    idle: float = 0.0  #: s for which nothing was sent to the servos
    lost: str = ""  #: ports that are gone, in words
    trouble: str = ""  #: why log or terminal failed
    asked_to_stop: str = ""  #: why a stop was asked for
    asked_off: str = ""  #: why torque is to go off at once
    broken: int = 0  #: packets with a wrong checksum since all joints answered last
    flow: FlowReading | None = None  #: of the optical-flow sensor in this step; None = the robot has none
    registers: ServoRegisters = UNREAD  #: of the servos, as last read
    suspect: Mask = field(default_factory=_each(False))  #: (8,) the last reading was impossible, and is not confirmed
    unseen: Array = field(default_factory=_each(0.0))  #: (8,) s not seen before the last answer, or the first impossible
    jump: Array = field(default_factory=_each(0.0))  #: (8,) rad that readings jumped for good, beyond a motor; 0 = not
    camera: CameraStatus | None = None  #: what the camera says; None = there is none


@dataclass(frozen=True)
class Ratings:
    """Ratings of the robot's motors, and what its servos' registers allow."""

    leg_limits: tuple[float, float]  #: rad, of the robot file
    stall_torque: Array  #: (8,) N m
    no_load_speed: Array  #: (8,) rad/s
    currents: CurrentLaw  #: of torques and rates
    period: float  #: s of a control step
    supply: float  #: V that these hold at
    low: Array = field(default_factory=_each(-np.inf))  #: (8,) rad and rad/s, lowest setpoints that the servos' registers take
    high: Array = field(default_factory=_each(np.inf))  #: (8,) and highest
    watchdog: float = np.nan  #: count that Bus Watchdog is armed with
    goal_pwm: Array = field(default_factory=_each(np.nan))  #: (8,) counts that Goal PWM is set to
    pwm_share: Array = field(default_factory=_each(1.0))  #: (8,) part of the supply that this is
    profile: Profile = field(default_factory=Profile)  #: of the servos


def ratings_of(robot: Robot, period: float, **registers: Any) -> Ratings:
    """Return the ratings of a robot; ``registers``: what its servos' registers allow (:class:`Ratings`)."""
    leg, wheel = robot.servo.leg, robot.servo.wheel
    return Ratings(
        leg_limits=robot.leg_limits,
        stall_torque=np.repeat([leg.stall_torque, wheel.stall_torque], 4),
        no_load_speed=np.repeat([leg.no_load_speed, wheel.no_load_speed], 4),
        currents=current_law(robot),
        period=period,
        supply=robot.servo.supply_voltage,
        **registers,
    )


@dataclass(frozen=True)
class JointMemory:
    """What lasts from step to step of joints and IMU."""

    still_at: Array = field(default_factory=_each(np.nan))  #: (8,) rad, reading since which only the encoder's last bits differ
    position: Array = field(default_factory=_each(np.nan))  #: (8,) rad, last read
    velocity: Array = field(default_factory=_each(np.nan))  #: (8,) rad/s; a leg that turns back may repeat one, not both
    ramp: Array = field(default_factory=_each(0.0))  #: (8,) rad/s, speed that the wheels' profile asks for by now; legs 0
    reference: Array = field(default_factory=_each(0.0))  #: (8,) rad/s, speed that the wheels should have by now; legs 0
    unmoved: Array = field(default_factory=_each(0.0))  #: (8,) rad a joint should have moved since then
    away: Array = field(default_factory=_each(0.0))  #: (8,) s for which a joint has stayed away from its setpoint
    imu: Array = field(default_factory=lambda: np.full(6, np.nan))  #: (6,) last rates and specific forces
    imu_same: float = 0.0  #: s for which they have not changed at all


@dataclass(frozen=True)
class Memory:
    """What lasts from step to step: how long (s) things have been beyond their limits, and more."""

    loaded: Array = field(default_factory=_each(0.0))
    current: float = 0.0
    sagged: float = 0.0
    tilted: float = 0.0
    tilting: float = 0.0
    torque_on: Mask = field(default_factory=_each(True))  #: (8,) motors that are on
    joints: JointMemory = field(default_factory=JointMemory)


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
    hottest = np.nanmax(status.temperature, initial=-np.inf)
    wheel_share = float(np.clip((limits.hot - hottest) / (limits.hot - limits.warm), 0.0, 1.0))
    setpoints, limited = limit_setpoints(limits, ratings, setpoints, start, status.position, wheel_share)
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

    The slew limit comes last, so no setpoint ever jumps: not even back into range from outside. ``position`` is (8,) rad, as
    last read; ``wheel_share`` is what a hot servo leaves of the wheel speed limit, 1 to 0.
    """
    low = np.where(_IS_LEG, ratings.leg_limits[0] + limits.leg_margin, -limits.wheel_speed * wheel_share)
    high = np.where(_IS_LEG, ratings.leg_limits[1] - limits.leg_margin, limits.wheel_speed * wheel_share)
    low, high = np.maximum(low, ratings.low), np.minimum(high, ratings.high)
    middle = (low + high) / 2.0  # both ends of a range that is inverted: clipping to it would pass a leg's end
    low, high = np.minimum(low, middle), np.maximum(high, middle)
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


# ---- how long it has been so ----


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
        remember_joints(limits, ratings, status, memory.joints, previous, memory.torque_on),
    )


def remember_joints(
    limits: SafetyLimits, ratings: Ratings, status: RobotStatus, memory: JointMemory, previous: Array, torque_on: Mask
) -> JointMemory:
    """Return the memory after a step with the setpoints (8,) and motors (8,) of the step before.

    Arrays of joints in ``status`` may be those of several robots, (N, 8).
    """
    # driven, heard in this step, and telling their registers
    seen = torque_on & (status.silence == 0.0) & np.isfinite(status.registers.torque)
    largest = ratings.no_load_speed * ratings.pwm_share * status.voltage / ratings.supply  # no setpoint makes a wheel faster
    change = ratings.profile.wheel_acceleration * ratings.period or np.inf
    asked = np.clip(previous, -largest, largest)
    ramp = np.where(torque_on & ~_IS_LEG, memory.ramp + np.clip(asked - memory.ramp, -change, change), 0.0)
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


# ---- verdicts ----


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
    yield from judge_joints(limits, ratings, status, memory.joints, memory.torque_on)
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


def judge_joints(
    limits: SafetyLimits, ratings: Ratings, status: RobotStatus, memory: JointMemory, on: Mask
) -> Iterator[Verdict]:
    """Yield what is wrong with joints and IMU.

    A joint that does not do what it is told cannot be stopped by setpoints either: torque goes off at once.
    """
    yield from _judge_registers(ratings, status, on)
    for k in np.flatnonzero(status.jump):
        reading, possible = status.position[k] + status.jump[k], reach(limits, ratings, status.unseen)[k]
        text = f"{JOINTS[k]} reads {reading:.2f} rad, {abs(status.jump[k]):.2f} rad from its reading {status.unseen[k]:.3f} s "
        text += f"before: no motor turns that far (limit {possible:.2f} rad); check horn and encoder, exchange the servo"
        yield Verdict(Level.OFF, "jump", text)
    frozen = frozen_limit(limits)
    for k in np.flatnonzero(is_frozen(limits, memory)):
        text = f"{JOINTS[k]} reads {status.position[k]:.3f} rad again and again while it should have turned by "
        text += f"{abs(memory.unmoved[k]):.2f} rad (limit {frozen[k]:g} rad): is it blocked? If not, its encoder has failed: "
        yield Verdict(Level.OFF, "frozen", text + "exchange the servo")
    for k in np.flatnonzero(is_lost(limits, ratings, memory)):
        seconds = f"for {memory.away[k]:.2f} s (limit {error_time(limits, ratings)[k]:.2f} s)"
        found = f"is at {status.position[k]:.2f} rad, more than {limits.leg_error:g} rad from its setpoint {seconds}"
        if not _IS_LEG[k]:
            expected = f"expected {memory.reference[k]:.2f} within {limits.wheel_error:g}"
            found = f"turns at {status.velocity[k]:.2f} rad/s, {expected} {seconds}"
        remedy = "is it blocked, or its motor weak? Turn it by hand with torque off, check supply and gears"
        yield Verdict(Level.OFF, "tracking", f"{JOINTS[k]} {found}: {remedy}")
    if memory.imu_same > limits.imu_frozen:
        text = f"imu repeats the same six values for {memory.imu_same:.2f} s (limit {limits.imu_frozen:g} s): "
        yield Verdict(Level.STOP, "imu frozen", text + "restart its microcontroller, check the wires to the chip")


def _judge_registers(ratings: Ratings, status: RobotStatus, on: Mask) -> Iterator[Verdict]:
    registers, end_others = status.registers, "end other programs on its bus"
    explained = status.restarted | status.alert  # these have rules of their own
    for k in np.flatnonzero(np.isfinite(registers.torque) & ~explained & (status.silence == 0.0)):
        joint, torque, watchdog, pwm = JOINTS[k], registers.torque[k], registers.watchdog[k], registers.goal_pwm[k]
        if torque != on[k]:
            text = f"{joint}: Torque Enable is {torque:.0f}, expected {on[k]:d}: it was switched or rebooted by something else"
            yield Verdict(Level.OFF, "torque", f"{text}; check its supply and cable, {end_others}")
        elif watchdog >= 0.0 and watchdog != ratings.watchdog:
            text = f"{joint}: Bus Watchdog is {watchdog:.0f}, expected {ratings.watchdog:.0f}"
            yield Verdict(Level.STOP, "register", f"{text}: it would not stop if this program died; {end_others}")
        if torque and pwm != ratings.goal_pwm[k]:
            text = f"{joint}: Goal PWM is {pwm:.0f}, expected {ratings.goal_pwm[k]:.0f}: something else changed its limit"
            yield Verdict(Level.STOP, "register", f"{text}; {end_others}")


def error_time(limits: SafetyLimits, ratings: Ratings) -> Array:
    """Return for how long (8,) in s joints may be away; a leg's acceleration profile is given its time, to turn back too."""
    profile = ratings.profile
    is_ramped = profile.leg_velocity > 0.0 and profile.leg_acceleration > 0.0
    more = (profile.leg_velocity + closing_speed(ratings)) / profile.leg_acceleration if is_ramped else np.zeros(_N)
    return np.where(_IS_LEG, limits.leg_error_time + more, limits.wheel_error_time)


def frozen_limit(limits: SafetyLimits) -> Array:
    """Return by how many rad (8,) a joint should have turned, when it has not moved, at most."""
    return np.where(_IS_LEG, limits.frozen_leg, limits.frozen_wheel)


def is_frozen(limits: SafetyLimits, memory: JointMemory) -> Mask:
    """Return which joints (..., 8) repeat their reading while they should turn."""
    return np.abs(memory.unmoved) > frozen_limit(limits)


def is_lost(limits: SafetyLimits, ratings: Ratings, memory: JointMemory) -> Mask:
    """Return which joints (..., 8) have stayed away from their setpoints for too long."""
    return memory.away > error_time(limits, ratings)


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
