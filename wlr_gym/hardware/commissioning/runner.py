"""Runs commissioning tests one after the other: motors off after each, logged, compared with the emulated robot."""

from __future__ import annotations

import contextlib
import datetime
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from wlr_gym.base.errors import InputError
from wlr_gym.base.files import write_json
from wlr_gym.data.format import RunMeta
from wlr_gym.data.record import next_run
from wlr_gym.data.write import write_run
from wlr_gym.hardware.commissioning.comparison import StandFinding, compare
from wlr_gym.hardware.commissioning.contract import Reading, StandTest
from wlr_gym.hardware.commissioning.emulated_person import EmulatedPerson
from wlr_gym.hardware.commissioning.errors import PowerError, QuitError, SkippedError, TroubleError
from wlr_gym.hardware.commissioning.person import Person
from wlr_gym.hardware.commissioning.stand import Stand
from wlr_gym.hardware.config import Hardware
from wlr_gym.hardware.dynamixel.errors import NoAnswerError, RefusedError
from wlr_gym.hardware.emulator.link import emulated_link
from wlr_gym.hardware.emulator.machine import MachineOptions
from wlr_gym.hardware.emulator.stand import EmulatedStand
from wlr_gym.hardware.link import Link
from wlr_gym.hardware.operator import stop_on_signals
from wlr_gym.hardware.safety.preflight import check_servos
from wlr_gym.hardware.safety.watchdog import WatchdogProcess
from wlr_gym.robot import Robot

#: How a test can end.
DONE, SKIPPED, FAILED, STOPPED = "done", "skipped", "failed", "stopped"
#: Of the emulated robot's sensor noise: other noise than that of an emulated robot under test, whose seed is 0.
_SEED = 1
_TROUBLE = (TroubleError, NoAnswerError, RefusedError, ConnectionError, InputError)


@dataclass(frozen=True)
class StandResult:
    """How a test went.

    Attributes:
        test: name.
        state: one of :data:`DONE`, :data:`SKIPPED`, :data:`FAILED`, :data:`STOPPED` (nothing follows).
        reason: why it is not done.
        findings: what was measured, and what was expected.
        run: name of its measured run; empty = it has no rows.
    """

    test: str
    state: str
    reason: str = ""
    findings: tuple[StandFinding, ...] = field(default=())
    run: str = ""

    @property
    def is_good(self) -> bool:
        """Whether it was made, or left out on purpose, and nothing differs."""
        return self.state in (DONE, SKIPPED) and all(finding.is_expected for finding in self.findings)


class Commissioning:
    """A robot on a stand, and an emulated one beside it that is put through the same.

    Use as a context manager.

    Args:
        robot, hardware: of the robot.
        link: to it, closed.
        person: beside it.
        folder: for runs and samples.
        meta: of the runs.
    """

    def __init__(self, robot: Robot, hardware: Hardware, link: Link, person: Person, folder: Path, meta: RunMeta) -> None:
        self._robot, self._hardware, self._link, self._person = robot, hardware, link, person
        self._folder, self._meta = folder, meta
        self._is_off = True
        self._stack = contextlib.ExitStack()

    def __enter__(self) -> Commissioning:
        with contextlib.ExitStack() as stack:
            self._stand = Stand(self._robot, self._hardware, self._opened(self._link, stack))
            emulated = EmulatedStand(self._robot, self._hardware, options=MachineOptions(seed=_SEED))
            self._model = Stand(self._robot, self._hardware, self._opened(emulated_link(emulated.machine), stack))
            self._model_person = EmulatedPerson(emulated)
            self._stack = stack.pop_all()
        return self

    def __exit__(self, *error: object) -> None:
        self._stack.close()

    def _opened(self, link: Link, stack: contextlib.ExitStack) -> Link:
        stack.callback(link.close)
        link.open()
        return link

    def faults(self) -> list[str]:
        """Return what stands against switching motors on, by the preflight checks."""
        checks = check_servos(self._stand.servos, self._robot, self._hardware)
        return [str(check) for check in checks if check.is_fatal and not check.ok]

    def make(self, tests: Sequence[StandTest]) -> Iterator[StandResult]:
        """Make the tests and yield how each went; the last one is the one that was stopped, if one was."""
        with self._guarded():
            for test in tests:
                result = self._make(test)
                yield result
                if result.state == STOPPED:
                    return

    @contextlib.contextmanager
    def _guarded(self) -> Iterator[None]:
        """Have a process beside this one that switches the motors of a real robot off when this one is killed."""
        watchdog = WatchdogProcess(self._robot, self._hardware, self._folder) if self._link.is_serial else None
        try:
            yield
        finally:
            if watchdog is not None and self._is_off:  # else it goes on trying when this process is gone
                watchdog.release()

    def _make(self, test: StandTest) -> StandResult:
        try:
            self._person.ready(f"{test.title}. {test.moves} {test.asks or 'Hands off.'}")
        except SkippedError:
            return StandResult(test.name, SKIPPED)
        except QuitError:
            return StandResult(test.name, STOPPED, "asked to")
        state, reason, readings = DONE, "", []
        try:
            readings = run_test(test, self._stand, self._person)
        except QuitError as asked:
            state, reason = STOPPED, str(asked) or "asked to"
        except PowerError as error:
            self._is_off = False
            state, reason = STOPPED, str(error)
        except _TROUBLE as error:
            state, reason = FAILED, str(error)
        expected = run_test(test, self._model, self._model_person) if readings else []
        result = StandResult(test.name, state, reason, tuple(compare(test, readings, expected)), self._log_run())
        write_json(self._folder / f"{test.name}.json", content_of(result) | {"samples": self._stand.samples})
        return result

    def _log_run(self) -> str:
        """Write the test's rows as a measured run; return its name, or nothing where there is none or it is refused as one."""
        table = self._stand.table()
        if not table:
            return ""
        try:
            return write_run(next_run(self._folder, ".csv"), table, self._meta, robot=self._robot).name
        except InputError:
            return ""


def run_test(test: StandTest, stand: Stand, person: Person) -> list[Reading]:
    """Make a test and switch every motor off, whatever happens; signals end it in good order.

    Raises:
        TroubleError, NoAnswerError, RefusedError, ConnectionError, InputError: it could not be made.
        QuitError: somebody asked for a stop.
        PowerError: torque is not confirmed off.
    """
    stand.begin()
    with stop_on_signals(stand.operator):
        try:
            readings = test.measure(stand, person)
        finally:
            left = stand.off()
            if left:
                raise PowerError(f"CUT THE POWER: torque is not confirmed off at {', '.join(left)}")
    return readings


def content_of(result: StandResult) -> dict[str, Any]:
    """Return a result as plain data, for JSON."""
    findings = [
        {
            "quantity": one.quantity.name,
            "where": one.where,
            "unit": one.quantity.unit,
            "measured": one.measured,
            "expected": one.expected,
            "tolerance": one.room,
            "verdict": one.verdict,
            "remedy": "" if one.is_expected else one.quantity.remedy,
        }
        for one in result.findings
    ]
    time = datetime.datetime.now().astimezone().isoformat(timespec="seconds")
    return {
        "test": result.test,
        "state": result.state,
        "reason": result.reason,
        "run": result.run,
        "time": time,
        "findings": findings,
    }
