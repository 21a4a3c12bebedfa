"""The commissioning tests: what each asks of the person, moves and measures; by name in :data:`TESTS`, in the order made."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from wlr_gym.base.errors import InputError, check_name
from wlr_gym.hardware.calibration import find_sign
from wlr_gym.hardware.commissioning.stand import (
    LARGEST_LEAN,
    LOW_PWM,
    PERIOD,
    PartlyError,
    Person,
    SlippedError,
    Stand,
    TroubleError,
)
from wlr_gym.hardware.dynamixel.bus import Block
from wlr_gym.hardware.dynamixel.protocol import RefusedError
from wlr_gym.robot import JOINTS, LEG_SLICE, LEGS, WHEEL_SLICE, WHEELS

Array = NDArray[np.float64]
Measure = Callable[[Stand, Person], None]


@dataclass(frozen=True)
class StandQuantity:
    """Something that a test measures."""

    name: str  #: goes into the hardware file where its ``measured`` section has a field of this name
    unit: str  #: SI unit; ``-`` is a pure number
    doc: str  #: what it is
    tolerance: float  #: by how much it may differ from what the emulated robot shows, in its unit ...
    remedy: str  #: what to do where it differs
    relative: float = 0.0  #: ... and beyond the tolerance as a part of it


@dataclass(frozen=True)
class StandTest:
    """A test of a robot on a stand.

    ``measure`` makes it, and notes what it measures (:meth:`Stand.note`). Torque may be on when it returns or fails: who calls
    switches off. It raises :class:`PartlyError` where it could not be made at some joints.
    """

    name: str  #: for ``--tests``
    title: str  #: what it shows, in a few words
    asks: str  #: what the person has to do; empty = keep hands off
    moves: str  #: what will move, for the question before the test
    quantities: tuple[StandQuantity, ...]  #: what it measures
    measure: Measure


#: Name -> test, in the order they are made: what cannot move first, hands first.
TESTS: dict[str, StandTest] = {}


def stand_test(name: str, title: str, asks: str, moves: str, *quantities: StandQuantity) -> Callable[[Measure], Measure]:
    """Make a function the measurement of a test in :data:`TESTS`; the arguments are those of :class:`StandTest`."""

    def add(measure: Measure) -> Measure:
        TESTS[name] = StandTest(name, title, asks, moves, quantities, measure)
        return measure

    return add


def choose(names: Sequence[str]) -> list[StandTest]:
    """Return the named tests in the order they are made; no name = all."""
    for name in names:
        check_name("test", name, TESTS)
    return [test for test in TESTS.values() if not names or test.name in names]


# ---- the line: adapters, and a servo that does not answer ----


#: Pings per bus.
_PINGS = 100
#: Bytes of a ping and its answer, bits per byte.
_PING_BYTES, _BITS = 10 + 14, 10
#: An id that no servo has.
_GHOST = 250
_TIMER = "Set the adapter's latency timer to 1 ms (docs/robot.md), use a port without a hub, end what loads the computer."
_ANSWERS = "part of the servos named {} the silent one that answer, {} read"
_CHAIN = "The emulator has this otherwise: report it. Reads that miss a servo cost another time than on the emulator."


@stand_test(
    "latency",
    "Latency and jitter of the adapters",
    "",
    "Nothing moves.",
    StandQuantity("adapter_latency", "s", "median time of a ping beyond its bytes' time on the wire", 0.0015, _TIMER),
    StandQuantity("adapter_jitter", "s", "99 of 100 pings take at most so much longer than the median", 0.002, _TIMER),
    StandQuantity("lost_answers", "-", "part of the pings without an answer", 0.005, "Check cable, ground and termination."),
)
def _measure_latency(stand: Stand, person: Person) -> None:
    for name, bus in stand.hardware.buses.items():
        missing = stand.servos.groups[name].statistics.missing
        lost, times = sum(missing.values()), []
        for _ in range(_PINGS):
            start = stand.clock.now()
            stand.servos.ping(bus.joints[0])
            times.append(stand.clock.now() - start - _PING_BYTES * _BITS / bus.baud_rate)
        median, slow = np.percentile(times, [50, 99]).tolist()
        stand.samples[f"ping_{name}"] = times
        stand.note("adapter_latency", name, median)
        stand.note("adapter_jitter", name, slow - median)
        stand.note("lost_answers", name, (sum(missing.values()) - lost) / _PINGS)


@stand_test(
    "silent_servo",
    "A read of several servos, one of which does not exist",
    "",
    "Nothing moves.",
    *(
        StandQuantity(f"answers_{place}_{kind}", "-", _ANSWERS.format(place, kind), 0.1, _CHAIN)
        for kind in ("ordinary", "fast")
        for place in ("before", "behind")
    ),
)
def _measure_silent_servo(stand: Stand, person: Person) -> None:
    for name, group in stand.servos.groups.items():
        first, *others = group.servos
        if not others:  # nobody is behind or before the silent one
            continue
        table = group.servos[first]
        block = Block(table, "realtime_tick", "present_position")
        for kind in ("ordinary", "fast"):
            asked = group.on_same_port(dict.fromkeys((first, _GHOST, *others), table))
            asked.fast = kind == "fast"
            start = stand.clock.now()
            asked.ask_all(block)
            answered = asked.answers()
            stand.samples[f"{kind}_read_{name}"] = [stand.clock.now() - start]
            stand.note(f"answers_behind_{kind}", name, sum(id in answered for id in others) / len(others))
            stand.note(f"answers_before_{kind}", name, first in answered)
        stand.servos.read()  # the line is quiet again


# ---- moved by hand, motors off: signs, zeros, the IMU's axes ----


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


@stand_test(
    "joints",
    "Sign and zero of every joint",
    "Each joint is to be turned by hand, one after the other; legs then held straight down.",
    "No motor comes on.",
    StandQuantity("joint_sign", "-", "1: the joint turns the way the hardware file says", 0.1, _CALIBRATE),
    StandQuantity("joint_zero", "rad", "reading of a leg that is held straight down, less pi/2", 0.04, _CALIBRATE),
)
def _measure_joints(stand: Stand, person: Person) -> None:
    for joint in JOINTS:
        stand.note("joint_sign", joint, _sign(stand, person, joint) * stand.hardware.joints[joint].sign)
        if joint in LEGS:
            person.straighten(joint)
            stand.note("joint_zero", joint, stand.step().position[JOINTS.index(joint)] - math.pi / 2)


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


def _counts(stand: Stand) -> list[int]:
    stand.step()
    counts = stand.servos.get_all("present_position")
    if missing := [joint for joint in JOINTS if joint not in counts]:
        raise TroubleError(f"no answer from {', '.join(missing)}")
    return [counts[joint] for joint in JOINTS]


@stand_test(
    "imu",
    "Axes of the IMU",
    "The robot with its stand is to be tilted to the right, nose down, and turned to the left.",
    "No motor comes on.",
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
)
def _measure_imu(stand: Stand, person: Person) -> None:
    level = _at_rest(stand)
    stand.note("gravity", "imu", np.linalg.norm(level))
    stand.note("level_tilt", "imu", math.acos(min(1.0, float(level[2] / np.linalg.norm(level)))))
    for k, name in enumerate(("roll", "pitch", "yaw")):
        person.tilt(_TILT_TIME, **{name: _TILT})
        rows = len(stand.run(_TILT_TIME))
        turned = stand.imu_rows(rows)[0].mean(axis=0) * rows * PERIOD
        whole = float(np.linalg.norm(turned))
        if whole < _LEAST_TILT:
            raise TroubleError(f"{name}: the gyroscope saw {math.degrees(whole):.0f} deg only, expected 20: turn the body")
        stand.note(f"gyro_{name}", "imu", turned[k] / whole)
        if name != "yaw":
            stand.note(f"tilt_{name}", "imu", _tilt(name, _at_rest(stand), level) / whole)
        person.tilt(_TILT_TIME)
        stand.run(_TILT_TIME)


def _at_rest(stand: Stand) -> Array:
    """Return the accelerometer's mean (3,), m/s2."""
    stand.run(_REST_ROWS * PERIOD)
    return stand.imu_rows(_REST_ROWS)[1].mean(axis=0)


