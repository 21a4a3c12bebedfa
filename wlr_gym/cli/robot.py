"""Robot files: make a ``new`` one, ``check`` and ``show`` one, ``import`` one from MJCF or URDF, ``export`` one, ``floors``.

Exit code 0: done, nothing stands against the robot; 1: it cannot stand, drive or turn; 2: bad input, nothing written.
"""

from __future__ import annotations

import textwrap
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

from rich.console import Console
from tyro.conf import Positional

from wlr_gym.base.errors import InputError
from wlr_gym.base.files import check_new_file, make_output_folder, refuse_existing, write_text
from wlr_gym.base.settings import overlay, read_layers
from wlr_gym.base.text import counted, pairs
from wlr_gym.cli import FAILED, OK
from wlr_gym.cli.options import FloorOption, ForceOption, JsonOption, refuse_given
from wlr_gym.cli.terminal import ask_terminal, print_json, print_table
from wlr_gym.physics.feasibility import ENTRIES, RobotFinding, capability_of, examine_robot, unusual
from wlr_gym.robot import Robot, load_robot, robot_content, robot_hash
from wlr_gym.robot.interchange.recognition import (
    ImportedRobot,
    LinkTree,
    base_beside,
    missing_numbers,
    of_all,
    recognise,
    robot_over,
    robot_text,
)
from wlr_gym.robot.interchange.urdf import NOT_IN_URDF, parse_urdf, urdf_text
from wlr_gym.robot.outline import QUESTIONS, Question, derived_numbers, question_of
from wlr_gym.robot.parameter_table import spec_of
from wlr_gym.robot.parameters import Parameters

Format = Literal["mjcf", "urdf", "parts"]
#: End of a file's name -> format.
SUFFIXES: dict[str, Format] = {".xml": "mjcf", ".mjcf": "mjcf", ".urdf": "urdf"}
#: Of a robot file, and of a picture.
ENDINGS, PICTURES = (".yaml", ".yml"), (".png", ".jpg", ".jpeg", ".webp")
#: SI; what is nearer to 0 is 0 but for rounding.
ROUNDING = 1e-12


@dataclass(frozen=True)
class NewOptions(JsonOption, ForceOption):
    """Write a robot file over a base. Asks for what --set does not give; Enter takes the default."""

    out: Path
    """Robot file to write (.yaml)."""
    name: str | None = None
    """Name of the robot; default: that of the file."""
    base: str = "nominal"
    """Robot that has all other numbers: name in configs/robot/ or path."""
    set: tuple[str, ...] = ()
    """Answers, such as body.mass=12 leg.length="300 mm" servo.wheel.no_load_speed="77 rpm"; units may be left out (SI)."""
    yes: bool = False
    """Take the default of everything that --set does not give, and ask nothing."""


@dataclass(frozen=True)
class CheckOptions(JsonOption):
    """Look for what is wrong or odd about a robot: units, masses, inertias, and what it cannot do, with numbers."""

    robot: Positional[str] = "nominal"
    """Robot file, or name in configs/robot/."""
    strict: bool = False
    """Warnings too give exit code 1."""


@dataclass(frozen=True)
class ShowOptions(JsonOption, ForceOption):
    """Show what a robot is and what it can do."""

    robot: Positional[str] = "nominal"
    """Robot file, or name in configs/robot/."""
    picture: Path | None = None
    """Picture to write (.png, .jpg, .webp): standing, and with its legs at their limits."""


@dataclass(frozen=True)
class RobotImportOptions(JsonOption, ForceOption):
    """Write a robot file from MJCF or URDF: of a robot with four legs of one hinge and a driven wheel on each."""

    file: Positional[Path]
    """MJCF or URDF."""
    out: Path
    """Robot file to write (.yaml)."""
    name: str | None = None
    """Name of the robot; default: that in the file."""
    base: str = "nominal"
    """Robot that has what the format cannot hold: name in configs/robot/ or path."""
    set: tuple[str, ...] = ()
    """Numbers in place of the file's, such as wheel.radius="80 mm" of wheels that are meshes; units may be left out (SI)."""
    idealise: bool = False
    """Accept that numbers are averaged or left out which change the robot by more than 5 %."""


