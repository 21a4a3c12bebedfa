"""The command limiter: the only one that writes setpoints and torque. Nothing drives but through it; nothing switches it off.

What is safe is decided in :mod:`wlr_gym.hardware.safety.rules`, by pure functions; here decisions are carried out.
"""

from __future__ import annotations

import contextlib
import math
from collections import Counter
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from wlr_gym.base.errors import InputError
from wlr_gym.data.format import Profile
from wlr_gym.hardware.config import Hardware
from wlr_gym.hardware.dynamixel.protocol import NoAnswerError
from wlr_gym.hardware.safety import preflight, rules
from wlr_gym.hardware.safety.preflight import Check, NotReadyError
from wlr_gym.hardware.safety.rules import Decision, Level, Memory
from wlr_gym.hardware.safety.status import RobotStatus, ratings_of
from wlr_gym.hardware.servos import JointReadings, Servos
from wlr_gym.hardware.timing import Clock
from wlr_gym.robot import JOINTS, LEGS, WHEELS, Robot

Array = NDArray[np.float64]

#: s of Bus Watchdog per count (e-manual).
WATCHDOG_UNIT = 0.02
#: s an answer may take at least while nothing moves: where no control step waits for it, a slow computer is no dead servo.
CALM_PATIENCE = 0.05
#: s an answer to torque off may take: an adapter that answers late (16 ms) is no servo that does not obey.
OFF_PATIENCE = 0.025
#: Times of it that a servo is waited for in a round: for a quiet line and an answer, of a write and a read.
OFF_WAITS = 4
#: Fastest setpoints of legs on the way to the start pose, over ``start_speed``: a minimum-jerk path needs 1.9 of it.
CALM_SPEED = 2.0
#: Times that the watchdogs are written and looked at.
_ARM_TRIES = 10
#: s between tries to switch off servos that do not confirm it.
_OFF_PAUSE = 0.05


def watchdog_count(seconds: float) -> int:
    """Return the count of Bus Watchdog; rounded up: what is judged by the limit has not tripped yet."""
    return math.ceil(seconds / WATCHDOG_UNIT - 1e-9)


def switch_off(servos: Servos, clock: Clock, seconds: float, quick: float, patience: float) -> list[str]:
    """Switch every motor off, and go on trying for so long; return the joints that did not confirm it.

    All buses at once and unconfirmed first, so that a dead one does not delay the others; then each servo until it has
    confirmed. A port that is gone is opened again when it is back. An answer may take ``quick`` s at first, so that a dead line
    delays nobody; after a quarter of the time ``patience`` s, while a round of such answers still ends in time.
    """
    for _ in range(2):
        servos.torque_off_unacknowledged()
    begin = clock.now()
    left: list[str] = list(JOINTS)
    while (left := servos.torque_off(1, left)) and (spent := clock.now() - begin) < seconds:
        clock.wait_until(clock.now() + _OFF_PAUSE)
        servos.reopen_gone()
        is_calm = spent > seconds / 4.0 and spent + OFF_WAITS * len(left) * patience < seconds
        servos.set_patience(patience if is_calm else quick)
    return left


