"""The safety gate: the only thing that writes goals and torque. Nothing can be driven but through it, and it cannot be off.

What is safe is decided in :mod:`wlr_gym.hardware.safety.rules`, by pure functions; here decisions are carried out.
"""

from __future__ import annotations

import contextlib
import math
from collections import Counter
from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from wlr_gym.base.errors import InputError
from wlr_gym.data.format import Profile
from wlr_gym.hardware.config import Hardware
from wlr_gym.hardware.dynamixel.errors import NoAnswerError, RefusedError
from wlr_gym.hardware.link import Clock
from wlr_gym.hardware.safety import preflight as checks
from wlr_gym.hardware.safety import rules as safety
from wlr_gym.hardware.safety.rules import Decision, Memory, View
from wlr_gym.hardware.servos import JointReadings, Servos
from wlr_gym.robot import JOINTS, LEGS, WHEELS, Robot

Array = NDArray[np.float64]

#: Items in RAM that a run depends on; set to their defaults (profiles off) before torque comes on.
_PREPARED = (
    "profile_velocity",
    "profile_acceleration",
    "velocity_p_gain",
    "velocity_i_gain",
    "position_p_gain",
    "position_i_gain",
    "position_d_gain",
    "feedforward_1st_gain",
    "feedforward_2nd_gain",
)
#: s of Bus Watchdog per count (e-manual).
WATCHDOG_UNIT = 0.02
#: s an answer may take while nothing moves: where no tick waits for it, a slow computer is no dead servo.
CALM_PATIENCE = 0.05
#: Fastest goals of legs on the way to the start pose, over ``start_speed``: a minimum-jerk path needs 1.9 of it.
CALM_SPEED = 2.0
#: Times that the watchdogs are written and looked at.
_ARM_TRIES = 10
#: s between tries to switch off servos that do not confirm it.
_OFF_PAUSE = 0.05


