"""The control loop of a real robot: what happens from limp to limp.

::

    LIMP --start()--> RAMP --start pose reached--> RUNNING --stop()--> STOPPING --> LIMP
                        \\------- a verdict of the safety gate, an exception ------/ or FAULT

Making a loop opens nothing and moves nothing. ``start`` looks at everything first (start-up checks), then switches torque on
with goals that ask for no motion. Whatever ends a run ends in :meth:`ControlLoop.stop`, which always switches torque off.
FAULT is for good: look at the robot, then make a new loop.
"""

from __future__ import annotations

import atexit
import contextlib
import signal
import sys
import threading
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import replace
from enum import Enum
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from wlr_gym.base.errors import InputError
from wlr_gym.data.format import RunMeta
from wlr_gym.hardware.config import Hardware
from wlr_gym.hardware.dynamixel.errors import NoAnswerError, RefusedError
from wlr_gym.hardware.imu.reading import ImuGoneError, ImuReading
from wlr_gym.hardware.link import Link
from wlr_gym.hardware.log import RunLog, sensors_of
from wlr_gym.hardware.safety.limiter import Gate
from wlr_gym.hardware.safety.rules import (
    FINE,
    REQUESTS,
    STANDARD_GRAVITY,
    VERTICAL_BAND,
    Level,
    Verdict,
    View,
    next_up,
    plausible,
    resting,
    tilt_of,
)
from wlr_gym.hardware.safety.watchdog import Guard
from wlr_gym.hardware.timing import Pacer
from wlr_gym.robot import JOINTS, LEGS, Robot

Array = NDArray[np.float64]

#: Reads that are timed by the start-up checks; ticks between looks at voltage and temperature; s the IMU may take to speak.
TIMED_READS, HEALTH_TICKS, IMU_TIME = 200, 5, 0.5
#: s the shortest ramp takes; fastest over mean speed of a minimum-jerk path.
SHORTEST_RAMP, PEAK_SPEED = 0.5, 1.875
#: s in all that the way to the start pose may be held, by the operator's absence for one.
LONGEST_HOLD = 30.0
#: Signals that stop the robot, where the system has them.
STOP_SIGNALS = ("SIGINT", "SIGTERM", "SIGHUP", "SIGQUIT", "SIGTSTP")
#: What a servo, a bus or the IMU can raise while it is talked to.
HARDWARE_TROUBLE = (NoAnswerError, RefusedError, ConnectionError)


class StoppedError(RuntimeError):
    """The robot has stopped, and its motors are off; the message says why."""