class CommandLimiter:
    """Decides, limits and writes what the servos are sent.

    Args:
        servos: taken over; nobody else may keep them. robot, hardware: limits and registers.
        clock: of the run. period: s of a control step.
        dry_run: decide, but write nothing.
        profile: of the servos; all 0 = step references.

    Attributes:
        interventions: rule -> control steps in which it changed or stopped something.
        setpoints: (8,) last setpoints. torque_on: (8,) motors that are on.
        ratings: of the motors, with the limits of the servos' registers.
        armed: torque may be on.
        is_calm: legs may move no faster than on the way to the start pose, whatever is asked for.
    """

    def __init__(
        self,
        servos: Servos,
        robot: Robot,
        hardware: Hardware,
        clock: Clock,
        period: float,
        dry_run: bool = False,
        profile: Profile | None = None,
    ) -> None:
        self.__servos = servos
        self.robot, self.hardware, self.limits = robot, hardware, hardware.safety
        self.dry_run = dry_run
        self.profile: Profile = profile or Profile()
        self.interventions: Counter[str] = Counter()
        self.setpoints = np.zeros(len(JOINTS))
        self.torque_on = np.zeros(len(JOINTS), bool)
        self._clock = clock
        self.ratings = ratings_of(robot, period, hardware.measured.load_per_pwm)
        self._memory = Memory()
        self.armed = self.is_calm = False
        speed = min(self.limits.leg_speed, CALM_SPEED * self.limits.start_speed)
        self._calm_limits = self.limits.model_copy(update={"leg_speed": speed})

    # ---- reading: for everybody ----

    def read(self) -> JointReadings:
        """Read all joints; see :meth:`Servos.read`."""
        return self.__servos.read()

    @property
    def broken_packets(self) -> int:
        """Packets with a wrong checksum; see :attr:`Servos.broken_packets`."""
        return self.__servos.broken_packets

    def read_health(self) -> tuple[Array, Array]:
        """Return voltages and temperatures; see :meth:`Servos.read_health`."""
        return self.__servos.read_health()

    def check(self, reads: int) -> list[Check]:
        """Return all preflight checks. A watchdog that an earlier run left latched is cleared, where nothing else is wrong."""
        self.__servos.unsupervise()  # a servo that had no power meanwhile has lost its indirect addresses
        self.__servos.set_patience(max(CALM_PATIENCE, self.limits.patience))
        found, wrong = self._examine()
        if wrong and not self.dry_run and all(check.what == "watchdog" for check in wrong):
            preflight.mend(self.__servos, wrong)
            found, wrong = self._examine()
        if not wrong:
            self.__servos.set_patience(self.limits.patience)
            found.append(preflight.check_bus_speed(self.__servos, reads, self.limits.read_time, self._clock.now))
        return found

    def _examine(self) -> tuple[list[Check], list[Check]]:
        """Return the checks of the servos, and those of them that forbid driving."""
        found = preflight.check_servos(self.__servos, self.robot, self.hardware)
        return found, [check for check in found if not check.ok and check.is_fatal]

    # ---- life ----

    def prepare(self) -> None:
        """Set the registers that a run depends on, with torque off."""
        self._memory = Memory()
        self.__servos.set_patience(max(CALM_PATIENCE, self.limits.patience))
        low, high = self._register_limits()
        measured = self.hardware.measured.load_per_pwm
        self.ratings = ratings_of(self.robot, self.ratings.period, measured, low=low, high=high)
        if not self.dry_run:
            goal_pwm = self._prepare()
            self.ratings = replace(
                self.ratings,
                watchdog=watchdog_count(self.limits.watchdog),
                goal_pwm=goal_pwm,
                pwm_share=self.__servos.joint_map.pwm_share(goal_pwm),
                profile=self.profile,
            )
            self.__servos.supervise()

    def arm(self) -> None:
        """Ask for no motion, switch torque on, arm the watchdog; :meth:`prepare` comes first.

        Raises:
            NotReadyError: a leg has left its range since it was checked. Torque is off.
            NoAnswerError, RefusedError, BusGoneError: a servo did not take it. Torque may be on: call :meth:`off`.
        """
        position = self._positions()
        self._check_legs(position)
        self.armed = True
        self.setpoints = rules.resting(position)
        self.torque_on[:] = True
        if self.dry_run:
            self.__servos.set_patience(self.limits.patience)
            return
        servos = self.__servos
        servos.write_setpoints(self._within_registers(self.setpoints))
        self._confirm_setpoints()
        for joint in JOINTS:
            servos.set(joint, "torque_enable", 1)
        self.__servos.set_patience(self.limits.patience)
        self._arm_watchdogs()

    def _check_legs(self, position: Array) -> None:
        joint_map = self.__servos.joint_map
        counts = joint_map.setpoint_counts(rules.resting(position)).tolist()
        legs = list(zip(LEGS, counts, strict=False))
        checks = [preflight.check_leg(joint_map, self.robot, self.hardware, leg, count) for leg, count in legs]
        if wrong := "\n".join(str(check) for check in checks if not check.ok):
            raise NotReadyError(f"preflight: {wrong}")

    def _arm_watchdogs(self) -> None:
        """Arm all watchdogs at once, and see that they are: where one bus is waited for, those of the other one would trip."""
        count = watchdog_count(self.limits.watchdog)
        wrong: list[str] = []
        for _ in range(_ARM_TRIES):
            self.__servos.write_item("bus_watchdog", dict.fromkeys(JOINTS, count))
            held = self.__servos.get_all("bus_watchdog")
            wrong = [joint for joint in JOINTS if held.get(joint) != count]
            if not wrong:
                return
        raise NoAnswerError(f"the watchdog of {', '.join(wrong)} does not say that it is armed")

    def _prepare(self) -> Array:
        """Set the registers that a run depends on; return Goal PWM (8,) in counts."""
        servos, profile = self.__servos, self.profile
        leg = {"profile_velocity": profile.leg_velocity, "profile_acceleration": profile.leg_acceleration}  # rad/s, rad/s2
        wheel = {"profile_acceleration": profile.wheel_acceleration}
        goal_pwm = np.zeros(len(JOINTS))
        for k, joint in enumerate(JOINTS):
            goal_pwm[k] = servos.get(joint, "pwm_limit")
            servos.set(joint, "goal_pwm", int(goal_pwm[k]))
            preflight.reset_tuning(servos, joint)
            for item, value in (leg if joint in LEGS else wheel).items():
                count = round(value / servos.table(joint).per_count(item))
                servos.set(joint, item, count if value == 0.0 else max(1, count))  # 0 would be no profile at all
        return goal_pwm

    def _positions(self) -> Array:
        position = np.full(len(JOINTS), np.nan)
        for _ in range(3):
            readings = self.read()
            position = np.where(readings.answered, readings.position, position)
            if np.isfinite(position).all():
                return position
        raise NoAnswerError(f"no answer from {', '.join(JOINTS[k] for k in np.flatnonzero(np.isnan(position)))}")

    def _confirm_setpoints(self) -> None:
        """Raise :class:`InputError` where a servo holds another setpoint than the one that asks for no motion."""
        counts = self.__servos.joint_map.setpoint_counts(self._within_registers(self.setpoints))
        for joint, count in zip(JOINTS, counts.tolist(), strict=True):
            item = "goal_position" if joint in LEGS else "goal_velocity"
            held = self.__servos.get(joint, item)
            if held != count:
                raise InputError(f"{joint}: {item} is {held} after {count} was written; nothing was switched on")

    def _register_limits(self) -> tuple[Array, Array]:
        """Setpoints (8,) that the servos take, lowest and highest, rad and rad/s."""
        get, joint_map = self.__servos.get, self.__servos.joint_map
        ends = np.zeros((2, len(JOINTS)))
        for k, joint in enumerate(JOINTS):
            if joint in WHEELS:
                ends[:, k] = np.array([-1.0, 1.0]) * get(joint, "velocity_limit")
            else:
                ends[:, k] = get(joint, "min_position_limit"), get(joint, "max_position_limit")
        values = np.where(
            np.isin(JOINTS, LEGS), [joint_map.position(row) for row in ends], [joint_map.velocity(row) for row in ends]
        )
        return values.min(axis=0), values.max(axis=0)

    @property
    def written(self) -> Array:
        """Last setpoints (8,) as the servos' registers hold them: what they really follow."""
        return self.__servos.joint_map.written(self._within_registers(self.setpoints))

    def _within_registers(self, setpoints: Array) -> Array:
        return np.clip(setpoints, self.ratings.low, self.ratings.high)

    def write(self, wanted: object, status: RobotStatus, torque_on: NDArray[np.bool_] | None = None) -> Decision:
        """Decide on what was asked for, send what is allowed, and count what was changed.

        Nothing is sent on ``OFF``: the caller calls :meth:`off`.

        Raises:
            BusGoneError, NoAnswerError, RefusedError: a servo did not take it.
            InputError: it is not armed.
        """
        if not self.armed:
            raise InputError("the command limiter is not armed: nothing is written")
        limits = self._calm_limits if self.is_calm else self.limits
        decision = rules.decide(limits, self.ratings, status, self._memory, self.setpoints, wanted, torque_on)
        self._memory = decision.memory
        self.interventions.update({*decision.limited, *(verdict.rule for verdict in decision.verdicts)})
        if decision.level == Level.OFF:
            return decision
        self.setpoints = decision.setpoints
        if not self.dry_run:
            self.__servos.write_setpoints(self._within_registers(decision.setpoints))
            changed = decision.torque_on != self.torque_on
            for k in np.flatnonzero(changed):  # setpoints, just written, ask for what they are to do
                self.__servos.set(JOINTS[k], "torque_enable", int(decision.torque_on[k]))
        self.torque_on = decision.torque_on.copy()
        return decision

    def off(self) -> list[str]:
        """Switch every motor off, whatever happened before; return the joints that did not confirm it."""
        self.torque_on[:] = False
        if self.dry_run:
            self.armed = False
            return []
        self.__servos.unsupervise()
        left = switch_off(self.__servos, self._clock, self.limits.off_time, self.limits.patience, OFF_PATIENCE)
        with contextlib.suppress(ConnectionError):
            # it stays armed where a motor may still be on
            self.__servos.write_item("bus_watchdog", {joint: 0 for joint in JOINTS if joint not in left})
        self.armed = False  # not before: an interrupted attempt is made again
        return left
