"""A model of each joint next to its readings: what it can have done in a control step, and what it must have done.

A motor turns at ``no-load speed * (voltage - load)``, both as parts of the supply and of the stall torque: its line. Legs
measure their current, so voltage and current tell their speed whatever the encoder says. Wheels measure none: their load is at
most what half of the robot's weight lets a tyre pass on, unless ``wlr commission`` has found that Present Load is torque. What
the encoder says otherwise, summed up, is how far motor and reading have come :attr:`JointMemory.apart`. Where the load is
known, the line is learned while the joint is well, within the tolerances of the robot file.

Rules: ``jump`` (a reading further off than motor and speeds allow); ``frozen``, ``reversed``, ``encoder`` and
``current sensor`` (motor and reading come apart); ``tracking`` (a joint stays away from its setpoint); ``torque`` and
``register`` (not as written).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from wlr_gym.hardware.config import SafetyLimits
from wlr_gym.hardware.safety.status import IS_LEG, Array, Mask, Ratings, RobotStatus, between, each
from wlr_gym.hardware.servos import JointReadings
from wlr_gym.robot import JOINTS

#: rad by which a reading that stands still may rattle, 3 counts, and rad/s that it then shows.
RATTLE, RATTLE_SPEED = 0.005, 0.25
#: rad/s below which a wheel's setpoint need not move it: it may be less than its friction for long.
CREEP = 0.05
#: s in which the wheels' velocity loop follows.
WHEEL_LAG = 0.25
#: Part of the no-load speed: a leg that comes nearer to its setpoint faster than this follows it.
CLOSING = 0.2
#: Part by which a learned line may still be off, and times by which its mean error is exceeded.
LEARNED, MARGIN = 0.03, 4.0
#: Speed and load, parts of the line's ends, at which it is learned fastest; s in which its slopes are learned then, s in which
#: its doubts fall, and times slower that they rise. Both ends' parts together tell little below the last number.
FAST, HEAVY, LEARN_TIME, DOUBT_TIME, RISES, LITTLE = 0.1, 0.05, 10.0, 0.7, 5.0, 0.01
#: s in which a faster motion, or a larger load, counts as learned.
WIDEN_TIME = 0.4
#: s in which motor and reading of a leg that agree again are forgiven; a wheel's at once.
FORGIVEN = 0.5
#: Readings in a row that must tell the same before anything follows: one may be a spike.
SAMPLES = 2.0
#: s for which a current that does not change at all is taken for a sensor that is stuck, where motor and reading part.
STUCK_TIME = 0.04
#: rad by which a leg that follows its setpoint may be behind it: a reading that stands still then drifts, and is not frozen.
FOLLOWED = 0.03


class Suspicion(NamedTuple):
    """What is wrong with a joint: the rule, and what was found. Torque goes off, unless it is ``gentle``: then a stop."""

    rule: str
    text: str
    gentle: bool = False


@dataclass(frozen=True)
class JointMemory:
    """What lasts from step to step of the joints; arrays may be those of several robots, (N, 8)."""

    still_at: Array = field(default_factory=each(np.nan))  #: (8,) rad, reading since which only the encoder's last bits differ
    is_still: Mask = field(default_factory=each(False))  #: (8,) no more differed in the last reading
    position: Array = field(default_factory=each(np.nan))  #: (8,) rad, last read
    velocity: Array = field(default_factory=each(np.nan))  #: (8,) rad/s; a leg that turns back may repeat one, not both
    ramp: Array = field(default_factory=each(0.0))  #: (8,) rad/s, speed that the wheels' profile asks for by now; legs 0
    reference: Array = field(default_factory=each(0.0))  #: (8,) rad/s, speed that the wheels should have by now; legs 0
    speed_factor: Array = field(default_factory=each(1.0))  #: (8,) learned: no-load speed over nominal
    load_factor: Array = field(default_factory=each(1.0))  #: (8,) learned: load over what the nominal stall torque makes of it
    speed_doubt: Array = field(default_factory=each(np.inf))  #: (8,) part by which the line's speeds may still be off
    load_doubt: Array = field(default_factory=each(np.inf))  #: (8,) part by which its loads may still be off
    fastest: Array = field(default_factory=each(0.0))  #: (8,) part of the no-load speed up to which that holds
    heaviest: Array = field(default_factory=each(0.0))  #: (8,) part of the stall torque up to which that holds
    told: Array = field(default_factory=each(0.0))  #: (8,) rad/s, speed that the motor's line tells
    apart: Array = field(default_factory=each(0.0))  #: (8,) rad that motor or setpoint have gone and the reading has not
    current: Array = field(default_factory=each(np.nan))  #: (8,) N m, last current as a torque
    same_current: Array = field(default_factory=each(0.0))  #: (8,) s for which it has not changed at all
    behind: Array = field(default_factory=each(0.0))  #: (8,) rad from a leg to its setpoint
    away: Array = field(default_factory=each(0.0))  #: (8,) s for which a joint has stayed away from its setpoint


# ---- the model ----


def remember_joints(
    limits: SafetyLimits, ratings: Ratings, status: RobotStatus, memory: JointMemory, previous: Array, torque_on: Mask
) -> JointMemory:
    """Return the memory after a step with the setpoints (8,) and motors (8,) of the step before."""
    period, full = ratings.period, ratings.no_load_speed
    # driven, heard in this step, and telling their registers
    seen = torque_on & (status.silence == 0.0) & np.isfinite(status.registers.torque)
    supply = status.voltage / ratings.supply
    largest = full * ratings.pwm_share * supply  # no setpoint makes a wheel faster
    change = ratings.profile.wheel_acceleration * period or np.inf
    asked = between(-largest, previous, largest)
    ramp = np.where(torque_on & ~IS_LEG, memory.ramp + between(-change, asked - memory.ramp, change), 0.0)
    reference = np.where(torque_on, memory.reference + (ramp - memory.reference) * period / WHEEL_LAG, 0.0)
    same = (status.position == memory.position) & (status.velocity == memory.velocity)
    rattles = (np.abs(status.position - memory.still_at) <= RATTLE) & (np.abs(status.velocity) <= RATTLE_SPEED)
    is_still = same | rattles

    # the line, in parts of the no-load speed: what it tells beyond the encoder, and how much it may be off
    volts = status.registers.voltage_share * supply
    load = np.where(ratings.tells_load, memory.load_factor * status.effort / ratings.stall_torque, 0.0)
    free = volts - load
    told = memory.speed_factor * free
    speed_doubt, load_doubt = (np.minimum(doubt, ratings.line_error) for doubt in (memory.speed_doubt, memory.load_doubt))
    speed = status.velocity / full
    tells = np.isfinite(told)
    gap = np.where(tells, told - speed, 0.0)
    moves, loaded = np.abs(speed), np.abs(load)
    # no faster and no heavier than it was learned: what is right at small loads need not be so at large ones
    width = limits.line_noise + ratings.unknown_load + ratings.line_error * (moves + loaded)
    width -= (ratings.line_error - speed_doubt) * np.minimum(moves, memory.fastest)
    width -= (ratings.line_error - load_doubt) * np.minimum(loaded, memory.heaviest)
    beyond = full * (gap - between(-width, gap, width))
    should = between(np.minimum(ramp, 0.0), reference, np.maximum(ramp, 0.0))  # a wheel told to stop may stand at once
    # nor does one turn whose motor still brakes: the servo's integral needs its time to change sign
    beyond = np.where(~IS_LEG & is_still & (np.abs(should) > CREEP) & ~(volts * should < 0.0), should, beyond)
    most = frozen_limit(limits) / SAMPLES
    kept = np.where(beyond != 0.0, 1.0, np.where(IS_LEG, 1.0 - period / FORGIVEN, 0.0))
    apart = memory.apart * kept + between(-most, beyond * period, most)

    # learn while they agree, as fast as motion and load tell something
    teaches = np.where(seen & ratings.tells_load & (beyond == 0.0) & tells, period, 0.0)
    free, load, gap, moves, loaded = (np.where(teaches > 0.0, value, 0.0) for value in (free, load, gap, moves, loaded))
    step = teaches / LEARN_TIME * gap / (moves * moves + loaded * loaded + LITTLE)
    error = MARGIN * np.maximum(np.abs(gap) - limits.line_noise, 0.0) / (moves + loaded + LITTLE)
    error = between(LEARNED, error, ratings.line_error)
    low, high = 1.0 - ratings.line_error, 1.0 + ratings.line_error
    current = status.effort + ratings.idle_effort * status.velocity
    is_same = np.abs(current - memory.current) < 1e-9
    behind = previous - status.position
    off = seen & is_away(limits, ratings, status, behind, reference)
    away = np.where(off, memory.away + period, np.where(seen, 0.0, memory.away))
    return JointMemory(
        still_at=np.where(seen & ~is_still, status.position, memory.still_at),
        is_still=is_still,
        position=status.position,
        velocity=status.velocity,
        ramp=ramp,
        reference=reference,
        speed_factor=between(low, memory.speed_factor - step * free, high),
        load_factor=between(low, memory.load_factor + step * load, high),
        speed_doubt=learned_doubt(speed_doubt, error, teaches * np.minimum(moves / FAST, 1.0)),
        load_doubt=learned_doubt(load_doubt, error, teaches * np.minimum(loaded / HEAVY, 1.0)),
        fastest=memory.fastest + np.maximum(moves - memory.fastest, 0.0) * teaches / WIDEN_TIME,
        heaviest=memory.heaviest + np.maximum(loaded - memory.heaviest, 0.0) * teaches / WIDEN_TIME,
        told=np.where(tells, full * told, 0.0),
        apart=np.where(torque_on, np.where(seen, apart, memory.apart), 0.0),
        current=current,
        same_current=np.where(is_same, memory.same_current + period, 0.0),
        behind=behind,
        away=np.where(torque_on, away, 0.0),
    )


def learned_doubt(doubt: Array, error: Array, seconds: Array) -> Array:
    """Return how far a line may be off (8,) after it was off by ``error`` (8,) for a time (8,) in s."""
    change = (error - doubt) * seconds / DOUBT_TIME
    return doubt + np.where(change > 0.0, change / RISES, change)


def is_away(limits: SafetyLimits, ratings: Ratings, status: RobotStatus, behind: Array, reference: Array) -> Mask:
    """Return which joints (8,) are away from where, or how fast, they should be, and do not come nearer."""
    comes_nearer = status.velocity * np.sign(behind) > closing_speed(ratings)
    leg = (np.abs(behind) > limits.leg_error) & ~comes_nearer
    return np.where(IS_LEG, leg, np.abs(reference - status.velocity) > limits.wheel_error)


def closing_speed(ratings: Ratings) -> Array:
    """Return the speed (8,) in rad/s above which a leg follows its setpoint; a velocity profile is slower."""
    speed = CLOSING * ratings.no_load_speed
    profile = ratings.profile.leg_velocity
    return np.minimum(speed, 0.5 * profile) if profile > 0.0 else speed


# ---- readings that no motor can have made ----


def reach(limits: SafetyLimits, ratings: Ratings, seconds: Array) -> Array:
    """Return how far (8,) in rad joints can have turned in a time (8,) in s, whatever they did."""
    return limits.jump_speed * ratings.no_load_speed * seconds + limits.jump_noise


def possible_way(
    limits: SafetyLimits, ratings: Ratings, before: RobotStatus, readings: JointReadings, seconds: Array
) -> tuple[Array, Array]:
    """Return the way (8,) in rad that speeds and line of two readings tell, and how far (8,) in rad it may be off.

    A leg that is as fast as was read before and after has gone half of the sum; in between, its motor accelerates and brakes by
    a quarter of ``acceleration * seconds**2`` more at most. A wheel's rotor is too light to tell.
    """
    most = reach(limits, ratings, seconds)
    off = limits.jump_noise + 0.25 * ratings.acceleration * seconds**2
    told = 0.5 * seconds * (before.velocity + readings.velocity)
    tells = IS_LEG & (off + np.abs(told) < most)
    return np.where(tells, told, 0.0), np.where(tells, off, most)


def is_far(way: Array, told: Array, off: Array) -> Mask:
    """Return which ways (8,) in rad no motor can have made; see :func:`possible_way`."""
    return np.abs(way - told) > off


def unseen(ratings: Ratings, before: RobotStatus, time: float) -> Array:
    """Return for how long (8,) in s joints were not seen before an answer at ``time``.

    Not longer than until their first reading that was rejected: what stays impossible must not become possible by waiting.
    """
    elapsed = before.silence + np.maximum(time - before.time, ratings.period)
    return np.where(before.suspect, before.unseen, elapsed)


# ---- findings ----


def judge_joints(
    limits: SafetyLimits, ratings: Ratings, status: RobotStatus, memory: JointMemory, on: Mask
) -> Iterator[Suspicion]:
    """Yield what is wrong with joints.

    A joint that does not do what it is told cannot be stopped by setpoints either: torque goes off at once.
    """
    yield from _judge_registers(ratings, status, on)
    for k in np.flatnonzero(status.jump):
        reading = status.position[k] + status.jump[k]
        text = f"{JOINTS[k]} reads {reading:.2f} rad, {abs(status.jump[k]):.2f} rad from its reading {status.unseen[k]:.3f} s "
        text += f"before: no motor turns that far (limit {status.reach[k]:.2f} rad); check horn and encoder, exchange the servo"
        yield Suspicion("jump", text)
    for k in np.flatnonzero(is_apart(limits, memory)):
        yield _explain(limits, memory, int(k))
    for k in np.flatnonzero(is_lost(limits, ratings, memory)):
        seconds = f"for {memory.away[k]:.2f} s (limit {error_time(limits, ratings)[k]:.2f} s)"
        found = f"is at {status.position[k]:.2f} rad, more than {limits.leg_error:g} rad from its setpoint {seconds}"
        if not IS_LEG[k]:
            expected = f"expected {memory.reference[k]:.2f} within {limits.wheel_error:g}"
            found = f"turns at {status.velocity[k]:.2f} rad/s, {expected} {seconds}"
        remedy = "is it blocked, or its motor weak? Turn it by hand with torque off, check supply and gears"
        yield Suspicion("tracking", f"{JOINTS[k]} {found}: {remedy}")


def _explain(limits: SafetyLimits, memory: JointMemory, k: int) -> Suspicion:
    """Return why motor and reading of a joint came apart."""
    joint, speed, told, way = JOINTS[k], memory.velocity[k], memory.told[k], abs(memory.apart[k])
    limit, remedy = frozen_limit(limits)[k], "exchange the servo"
    if memory.same_current[k] >= STUCK_TIME and IS_LEG[k]:
        text = f"{joint}: its current reads the same for {memory.same_current[k]:.2f} s, and does not explain its motion "
        text += f"({way:.2f} rad, limit {limit:g}): {remedy}; its encoder may be well"
        return Suspicion("current sensor", text, gentle=True)
    if speed * told < 0.0 and abs(speed) > RATTLE_SPEED:
        text = f"{joint} turns at {speed:.2f} rad/s, its motor at {told:.2f} (by voltage and load): it runs away: encoder or "
        return Suspicion("reversed", text + "motor are reversed; check Drive Mode (wlr doctor), " + remedy)
    if memory.is_still[k]:
        text = f"{joint} reads {memory.position[k]:.3f} rad again and again while it should have turned by {way:.2f} rad "
        cause = "is it blocked? If not, its encoder has failed: "
        if IS_LEG[k] and abs(memory.behind[k]) < FOLLOWED:
            cause = "its setpoint is reached, and its motor turns on: its encoder drifts, or its current sensor is off: "
        return Suspicion("frozen", f"{text}(limit {limit:g} rad): {cause}{remedy}")
    share = "" if not told else f", {abs(speed / told):.0%} of that"
    text = f"{joint} reads {speed:.2f} rad/s{share} while its motor turns at {told:.2f} (by voltage and load), {way:.2f} "
    return Suspicion("encoder", f"{text}rad by now (limit {limit:g}): its encoder counts wrong, or it is blocked: {remedy}")


def _judge_registers(ratings: Ratings, status: RobotStatus, on: Mask) -> Iterator[Suspicion]:
    registers, end_others = status.registers, "end other programs on its bus"
    explained = status.restarted | status.alert  # these have rules of their own
    for k in np.flatnonzero(np.isfinite(registers.torque) & ~explained & (status.silence == 0.0)):
        joint, torque, watchdog, pwm = JOINTS[k], registers.torque[k], registers.watchdog[k], registers.goal_pwm[k]
        if torque != on[k]:
            text = f"{joint}: Torque Enable is {torque:.0f}, expected {on[k]:d}: it was switched or rebooted by something else"
            yield Suspicion("torque", f"{text}; check its supply and cable, {end_others}")
        elif watchdog >= 0.0 and watchdog != ratings.watchdog:
            text = f"{joint}: Bus Watchdog is {watchdog:.0f}, expected {ratings.watchdog:.0f}"
            yield Suspicion("register", f"{text}: it would not stop if this program died; {end_others}", gentle=True)
        if torque and pwm != ratings.goal_pwm[k]:
            text = f"{joint}: Goal PWM is {pwm:.0f}, expected {ratings.goal_pwm[k]:.0f}: something else changed its limit"
            yield Suspicion("register", f"{text}; {end_others}", gentle=True)


def error_time(limits: SafetyLimits, ratings: Ratings) -> Array:
    """Return for how long (8,) in s joints may be away; a leg's acceleration profile is given its time, to turn back too."""
    profile = ratings.profile
    is_ramped = profile.leg_velocity > 0.0 and profile.leg_acceleration > 0.0
    more = (profile.leg_velocity + closing_speed(ratings)) / profile.leg_acceleration if is_ramped else np.zeros(len(JOINTS))
    return np.where(IS_LEG, limits.leg_error_time + more, limits.wheel_error_time)


def frozen_limit(limits: SafetyLimits) -> Array:
    """Return by how many rad (8,) motor or setpoint may go without the reading."""
    return np.where(IS_LEG, limits.frozen_leg, limits.frozen_wheel)


def is_apart(limits: SafetyLimits, memory: JointMemory) -> Mask:
    """Return of which joints (..., 8) motor and reading have come apart."""
    return np.abs(memory.apart) > frozen_limit(limits)


def is_lost(limits: SafetyLimits, ratings: Ratings, memory: JointMemory) -> Mask:
    """Return which joints (..., 8) have stayed away from their setpoints for too long."""
    return memory.away > error_time(limits, ratings)
