"""The control loop of a real robot: what happens from torque off to torque off.

::

    TORQUE_OFF --start()--> RAMP --start pose reached--> RUNNING --stop()--> STOPPING --> TORQUE_OFF
                              \\--- a verdict of the safety rules, an exception ---/ or FAULT

Making a loop opens nothing and moves nothing. ``start`` makes the preflight checks first, then switches torque on with
setpoints that ask for no motion. Whatever ends a run ends in :meth:`ControlLoop.stop`, which always switches torque off.
FAULT is for good: look at the robot, then make a new loop.

A control step follows the data: check, decide and limit, write; log; serve the operator, wait for the deadline, read.
"""

from __future__ import annotations

import atexit
import contextlib
import math
import sys
from collections import Counter
from collections.abc import Iterator
from dataclasses import replace
from enum import Enum
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from wlr_gym.base.errors import InputError
from wlr_gym.data.format import Profile, RunMeta
from wlr_gym.hardware.config import Hardware
from wlr_gym.hardware.dynamixel.protocol import NoAnswerError, RefusedError
from wlr_gym.hardware.link import Link, Sensing
from wlr_gym.hardware.log import RunRecorder, sensors_of
from wlr_gym.hardware.operator import Operator
from wlr_gym.hardware.safety.limiter import CommandLimiter
from wlr_gym.hardware.safety.preflight import NotReadyError
from wlr_gym.hardware.safety.rules import REQUESTS, Decision, Level, Verdict, resting
from wlr_gym.hardware.safety.status import RobotStatus
from wlr_gym.hardware.safety.watchdog import Guard
from wlr_gym.hardware.timing import Clock, Pacer
from wlr_gym.physics.plants.base import RobotOptions, Sensors
from wlr_gym.robot import JOINTS, LEG_SLICE, LEGS, WHEELS, Robot

Array = NDArray[np.float64]

#: Reads that are timed by the preflight checks.
TIMED_READS = 200
#: s in all that the way to the start pose may be held, by the operator's absence for one.
LONGEST_HOLD = 30.0
#: s that arming the servos may take, or the last tries to switch them off, before this process counts as hung.
ARM_TIME = 10.0
#: s the shortest way to the start pose takes.
SHORTEST_RAMP = 0.5
#: Fastest over mean speed of a minimum-jerk path.
PEAK_SPEED = 1.875
#: What a servo, a bus or the IMU can raise while it is talked to.
HARDWARE_TROUBLE = (NoAnswerError, RefusedError, ConnectionError)


class StoppedError(RuntimeError):
    """The robot has stopped, and its motors are off; the message says why."""


class Phase(Enum):
    """Where a run is; values are the names in the log."""

    TORQUE_OFF = "limp"
    RAMP = "ramp"
    RUNNING = "running"
    STOPPING = "stopping"
    FAULT = "fault"