def _tilt(name: str, force: Array, level: Array) -> float:
    """Return the roll or pitch (rad) since ``level`` that the accelerometer shows: right side down and nose down positive."""
    angles = [
        math.atan2(up[1], up[2]) if name == "roll" else math.atan2(-up[0], math.hypot(up[1], up[2])) for up in (force, level)
    ]
    return angles[0] - angles[1]


# ---- what servos do with setpoints: when the line falls silent, when torque comes on ----


#: rad/s of the wheels when the line falls silent, s until they turn evenly, s of silence beyond the watchdog's time.
_SPEED, _STEADY, _SILENCE = 2.0, 1.6, 0.8
_SLOW = 1.0
#: rad that a leg is asked to move by, and s it is given for it.
_LEAN, _LEAN_TIME = 0.1, 0.8
_STOP = "Do not drive until this is understood: nothing else stops the wheels when this computer dies."
_LEG_WEAK = "If the test load or stall differs too, the leg is weak or something holds it. Otherwise: "
_GIVEN = (
    "Torque-on drops a setpoint that was written before. Driving is safe if the kept setpoint is dropped, too. If not, joints "
    "go back to where the last run ended when torque comes on: switch power off and on before each start."
)
_KEPT = (
    "Torque-on takes up the setpoint left from before. Driving is safe if a given setpoint is followed: wlr writes one that "
    "asks for no motion first. If not, switch power off and on before each start."
)


