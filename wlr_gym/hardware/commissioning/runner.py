"""Runs commissioning tests one after the other: motors off after each, logged, compared with the emulated robot.

What was measured goes into the hardware file (:func:`with_measurements`).
"""

from __future__ import annotations

import contextlib
import datetime
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path

from wlr_gym.base.errors import InputError
from wlr_gym.base.files import write_json
from wlr_gym.data.format import RunMeta
from wlr_gym.data.runs import next_run, write_run
from wlr_gym.hardware.commissioning.stand import (
    EmulatedPerson,
    PartlyError,
    Person,
    PowerError,
    QuitError,
    SkippedError,
    Stand,
    TrippedError,
    TroubleError,
)
from wlr_gym.hardware.commissioning.stand_tests import StandTest
from wlr_gym.hardware.config import Hardware, Measured, MeasuredValue
from wlr_gym.hardware.dynamixel.protocol import NoAnswerError, RefusedError
from wlr_gym.hardware.emulator.link import emulated_link
from wlr_gym.hardware.emulator.machine import MachineOptions
from wlr_gym.hardware.emulator.stand import EmulatedStand
from wlr_gym.hardware.link import Link
from wlr_gym.hardware.operator import stop_on_signals
from wlr_gym.hardware.safety.preflight import check_servos
from wlr_gym.hardware.safety.watchdog import Guard
from wlr_gym.robot import Robot

#: How a test can end.
DONE, SKIPPED, FAILED, STOPPED = "done", "skipped", "failed", "stopped"
#: Times that a test is made whose motors the Bus Watchdog stopped.
TRIES = 3
#: Of the emulated robot's sensor noise: other noise than that of an emulated robot under test, whose seed is 0.
_SEED = 1
#: Name of a quantity, and joint, bus or ``imu`` -> value.
Readings = dict[tuple[str, str], float]
_TROUBLE = (TroubleError, NoAnswerError, RefusedError, ConnectionError, InputError)


@dataclass(frozen=True)
class StandFinding:
    """A measured value beside the expected one."""

    quantity: str  #: name of what was measured
    where: str  #: joint, bus, or ``imu``
    unit: str  #: SI unit of the numbers
    measured: float  #: on this robot
    expected: float  #: on the emulated one
    tolerance: float  #: by which they may differ
    verdict: str  #: ``as expected`` or ``differs``, as a value does that is no number
    remedy: str  #: what to do where it differs

    @property
    def is_expected(self) -> bool:
        """Whether nothing is wrong with it."""
        return self.verdict == "as expected"


@dataclass(frozen=True)
class StandResult:
    """How a test went."""

    test: str  #: name
    state: str  #: one of :data:`DONE`, :data:`SKIPPED`, :data:`FAILED`, :data:`STOPPED` (nothing follows)
    reason: str = ""  #: why it is not done
    repeated: tuple[str, ...] = ()  #: why it was begun anew, once for each time
    run: str = ""  #: name of its measured run; empty = it has no rows
    time: str = field(default_factory=lambda: _now().isoformat(timespec="seconds"))  #: when it was over
    findings: tuple[StandFinding, ...] = ()  #: what was measured beside what was expected; of a failed test, where it was made

    @property
    def is_good(self) -> bool:
        """Whether it was made, or left out on purpose, and nothing differs."""
        return self.state in (DONE, SKIPPED) and all(finding.is_expected for finding in self.findings)


def _now() -> datetime.datetime:
    return datetime.datetime.now().astimezone()


def with_measurements(hardware: Hardware, findings: Iterable[StandFinding], earlier: Measured | None = None) -> Hardware:
    """Return the hardware with what was measured; values that were not stay, its own or ``earlier`` ones: the later of two."""
    kept = {name: dict(getattr(hardware.measured, name)) for name in Measured.model_fields}
    for name, values in kept.items():
        for where, value in getattr(earlier or Measured(), name).items():
            if where not in values or value.date >= values[where].date:
                values[where] = value
    today = _now().date().isoformat()
    for one in findings:
        if one.quantity in kept:
            value = float(f"{one.measured:.4g}")
            kept[one.quantity][one.where] = MeasuredValue(value=value, unit=one.unit, date=today)
    return hardware.model_copy(update={"measured": Measured(**{name: values for name, values in kept.items() if values})})


def compare(test: StandTest, measured: Readings, expected: Readings) -> tuple[StandFinding, ...]:
    """Return what was measured beside what the emulated robot showed, in the order it was measured."""
    quantities = {quantity.name: quantity for quantity in test.quantities}
    found = []
    for (name, where), value in measured.items():
        quantity, known = quantities[name], expected[name, where]
        tolerance = quantity.tolerance + quantity.relative * abs(known)
        is_expected = abs(value - known) <= tolerance
        verdict, remedy = ("as expected", "") if is_expected else ("differs", quantity.remedy)
        found.append(StandFinding(name, where, quantity.unit, value, known, tolerance, verdict, remedy))
    return tuple(found)