@dataclass(frozen=True)
class RobotExportOptions(JsonOption, ForceOption, FloorOption):
    """Write a robot as MJCF (the MuJoCo plant's own model, with --floor the floor's pieces too), URDF, or parts to build it.

    Parts are STL and DXF files in mm; their masses and inertias are compared with the robot file.
    """

    robot: Positional[str]
    """Robot file, or name in configs/robot/."""
    out: Path
    """File to write; .xml or .mjcf: MJCF, .urdf: URDF. Of parts: folder."""
    format: Format | None = None
    """mjcf, urdf or parts; default: by the end of --out."""


@dataclass(frozen=True)
class FloorsOptions(JsonOption):
    """List the floors that ship with it, for --floor."""


def new_robot(options: NewOptions, ask: Callable[[str], str] | None = None) -> int:
    """Ask, write the file, say what is odd about the robot; 1 when it cannot stand, drive or turn.

    Args:
        options: of the command.
        ask: shows a text and returns what was typed; None = the terminal.

    Raises:
        InputError: a bad option, or answers that no robot file can hold; nothing is written.
    """
    check_new_file(options.out, options.force, endings=ENDINGS)
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
        lists = {key: value if isinstance(value, list) else [value] for key, value in answers.items()}
        why = [str(finding) for key, values in lists.items() for finding in unusual(key, values)]
        words = [
            f"{key}={' '.join(map(str, values))!r}" if len(values) > 1 else f"{key}={values[0]}"
            for key, values in lists.items()
        ]
        kept = "" if options.yes else f"; your answers: --set {' '.join(words)}"  # none is lost
        raise InputError(f"{'; '.join([*why, str(error)])}{kept}") from None
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


def print_findings(robot: Robot, findings: Sequence[RobotFinding]) -> None:
    """Print findings, faults first, and what they come to."""
    for finding in findings:
        print(f"{finding.level + ':':<9}{finding}")
    faults = sum(finding.level == "fault" for finding in findings)
    if not findings:
        print(f"robot '{robot.name}': nothing odd")
    else:
        print(f"robot '{robot.name}': {counted(faults, 'fault')}, {counted(len(findings) - faults, 'warning')}")


def check_robot(options: CheckOptions) -> int:
    """Print what is wrong or odd; 1 when something stands against the robot."""
    robot = load_robot(options.robot, check=False)
    findings = [*examine_robot(robot), *_borrowed(options.robot)]
    if options.json:
        print_json({"robot": robot.name, "findings": findings})
    else:
        print_findings(robot, findings)
    against = findings if options.strict else [finding for finding in findings if finding.level == "fault"]
    return FAILED if against else OK


#: Number of a robot file -> what follows from it: another robot's is seldom right.
MATTERS = {
    **{f"servo.{part}.stall_torque": "what it carries and climbs" for part in ("leg", "wheel")},
    "servo.leg.no_load_speed": "how fast legs move",
    "servo.wheel.no_load_speed": "the top speed",
    **{f"servo.{part}.armature": "how fast it speeds up" for part in ("leg", "wheel")},
    "servo.supply_voltage": "the motors' resistance and gains",
}


def _borrowed(source: str) -> list[RobotFinding]:
    """Warn of numbers that a robot with a body and wheels of its own has from the robot it is based on."""
    own: Mapping[str, Any] = {}
    (base, name), *above = read_layers("robot", source)
    for content, _ in above:
        own = overlay(own, content)
    lacking, stated = missing_numbers(own, base), set(missing_numbers({}, own))
    if not {"body.mass", "wheel.radius"} <= stated:
        return []
    said = [(key, why) for key, why in MATTERS.items() if key in lacking]
    text = f"taken from '{Path(name).stem}'; it decides {{}}: state your robot's"
    return [RobotFinding("warning", key, lacking[key], _unit(key), text.format(why)) for key, why in said]


