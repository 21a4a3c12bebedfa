"""Commission a robot: scripted tests on a stand, wheels off the ground, each compared with the emulated robot.

Asks before each test; motors are off after each. Writes measured runs, a JSON per test, and what was measured into the hardware
file. Exit code 0: all as expected; 1: something differs, or a test could not be made.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.console import Console

from wlr_gym.base.errors import InputError
from wlr_gym.base.files import make_output_folder, refuse_existing, write_json
from wlr_gym.base.paths import find_config
from wlr_gym.cli import FAILED, OK
from wlr_gym.cli.options import ForceOption, JsonOption, PatchOption, RobotOption, refuse_given
from wlr_gym.cli.terminal import ask_terminal, print_json, print_table
from wlr_gym.robot import Robot

if TYPE_CHECKING:
    from wlr_gym.hardware.commissioning.runner import StandFinding, StandResult
    from wlr_gym.hardware.commissioning.stand import Person
    from wlr_gym.hardware.commissioning.stand_tests import StandTest
    from wlr_gym.hardware.config import Hardware, Measured
    from wlr_gym.hardware.link import Link

#: File in ``--out`` with all results.
REPORT = "commission.json"
#: File in ``--out``: the hardware file with what was measured.
COPY = "hardware.yaml"


@dataclass(frozen=True)
class CommissionOptions(JsonOption, ForceOption, RobotOption, PatchOption):
    out: Path | None = None
    """Folder for runs and results, made if it is not there; needed for all but --list."""
    tests: tuple[str, ...] = ()
    """Which tests to make; none = all. See --list. With --force, results of the others in --out are kept."""
    fault: tuple[str, ...] = ()
    """With --emulated: what goes wrong, as in wlr emulate: "delay legs value=0.015"."""
    list: bool = False
    """Show the tests."""
    yes: bool = False
    """Do not ask before each test, and write the hardware file; what hands have to do is asked for all the same."""


def run(options: CommissionOptions, ask: Callable[[str], str] | None = None) -> int:
    """Make the tests, print and write the results; 0 when all is as expected.

    ``ask`` shows a text and returns what was typed; None = the terminal.
    """
    from wlr_gym.hardware.commissioning.stand_tests import choose

    console = Console(soft_wrap=True, highlight=False, stderr=options.json)
    tests = choose(options.tests)
    if options.list:
        rows = [{"test": one.name, "what": one.title, "hands": one.asks or "off", "moves": one.moves} for one in tests]
        if options.json:
            print_json(rows)
        else:
            print_table(console, ("test", "what", "hands", "what moves"), [tuple(row.values()) for row in rows])
        return OK
    if options.out is None:
        raise InputError("--out: expected a folder for runs and results")
    if not options.emulated:
        refuse_given(options, ("fault",), "it is for the emulated robot: add --emulated")
    options.refuse_results(options.out, REPORT)
    if not (options.out / REPORT).is_file():  # a hardware file that no session wrote
        refuse_existing(options.out / COPY, options.force)
    make_output_folder(options.out)
    return _commission(options, options.out, tests, ask or partial(ask_terminal, what="commissioning"), console)


def _commission(
    options: CommissionOptions, out: Path, tests: Sequence[StandTest], ask: Callable[[str], str], console: Console
) -> int:
    from wlr_gym.data.format import RunMeta
    from wlr_gym.hardware.commissioning.runner import SKIPPED, STOPPED, Commissioning
    from wlr_gym.hardware.config import load_hardware

    robot, hardware = options.load()
    file = Path(options.hardware)  # one's own by its path, for others may have its name
    words = [f"robot '{robot.name}'", f"hardware '{file.resolve() if file.suffix else file}'"]
    named = ", ".join([*words, *(["emulated"] if options.emulated else []), *options.effects, *options.fault])
    earlier = _earlier(out / REPORT, named, tests, console)
    copy, source = out / COPY, find_config("hardware", options.hardware)
    if copy.exists() and copy.samefile(source):
        raise InputError(f"--out {out}: its {COPY} is the file of --hardware, and gets every value: choose another folder")
    measured = load_hardware(copy).measured if earlier and copy.is_file() else None
    link, person = _robot(options, robot, hardware, ask)
    results: list[StandResult] = []
    findings: list[StandFinding] = []
    with Commissioning(
        robot, hardware, link, person, out, RunMeta(robot=robot.name, notes="wlr commission, on a stand")
    ) as commissioning:
        if faults := commissioning.faults():
            console.print("\n".join([*faults, "Nothing was switched on: mend this first (wlr doctor)."]), style="bold red")
            return FAILED
        for result in commissioning.make(tests):
            results.append(result)
            findings += result.findings
            for reason in result.repeated:
                console.print(f"{result.test}: made once more: {reason}")
            console.print(f"{result.test}: {result.state}{f': {result.reason}' if result.reason else ''}")
            if result.state not in (SKIPPED, STOPPED) or result.test not in earlier:  # else what is there stays
                earlier.pop(result.test, None)
                earlier[result.test] = asdict(result) | {"robot": named}
            write_json(out / REPORT, list(earlier.values()))
            if findings:
                _write(copy, source, findings, measured)
    if options.json:
        print_json([asdict(one) for one in results])
    else:
        _print_table(findings, console)
    _print_end(tests, results, findings, console)
    if findings:
        console.print(f"written: {copy}")
        is_own = options.hardware.endswith((".yaml", ".yml")) and not options.emulated
        question = f"Write the measured values into {source}? [y/N]"
        if is_own and (options.yes or ask(question).strip().lower() in ("y", "yes")):
            _write(source, source, findings, None)
            console.print(f"written: {source}")
    return OK if all(result.is_good for result in results) else FAILED


def _earlier(report: Path, robot: str, tests: Sequence[StandTest], console: Console) -> dict[str, dict[str, Any]]:
    """Return the results of an earlier session with the same robot by test; none where the file does not say of which they are.

    Raises:
        InputError: they are of another robot, and of tests that are not made now.
    """
    try:
        results = json.loads(report.read_text(encoding="utf-8")) if report.is_file() else []
        found = {result["test"]: (result["robot"], result) for result in results}
    except (OSError, ValueError, TypeError, KeyError):
        console.print(f"{report}: damaged, or does not say of which robot its results are: it is replaced", style="bold yellow")
        return {}
    made = [test.name for test in tests]
    for test, (other, _) in found.items():
        if other != robot and test not in made:
            raise InputError(f"{report}: its {test} is of {other}, not of {robot}: choose another --out")
    return {test: result for test, (other, result) in found.items() if other == robot}


def _robot(options: CommissionOptions, robot: Robot, hardware: Hardware, ask: Callable[[str], str]) -> tuple[Link, Person]:
    """Return a link to the robot, and who stands beside it."""
    from wlr_gym.hardware.commissioning.stand import EmulatedPerson, Person
    from wlr_gym.hardware.emulator.link import emulated_link
    from wlr_gym.hardware.emulator.stand import EmulatedStand

    if not options.emulated:
        options.refuse_effects(options.patch())
        return options.link_to(robot, hardware), Person(ask, not options.yes)
    stand = EmulatedStand(robot, hardware, options.patch())
    for fault in options.fault:
        stand.machine.inject(fault)
    return emulated_link(stand.machine), EmulatedPerson(stand)


def _write(target: Path, source: Path, findings: Iterable[StandFinding], earlier: Measured | None) -> None:
    """Write the hardware file with what was measured, now or in an ``earlier`` session that this one continues."""
    from wlr_gym.hardware.calibration import save_hardware
    from wlr_gym.hardware.commissioning.runner import with_measurements
    from wlr_gym.hardware.config import load_hardware

    content = with_measurements(load_hardware(source), findings, earlier)  # what the file says, not ports of the command line
    save_hardware(target, source, content, "measured", "Measured on the robot by wlr commission: docs/robot.md.")


# ---- the report ------------------------------------------------------------------------------------------------------


def _print_table(findings: Sequence[StandFinding], console: Console) -> None:
    """One row for all places where a quantity is as expected, one for each where it differs; then what to do."""
    from wlr_gym.hardware.commissioning.stand_tests import TESTS

    groups = []
    for quantity in dict.fromkeys(finding.quantity for finding in findings):
        alike = [finding for finding in findings if finding.quantity == quantity]
        good = [finding for finding in alike if finding.is_expected]
        groups += ([good] if good else []) + [[finding] for finding in alike if not finding.is_expected]
    styles = ["" if group[0].is_expected else "red" for group in groups]
    print_table(console, ("quantity", "where", "measured", "expected", "verdict"), map(_row, groups), styles=styles)
    said = {quantity.name: quantity.doc for test in TESTS.values() for quantity in test.quantities}
    for one in findings:
        if not one.is_expected:
            console.print(f"{one.where}, {one.quantity}: {said[one.quantity]}. {one.remedy}", style="bold")


def _row(group: Sequence[StandFinding]) -> tuple[str, ...]:
    """Table row of findings of one quantity."""
    first, unit = group[0], group[0].unit
    where = first.where if len(group) == 1 else f"{len(group)} places"
    expected = f"{_span([one.expected for one in group], unit)} ± {max(one.tolerance for one in group):.2g}"
    return first.quantity, where, _span([one.measured for one in group], unit), expected, first.verdict


def _span(values: Sequence[float], unit: str) -> str:
    low, high = (f"{round(value, 9) + 0.0:.3g}" for value in (min(values), max(values)))
    text = low if low == high else f"{low} .. {high}"
    return text if unit == "-" else f"{text} {unit}"


def _print_end(
    tests: Sequence[StandTest], results: Sequence[StandResult], findings: Sequence[StandFinding], console: Console
) -> None:
    """Say what was not tested, or not at every joint, and whether all that was is as expected."""
    from wlr_gym.hardware.commissioning.runner import DONE

    made = {result.test: result for result in results}
    untested = [
        f"{test.name} in part" if test.name in made and made[test.name].findings else test.name
        for test in tests
        if test.name not in made or made[test.name].state != DONE
    ]
    if untested:
        console.print(f"Not tested: {', '.join(untested)}.", style="bold yellow")
    if findings and all(finding.is_expected for finding in findings):
        rest = " of the other tests" if untested else ""
        console.print(f"All {len(findings)} values{rest} as expected.", style="" if untested else "bold green")