class Commissioning:
    """A robot on a stand, and an emulated one beside it that is put through the same. Use as a context manager.

    Args:
        robot, hardware, link: of the robot; closed. person: beside it.
        folder, meta: of runs and samples.
    """

    def __init__(self, robot: Robot, hardware: Hardware, link: Link, person: Person, folder: Path, meta: RunMeta) -> None:
        self._robot, self._hardware, self._link, self._person = robot, hardware, link, person
        self._folder, self._meta = folder, meta
        self._is_off = True
        self._stack = contextlib.ExitStack()

    def __enter__(self) -> Commissioning:
        emulated = EmulatedStand(self._robot, self._hardware, options=MachineOptions(seed=_SEED))
        with contextlib.ExitStack() as stack:
            stands = []
            for link in (self._link, emulated_link(emulated.machine)):
                stack.callback(link.close)
                link.open()
                stands.append(Stand(self._robot, self._hardware, link))
            self._stand, self._model = stands
            self._model_person = EmulatedPerson(emulated)
            self._stack = stack.pop_all()
        return self

    def __exit__(self, *error: object) -> None:
        self._stack.close()

    def faults(self) -> list[str]:
        """Return what stands against switching motors on, by the preflight checks."""
        checks = check_servos(self._stand.servos, self._robot, self._hardware)
        return [str(check) for check in checks if check.is_fatal and not check.ok]

    def make(self, tests: Sequence[StandTest]) -> Iterator[StandResult]:
        """Make the tests and yield how each went; the last one is the one that was stopped, if one was."""
        guard = Guard(self._robot, self._hardware, is_wanted=self._link.is_serial)
        guard.start(self._folder)
        self._stand.sign_of_life = guard.expect
        try:
            for test in tests:
                result = self._make(test)
                yield result
                if result.state == STOPPED:
                    return
        finally:
            if self._is_off:  # else it goes on trying when this process is gone
                guard.release()

    def _make(self, test: StandTest) -> StandResult:
        """Make a test; once more where the Bus Watchdog stopped its motors, for that is no fault of theirs."""
        repeated: list[str] = []
        while True:
            try:
                return self._try(test, tuple(repeated))
            except TrippedError as error:
                repeated.append(str(error))

    def _try(self, test: StandTest, repeated: tuple[str, ...]) -> StandResult:
        again = f"Once more, for {repeated[-1]}. " if repeated else ""
        state, reason = DONE, ""
        readings: Readings = {}
        expected: Readings = {}
        try:
            self._person.ready(f"{again}{test.title}. {test.moves} {test.asks or 'Hands off.'}")
        except SkippedError:
            return StandResult(test.name, SKIPPED, repeated=repeated)
        except QuitError:
            return StandResult(test.name, STOPPED, "asked to", repeated)
        try:
            readings = run_test(test, self._stand, self._person)
        except TrippedError as error:
            if len(repeated) + 1 < TRIES:
                raise
            state, reason = FAILED, f"{error}, in {TRIES} tries"
            self._stand.begin()  # no run: motors that were stopped did not follow its commands
        except SkippedError:
            return StandResult(test.name, SKIPPED, "no consent to go on", repeated)
        except QuitError as asked:
            state, reason = STOPPED, str(asked) or "asked to"
        except PowerError as error:
            self._is_off = False
            state, reason = STOPPED, str(error)
        except _TROUBLE as error:
            state, reason = FAILED, str(error)
            readings = self._stand.readings if isinstance(error, PartlyError) else {}
        try:
            expected = run_test(test, self._model, self._model_person) if readings else {}
        except QuitError as asked:  # a signal, while the emulated robot was put through it
            state, reason, readings = STOPPED, str(asked) or "asked to", {}
        findings = compare(test, readings, expected)
        result = StandResult(test.name, state, reason, repeated, self._log_run(), findings=findings)
        path = self._folder / f"{test.name}.json"
        if state != STOPPED or not path.exists():  # what an earlier session measured is not lost for a test that was not made
            write_json(path, asdict(result) | {"samples": self._stand.samples})
        return result

    def _log_run(self) -> str:
        """Write the test's rows as a measured run; return its name, or nothing where there is none or it is refused as one."""
        if table := self._stand.table():
            with contextlib.suppress(InputError):
                return write_run(next_run(self._folder, ".csv"), table, self._meta, robot=self._robot).name
        return ""


def run_test(test: StandTest, stand: Stand, person: Person) -> Readings:
    """Make a test and switch every motor off, whatever happens; signals end it in good order.

    Raises:
        TroubleError, NoAnswerError, RefusedError, ConnectionError, InputError: it could not be made, or (PartlyError) in part;
            TrippedError where a watchdog stopped a motor meanwhile, whatever else that led to.
        QuitError: somebody asked for a stop.
        PowerError: torque is not confirmed off.
    """
    stand.begin()
    with stop_on_signals(stand.operator):
        try:
            try:
                test.measure(stand, person)
            except (TroubleError, NoAnswerError, RefusedError):
                with contextlib.suppress(ConnectionError):
                    stand.check_watchdogs()  # a refused setpoint, a wheel that stands: it may be why
                raise
            stand.check_watchdogs()
        finally:
            if left := stand.off():
                raise PowerError(f"CUT THE POWER: torque is not confirmed off at {', '.join(left)}")
    return stand.readings