@stand_test(
    "torque_on",
    "What torque-on does to the setpoint",
    "Legs straight down. One leg is to be turned by hand in between, motors off.",
    f"Wheels turn at {_SLOW:g} rad/s, and each leg moves by {_LEAN:g} rad.",
    StandQuantity("wheel_follows_given", "-", "speed over the setpoint written before torque came on", 0.15, _GIVEN),
    StandQuantity("wheel_follows_kept", "-", "speed over the setpoint left from before torque went off", 0.15, _KEPT),
    StandQuantity("leg_follows_given", "-", "way over the way asked for before torque came on", 0.2, _LEG_WEAK + _GIVEN),
    StandQuantity("leg_follows_kept", "-", "way over the way back to the setpoint from before torque went off", 0.2, _KEPT),
)
def _measure_torque_on(stand: Stand, person: Person) -> None:
    stand.prepare(WHEELS)
    stand.spin(dict.fromkeys(WHEELS, _SLOW))
    stand.switch_on(WHEELS)
    stand.note("wheel_follows_given", WHEELS, _even_speed(stand) / _SLOW)
    stand.switch_off(WHEELS)
    stand.run(0.4)
    stand.switch_on(WHEELS)
    stand.note("wheel_follows_kept", WHEELS, _even_speed(stand) / _SLOW)
    stand.switch_off(WHEELS)
    stand.prepare(LEGS)
    for leg in LEGS:
        stand.note("leg_follows_given", leg, _way(stand, leg, _LEAN) / _LEAN)
    person.turn(LEGS[0], -_LEAN)
    stand.note("leg_follows_kept", LEGS[0], _way(stand, LEGS[0]) / _LEAN)


def _way(stand: Stand, leg: str, asked: float = 0.0) -> float:
    """Return by how much (rad) a leg moves when its torque comes on; 0 = nothing is asked for, an old setpoint counts."""
    k = JOINTS.index(leg)
    start = stand.step().position[k]
    if asked:
        stand.lean(leg, asked)
    stand.switch_on([leg])
    end = stand.run(_LEAN_TIME)[-1].position[k]
    stand.switch_off([leg])
    return float(end - start)


def _even_speed(stand: Stand) -> Array:
    """Return the wheels' mean speed (4,) once they turn evenly, rad/s."""
    stand.run(_STEADY)
    return np.mean([readings.velocity[WHEEL_SLICE] for readings in stand.run(0.2)], axis=0)


