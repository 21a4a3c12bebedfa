"""Tests of the wheels' servos: their velocity loop, what Present Load follows; and of all servos: load and stall."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from wlr_gym.hardware.commissioning.contract import PartlyError, Reading, StandQuantity, StandTest
from wlr_gym.hardware.commissioning.errors import SlippedError, TroubleError
from wlr_gym.hardware.commissioning.person import Person
from wlr_gym.hardware.commissioning.stand import LARGEST_LEAN, LOW_PWM, PERIOD, Stand
from wlr_gym.robot import JOINTS, LEGS, WHEEL_SLICE, WHEELS

#: rad/s of the step, s that are recorded, and the part of the step over which the response is fitted.
_STEP, _STEP_TIME, _FITTED = 3.0, 2.0, (0.3, 0.9)
#: rad/s at which the load is read, s until a wheel turns evenly, rows that are averaged.
_SPEEDS, _EVEN, _ROWS = (1.0, 2.0, 3.0), 1.4, 10
#: Part of the speed asked for that a wheel may be off it then; part of its way that a leg may be off.
_OFF_SPEED = 0.2
#: rad/s of a free leg whose load is read, s until it is on its way, rows on the way, s until it is there.
_LEG_SPEED, _LEG_START, _LEG_ROWS, _LEG_REST = 0.1, 0.4, 30, 0.6
#: s that a held joint pulls, and of it the rows that are averaged.
_HELD_TIME, _HELD_ROWS = 1.2, 20
#: rad/s below which a wheel counts as held, and rad that a held leg may give way: its motor pulls with all that it may then.
_HELD_SPEED, _HELD_WAY = 0.1, 0.05
_LOOP = "The servo's velocity loop is not the file's: gains in its registers, firmware, or the robot file's numbers for it."
_WEAK = "it does not follow; does something hold it, is its motor weak, its servo's PWM limited?"
_FRICTION = "It needs another torque to turn freely: a rubbing tyre, a tight screw, or a weak or worn motor."
_LAW = "Present Load follows something else than on the emulator: efforts of the wheels in logs mean that instead of torque."
_STALL = "Its motor is weaker or stronger than the file's: check supply and plugs; else exchange the servo, or measure again."


def _measure_velocity_step(stand: Stand, person: Person) -> list[Reading]:
    stand.prepare(WHEELS)
    stand.switch_on(WHEELS)
    stand.run(0.2)
    stand.spin(dict.fromkeys(WHEELS, _STEP))
    start = stand.clock.now()
    times, speeds = [], []
    while stand.clock.now() < start + _STEP_TIME:
        readings = stand.step()
        speeds.append(readings.velocity[WHEEL_SLICE])
        # when the servo took it: where an answer is waited for in vain, the others have been there for long
        times.append(stand.clock.now() - start - readings.age[WHEEL_SLICE])
    found = []
    for wheel, moments, speed in zip(WHEELS, np.array(times).T, np.array(speeds).T, strict=True):
        time = _time_constant(wheel, moments, speed)
        found += [
            Reading("velocity_loop_time", wheel, time),
            Reading("integral_cycle", wheel, _integral_cycle(stand, time)),
            Reading("velocity_error", wheel, float(1.0 - speed[-_ROWS:].mean() / _STEP)),
        ]
    return found


def _time_constant(wheel: str, times: NDArray[np.float64], speed: NDArray[np.float64]) -> float:
    """Return the time constant (s) of the error's decay, fitted on the wheel's way; times of lost answers are NaN."""
    part = speed / _STEP
    late = np.flatnonzero(part > _FITTED[1])
    way = np.arange(len(part)) < (late[0] if len(late) else len(part))
    way &= (part > _FITTED[0]) & (part < _FITTED[1]) & np.isfinite(times)
    if way.sum() < 3:
        raise TroubleError(f"{wheel}: {way.sum()} rows on the way to {_STEP:g} rad/s, expected 3 or more: it does not follow")
    return float(-1.0 / np.polyfit(times[way], np.log(1.0 - part[way]), 1)[0])


def _integral_cycle(stand: Stand, time: float) -> float:
    """Return the servo's control cycle (s) that a time constant means.

    Motor and rotor settle at once, so that speed, proportional and integral term balance: time = (K + kd) / kp, with K of the
    torque-speed line. The robot file's kp holds for a cycle of 1 ms.
    """
    servo = stand.robot.servo
    line = servo.supply_voltage / servo.wheel.no_load_speed
    return 1e-3 * time * servo.wheel.kp / (line + servo.wheel.kd)


VELOCITY_STEP = StandTest(
    "velocity_step",
    "Step response of the wheels' velocity loop",
    "",
    f"Wheels turn at {_STEP:g} rad/s for {_STEP_TIME:g} s.",
    (
        StandQuantity("velocity_loop_time", "s", "time constant of the way to a new speed", 0.0, _LOOP, 0.1),
        StandQuantity("integral_cycle", "s", "control cycle that this means, by the robot file's gains", 0.0, _LOOP, 0.1),
        StandQuantity("velocity_error", "-", "part of the speed that is missing in the end", 0.03, _LOOP),
    ),
    _measure_velocity_step,
)


def _measure_load(stand: Stand, person: Person) -> list[Reading]:
    stand.prepare(WHEELS)
    stand.switch_on(WHEELS)
    loads, pwms = np.empty((2, len(_SPEEDS), len(WHEELS)))
    for row, speed in enumerate(_SPEEDS):
        stand.spin(dict.fromkeys(WHEELS, speed))
        stand.run(_EVEN)
        seen = []
        for _ in range(_ROWS):
            readings = stand.step()
            values = readings.velocity, stand.load(readings.effort), stand.pwm()
            seen.append([value[WHEEL_SLICE] for value in values])
        reached, loads[row], pwms[row] = np.nanmean(np.array(seen), axis=0)
        _require_speed(speed, reached)
    found = []
    for k, wheel in enumerate(WHEELS):
        stand.samples |= {f"load_{wheel}": loads[:, k].tolist(), f"pwm_{wheel}": pwms[:, k].tolist()}
        slope = float(np.polyfit(pwms[:, k], loads[:, k], 1)[0])
        found += [Reading("load_per_pwm", wheel, slope), Reading("running_load", wheel, float(loads[:, k].mean()))]
    stand.switch_off(WHEELS)  # before legs are prepared: on a slow line that takes longer than the watchdogs wait
    return found + [Reading("running_load", leg, _leg_load(stand, leg)) for leg in LEGS]


def _leg_load(stand: Stand, leg: str) -> float:
    """Return the mean load of a free leg on a slow way, part of stall torque: a weak motor needs more for the same friction."""
    k = JOINTS.index(leg)
    stand.prepare([leg])
    stand.slow(leg, _LEG_SPEED)
    stand.switch_on([leg])
    start = stand.step().position[k]
    stand.lean(leg, LARGEST_LEAN)
    stand.run(_LEG_START)
    loads = [stand.load(readings.effort)[k] for readings in stand.run(_LEG_ROWS * PERIOD)]
    way = stand.run(_LEG_REST)[-1].position[k] - start
    stand.switch_off([leg])
    if abs(way - LARGEST_LEAN) > _OFF_SPEED * LARGEST_LEAN:
        raise TroubleError(f"{leg} moved by {way:.3f} rad, expected {LARGEST_LEAN:g} within {_OFF_SPEED:.0%}: {_WEAK}")
    return float(np.mean(loads))


def _require_speed(asked: float, reached: NDArray[np.float64]) -> None:
    """Raise :class:`TroubleError` where wheels are not at their speed: what they load then says nothing."""
    off = [(wheel, speed) for wheel, speed in zip(WHEELS, reached, strict=True) if abs(speed - asked) > _OFF_SPEED * asked]
    if off:
        slow = [f"{wheel} turns at {speed:.2f}" for wheel, speed in off]
        raise TroubleError(f"{', '.join(slow)} rad/s after {_EVEN:g} s, expected {asked:g} within {_OFF_SPEED:.0%}: {_WEAK}")


LOAD = StandTest(
    "load",
    "Load of free wheels and legs, and what Present Load follows",
    "Legs straight down, then hands off.",
    f"Wheels turn at {', '.join(f'{speed:g}' for speed in _SPEEDS)} rad/s, each for {_EVEN:g} s; then each leg moves by "
    f"{LARGEST_LEAN:g} rad.",
    (
        StandQuantity(
            "load_per_pwm", "-", "load over PWM from speed to speed, wheel free: 0 = it is torque, 1 = it is PWM", 0.3, _LAW
        ),
        StandQuantity(
            "running_load", "-", "load of the free wheel, or of the leg on its way, part of stall torque", 0.01, _FRICTION
        ),
    ),
    _measure_load,
)


def _measure_stall(stand: Stand, person: Person) -> list[Reading]:
    found: list[Reading] = []
    slipped = []
    for joint in (*WHEELS, *LEGS):
        try:
            found += _stall(stand, person, joint)
        except SlippedError as error:
            slipped.append(str(error))
        person.release(joint)
    if slipped:
        raise PartlyError(f"not measured: {'; '.join(slipped)}", found)
    return found


def _stall(stand: Stand, person: Person, joint: str) -> list[Reading]:
    """Return what a held joint shows; a person may let it slip once."""
    try:
        found, share = _pull(stand, person, joint)
    except SlippedError as error:
        found, share = _pull(stand, person, joint, f"{error}. Once more. ")
    current = person.supply_current() if joint in WHEELS else None  # legs measure theirs: it is their load
    return found if current is None else [*found, Reading("stall_current", joint, current / share)]


def _pull(stand: Stand, person: Person, joint: str, trouble: str = "") -> tuple[list[Reading], float]:
    """Return the readings of a joint that a person holds, and what part of the stall current the supply gives meanwhile.

    Raises:
        SlippedError: it gave way.
    """
    k = JOINTS.index(joint)
    person.brake(joint, trouble)
    stand.prepare([joint])  # now: a hand may have moved it
    asked = stand.weaken(joint)
    stand.switch_on([joint])
    start = stand.step().position[k]
    if joint in LEGS:
        stand.lean(joint, LARGEST_LEAN)
    else:
        stand.spin({joint: 2.0})
    stand.run(_HELD_TIME - _HELD_ROWS * PERIOD)
    rows = [stand.step() for _ in range(_HELD_ROWS)]
    person.watch_supply()
    pwm = float(abs(np.nanmean([stand.pwm()[k] for _ in range(_ROWS)])))
    supply = float(np.nanmean(stand.servos.read_health()[0])) / stand.robot.servo.supply_voltage
    stand.switch_off([joint])
    speed, way = float(np.mean([readings.velocity[k] for readings in rows])), rows[-1].position[k] - start
    if abs(speed) > _HELD_SPEED or (joint in LEGS and abs(way) > _HELD_WAY):
        raise SlippedError(f"{joint} turned by {way:.2f} rad, in the end at {speed:.2f} rad/s: hold it firmly")
    load = float(np.mean([stand.load(readings.effort)[k] for readings in rows]))
    found = [Reading("stall_pwm", joint, pwm / asked), Reading("stall_load", joint, load / (pwm * supply))]
    return found, pwm * pwm * supply


STALL = StandTest(
    "stall",
    "Stall of held wheels and legs",
    "Each wheel, then each leg's end, is to be held by hand, one after the other. Legs straight down.",
    f"The held wheel or leg pulls for {_HELD_TIME:g} s with {LOW_PWM:.0%} of the supply.",
    (
        StandQuantity(
            "stall_pwm", "-", "PWM at the held joint over the Goal PWM", 0.05, "The servo does not keep to Goal PWM."
        ),
        StandQuantity("stall_load", "-", "load of the held joint over PWM and supply", 0.05, _STALL, 0.1),
        StandQuantity("stall_current", "A", "current at full voltage, from the supply's display", 0.1, _STALL, 0.25),
    ),
    _measure_stall,
)