class ControlLoop:
    """Drives one robot at a fixed rate.

    Use as a context manager, or call :meth:`close`: whatever happens, torque goes off.

    Args:
        robot, hardware: what is driven.
        link: its connections; taken over and opened by the first :meth:`start`.
        period: s of a control step.
        options: ``dry_run``, ``log``, ``guard`` and ``floor`` count here: what is not written, where logs go, whether a
            watchdog process starts (real ports only), which floor the logs name.
        meta: of the log; its profile is the servos'. None = robot's name, no profile.

    Attributes:
        phase: where it is.
        reason: why it stopped; with what was asked for meanwhile, and with the servos whose torque is not confirmed off.
        ended_well: nothing went wrong in the last run, which may have been stopped on request; torque is confirmed off.
        operator, pacer, recorder: requests; deadlines and statistics; logs.
        interventions: rule -> control steps in which it changed or stopped something.
    """

    def __init__(
        self,
        robot: Robot,
        hardware: Hardware,
        link: Link,
        period: float = 0.02,
        options: RobotOptions | None = None,
        meta: RunMeta | None = None,
    ) -> None:
        options = options or RobotOptions()
        if period >= (longest := hardware.safety.watchdog):
            raise InputError(
                f"control period {period:g} s: expected less than safety.watchdog, {longest:g} s: servos would stop"
            )
        meta = meta or RunMeta(robot=robot.name, profile=Profile(), notes="dry run" if options.dry_run else None)
        if options.floor is not None:
            meta = meta.model_copy(update={"floor": options.floor})
        self.robot, self.hardware, self.limits = robot, hardware, hardware.safety
        self.phase: Phase = Phase.TORQUE_OFF
        self.reason, self.ended_well = "", True
        self.clock: Clock = link.clock
        self.operator, self.pacer = Operator(link.clock), Pacer(link.clock, period)
        self.recorder: RunRecorder = RunRecorder(options.log, meta, robot, link)
        self._link, self._is_open = link, False
        self._limiter = CommandLimiter(link.servos, robot, hardware, link.clock, period, options.dry_run, meta.profile)
        self.interventions: Counter[str] = self._limiter.interventions
        self._sensing = Sensing(self._limiter, link, period)
        self._guard = Guard(robot, hardware, options.guard and link.is_serial and not options.dry_run)
        self._idle = self._read_at = 0.0  # s for which nothing was sent before the last reading, and when that was there

    def __enter__(self) -> ControlLoop:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, traceback: object) -> None:
        self.close("" if error is None else f"{type(error).__name__}: {error}")

    @property
    def status(self) -> RobotStatus | None:
        """What was last read; None = nothing yet."""
        return self._sensing.status

    @property
    def setpoints(self) -> Array:
        """Setpoints (8,) last sent, rad and rad/s."""
        return self._limiter.setpoints.copy()

    def sensors(self) -> Sensors:
        """Return what was last read as a plant's sensors; wheels from where they stood at the run's start."""
        return sensors_of(self._sensing.known, self.recorder.origin)

    def statistics(self) -> dict[str, Any]:
        """Return ticks, missed ones, percentiles of the timing (ms), the limiter's interventions, what camera and flow gave."""
        return {**self.pacer.statistics(), "interventions": dict(self.interventions), **self._sensing.statistics()}

    # ---- start-up ----

    def start(self, legs: ArrayLike | None = None) -> RobotStatus:
        """Check everything, switch torque on, ramp to the start pose; return what is read there.

        While RUNNING: stop the wheels and ramp from here; the log goes on in a new run.

        Args:
            legs: (4,) leg angles of the start pose, rad; None = home.

        Raises:
            StoppedError: a check failed, or the robot had to stop on the way.
            InputError: a port cannot be opened, the loop is in FAULT, or ``legs`` are not four finite numbers.
        """
        if self.phase is Phase.FAULT:
            raise InputError(f"the robot stopped with a fault ({self.reason}): look at it, then start anew")
        target = np.full(len(LEGS), self.robot.home.leg_angle) if legs is None else np.asarray(legs, np.float64)
        if target.shape != (len(LEGS),) or not np.isfinite(target).all():
            raise InputError(f"start pose {target}: expected four finite leg angles in rad")
        with self._stopping_on_trouble():
            if self.phase is Phase.TORQUE_OFF:
                self._switch_on()
            else:
                self.recorder.new_run()
            self._enter(Phase.RAMP)
            self._follow_ramp(target)
            self.recorder.origin = self._sensing.begin_run()
            self._enter(Phase.RUNNING)
        return self._sensing.known

    def _switch_on(self) -> None:
        """Torque off, and nothing known, to standing with torque on."""
        if not self._is_open:
            self._link.open()
            self._is_open = True
        self.reason = ""  # of the run before; what was asked for since then counts
        self.operator.note_sign()
        found = self._limiter.check(TIMED_READS)
        self.recorder.new_run([str(check) for check in found])
        if wrong := "\n".join(str(check) for check in found if check.is_fatal and not check.ok):
            self._fail(f"preflight: {wrong}")
        self._guard.start(self.recorder.folder)
        self._sensing.first()
        self.operator.serve()
        if self.operator.asked:
            self._fail(self.operator.asked, is_fault=False)
        self._limiter.prepare()
        self._sensing.first()  # again, after what takes a second: torque comes on under a body that stands now
        atexit.register(self.close)
        self._guard.expect(ARM_TIME)
        self._limiter.arm()
        self._idle = 0.0
        self.pacer.start()
        self._sensing.next()

    def _follow_ramp(self, target: Array) -> None:
        """Go to a start pose (4,), and see that the legs are there: not blocked, too weak, or held by the command limiter."""
        speed, fastest = self.limits.start_speed, self._limiter.profile.leg_velocity
        speed = min(speed, fastest / PEAK_SPEED) if fastest > 0.0 else speed  # legs with a velocity profile follow no faster
        way = minimum_jerk(self.setpoints[LEG_SLICE], target, speed, self.pacer.period)
        done = held = 0
        while done < len(way):
            worst = self._drive(way[done])
            if worst.level < Level.HOLD:
                done += 1
                continue
            held += 1  # held legs wait where they are, and so does their way
            if held * self.pacer.period > LONGEST_HOLD:
                self._fail(f"held for {LONGEST_HOLD:g} s on the way to the start pose: {worst.rule}: {worst.text}")
        position, limit = self._sensing.known.position, self.limits.start_error
        away = [
            f"{leg} is at {at:.2f} rad, its setpoint is {to:.2f} rad"
            for leg, at, to in zip(LEGS, position[LEG_SLICE], target, strict=True)
            if abs(at - to) > limit
        ]
        if away and not self._limiter.dry_run:
            self._fail(f"start pose: {'; '.join(away)} (limit {limit:g} rad)")

    # ---- drive ----

    def tick(self, wanted: object, torque_on: NDArray[np.bool_] | None = None) -> RobotStatus:
        """Drive one control step: send what the command limiter allows, wait for the deadline, read.

        Args:
            wanted: (8,) leg angles (rad) and wheel speeds (rad/s).
            torque_on: (8,) motors that are on; None = all.

        Raises:
            StoppedError: the robot has stopped.
        """
        if self.phase is not Phase.RUNNING:
            raise StoppedError(self.reason or "the robot has not been started")
        with self._stopping_on_trouble():
            self._drive(wanted, torque_on)
        return self._sensing.known

    def _drive(self, wanted: object, torque_on: NDArray[np.bool_] | None = None) -> Verdict:
        """Take a control step; return the worst verdict, if it lets the run go on."""
        worst = self._take_step(wanted, torque_on)
        if worst.level >= Level.STOP:
            self._fail(self.reason, is_fault=worst.rule not in REQUESTS, is_off=worst.level == Level.OFF)
        return worst

    def _take_step(self, wanted: object, torque_on: NDArray[np.bool_] | None = None) -> Verdict:
        """Send, log and receive; return the worst verdict, at once when torque must go off."""
        self._guard.expect(self.limits.heartbeat)
        status, decision = self._send(wanted, torque_on)
        worst = decision.worst
        if worst.level >= (Level.OFF if self.phase is Phase.STOPPING else Level.STOP):
            self._note_reason(f"{worst.rule}: {worst.text}")
        is_on = self._limiter.torque_on & (worst.level < Level.OFF)
        sent = np.where(is_on, self._limiter.written, np.nan)
        self.recorder.step(status, decision, sent, self._sensing.count)
        if worst.level < Level.OFF:
            self._receive()
        return worst

    def _send(self, wanted: object, torque_on: NDArray[np.bool_] | None) -> tuple[RobotStatus, Decision]:
        """Check what was last read, decide, limit and write; return what was known, and what was decided."""
        known, pacer, operator = self._sensing.known, self.pacer, self.operator
        is_answer = self.phase is Phase.RUNNING  # somebody answers what was read (a policy): time thinking and latency
        if is_answer:
            pacer.note("think", self.clock.now() - self._read_at)
        status = replace(
            known,
            late_ticks=pacer.late_ticks,
            late_share=pacer.late_share,
            operator_silence=operator.silence,
            idle=max(self._idle, self.clock.now() - known.time),
            trouble=self.recorder.trouble or self._guard.trouble or operator.trouble,
            asked_to_stop=operator.asked_to_stop,
            asked_off=operator.asked_off,
        )
        with pacer.timed("write"):
            decision = self._limiter.write(wanted, status, torque_on)
        if is_answer:
            pacer.note("latency", self.clock.now() - self._read_at)
        return status, decision

    def _receive(self) -> None:
        """Serve the operator in the time that is left, wait for the deadline, read."""
        sent = self.clock.now()
        self.operator.serve()
        self.pacer.wait()
        self._idle = self.clock.now() - sent
        with self.pacer.timed("read"):
            self._sensing.next()
        self._read_at = self.clock.now()

    # ---- stop ----

    def stop(self, reason: str = "end", is_fault: bool = False) -> None:
        """Stop the wheels, hold the legs, switch torque off. Does nothing when it has happened already.

        Motors that are off stay off: somebody may hold them. How it went is in ``reason`` and ``ended_well``; see also
        :meth:`finish`.

        Args:
            reason: for the log.
            is_fault: end in FAULT, not in TORQUE_OFF.
        """
        if self.phase not in (Phase.RAMP, Phase.RUNNING):
            return
        self.reason = self.reason or reason
        try:
            self._enter(Phase.STOPPING)
            for _ in range(round(self.limits.stop_time / self.pacer.period)):
                worst = self._take_step(resting(self.setpoints), self._limiter.torque_on.copy())
                if worst.level == Level.OFF:
                    is_fault = is_fault or worst.rule not in REQUESTS
                    break
        except HARDWARE_TROUBLE as error:
            is_fault = True
            self._note_reason(f"{type(error).__name__}: {error}")
        finally:
            self._switch_off(is_fault)

    def finish(self, reason: str) -> None:
        """Stop, as :meth:`stop`, and let nothing else that ended the run go unnoticed.

        Raises:
            StoppedError: the run did not end for this reason alone: something failed, torque is not confirmed off, or somebody
                asked for a stop meanwhile.
        """
        self.stop(reason)
        if self.reason != reason:
            raise StoppedError(self.reason)

    def close(self, reason: str = "") -> None:
        """Stop if need be, and close the ports. Does nothing the second time."""
        atexit.unregister(self.close)
        try:
            self.stop(reason or "end")
        finally:
            if self._limiter.armed:  # a stop that was interrupted
                self._switch_off(is_fault=True)
            if not self._limiter.armed and self.phase is not Phase.FAULT:
                self._guard.release()
            if self._is_open:
                self._is_open = False
                self._link.close()

    @contextlib.contextmanager
    def _stopping_on_trouble(self) -> Iterator[None]:
        """Turn trouble with the hardware into a stop; let everything else through after torque is off."""
        try:
            yield
        except StoppedError:
            raise
        except NotReadyError as error:
            self._fail(str(error))
        except HARDWARE_TROUBLE as error:
            self._fail(f"{type(error).__name__}: {error}", is_off=True)
        except BaseException as error:
            if self.phase in (Phase.RAMP, Phase.RUNNING):
                self.stop(f"{type(error).__name__}: {error}")
            elif self._limiter.armed:
                self._switch_off(is_fault=False)
            raise

    def _fail(self, reason: str, is_fault: bool = True, is_off: bool = False) -> None:
        """Bring the robot to rest and raise :class:`StoppedError`."""
        self.reason = reason
        if not self._limiter.armed:  # nothing was switched on, and what another program holds up must not be dropped
            self._guard.release()
            self._note_end(not is_fault)
            self.recorder.end(self.reason, self.statistics())
        elif is_off or self.phase is Phase.TORQUE_OFF:
            self._switch_off(is_fault)
        else:
            self.stop(reason, is_fault)
        raise StoppedError(self.reason)

    def _switch_off(self, is_fault: bool) -> None:
        """Torque off, logs closed."""
        left: list[str] = list(JOINTS)
        self.operator.is_switching_off = True
        self._guard.expect(self.limits.off_time + ARM_TIME)
        try:
            left = self._limiter.off()
        except BaseException:  # interrupted: once more, before the interruption goes on
            left = self._limiter.off()
            raise
        finally:
            self._note_end(not (is_fault or left))
            if left:
                demand = f"CUT THE POWER: torque is not confirmed off at {', '.join(left)}"
                self.reason = f"{self.reason}; {demand}"
                with contextlib.suppress(OSError, ValueError):  # the terminal may be gone
                    print(demand, file=sys.stderr, flush=True)  # who ended the run may not look at the reason
            self.operator.is_switching_off = False
            self._enter(Phase.FAULT if is_fault or left else Phase.TORQUE_OFF)
            self.recorder.end(self.reason, self.statistics())
            if left:
                self._guard.expect(math.inf)  # it has been said: nothing more is done here
            else:
                self._guard.release()

    def _note_end(self, is_well: bool) -> None:
        """Remember how the run ended. What was asked for until now has happened, and does not stop the next run."""
        self.ended_well = is_well
        if (asked := self.operator.take()) not in self.reason:
            self.reason = f"{self.reason}; {asked}"

    def _note_reason(self, reason: str) -> None:
        self.reason = f"{reason} (while stopping: {self.reason})" if self.phase is Phase.STOPPING else reason

    def _enter(self, phase: Phase) -> None:
        self.phase = phase
        self._limiter.is_calm = phase is Phase.RAMP
        self.recorder.phase(phase.value, self.reason)


def minimum_jerk(begin: Array, target: Array, speed: float, period: float) -> list[Array]:
    """Return the setpoints (8,) of every control step from one pose (4,) to another, wheels at rest; rad and rad/s.

    ``speed`` is the mean speed (rad/s) of the leg with the longest way.
    """
    steps = int(np.ceil(max(SHORTEST_RAMP, float(np.abs(target - begin).max()) / speed) / period))
    times = [step / steps for step in range(1, steps + 1)]
    shares = [s**3 * (10.0 - 15.0 * s + 6.0 * s * s) for s in times]
    return [np.concatenate([begin + share * (target - begin), np.zeros(len(WHEELS))]) for share in shares]