@stand_test(
    "watchdog",
    "Bus Watchdog",
    "",
    f"All motors come on; wheels turn at {_SPEED:g} rad/s, then nothing is sent for a second.",
    StandQuantity(
        "watchdog_stop_time", "s", "way of a wheel after the last packet over its speed", 0.08, f"Too long: {_STOP}", 0.1
    ),
    StandQuantity("watchdog_leg_move", "rad", "way of a leg meanwhile", 0.02, "Is its Homing Offset 0 (wlr doctor)?"),
    StandQuantity("watchdog_latched", "-", "1: the watchdog register says that it stopped the servo", 0.1, _STOP),
    StandQuantity("watchdog_holds_torque", "-", "1: torque stays on", 0.1, "The emulator has this otherwise: report it."),
    StandQuantity("watchdog_refuses", "-", "1: setpoints are refused until it is cleared", 0.1, _STOP),
)
def _measure_watchdog(stand: Stand, person: Person) -> None:
    stand.prepare(JOINTS)
    stand.switch_on(JOINTS)
    stand.spin(dict.fromkeys(WHEELS, _SPEED))
    before = stand.run(_STEADY)[-1]
    speed = np.mean([readings.velocity[WHEEL_SLICE] for readings in stand.run(0.2)], axis=0)
    if (np.abs(speed) < 0.5 * _SPEED).any():
        raise TroubleError(f"wheels turn at {np.round(speed, 2).tolist()} rad/s, asked for {_SPEED:g}")
    last = stand.fall_silent(_SILENCE)
    after = stand.step()
    stand.note("watchdog_stop_time", WHEELS, (after.position - last.position)[WHEEL_SLICE] / speed)
    stand.note("watchdog_leg_move", LEGS, np.abs(after.position - before.position)[LEG_SLICE])
    stand.note("watchdog_latched", JOINTS, [stand.servos.get(joint, "bus_watchdog") < 0 for joint in JOINTS])
    stand.note("watchdog_holds_torque", JOINTS, [stand.servos.get(joint, "torque_enable") for joint in JOINTS])
    stand.note("watchdog_refuses", WHEELS, [_refuses(stand, wheel) for wheel in WHEELS])


def _refuses(stand: Stand, wheel: str) -> bool:
    try:
        stand.spin({wheel: 0.0})
    except RefusedError:
        return True
    return False


# ---- the wheels' velocity loop and load; stall of all joints ----


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


@stand_test(
    "velocity_step",
    "Step response of the wheels' velocity loop",
    "",
    f"Wheels turn at {_STEP:g} rad/s for {_STEP_TIME:g} s.",
    StandQuantity("velocity_loop_time", "s", "time constant of the way to a new speed", 0.0, _LOOP, 0.1),
    StandQuantity("integral_cycle", "s", "control cycle that this means, by the robot file's gains", 0.0, _LOOP, 0.1),
    StandQuantity("velocity_error", "-", "part of the speed that is missing in the end", 0.03, _LOOP),
)
def _measure_velocity_step(stand: Stand, person: Person) -> None:
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
    # Motor and rotor settle at once, so that speed, proportional and integral term balance: time = (K + kd) / kp, with K of the
    # torque-speed line. The robot file's kp holds for a cycle of 1 ms.
    servo = stand.robot.servo
    line = servo.supply_voltage / servo.wheel.no_load_speed
    for wheel, moments, speed in zip(WHEELS, np.array(times).T, np.array(speeds).T, strict=True):
        time = _time_constant(wheel, moments, speed)
        stand.note("velocity_loop_time", wheel, time)
        stand.note("integral_cycle", wheel, 1e-3 * time * servo.wheel.kp / (line + servo.wheel.kd))
        stand.note("velocity_error", wheel, 1.0 - speed[-_ROWS:].mean() / _STEP)