class Phase(Enum):
    """Where a run is."""

    LIMP = "limp"
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
        period: s of a control tick.
        dry_run: everything but writing: torque stays off, nothing moves.
        log: folder for the logs of runs; None = none.
        guard: start a guard process (real ports only).
        meta: of the log; its profile is the servos'. None = robot's name, no profile.

    Attributes:
        phase: where it is.
        view: what was last seen.
        reason: why it stopped; with what was asked for meanwhile, and with the servos whose torque is not confirmed off.
        ended_well: nothing went wrong in the last run, which may have been stopped on request; torque is confirmed off.
        interventions: rule -> ticks in which the safety gate changed or stopped something.
        pacer: deadlines and statistics.
        log: of the present or last run.
        checks: what the start-up checks found.
        spare: called before torque comes on, and in every tick between writing and waiting, while there is time (keys,
            display).
    """

    def __init__(
        self,
        robot: Robot,
        hardware: Hardware,
        link: Link,
        period: float = 0.02,
        *,
        dry_run: bool = False,
        log: Path | None = None,
        guard: bool = True,
        meta: RunMeta | None = None,
    ) -> None:
        self.robot, self.hardware, self.limits = robot, hardware, hardware.safety
        self.phase = Phase.LIMP
        self.reason = ""
        self.ended_well = True
        self.dry_run = dry_run
        self.clock = link.clock
        self.pacer = Pacer(link.clock, period)
        self.log: RunLog | None = None
        self.checks: list[Any] = []
        self.spare: Callable[[], object] | None = None
        self._link = link
        self._is_open = False
        self._meta = meta or RunMeta(robot=robot.name, notes="dry run" if dry_run else None)
        self._gate = Gate(link.servos, robot, hardware, link.clock, period, dry_run, self._meta.profile)
        self._imu = link.imu
        self._log_folder = log
        self._wants_guard = guard and link.is_serial and not dry_run
        self._guard: Guard | None = None
        self._asked_to_stop = self._asked_off = ""
        self._log_trouble = self._terminal_trouble = ""
        self._is_switching_off = False
        self._operator_at = -np.inf
        self._rules: frozenset[str] = frozenset()
        self._ticks = 0
        self._started = 0.0
        self._read_at = 0.0
        self._idle = 0.0
        self._imu_reading: ImuReading | None = None
        self._wheel_zero = np.zeros(4)
        self.view: View | None = None

    # ---- life ----

    def __enter__(self) -> ControlLoop:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, traceback: object) -> None:
        self.close("" if error is None else f"{type(error).__name__}: {error}")

    @property
    def interventions(self) -> Counter[str]:
        """Rule -> ticks in which the safety gate changed or stopped something."""
        return self._gate.interventions

    @property
    def asked(self) -> str:
        """What somebody asked for that has not happened yet: a key, a signal; empty = nothing."""
        return self._asked_off or self._asked_to_stop

    @property
    def goals(self) -> Array:
        """Goals (8,) last sent, rad and rad/s."""
        return self._gate.goals.copy()

    def start(self, legs: ArrayLike | None = None) -> View:
        """Check everything, switch torque on, ramp to the start pose; return what is seen there.

        While RUNNING: stop the wheels and ramp from here; the log goes on in a new run.

        Args:
            legs: (4,) leg angles of the start pose, rad; None = home.

        Raises:
            StoppedError: a check failed, or the robot had to stop on the way.
            InputError: a port cannot be opened, or the loop is in FAULT.
        """
        if self.phase is Phase.FAULT:
            raise InputError(f"the robot stopped with a fault ({self.reason}): look at it, then start anew")
        target = np.full(len(LEGS), self.robot.home.leg_angle) if legs is None else np.asarray(legs, np.float64)
        if target.shape != (len(LEGS),) or not np.isfinite(target).all():
            raise InputError(f"start pose {target}: expected four finite leg angles in rad")
        with self._ending_well():
            if self.phase is Phase.LIMP:
                self._prepare()
            else:
                self._new_log()
            self._enter(Phase.RAMP)
            self._follow(target)
            self._check_pose(target)
            assert self.view is not None
            self._wheel_zero = self.view.position[4:].copy()
            self._started = self.view.time
            self._enter(Phase.RUNNING)
        return self.view

    def _prepare(self) -> None:
        """Limp, and unknown, to standing with torque on."""
        if not self._is_open:
            self._link.open()
            self._is_open = True
        self.reason = ""  # of the run before; what was asked for since then counts
        self._operator_at = self.clock.now()
        self.checks = self._gate.check(TIMED_READS)
        self._new_log()
        bad = [check for check in self.checks if not check.ok and check.is_fatal]
        if bad:
            self._fail("start-up checks: " + "\n".join(map(str, bad)))
        if self._wants_guard and self._guard is None:
            self._guard = Guard(self.robot, self.hardware, self._log_folder)
        self.view = self._first_look()
        self._serve_operator()
        if self.asked:
            self._fail(self.asked, is_fault=False)
        atexit.register(self.close)
        self._gate.arm()
        self._idle = 0.0
        self.pacer.start()
        self.view = self._look()

    def _new_log(self) -> None:
        if self._log_folder is None:
            return
        if self.log is not None:
            self.log.finish()
        self._log_trouble = ""
        self.log = RunLog(self._log_folder, self._meta)
        self.log.event(self.clock.now(), "checks", found=[str(check) for check in self.checks])

    def _follow(self, target: Array) -> None:
        """Go to a start pose on a minimum-jerk path."""
        begin = self.goals[: len(LEGS)]
        duration = max(SHORTEST_RAMP, float(np.abs(target - begin).max()) / self._ramp_speed())
        ticks = int(np.ceil(duration / self.pacer.period))
        done = held = 0
        while done < ticks:
            s = (done + 1) / ticks
            share = s**3 * (10.0 - 15.0 * s + 6.0 * s * s)
            worst = self._advance(np.concatenate([begin + share * (target - begin), np.zeros(4)]))
            if worst.level < Level.HOLD:
                done += 1
                continue
            held += 1  # held legs wait where they are, and so does their way
            if held * self.pacer.period > LONGEST_HOLD:
                self._fail(f"held for {LONGEST_HOLD:g} s on the way to the start pose: {worst.rule}: {worst.text}")

    def _ramp_speed(self) -> float:
        """Mean speed (rad/s) of the way to the start pose: one that legs with the servos' profile can follow."""
        fastest = self._gate.profile.leg_velocity  # 0 = no profile
        return min(self.limits.start_speed, fastest / PEAK_SPEED) if fastest > 0.0 else self.limits.start_speed

    def _check_pose(self, target: Array) -> None:
        """Stop where a leg has not come to the start pose: blocked, too weak, held by the safety gate."""
        if self.dry_run:
            return
        position = self._seen().position[: len(LEGS)]
        far = np.flatnonzero(np.abs(position - target) > self.limits.start_error)
        if len(far):
            found = "; ".join(f"{LEGS[k]} is at {position[k]:.2f} rad, its goal is {target[k]:.2f} rad" for k in far)
            self._fail(f"start pose: {found} (limit {self.limits.start_error:g} rad)")

    def tick(self, wanted: object, torque_on: NDArray[np.bool_] | None = None) -> View:
        """Drive one control tick: send what the safety gate allows, wait for the deadline, look.

        Args:
            wanted: (8,) leg angles (rad) and wheel speeds (rad/s).
            torque_on: (8,) motors that are on; None = all.

        Raises:
            StoppedError: the robot has stopped.
        """
        if self.phase is not Phase.RUNNING:
            raise StoppedError(self.reason or "the robot has not been started")
        with self._ending_well():
            if self._read_at > 0.0:
                self.pacer.note("think", self.clock.now() - self._read_at)
            return self._tick(wanted, torque_on)

    def _tick(self, wanted: object, torque_on: NDArray[np.bool_] | None = None) -> View:
        self._advance(wanted, torque_on)
        assert self.view is not None
        return self.view

    def _advance(self, wanted: object, torque_on: NDArray[np.bool_] | None = None) -> Verdict:
        """Exchange; return the worst verdict, if it lets the run go on."""
        worst = self._exchange(wanted, torque_on)
        if worst.level >= Level.STOP:
            self._fail(self.reason, is_fault=worst.rule not in REQUESTS, is_off=worst.level == Level.OFF)
        return worst

    def stop(self, reason: str = "end", is_fault: bool = False) -> None:
        """Stop the wheels, hold the legs, switch torque off. Does nothing when it has happened already.

        Motors that are off stay off: somebody may hold them. How it went is in ``reason`` and ``ended_well``; see also
        :meth:`finish`.

        Args:
            reason: for the log.
            is_fault: end in FAULT, not in LIMP.
        """
        if self.phase not in (Phase.RAMP, Phase.RUNNING):
            return
        self.reason = self.reason or reason
        try:
            self._enter(Phase.STOPPING)
            for _ in range(round(self.limits.stop_time / self.pacer.period)):
                worst = self._exchange(resting(self.goals), self._gate.torque_on.copy())
                if worst.level == Level.OFF:
                    is_fault = is_fault or worst.rule not in REQUESTS
                    break
        except HARDWARE_TROUBLE as error:
            is_fault = True
            self._note_reason(f"{type(error).__name__}: {error}")
        finally:
            self._off(is_fault)

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
            if self._gate.armed:  # a stop that was interrupted
                self._off(is_fault=True)
            if not self._gate.armed and self.phase is not Phase.FAULT:
                self._release_guard()
            if self._is_open:
                self._is_open = False
                self._link.close()

    def _off(self, is_fault: bool) -> None:
        """Torque off, logs closed."""
        left: list[str] = list(JOINTS)
        self._is_switching_off = True
        try:
            left = self._gate.off()
        finally:
            self._note_end(not (is_fault or left))
            if left:
                self._warn(f"CUT THE POWER: torque is not confirmed off at {', '.join(left)}")
            self._is_switching_off = False
            self._enter(Phase.FAULT if is_fault or left else Phase.LIMP)
            self._finish_log()
            if not left:
                self._release_guard()

    def _note_end(self, is_well: bool) -> None:
        """Remember how the run ended. What was asked for until now has happened, and does not stop the next run."""
        self.ended_well = is_well
        if asked := self.asked:
            if asked not in self.reason:
                self.reason = f"{self.reason}; {asked}"
            self._asked_to_stop = self._asked_off = ""

    def _warn(self, text: str) -> None:
        """Add to the reason, and tell the operator at once: who ended the run may not look at the reason."""
        self.reason = f"{self.reason}; {text}"
        with contextlib.suppress(OSError, ValueError):  # the terminal may be gone
            print(text, file=sys.stderr, flush=True)

    def _finish_log(self) -> None:
        if self.log is not None:
            with self._logging():
                self.log.event(self.clock.now(), "end", reason=self.reason, statistics=self.statistics())
            with self._logging():
                self.log.finish()

    @contextlib.contextmanager
    def _logging(self) -> Iterator[None]:
        """Let a log that cannot be written (a full disk) stop the robot in good order, and keep nothing from being done."""
        try:
            yield
        except OSError as error:
            self._log_trouble = self._log_trouble or f"the log cannot be written: {error}"

    def log_policy(self, names: list[str], values: Array) -> None:
        """Log what the policy was commanded and answered for the row that comes next; a log that fails stops the robot."""
        if self.log is not None and not self._log_trouble:
            with self._logging():
                self.log.policy(names, values)

    def _release_guard(self) -> None:
        if self._guard is not None:
            self._guard.release()
            self._guard = None

    @contextlib.contextmanager
    def _ending_well(self) -> Iterator[None]:
        """Turn trouble with the hardware into a stop; let everything else through after torque is off."""
        try:
            yield
        except StoppedError:
            raise
        except HARDWARE_TROUBLE as error:
            self._fail(f"{type(error).__name__}: {error}", is_off=True)
        except BaseException as error:
            if self.phase in (Phase.RAMP, Phase.RUNNING):
                self.stop(f"{type(error).__name__}: {error}")
            elif self._gate.armed:
                self._off(is_fault=False)
            raise

    def _fail(self, reason: str, is_fault: bool = True, is_off: bool = False) -> None:
        """Bring the robot to rest and raise :class:`StoppedError`."""
        self.reason = reason
        if not self._gate.armed:  # nothing was switched on, and what another program holds up must not be dropped
            self._note_end(not is_fault)
            self._finish_log()
        elif is_off or self.phase is Phase.LIMP:
            self._off(is_fault)
        else:
            self.stop(reason, is_fault)
        raise StoppedError(self.reason)

    def _enter(self, phase: Phase) -> None:
        self.phase = phase
        self._gate.is_calm = phase is Phase.RAMP
        if self.log is None or self._log_trouble:
            return
        with self._logging():
            self.log.event(self.clock.now(), "phase", phase=phase.value, reason=self.reason)
            if phase is Phase.RAMP:
                self.log.begin("ramp")
            elif phase is Phase.RUNNING:
                self.log.begin("run")

    # ---- requests from outside: signals, keys ----

    def ask_to_stop(self, reason: str) -> None:
        """Stop at the next tick, in good order."""
        self._asked_to_stop = self._asked_to_stop or reason

    def ask_off(self, reason: str) -> None:
        """Switch torque off at the next tick (emergency stop)."""
        self._asked_off = self._asked_off or reason

    def operator_is_there(self) -> None:
        """Take a sign of the operator (deadman)."""
        self._operator_at = self.clock.now()

    # ---- one tick ----

    def _exchange(self, wanted: object, torque_on: NDArray[np.bool_] | None = None) -> Verdict:
        """Write through the gate, log, wait for the deadline, look; return the worst verdict.

        Returns at once when torque must go off.
        """
        view = replace(
            self._seen(),
            late_ticks=self.pacer.late_ticks,
            late_share=self.pacer.late_share,
            operator_silence=self.clock.now() - self._operator_at,
            idle=max(self._idle, self.clock.now() - self._seen().time),
            trouble=self._log_trouble or self._terminal_trouble,
            asked_to_stop=self._asked_to_stop,
            asked_off=self._asked_off,
        )
        with self.pacer.timed("write"):
            decision = self._gate.write(wanted, view, torque_on)
        if self.phase is Phase.RUNNING:
            self.pacer.note("latency", self.clock.now() - self._read_at)
        # of equals, what was asked for: a stop in good order is one whatever else would have stopped the robot
        worst = max(decision.verdicts, key=lambda verdict: (verdict.level, verdict.rule in REQUESTS, verdict), default=FINE)
        self._note(view, decision, worst)
        if worst.level == Level.OFF:
            return worst
        sent = self.clock.now()
        self._serve_operator()
        self.pacer.wait()
        self._idle = self.clock.now() - sent
        with self.pacer.timed("read"):
            self.view = self._look()
        self._read_at = self.clock.now()
        return worst

    def _serve_operator(self) -> None:
        if self.spare is None:
            return
        try:
            self.spare()
        except OSError as error:
            self.spare = None
            self._terminal_trouble = f"the operator's terminal is gone: {error}"

    def _note(self, view: View, decision: Any, worst: Verdict) -> None:
        """Log the row, and each rule that begins to act; remember why the worst stopped the robot."""
        if worst.level >= (Level.OFF if self.phase is Phase.STOPPING else Level.STOP):
            self._note_reason(f"{worst.rule}: {worst.text}")
        if self.log is None or self._log_trouble:
            return
        with self._logging():
            self._write_row(self.log, view, decision)

    def _note_reason(self, reason: str) -> None:
        self.reason = f"{reason} (while stopping: {self.reason})" if self.phase is Phase.STOPPING else reason

    def _write_row(self, log: RunLog, view: View, decision: Any) -> None:
        goals = np.where(self._gate.torque_on & (decision.level < Level.OFF), self._gate.written, np.nan)
        log.row(view.time, sensors_of(view, self._wheel_zero, self._started), goals)
        rules = {verdict.rule: {"level": verdict.level.name, "text": verdict.text} for verdict in decision.verdicts}
        rules |= {rule: {"joints": [JOINTS[k] for k in np.flatnonzero(mask)]} for rule, mask in decision.limited.items()}
        for rule in rules.keys() - self._rules:
            log.event(view.time, "intervention", rule=rule, row=self._ticks, **rules[rule])
        self._rules = frozenset(rules)

    def _seen(self) -> View:
        if self.view is None:
            raise InputError("the robot has not been started")
        return self.view

    # ---- looking ----

    def _first_look(self) -> View:
        """Wait for the IMU; read everything once.

        Raises:
            StoppedError: a joint or the IMU does not answer.
        """
        end = self.clock.now() + IMU_TIME
        while (reading := self._imu.read()) is None or reading.age > self.limits.imu_silence:
            if self.clock.now() > end:
                self._fail("imu: no reading; check its port and power")
            self.clock.wait_until(self.clock.now() + self.pacer.period)
        readings = self._gate.read()
        if not readings.answered.all():
            readings = self._gate.read()
        if not readings.answered.all():
            silent = ", ".join(JOINTS[k] for k in np.flatnonzero(~readings.answered))
            self._fail(f"no answer from {silent}")
        size = float(np.linalg.norm(reading.accelerometer))
        if abs(size - STANDARD_GRAVITY) > VERTICAL_BAND:
            self._fail(
                f"imu: the accelerometer reads {size:.1f} m/s2, expected {STANDARD_GRAVITY:.1f} at rest: no tilt would be seen"
            )
        up = reading.accelerometer / size
        if tilt_of(up) > self.limits.tilt:
            self._fail(f"imu: the body leans by {tilt_of(up):.2f} rad, limit {self.limits.tilt:g}: it must stand, and be level")
        voltage, temperature = self._gate.read_health()
        self._ticks = 0
        self._imu_reading = reading
        return View(
            time=self.clock.now(),
            position=readings.position,
            velocity=readings.velocity,
            effort=readings.effort,
            silence=np.zeros(len(JOINTS)),
            alert=readings.alert,
            restarted=np.zeros(len(JOINTS), bool),
            voltage=np.where(np.isnan(voltage), self.robot.servo.supply_voltage, voltage),
            temperature=np.where(np.isnan(temperature), 0.0, temperature),
            gyro=reading.gyro,
            accelerometer=reading.accelerometer,
            imu_silence=reading.age,
            up=up,
        )

    def _look(self) -> View:
        """Read servos and IMU; what does not answer stays as it was, and its silence grows."""
        before = self._seen()
        now = self.clock.now()
        elapsed = now - before.time
        lost = ""
        view = replace(before, time=now)
        try:
            view = self._look_at_joints(before, now)
        except ConnectionError as error:
            lost = str(error)
        try:
            reading = self._imu.read()
            if reading is not None:
                self._imu_reading = reading
        except ImuGoneError:
            reading = None
        known = self._imu_reading
        assert known is not None
        if reading is None:
            return replace(view, lost=lost, imu_silence=before.imu_silence + elapsed)
        return replace(
            view,
            lost=lost,
            gyro=reading.gyro,
            accelerometer=reading.accelerometer,
            imu_silence=reading.age,
            up=next_up(before.up, reading.gyro, reading.accelerometer, elapsed),
        )

    def _look_at_joints(self, before: View, now: float) -> View:
        readings = self._gate.read()
        if not readings.answered.all() and not before.silence.any():
            again = self._gate.read()  # once, while there is time: a single lost packet costs nothing then
            fill = ~readings.answered
            readings = replace(
                readings,
                **{
                    name: np.where(fill, getattr(again, name), getattr(readings, name))
                    for name in ("position", "velocity", "effort", "answered")
                },
                alert=readings.alert | again.alert,
                restarted=readings.restarted | again.restarted,
            )
        good = readings.answered & plausible(self._gate.frame, before, np.nan_to_num(readings.position, nan=np.inf), now)
        heard_nothing = good & (before.silence > 0.0) & (before.silence + now - before.time > self.limits.watchdog)
        latched = self._gate.latched(JOINTS[k] for k in np.flatnonzero(heard_nothing))
        self._ticks += 1
        voltage, temperature = before.voltage, before.temperature
        if self._ticks % HEALTH_TICKS == 0 and good.all():
            fresh = self._gate.read_health()
            voltage = np.where(np.isnan(fresh[0]), voltage, fresh[0])
            temperature = np.where(np.isnan(fresh[1]), temperature, fresh[1])
        return replace(
            before,
            time=now,
            position=np.where(good, readings.position, before.position),
            velocity=np.where(good, readings.velocity, before.velocity),
            effort=np.where(good, readings.effort, before.effort),
            silence=np.where(good, 0.0, before.silence + (now - before.time)),
            alert=readings.alert,
            restarted=readings.restarted,
            voltage=voltage,
            temperature=temperature,
            latched=", ".join(latched) or before.latched,
        )

    def statistics(self) -> dict[str, Any]:
        """Return ticks, missed ones, percentiles of the timing (ms), and the safety gate's interventions."""
        return {**self.pacer.statistics(), "interventions": dict(self.interventions)}


@contextlib.contextmanager
def stop_on_signals(loop: ControlLoop) -> Iterator[None]:
    """Let signals stop the robot in good order at the next tick; the second one interrupts at once.

    Nothing interrupts switching torque off. Ctrl-Z (SIGTSTP) and Ctrl-\\ (SIGQUIT) are stops like Ctrl-C: a program that sleeps
    would leave torque on.

    Raises:
        KeyboardInterrupt: for the second signal, and at the end for one that came when the loop did not look any more.
    """
    heard = interrupted = False

    def take(number: int, _: object) -> None:
        nonlocal heard, interrupted
        name = signal.Signals(number).name
        if (heard or loop.asked) and not loop._is_switching_off:
            interrupted = True
            raise KeyboardInterrupt(name)
        heard = True
        loop.ask_to_stop(name)

    if threading.current_thread() is not threading.main_thread():
        yield
        return
    numbers = [getattr(signal, name) for name in STOP_SIGNALS if hasattr(signal, name)]
    before = {number: signal.signal(number, take) for number in numbers}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
    if heard and loop.asked and not interrupted:
        raise KeyboardInterrupt(loop.asked)