class Gate:
    """Guards the servos.

    Args:
        servos: taken over; nobody else may keep them.
        robot, hardware: limits and registers.
        clock: of the run.
        period: s of a control tick.
        dry_run: decide, but write nothing.
        profile: of the servos; all 0 = step references.

    Attributes:
        interventions: rule -> ticks in which it changed or stopped something.
        goals: (8,) last goals. torque_on: (8,) motors that are on.
        frame: what the limits are about.
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
        self.profile = profile or Profile()
        self.interventions: Counter[str] = Counter()
        self.goals = np.zeros(len(JOINTS))
        self.torque_on = np.zeros(len(JOINTS), bool)
        self._clock = clock
        self.frame = safety.make_frame(robot, period)
        self._memory = Memory()
        self._armed = False
        self.is_calm = False
        speed = min(self.limits.leg_speed, CALM_SPEED * self.limits.start_speed)
        self._calm_limits = self.limits.model_copy(update={"leg_speed": speed})

    # ---- reading: for everybody ----

    def read(self) -> JointReadings:
        """Read all joints; see :meth:`Servos.read`."""
        return self.__servos.read()

    def read_health(self) -> tuple[Array, Array]:
        """Return voltages and temperatures; see :meth:`Servos.read_health`."""
        return self.__servos.read_health()

    def hardware_errors(self) -> dict[str, list[str]]:
        """Return joint -> hardware errors, of the joints that answer and have some."""
        found = {}
        for joint in JOINTS:
            with contextlib.suppress(NoAnswerError, RefusedError, ConnectionError):
                found[joint] = self.__servos.hardware_errors(joint)
        return {joint: errors for joint, errors in found.items() if errors}

    def latched(self, joints: Iterable[str]) -> list[str]:
        """Return those of the joints whose watchdog has stopped them, or that do not say."""
        return [joint for joint in joints if not self._listens(joint)]

    def _listens(self, joint: str) -> bool:
        try:
            return self.__servos.get(joint, "bus_watchdog") >= 0
        except (NoAnswerError, RefusedError):
            return False

    def check(self, reads: int) -> list[checks.Check]:
        """Return all start-up checks. A watchdog that an earlier run left latched is cleared, where nothing else is wrong."""
        self.__servos.set_patience(CALM_PATIENCE)
        found = self._examine()
        wrong = [check for check in found if not check.ok and check.is_fatal]
        if wrong and not self.dry_run and all(check.what == "watchdog" for check in wrong):
            checks.mend(self.__servos, wrong)
            found = self._examine()
            wrong = [check for check in found if not check.ok and check.is_fatal]
        if not wrong:
            self.__servos.set_patience(self.limits.patience)
            found.append(checks.check_bus_speed(self.__servos, reads, self.limits.read_time, self._clock.now))
        return found

    def _examine(self) -> list[checks.Check]:
        return checks.check_servos(self.__servos, self.robot, self.hardware)

    # ---- life ----

    @property
    def armed(self) -> bool:
        """Whether torque may be on."""
        return self._armed

    def arm(self) -> None:
        """Prepare registers, ask for no motion, switch torque on, arm the watchdog.

        Raises:
            NoAnswerError, RefusedError, BusGoneError: a servo did not take it. Torque may be on: call :meth:`off`.
        """
        self._memory = Memory()
        self.__servos.set_patience(CALM_PATIENCE)
        self.frame = safety.make_frame(self.robot, self.frame.period, *self._register_limits())
        self._armed = True
        if not self.dry_run:
            self._prepare()
        self.goals = safety.resting(self._positions())
        self.torque_on[:] = True
        if self.dry_run:
            self.__servos.set_patience(self.limits.patience)
            return
        servos = self.__servos
        servos.write_setpoints(self._within_registers(self.goals))
        self._confirm_goals()
        for joint in JOINTS:
            servos.set(joint, "torque_enable", 1)
        self.__servos.set_patience(self.limits.patience)
        self._arm_watchdogs()

    def _arm_watchdogs(self) -> None:
        """Arm all watchdogs at once, and see that they are: where one bus is waited for, those of the other one would trip."""
        count = math.ceil(self.limits.watchdog / WATCHDOG_UNIT - 1e-9)  # up: what is judged by the limit has not tripped yet
        wrong: list[str] = []
        for _ in range(_ARM_TRIES):
            self.__servos.write_item("bus_watchdog", dict.fromkeys(JOINTS, count))
            held = self.__servos.get_all("bus_watchdog")
            wrong = [joint for joint in JOINTS if held.get(joint) != count]
            if not wrong:
                return
        raise NoAnswerError(f"the watchdog of {', '.join(wrong)} does not say that it is armed")

    def _prepare(self) -> None:
        servos = self.__servos
        for joint in JOINTS:
            servos.set(joint, "goal_pwm", servos.get(joint, "pwm_limit"))
            for item in _PREPARED:
                default = servos.table(joint)[item].default
                assert isinstance(default, int)
                servos.set(joint, item, default)
            for item, value in self._profile_of(joint).items():
                count = round(value / servos.table(joint).per_count(item))
                servos.set(joint, item, count if value == 0.0 else max(1, count))  # 0 would be no profile at all

    def _profile_of(self, joint: str) -> dict[str, float]:
        """Profile registers of a joint, rad/s and rad/s2."""
        profile = self.profile
        if joint in LEGS:
            return {"profile_velocity": profile.leg_velocity, "profile_acceleration": profile.leg_acceleration}
        return {"profile_acceleration": profile.wheel_acceleration}

    def _positions(self) -> Array:
        position = np.full(len(JOINTS), np.nan)
        for _ in range(3):
            readings = self.read()
            position = np.where(readings.answered, readings.position, position)
            if np.isfinite(position).all():
                return position
        raise NoAnswerError(f"no answer from {', '.join(JOINTS[k] for k in np.flatnonzero(np.isnan(position)))}")

    def _confirm_goals(self) -> None:
        """Raise :class:`InputError` where a servo holds another goal than the one that asks for no motion."""
        counts = self.__servos.joint_map.setpoint_counts(self._within_registers(self.goals))
        for joint, count in zip(JOINTS, counts.tolist(), strict=True):
            item = "goal_position" if joint in LEGS else "goal_velocity"
            held = self.__servos.get(joint, item)
            if held != count:
                raise InputError(f"{joint}: {item} is {held} after {count} was written; nothing was switched on")

    def _register_limits(self) -> tuple[Array, Array]:
        """Goals (8,) that the servos take, lowest and highest, rad and rad/s."""
        get, joint_map = self.__servos.get, self.__servos.joint_map
        ends = np.zeros((2, len(JOINTS)))
        for k, joint in enumerate(JOINTS):
            if joint in WHEELS:
                ends[:, k] = get(joint, "velocity_limit")
                ends[0, k] *= -1
            else:
                ends[:, k] = get(joint, "min_position_limit"), get(joint, "max_position_limit")
        values = np.where(
            np.isin(JOINTS, LEGS), [joint_map.position(row) for row in ends], [joint_map.velocity(row) for row in ends]
        )
        return values.min(axis=0), values.max(axis=0)

    @property
    def written(self) -> Array:
        """Last goals (8,) as the servos' registers hold them: what they really follow."""
        return self.__servos.joint_map.written(self._within_registers(self.goals))

    def _within_registers(self, goals: Array) -> Array:
        return np.clip(goals, self.frame.low, self.frame.high)

    def write(self, wanted: object, view: View, torque_on: NDArray[np.bool_] | None = None) -> Decision:
        """Decide on what was asked for, send what is allowed, and count what was changed.

        Nothing is sent on ``OFF``: the caller calls :meth:`off`.

        Raises:
            BusGoneError, NoAnswerError, RefusedError: a servo did not take it.
            InputError: the gate is not armed.
        """
        if not self._armed:
            raise InputError("the safety gate is not armed: nothing is written")
        limits = self._calm_limits if self.is_calm else self.limits
        decision = safety.decide(limits, self.frame, view, self._memory, self.goals, wanted, torque_on)
        self._memory = decision.memory
        self.interventions.update({*decision.limited, *(verdict.rule for verdict in decision.verdicts)})
        if decision.level == safety.Level.OFF:
            return decision
        self.goals = decision.goals
        if not self.dry_run:
            self.__servos.write_setpoints(self._within_registers(decision.goals))
            self._switch(decision.torque_on)
        self.torque_on = decision.torque_on.copy()
        return decision

    def _switch(self, torque_on: NDArray[np.bool_]) -> None:
        """Switch single motors; their goals, just written, ask for what they are to do."""
        for k in np.flatnonzero(torque_on != self.torque_on):
            self.__servos.set(JOINTS[k], "torque_enable", int(torque_on[k]))

    def off(self) -> list[str]:
        """Switch every motor off, whatever happened before; return the joints that did not confirm it.

        All buses at once and unconfirmed first, so that a dead one does not delay the others; then each servo until it has
        confirmed. A port that is gone is opened again when it is back.
        """
        self._armed = False
        self.torque_on[:] = False
        if self.dry_run:
            return []
        servos = self.__servos
        for _ in range(2):
            servos.torque_off_unacknowledged()
        end = self._clock.now() + self.limits.off_time
        while (left := servos.torque_off(1)) and self._clock.now() < end:
            self._clock.wait_until(self._clock.now() + _OFF_PAUSE)
            servos.reopen_gone()
        with contextlib.suppress(ConnectionError):
            # it goes on guarding a motor that may still be on
            servos.write_item("bus_watchdog", {joint: 0 for joint in JOINTS if joint not in left})
        return left
