"""A robot on a stand, wheels off the ground, and the person beside it: what commissioning tests may do with them, and no more.

Tests look at what servos do below the command limiter, so they do not go through it. This module is the only other one that
drives motors, with limits of its own that are lower: slow wheels, a leg by a few degrees, low PWM where something is held. The
Bus Watchdog is armed whenever a motor is on.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from wlr_gym.base.errors import InputError
from wlr_gym.data.format import COMMANDS
from wlr_gym.hardware.config import Hardware
from wlr_gym.hardware.dynamixel.protocol import NoAnswerError, RefusedError
from wlr_gym.hardware.emulator.stand import EmulatedStand
from wlr_gym.hardware.imu import ImuGoneError
from wlr_gym.hardware.link import Link
from wlr_gym.hardware.operator import Operator
from wlr_gym.hardware.safety.limiter import CALM_PATIENCE, WATCHDOG_UNIT, switch_off, watchdog_count
from wlr_gym.hardware.safety.preflight import reset_tuning
from wlr_gym.hardware.servos import JointReadings
from wlr_gym.robot import JOINTS, LEGS, WHEELS, Robot, full_name

Array = NDArray[np.float64]

#: s between the rows of a run.
PERIOD = 0.02
#: rad/s: fastest wheel.
TOP_SPEED = 3.0
#: rad that a leg may be asked to move by, and rad/s it moves with.
LARGEST_LEAN, LEAN_SPEED = 0.12, 0.5
#: rad: by which two readings of a leg at rest may differ.
_READING = 0.01
#: Part of the supply on a motor that is held: a wheel pulls with 0.3 N m, 9 N at the rim, a leg with 1.5 N m, 11 N at its end.
LOW_PWM = 0.2
#: Part of the stall torque above which a motor that should turn freely is blocked, and rows in a row.
BLOCKED, BLOCKED_ROWS = 0.4, 3
#: s beyond its waits that a stand is busy between two signs of life; and while it switches off.
LONGEST_BUSY, LONGEST_OFF = 2.0, 20.0


class TroubleError(RuntimeError):
    """A test cannot go on; the message says why. Torque goes off."""


class TrippedError(TroubleError):
    """The Bus Watchdog stopped a motor that a test drives: what was measured says nothing about the servo."""


class SlippedError(TroubleError):
    """A joint that was to be held gave way."""


class PartlyError(TroubleError):
    """A test could not be made at some joints; what it measured is of the others."""


class SkippedError(Exception):
    """The person does not want this test."""


class QuitError(Exception):
    """The person does not want to go on."""


class PowerError(Exception):
    """Torque is not confirmed off: nothing more is tried."""


class Person:
    """Hands and eyes beside a robot: a human, asked at a terminal. Nobody is asked anything while a motor is on.

    Args:
        ask: shows a text, waits for Enter, returns what was typed: ``q`` ends (:class:`QuitError`), anything but Enter or
            ``y`` is no consent (:class:`SkippedError`).
        is_asked_before: every test is asked for before it begins.
    """

    def __init__(self, ask: Callable[[str], str], is_asked_before: bool = True) -> None:
        self._ask = ask
        self._is_asked_before = is_asked_before

    def _answer(self, text: str) -> str:
        answer = self._ask(text).strip().lower()
        if answer in ("q", "quit"):
            raise QuitError
        return answer

    def _enter(self, text: str) -> None:
        if self._answer(text) not in ("", "y", "yes"):
            raise SkippedError

    def ready(self, test: str) -> None:
        """Agree to a test, told in words."""
        if self._is_asked_before:
            self._enter(f"{test} Enter starts, s skips, q ends.")

    def turn(self, joint: str, angle: float) -> None:
        """Turn a joint by ``angle`` (rad) in its positive direction, and leave it there."""
        if joint in LEGS:
            way = f"swing its foot to the {'back' if angle > 0 else 'front'}"
        else:
            way = f"roll it {'forward' if angle > 0 else 'backward'}"
        self._enter(f"{full_name(joint)}: {way} by about {abs(math.degrees(angle)):.0f} deg, leave it there, then Enter.")

    def straighten(self, leg: str) -> None:
        """Hold a leg straight down."""
        self._enter(f"{full_name(leg)}: hold it straight down, wheel's centre under the hip, then Enter.")

    def tilt(self, seconds: float, **angles: float) -> None:
        """Begin to turn the body to ``roll``, ``pitch`` or ``yaw`` (rad), be there within ``seconds``; none = level again."""
        names = {"roll": "right side down", "pitch": "nose down", "yaw": "nose to the left"}
        ways = [f"{names[name]} by about {math.degrees(angle):.0f} deg" for name, angle in angles.items()]
        way = " and ".join(ways) or "level, as it was before"
        self._enter(f"Robot: press Enter, then turn it {way}, smoothly within {seconds:g} s, and keep it still there.")

    def brake(self, joint: str, trouble: str = "") -> None:
        """Hold a wheel or a leg's end so that it does not turn, until :meth:`release`; ``trouble``: why it is asked again."""
        where = "the tyre firmly, away from gears and leg; watch the supply"
        if joint in LEGS:
            where = "its end firmly, away from the hip; it will push to the back"
        self._enter(f"{trouble}{full_name(joint)}: hold {where}. Then Enter.")

    def release(self, joint: str) -> None:
        """Let go of it."""
        self._answer(f"{full_name(joint)}: its motor is off, let go, then Enter.")

    def watch_supply(self) -> None:
        """Look at the current that the supply shows, now: a human does by himself."""

    def supply_current(self) -> float | None:
        """Return what it showed, A; None = not read."""
        while answer := self._answer("The supply's current while it was held, less the one before, A (Enter: not read)?"):
            with contextlib.suppress(ValueError):
                return float(answer)
        return None