def _unit(key: str) -> str:
    """Return the unit of a number of the servos."""
    return spec_of(f"servo.{key.rpartition('.')[2]}").unit


def show_robot(options: ShowOptions) -> int:
    """Print the numbers of a robot, and draw it."""
    if options.picture is not None:
        check_new_file(options.picture, options.force, "--picture", PICTURES, any_case=True)
    robot = load_robot(options.robot)
    can = capability_of(robot)
    numbers: dict[str, dict[str, Any]] = {}
    for name, (unit, doc) in ENTRIES.items():
        value = getattr(can, name)
        numbers[name] = {"value": 0.0 if abs(value) < ROUNDING else value, "unit": unit, "meaning": doc}
    if options.json:
        print_json({"robot": robot.name, "fingerprint": robot_hash(robot), "numbers": numbers})
    else:
        rows = [(name, f"{one['value']:.4g}", one["unit"], one["meaning"]) for name, one in numbers.items()]
        title = f"{robot.name}, fingerprint {robot_hash(robot)}"
        print_table(Console(highlight=False), ("number", "value", "unit", "meaning"), rows, title)
    if options.picture is not None:
        from wlr_gym.render.scene import draw_portrait

        draw_portrait(options.picture, robot)
        print(f"written: {options.picture}")
    return OK


def import_robot(options: RobotImportOptions) -> int:
    """Read, write, and say what was averaged or left out; 1 when the robot cannot stand, drive or turn."""
    check_new_file(options.out, options.force, endings=ENDINGS)
    given = {key: question_of(key).read(text) for key, text in pairs("--set", options.set, "wheel.radius=0.08").items()}
    found = recognise(_read(options.file), idealise=options.idealise, given=given)
    name = options.name or found.name or options.out.stem
    numbers = of_all(found.numbers, options.base)
    robot = robot_over(options.base, name, numbers, options.out)
    borrowed = missing_numbers(found.numbers, robot_content(options.base))
    explained = _explained(found, options.base, borrowed)
    title = [f"Imported from {options.file.name} by wlr robot import. SI units, radians.", *explained]
    write_text(options.out, robot_text(name, base_beside(options.base, options.out), numbers, title=title))
    findings = examine_robot(robot)
    if options.json:
        print_json({"out": options.out, **asdict(found), "from_base": borrowed, "findings": findings})
    else:
        print("\n".join([f"written: {options.out}", *explained]))
        print_findings(robot, findings)
    return FAILED if any(finding.level == "fault" for finding in findings) else OK


def _explained(found: ImportedRobot, base: str, borrowed: Mapping[str, Any]) -> list[str]:
    """What was read, what was not, and how joints correspond."""
    taken = [_shown(key, value) for key, value in borrowed.items() if key not in ("name", "joints")]
    lines = textwrap.wrap(f"Taken from '{base}': {', '.join(dict.fromkeys(taken))}.", 120, subsequent_indent="  ")
    lines += [f"note: {note}" for note in found.notes]
    lines.append("Joint here = sign x angle in the file + offset (rad):")
    return lines + [f"  {one.joint} = {one.sign:+.0f} x {one.name} {one.offset:+.6g}" for one in found.joints]


def _shown(key: str, value: Any) -> str:
    """Return a number of a robot file in words; of long groups the name."""
    group = key.partition(".")[0]
    if group in ("sensors", "tolerances", "dynamixel_ids"):
        return group
    return f"{key} = {value:.6g}" if isinstance(value, float) else f"{key} = {value}"


def _read(path: Path) -> LinkTree:
    """Read a file by what it holds, not by its name."""
    from wlr_gym.physics.plants.mujoco.mjcf import read_mjcf

    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: cannot be read: {getattr(error, 'strerror', None) or error}") from None
    return read_mjcf(path) if "<mujoco" in text and "<robot" not in text else parse_urdf(text, str(path))


