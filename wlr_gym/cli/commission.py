"""Commission a robot: scripted tests on a stand, wheels off the ground, each compared with the emulated robot.

Asks before each test; motors are off after each. Writes measured runs, a JSON per test, and what was measured into the hardware
file. Exit code 0: all as expected; 1: something differs, or a test could not be made.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
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

    Args:
        options: of the command.
        ask: shows a text and returns what was typed; None = the terminal.

    Raises:
        InputError: unknown robot, hardware, test or patch, options that make no sense, ports that cannot be opened.
    """
    from wlr_gym.hardware.commissioning.stand_tests import choose

    console = Console(soft_wrap=True, highlight=False, stderr=options.json)
    tests = choose(options.tests)
    if options.list:
        _list(tests, console, options.json)
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


def _earlier(report: Path, robot: str, tests: Sequence[StandTest], console: Console) -> list[dict[str, Any]]:
    """Return the results of an earlier session with the same robot; none where the file does not say of which they are.

    Raises:
        InputError: they are of another robot, and of tests that are not made now.
    """
    try:
        found = json.loads(report.read_text(encoding="utf-8")) if report.is_file() else []
        others = [(result["test"], result["robot"]) for result in found if result["robot"] != robot]
    except (OSError, ValueError, TypeError, KeyError):
        console.print(f"{report}: damaged, or does not say of which robot its results are: it is replaced", style="bold yellow")
        return []
    made = [test.name for test in tests]
    for test, other in others:
        if test not in made:
            raise InputError(f"{report}: its {test} is of {other}, not of {robot}: choose another --out")
    return [result for result in found if result["robot"] == robot]