class EmulatedPerson(Person):
    """Does with an emulated robot what is asked for, and agrees to everything."""

    def __init__(self, stand: EmulatedStand) -> None:
        super().__init__(lambda text: "")
        self._stand, self._current = stand, 0.0

    def turn(self, joint: str, angle: float) -> None:
        """Turn it."""
        self._stand.machine.turn(joint, angle)

    def straighten(self, leg: str) -> None:
        """Hold it straight."""
        self._stand.machine.straighten(leg)

    def tilt(self, seconds: float, **angles: float) -> None:
        """Tilt the body; it is there in about 2 s."""
        self._stand.tilt(**angles)

    def brake(self, joint: str, trouble: str = "") -> None:
        """Hold it."""
        self._stand.brake(joint)

    def release(self, joint: str) -> None:
        """Let go."""
        self._stand.release(joint)

    def watch_supply(self) -> None:
        """Note the current."""
        self._current = self._stand.wheel_current()

    def supply_current(self) -> float | None:
        """Return what was noted."""
        return self._current


class Stand:
    """A robot on a stand. Open its link before, close it afterwards.

    Args:
        robot, hardware: what it should be.
        link: to it.

    Attributes:
        servos: for reading; tests write with the methods below only.
        clock: of the link.
        operator: Ctrl-C and signals.
        readings: what a test measured: name of the quantity, and joint, bus or ``imu`` -> value in the quantity's unit.
        samples: what it notes beyond that and the rows.
        sign_of_life: told, while a motor is on, within how many seconds the next sign comes (inf: no motor is on). It is for
            the watchdog process.
    """

    def __init__(self, robot: Robot, hardware: Hardware, link: Link) -> None:
        self.robot, self.hardware = robot, hardware
        self.servos, self.clock = link.servos, link.clock
        self.operator: Operator = Operator(link.clock)
        self.readings: dict[tuple[str, str], float] = {}
        self.samples: dict[str, list[float]] = {}
        self.sign_of_life: Callable[[float], None] = lambda seconds: None
        self._imu = link.imu
        self._rows: list[Array] = []
        self._setpoints = np.full(len(JOINTS), np.nan)
        self._next = 0.0
        self._silent = self._blocked = 0
        self._armed: set[str] = set()
        self._on: set[str] = set()
        self._stall = np.repeat([robot.servo.leg.stall_torque, robot.servo.wheel.stall_torque], 4)
        self._last = np.zeros(3 * len(JOINTS))
        self.servos.set_patience(max(CALM_PATIENCE, hardware.safety.patience))

    # ---- rows ----

    def begin(self) -> None:
        """Begin a new run: no rows, nothing noted."""
        self._rows, self.readings, self.samples = [], {}, {}
        self._next = self.clock.now()
        self._silent = self._blocked = 0
        self._armed.clear()

    def note(self, quantity: str, places: str | Sequence[str], values: ArrayLike) -> None:
        """Take what was measured of a quantity: a value for a place, or one for each of several."""
        places, numbers = [places] if isinstance(places, str) else places, np.ravel(values).astype(float).tolist()
        self.readings |= {(quantity, place): value for place, value in zip(places, numbers, strict=True)}

    def step(self) -> JointReadings:
        """Wait for the next row's time, read everything, and note it; one lost answer leaves the values of the row before.

        Raises:
            TroubleError: a servo is silent, restarted, blocked or has an error.
            QuitError: somebody asked for a stop.
        """
        self._next = max(self._next + PERIOD, self.clock.now())
        self.wait_until(self._next)
        time, readings = self.clock.now(), self.servos.read()
        self._judge(readings)
        joints = np.concatenate([readings.position, readings.velocity, readings.effort])
        self._last = np.where(np.isnan(joints), self._last, joints)
        self._rows.append(np.concatenate([[time], self._setpoints, self._last, self._imu_row()]))
        position, velocity, effort = self._last.reshape(3, -1)
        return replace(readings, position=position, velocity=velocity, effort=effort)

    def run(self, seconds: float) -> list[JointReadings]:
        """Go on for so long; return the readings."""
        return [self.step() for _ in range(max(1, round(seconds / PERIOD)))]

    def wait_until(self, moment: float) -> None:
        """Let time pass without a word on the line.

        Raises:
            QuitError: somebody asked for a stop.
        """
        if self._on:
            self.sign_of_life(max(0.0, moment - self.clock.now()) + LONGEST_BUSY)
        self.clock.wait_until(moment)
        if asked := self.operator.take():
            raise QuitError(asked)

    def fall_silent(self, seconds: float) -> JointReadings:
        """Read a last time and return it, then say nothing for ``seconds`` more than the watchdogs' time: they trip."""
        last = self.step()
        self.check_watchdogs()
        self._armed.clear()
        self.wait_until(self.clock.now() + self.hardware.safety.watchdog + seconds)
        return last

    def check_watchdogs(self) -> None:
        """See that no watchdog has stopped a motor unasked; it does, and refuses setpoints, when nobody speaks for long.

        Raises:
            TrippedError: one has.
        """
        held = self.servos.get_all("bus_watchdog") if self._armed else {}
        if len(held) < len(JOINTS):  # waiting for the silent one took the time: it is the reason, not this computer
            return
        if tripped := [joint for joint in JOINTS if joint in self._armed and held.get(joint, 0) < 0]:
            raise TrippedError(
                f"{', '.join(tripped)}: stopped by the Bus Watchdog: this computer, or the bus, was silent for longer than "
                f"{watchdog_count(self.hardware.safety.watchdog) * WATCHDOG_UNIT:g} s"
            )

    def _judge(self, readings: JointReadings) -> None:
        silent = ~readings.answered
        self._silent = self._silent + 1 if silent.any() else 0
        if self._silent >= 2:
            raise TroubleError(f"no answer from {_names(silent)}")
        for mask, what in ((readings.alert, "a hardware error"), (readings.restarted, "restarted")):
            if mask.any():
                raise TroubleError(f"{_names(mask)}: {what}; see wlr doctor")
        strained = np.abs(np.nan_to_num(readings.effort)) > BLOCKED * self._stall
        self._blocked = self._blocked + 1 if strained.any() else 0
        if self._blocked >= BLOCKED_ROWS:
            raise TroubleError(f"{_names(strained)}: above {BLOCKED:.0%} of stall torque: does something hold it?")

    def _imu_row(self) -> Array:
        with contextlib.suppress(ImuGoneError):
            if (reading := self._imu.read()) is not None:
                return np.concatenate([reading.gyro, reading.accelerometer])
        return np.full(6, np.nan)

    def table(self) -> dict[str, Array]:
        """Return the rows since :meth:`begin` as columns of a measured run; empty without two rows."""
        if len(self._rows) < 2:
            return {}
        names = ["t", *COMMANDS, *(f"{kind}_{joint}" for kind in ("pos", "vel", "eff") for joint in JOINTS)]
        names += [f"{kind}_{axis}" for kind in ("gyro", "acc") for axis in "xyz"]
        table = dict(zip(names, np.array(self._rows).T, strict=True))
        for wheel in WHEELS:
            table[f"pos_{wheel}"] = table[f"pos_{wheel}"] - table[f"pos_{wheel}"][0]
        return table

    def imu_rows(self, count: int) -> tuple[Array, Array]:
        """Return gyroscope and accelerometer (count, 3) of the last rows that have them, rad/s and m/s2."""
        rows = np.array(self._rows[-count:])[:, -6:]
        rows = rows[np.isfinite(rows).all(axis=1)]
        if len(rows) < count // 2:
            raise TroubleError(f"imu: {len(rows)} readings in {count} rows; see wlr doctor")
        return rows[:, :3], rows[:, 3:]

    # ---- motors ----

    def prepare(self, joints: Iterable[str]) -> None:
        """Set what a test depends on: gains and profiles at their defaults, legs slow, all of the PWM, setpoints at rest."""
        for joint in joints:
            reset_tuning(self.servos, joint)
            self.servos.set(joint, "goal_pwm", self.servos.get(joint, "pwm_limit"))
            if joint in LEGS:
                self.slow(joint, LEAN_SPEED)
                self.servos.set(joint, "goal_position", self.servos.get(joint, "present_position"))
            else:
                self.servos.set(joint, "goal_velocity", 0)

    def slow(self, leg: str, speed: float) -> None:
        """Let a leg move at ``speed`` (rad/s) from now on, :data:`LEAN_SPEED` at most."""
        count = round(min(speed, LEAN_SPEED) / self.servos.table(leg).per_count("profile_velocity"))
        self.servos.set(leg, "profile_velocity", max(1, count))

    def switch_on(self, joints: Iterable[str]) -> None:
        """Switch torque on and arm the watchdogs; the servos' registers say what happens then.

        Raises:
            QuitError: somebody asked for a stop, during a question too.
            PartlyError: a leg would go farther than :data:`LARGEST_LEAN`.
        """
        if asked := self.operator.take():
            raise QuitError(asked)
        joints = list(joints)
        for leg in [joint for joint in joints if joint in LEGS]:
            way = self._register(leg, "goal_position") - self._register(leg, "present_position")
            if not abs(way) <= LARGEST_LEAN + _READING:  # a hand may have moved it
                raise PartlyError(f"{leg}: {way:+.2f} rad from its setpoint, expected {LARGEST_LEAN:g} at most: turn it less")
        self._on.update(joints)
        self.sign_of_life(LONGEST_BUSY)
        for joint in joints:
            goal = self._register(joint, "goal_position" if joint in LEGS else "goal_velocity")
            self._setpoints[JOINTS.index(joint)] = goal
            self.servos.set(joint, "torque_enable", 1)
        self._armed.update(joints)
        for joint in sorted(joints, key=lambda joint: JOINTS.index(joint) % len(LEGS)):  # no bus is silent for long meanwhile
            self.servos.set(joint, "bus_watchdog", watchdog_count(self.hardware.safety.watchdog))

    def switch_off(self, joints: Iterable[str]) -> None:
        """Switch single motors off, and disarm their watchdogs; what they are to do stays in their registers.

        With the last one the promise of a next sign of life ends: a person may take as long as he likes.
        """
        self.check_watchdogs()
        for joint in joints:
            self.servos.set(joint, "torque_enable", 0)
            self.servos.set(joint, "bus_watchdog", 0)
            self._armed.discard(joint)
            self._on.discard(joint)
            self._setpoints[JOINTS.index(joint)] = np.nan
        if not self._on:
            self.sign_of_life(math.inf)

    def _register(self, joint: str, item: str) -> float:
        """Return a register of a servo: an angle of a leg, rad, or a rate of a wheel, rad/s."""
        counts = np.zeros(len(JOINTS))
        k = JOINTS.index(joint)
        counts[k] = self.servos.get(joint, item)
        convert = self.servos.joint_map.position if joint in LEGS else self.servos.joint_map.velocity
        return float(convert(counts)[k])

    def spin(self, speeds: Mapping[str, float]) -> None:
        """Write wheel speeds, rad/s; acknowledged by each servo.

        Raises:
            InputError: faster than the stand allows.
        """
        limit = min(TOP_SPEED, self.hardware.safety.wheel_speed)
        for wheel, speed in speeds.items():
            if wheel not in WHEELS or not abs(speed) <= limit:
                raise InputError(f"{wheel}: {speed:g} rad/s, expected a wheel and {limit:g} rad/s at most")
            self._write_setpoint(wheel, "goal_velocity", speed)

    def lean(self, leg: str, angle: float) -> None:
        """Write a leg's setpoint ``angle`` (rad) beyond where it is now.

        Raises:
            InputError: farther than the stand allows, or out of the leg's range.
        """
        goal = float(self.servos.read().position[JOINTS.index(leg)]) + angle
        margin = self.hardware.safety.leg_margin
        low, high = self.robot.leg_limits[0] + margin, self.robot.leg_limits[1] - margin
        if leg not in LEGS or not abs(angle) <= LARGEST_LEAN or not low <= goal <= high:
            raise InputError(
                f"{leg}: by {angle:g} rad to {goal:.2f}, expected a leg, {LARGEST_LEAN:g} rad at most, and a goal in "
                f"{low:.2f} to {high:.2f}: put the legs straight down"
            )
        self._write_setpoint(leg, "goal_position", goal)

    def _write_setpoint(self, joint: str, item: str, value: float) -> None:
        k = JOINTS.index(joint)
        wanted = np.where(np.arange(len(JOINTS)) == k, value, 0.0)
        self.servos.set(joint, item, int(self.servos.joint_map.setpoint_counts(wanted)[k]))
        if not np.isnan(self._setpoints[k]):
            self._setpoints[k] = value

    def weaken(self, joint: str) -> float:
        """Let a motor have a small part of the supply only; return the part."""
        full = self.servos.table(joint).counts.full_pwm
        count = round(LOW_PWM * full)
        self.servos.set(joint, "goal_pwm", count)
        return count / full

    def pwm(self) -> Array:
        """Return the part of the supply on each motor (8,), -1 to 1 in the joints' directions; NaN without an answer."""
        counts = self.servos.get_all("present_pwm")
        found = np.array([counts.get(joint, np.nan) for joint in JOINTS], np.float64)
        return self.servos.joint_map.voltage_share(found)

    def load(self, effort: Array) -> Array:
        """Return efforts (..., 8) in N m as parts of the stall torque."""
        return effort / self._stall

    # ---- off ----

    def off(self) -> list[str]:
        """Switch every motor off and put the registers back, whatever happened; return the joints that did not confirm."""
        self.operator.is_switching_off = True
        try:
            self.sign_of_life(LONGEST_OFF)
            left = switch_off(self.servos, self.clock, self.hardware.safety.off_time, CALM_PATIENCE, CALM_PATIENCE)
            with contextlib.suppress(ConnectionError, NoAnswerError, RefusedError):
                is_off = [joint for joint in JOINTS if joint not in left]
                for joint in is_off:
                    self.servos.set(joint, "bus_watchdog", 0)
                self.prepare(is_off)
            self._on.clear()
            self.sign_of_life(math.inf)
            return left
        finally:
            self.operator.is_switching_off = False
            self._setpoints[:] = np.nan


def _names(mask: NDArray[np.bool_]) -> str:
    return ", ".join(JOINTS[k] for k in np.flatnonzero(mask))
