"""``wlr robot new``: a robot file from a few questions, or from options alone."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from wlr_gym.base.errors import InputError
from wlr_gym.base.text import counted, pairs
from wlr_gym.cli import FAILED, OK
from wlr_gym.cli.options import ForceOption, JsonOption
from wlr_gym.cli.results import print_json
from wlr_gym.cli.robot_options import ask_terminal

if TYPE_CHECKING:
    from wlr_gym.physics.feasibility import RobotFinding
    from wlr_gym.robot import Robot
    from wlr_gym.robot.outline import Question

#: Of a robot file.
ENDINGS = (".yaml", ".yml")


@dataclass(frozen=True)
class NewOptions(JsonOption, ForceOption):
    """Write a robot file over a base. Asks for what --set does not give; Enter takes the default.

    Attributes:
        out: robot file to write (.yaml).
        name: of the robot; default: that of the file.
        base: robot that has all other numbers: name in configs/robot/ or path.
        set: answers, such as body.mass=12 leg.length="300 mm" servo.wheel.no_load_speed="77 rpm"; units may be left out (SI).
        yes: take the default of everything that --set does not give, and ask nothing.
    """

    out: Path
    name: str | None = None
    base: str = "nominal"
    set: tuple[str, ...] = ()
    yes: bool = False


def new_robot(options: NewOptions, ask: Callable[[str], str] | None = None) -> int:
    """Ask, write the file, say what is odd about the robot; 1 when it cannot stand, drive or turn.

    Args:
        options: of the command.
        ask: shows a text and returns what was typed; None = the terminal.

    Raises:
        InputError: a bad option, or answers that no robot file can hold; nothing is written.
    """
    from wlr_gym.base.files import require_ending, write_text
    from wlr_gym.physics.feasibility import examine_robot
    from wlr_gym.robot import load_robot
    from wlr_gym.robot.interchange.robot_file import base_beside, new_file, of_all, robot_over, robot_text
    from wlr_gym.robot.outline import QUESTIONS, derived_numbers, question_of

    require_ending(options.out, ENDINGS)
    new_file(options.out, force=options.force)
    base, name = load_robot(options.base), options.name or options.out.stem
    words = pairs("--set", options.set, "body.mass=12")
    given = {key: question_of(key).read(text) for key, text in words.items()}
    answers: dict[str, Any] = {}
    for question in QUESTIONS:
        default = question.default(answers, base)
        answers[question.key] = given.get(question.key, default)
        if not options.yes and question.key not in given:
            answers[question.key] = _asked(question, default, ask or (lambda text: ask_terminal(text, "wlr robot new")))
    numbers, comments = derived_numbers(answers, base)
    numbers = of_all(numbers, options.base)
    try:
        robot = robot_over(options.base, name, numbers, options.out, check=False)
    except InputError as error:
        why = "; ".join([*_unusual(answers), str(error)])
        kept = "" if options.yes else f"; your answers: {_as_options(answers)}"
        raise InputError(f"{why}{kept}") from None
    title = (
        f"Written by wlr robot new. SI units, radians; what is not here is as in '{options.base}'.",
        "[given] an answer or its default; [derived] computed from the answers and the base.",
    )
    text = robot_text(name, base_beside(options.base, options.out), numbers, title=title, comments=comments)
    write_text(options.out, text)
    print(f"written: {options.out}")
    findings = examine_robot(robot)
    if options.json:
        print_json({"robot": robot.name, "out": options.out, "findings": findings})
    else:
        print_findings(robot, findings)
    return FAILED if any(finding.level == "fault" for finding in findings) else OK


def _asked(question: Question, default: Any, ask: Callable[[str], str]) -> Any:
    """Ask until the answer can be read; an empty one is the default."""
    while True:
        answer = ask(f"{question.words} [{question.shown(default)}]:").strip()
        if not answer:
            return default
        try:
            return question.read(answer)
        except InputError as error:
            print(error)


def _unusual(answers: Mapping[str, Any]) -> list[str]:
    """Return what is outside the usual, in words."""
    from wlr_gym.physics.feasibility import unusual

    lists = {key: value if isinstance(value, list) else [value] for key, value in answers.items()}
    return [str(finding) for key, values in lists.items() for finding in unusual(key, values)]


def _as_options(answers: Mapping[str, Any]) -> str:
    """Return answers as words of ``--set``, so that none is lost."""
    return "--set " + " ".join(
        f"{key}={' '.join(map(str, value))!r}" if isinstance(value, list) else f"{key}={value}"
        for key, value in answers.items()
    )


def print_findings(robot: Robot, findings: Sequence[RobotFinding]) -> None:
    """Print findings, faults first, and what they come to."""
    for finding in findings:
        print(f"{finding.level + ':':<9}{finding}")
    faults = sum(finding.level == "fault" for finding in findings)
    if not findings:
        print(f"robot '{robot.name}': nothing odd")
    else:
        print(f"robot '{robot.name}': {counted(faults, 'fault')}, {counted(len(findings) - faults, 'warning')}")