def _time_constant(wheel: str, times: Array, speed: Array) -> float:
    """Return the time constant (s) of the error's decay, fitted on the wheel's way; times of lost answers are NaN."""
    part = speed / _STEP
    late = np.flatnonzero(part > _FITTED[1])
    way = np.arange(len(part)) < (late[0] if len(late) else len(part))
    way &= (part > _FITTED[0]) & (part < _FITTED[1]) & np.isfinite(times)
    if way.sum() < 3:
        raise TroubleError(f"{wheel}: {way.sum()} rows on the way to {_STEP:g} rad/s, expected 3 or more: it does not follow")
    return float(-1.0 / np.polyfit(times[way], np.log(1.0 - part[way]), 1)[0])


@stand_test(
    "load",
    "Load of free wheels and legs, and what Present Load follows",
    "Legs straight down, then hands off.",
    f"Wheels turn at {', '.join(f'{speed:g}' for speed in _SPEEDS)} rad/s, each for {_EVEN:g} s; then each leg moves by "
    f"{LARGEST_LEAN:g} rad.",
    StandQuantity(
        "load_per_pwm", "-", "load over PWM from speed to speed, wheel free: 0 = it is torque, 1 = it is PWM", 0.3, _LAW
    ),
    StandQuantity(
        "running_load", "-", "load of the free wheel, or of the leg on its way, part of stall torque", 0.01, _FRICTION
    ),
)
def _measure_load(stand: Stand, person: Person) -> None:
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
        is_off = np.abs(reached - speed) > _OFF_SPEED * speed  # what it loads then says nothing
        if off := ", ".join(f"{WHEELS[k]} turns at {reached[k]:.2f}" for k in np.flatnonzero(is_off)):
            raise TroubleError(f"{off} rad/s after {_EVEN:g} s, expected {speed:g} within {_OFF_SPEED:.0%}: {_WEAK}")
    for k, wheel in enumerate(WHEELS):
        stand.samples |= {f"load_{wheel}": loads[:, k].tolist(), f"pwm_{wheel}": pwms[:, k].tolist()}
        stand.note("load_per_pwm", wheel, np.polyfit(pwms[:, k], loads[:, k], 1)[0])
        stand.note("running_load", wheel, loads[:, k].mean())
    stand.switch_off(WHEELS)  # before legs are prepared: on a slow line that takes longer than the watchdogs wait
    for leg in LEGS:
        stand.note("running_load", leg, _leg_load(stand, leg))


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


@stand_test(
    "stall",
    "Stall of held wheels and legs",
    "Each wheel, then each leg's end, is to be held by hand, one after the other. Legs straight down.",
    f"The held wheel or leg pulls for {_HELD_TIME:g} s with {LOW_PWM:.0%} of the supply.",
    StandQuantity("stall_pwm", "-", "PWM at the held joint over the Goal PWM", 0.05, "The servo does not keep to Goal PWM."),
    StandQuantity("stall_load", "-", "load of the held joint over PWM and supply", 0.05, _STALL, 0.1),
    StandQuantity("stall_current", "A", "current at full voltage, from the supply's display", 0.1, _STALL, 0.25),
)
def _measure_stall(stand: Stand, person: Person) -> None:
    slipped = []
    for joint in (*WHEELS, *LEGS):
        try:
            try:
                _pull(stand, person, joint)
            except SlippedError as error:  # once
                _pull(stand, person, joint, f"{error}. Once more. ")
        except SlippedError as error:
            slipped.append(str(error))
        person.release(joint)
    if slipped:
        raise PartlyError(f"not measured: {'; '.join(slipped)}")


def _pull(stand: Stand, person: Person, joint: str, trouble: str = "") -> None:
    """Measure a joint that a person holds; :class:`SlippedError` where it gives way."""
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
    stand.note("stall_pwm", joint, pwm / asked)
    stand.note("stall_load", joint, np.mean([stand.load(readings.effort)[k] for readings in rows]) / (pwm * supply))
    # a wheel draws this part of its stall current; a leg measures its own: it is its load
    if joint in WHEELS and (current := person.supply_current()) is not None:
        stand.note("stall_current", joint, current / (pwm * pwm * supply))