def export_robot(options: RobotExportOptions) -> int:
    """Write the file, and say what it cannot hold."""
    from wlr_gym.physics.floor import lay_floor, load_floor
    from wlr_gym.physics.plants.mujoco.mjcf import NOT_IN_MJCF, NOT_IN_MJCF_FLOOR, mjcf_text

    by_name = SUFFIXES.get(options.out.suffix.lower())
    kind = options.format or by_name
    if kind == "parts":
        return export_parts(options)
    if kind is None:
        raise InputError(f"--out {options.out}: expected a file that ends in {', '.join(SUFFIXES)}, or --format")
    if by_name not in (None, kind) and options.out.suffix.lower() != ".xml":  # which is used for both
        raise InputError(f"--out {options.out}: a name of {by_name}, and --format {kind}; leave --format out")
    if kind == "urdf":
        refuse_given(options, ("floor",), "URDF holds a robot, no floor; expected --format mjcf")
    check_new_file(options.out, options.force)
    robot = load_robot(options.robot)
    if kind == "mjcf":
        floor = load_floor(options.floor, robot).drawn()
        text = mjcf_text(robot, lay_floor(floor, Parameters.nominal(robot)))
        lost = NOT_IN_MJCF if floor.is_flat else NOT_IN_MJCF + NOT_IN_MJCF_FLOOR
    else:
        text, lost = urdf_text(robot), NOT_IN_URDF
    write_text(options.out, text)
    if options.json:
        print_json({"out": options.out, "format": kind, "not_held": lost})
    else:
        print(f"written: {options.out}\n{kind.upper()} does not hold: {', '.join(lost)}")
    return OK


def export_parts(options: RobotExportOptions) -> int:
    """Write files of the parts, and how their masses differ from the robot file; 1 where one is outside the tolerance."""
    from wlr_gym.robot.parts import TOLERANCE, compare, make_kit, write_kit

    refuse_given(options, ("floor",), "parts are of a robot; leave it out")
    robot = load_robot(options.robot)
    kit = make_kit(robot)
    make_output_folder(options.out)
    refuse_existing(options.out / "parts.csv", options.force)
    files, differences = write_kit(kit, options.out), compare(robot, kit)
    if options.json:
        print_json({"out": options.out, "files": files, "differences": [line._asdict() for line in differences]})
        return OK if all(line.fits for line in differences) else FAILED
    console = Console(highlight=False)
    rows = [(name, str(count), f"{1e3 * mass:.1f}", made) for name, count, mass, made in kit.bill()]
    print_table(console, ("part", "pieces", "g each", "made"), rows)
    lines = [(d.name, f"{d.file:.4g}", f"{d.parts:.4g}", d.unit, "" if d.fits else "differs") for d in differences]
    print_table(console, ("number", "robot file", "parts", "unit", f"within {TOLERANCE:.0%}"), lines)
    print(f"written: {len(files)} files in {options.out}")
    return OK if all(line.fits for line in differences) else FAILED


def list_floors(options: FloorsOptions) -> int:
    """List the floors that ship."""
    from wlr_gym.base.paths import config_names
    from wlr_gym.physics.floor import load_floor

    floors = [load_floor(name) for name in config_names("floor")]
    if options.json:
        print_json([floor.content() for floor in floors])
        return OK
    rows = [(floor.name, floor.summary, ", ".join(floor.randomise) or "-") for floor in floors]
    print_table(Console(highlight=False), ("floor", "what it is", "drawn for every episode"), rows)
    return OK


#: Command -> its options, and what it does.
COMMANDS = {
    "new": (NewOptions, new_robot),
    "check": (CheckOptions, check_robot),
    "show": (ShowOptions, show_robot),
    "import": (RobotImportOptions, import_robot),
    "export": (RobotExportOptions, export_robot),
    "floors": (FloorsOptions, list_floors),
}