def _together(earlier: Sequence[dict[str, Any]], made: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return all results, one per test: an earlier one stays until its test was made anew, well or not."""
    from wlr_gym.hardware.commissioning.runner import SKIPPED, STOPPED

    known = {result["test"] for result in earlier}
    new = [result for result in made if result["state"] not in (SKIPPED, STOPPED) or result["test"] not in known]
    replaced = {result["test"] for result in new}
    return [*(result for result in earlier if result["test"] not in replaced), *new]


def _named(options: CommissionOptions, robot: Robot) -> str:
    """Return in words which robot is tested; a hardware file of one's own by its path, for others may have its name."""
    file = Path(options.hardware)
    words = [f"robot '{robot.name}'", f"hardware '{file.resolve() if file.suffix else file}'"]
    return ", ".join([*words, *(["emulated"] if options.emulated else []), *options.effects, *options.fault])


def _commission(
    options: CommissionOptions, out: Path, tests: Sequence[StandTest], ask: Callable[[str], str], console: Console
) -> int:
    from wlr_gym.data.format import RunMeta
    from wlr_gym.hardware.commissioning.runner import Commissioning, content_of
    from wlr_gym.hardware.config import load_hardware

    robot, hardware = options.load()
    named = _named(options, robot)
    earlier = _earlier(out / REPORT, named, tests, console)
    copy = out / COPY
    source = find_config("hardware", options.hardware)
    if copy.exists() and copy.samefile(source):
        raise InputError(f"--out {out}: its {COPY} is the file of --hardware, and gets every value: choose another folder")
    measured = load_hardware(copy).measured if earlier and copy.is_file() else None
    link, person = _robot(options, robot, hardware, ask)
    meta = RunMeta(robot=robot.name, notes="wlr commission, on a stand")
    results: list[StandResult] = []
    findings: list[StandFinding] = []
    with Commissioning(robot, hardware, link, person, out, meta) as commissioning:
        if faults := commissioning.faults():
            console.print("\n".join([*faults, "Nothing was switched on: mend this first (wlr doctor)."]), style="bold red")
            return FAILED
        for result in commissioning.make(tests):
            results.append(result)
            for reason in result.repeated:
                console.print(f"{result.test}: made once more: {reason}")
            console.print(f"{result.test}: {result.state}{f': {result.reason}' if result.reason else ''}")
            write_json(out / REPORT, _together(earlier, [content_of(one) | {"robot": named} for one in results]))
            findings += result.findings
            if findings:
                _write(copy, source, findings, measured)
    if options.json:
        print_json([content_of(one) for one in results])
    else:
        _print_table(findings, console)
    _print_end(findings, _untested(tests, results), console)
    if findings:
        console.print(f"written: {copy}")
        _save(options, source, findings, ask, console)
    return OK if all(result.is_good for result in results) else FAILED


def _robot(options: CommissionOptions, robot: Robot, hardware: Hardware, ask: Callable[[str], str]) -> tuple[Link, Person]:
    """Return a link to the robot, and who stands beside it."""
    from wlr_gym.hardware.commissioning.runner import EmulatedPerson
    from wlr_gym.hardware.commissioning.stand import TerminalPerson
    from wlr_gym.hardware.emulator.link import emulated_link
    from wlr_gym.hardware.emulator.stand import EmulatedStand

    if not options.emulated:
        options.refuse_effects(options.patch())
        return options.link_to(robot, hardware), TerminalPerson(ask, not options.yes)
    stand = EmulatedStand(robot, hardware, options.patch())
    for fault in options.fault:
        stand.machine.inject(fault)
    return emulated_link(stand.machine), EmulatedPerson(stand)


def _save(
    options: CommissionOptions, source: Path, findings: Iterable[StandFinding], ask: Callable[[str], str], console: Console
) -> None:
    """Write what was measured into a real robot's own hardware file, if wanted."""
    is_own = options.hardware.endswith((".yaml", ".yml")) and not options.emulated
    if is_own and (options.yes or ask(f"Write the measured values into {source}? [y/N]").strip().lower() in ("y", "yes")):
        _write(source, source, findings, None)
        console.print(f"written: {source}")


def _write(target: Path, source: Path, findings: Iterable[StandFinding], earlier: Measured | None) -> None:
    """Write the hardware file with what was measured, now or in an ``earlier`` session that this one continues."""
    from wlr_gym.hardware.calibration import save_hardware
    from wlr_gym.hardware.commissioning.runner import with_measurements
    from wlr_gym.hardware.config import load_hardware

    content = with_measurements(load_hardware(source), findings, earlier)  # what the file says, not ports of the command line
    save_hardware(target, source, content, "measured", "Measured on the robot by wlr commission: docs/robot.md.")


# ---- the report ------------------------------------------------------------------------------------------------------


def _list(tests: Sequence[StandTest], console: Console, as_json: bool) -> None:
    rows = [{"test": one.name, "what": one.title, "hands": one.asks or "off", "moves": one.moves} for one in tests]
    if as_json:
        print_json(rows)
    else:
        print_table(console, ("test", "what", "hands", "what moves"), [tuple(row.values()) for row in rows])


def _print_table(findings: Sequence[StandFinding], console: Console) -> None:
    """One row for all places where a quantity is as expected, one for each where it differs; then what to do."""
    groups = []
    for quantity in dict.fromkeys(finding.quantity for finding in findings):
        alike = [finding for finding in findings if finding.quantity == quantity]
        good = [finding for finding in alike if finding.is_expected]
        groups += ([good] if good else []) + [[finding] for finding in alike if not finding.is_expected]
    styles = ["" if group[0].is_expected else "red" for group in groups]
    print_table(console, ("quantity", "where", "measured", "expected", "verdict"), map(_row, groups), styles=styles)
    wrong = [finding for finding in findings if not finding.is_expected]
    for finding in wrong:
        console.print(
            f"{finding.where}, {finding.quantity.name}: {finding.quantity.doc}. {finding.quantity.remedy}", style="bold"
        )


def _untested(tests: Sequence[StandTest], results: Sequence[StandResult]) -> list[str]:
    """Return the tests that were not made, or not at every joint."""
    from wlr_gym.hardware.commissioning.runner import DONE

    done = {result.test for result in results if result.state == DONE}
    partly = {result.test for result in results if result.findings}
    return [f"{test.name} in part" if test.name in partly else test.name for test in tests if test.name not in done]


def _print_end(findings: Sequence[StandFinding], untested: Sequence[str], console: Console) -> None:
    """Say what was not tested, and whether all that was is as expected."""
    if untested:
        console.print(f"Not tested: {', '.join(untested)}.", style="bold yellow")
    if findings and all(finding.is_expected for finding in findings):
        rest = " of the other tests" if untested else ""
        console.print(f"All {len(findings)} values{rest} as expected.", style="" if untested else "bold green")


def _row(group: Sequence[StandFinding]) -> tuple[str, ...]:
    """Table row of findings of one quantity."""
    first, unit = group[0], group[0].quantity.unit
    where = first.where if len(group) == 1 else f"{len(group)} places"
    expected = f"{_span([one.expected for one in group], unit)} ± {max(one.room for one in group):.2g}"
    return first.quantity.name, where, _span([one.measured for one in group], unit), expected, first.verdict


def _span(values: Sequence[float], unit: str) -> str:
    low, high = (f"{round(value, 9) + 0.0:.3g}" for value in (min(values), max(values)))
    text = low if low == high else f"{low} .. {high}"
    return text if unit == "-" else f"{text} {unit}"
