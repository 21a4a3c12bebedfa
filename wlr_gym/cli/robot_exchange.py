"""``wlr robot import`` and ``export``: robots of MJCF and URDF files, and as such."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from wlr_gym.base.errors import InputError
from wlr_gym.base.files import require_ending, write_text
from wlr_gym.cli import FAILED, OK
from wlr_gym.cli.options import ForceOption, JsonOption
from wlr_gym.cli.results import print_json
from wlr_gym.cli.robot_new import ENDINGS, print_findings

if TYPE_CHECKING:
    from wlr_gym.robot.interchange import ImportedRobot, LinkTree

Format = Literal["mjcf", "urdf"]
#: End of a file's name -> format.
SUFFIXES: dict[str, Format] = {".xml": "mjcf", ".mjcf": "mjcf", ".urdf": "urdf"}


@dataclass(frozen=True)
class RobotImportOptions(JsonOption, ForceOption):
    """Write a robot file of a robot with four legs of one hinge and a driven wheel on each; others are refused.

    Attributes:
        file: MJCF or URDF.
        out: robot file to write (.yaml).
        name: of the robot; default: that in the file.
        base: robot that has what the format cannot hold: name in configs/robot/ or path.
        idealise: accept that numbers are averaged or left out which change the robot by more than 5 %.
    """

    file: Annotated[Path, tyro.conf.Positional]
    out: Path
    name: str | None = None
    base: str = "nominal"
    idealise: bool = False


@dataclass(frozen=True)
class RobotExportOptions(JsonOption, ForceOption):
    """Write a robot as MJCF (the MuJoCo plant's own model) or URDF.

    Attributes:
        robot: robot file, or name in configs/robot/.
        out: file to write; .xml or .mjcf: MJCF, .urdf: URDF.
        format: of the file; default: by the end of --out.
    """

    robot: Annotated[str, tyro.conf.Positional]
    out: Path
    format: Format | None = None


def import_robot(options: RobotImportOptions) -> int:
    """Read, write, and say what was averaged or left out; 1 when the robot cannot stand, drive or turn.

    Raises:
        InputError: no such file, another kind of robot, or numbers that no robot file can hold; nothing is written.
    """
    from wlr_gym.physics.feasibility import examine_robot
    from wlr_gym.robot.interchange import recognise
    from wlr_gym.robot.interchange.robot_file import base_beside, new_file, of_all, robot_over, robot_text

    require_ending(options.out, ENDINGS)
    new_file(options.out, force=options.force)
    found = recognise(_read(options.file), idealise=options.idealise)
    name = options.name or found.name or options.out.stem
    numbers = of_all(found.numbers, options.base)
    robot = robot_over(options.base, name, numbers, options.out)
    title = [f"Imported from {options.file.name} by wlr robot import. SI units, radians.", *_explained(found, options.base)]
    write_text(options.out, robot_text(name, base_beside(options.base, options.out), numbers, title=title))
    findings = examine_robot(robot)
    if options.json:
        print_json({"out": options.out, **asdict(found), "findings": findings})
    else:
        print("\n".join([f"written: {options.out}", *_explained(found, options.base)]))
        print_findings(robot, findings)
    return FAILED if any(finding.level == "fault" for finding in findings) else OK


def _explained(found: ImportedRobot, base: str) -> list[str]:
    """What was read, what was not, and how joints correspond."""
    lines = [f"What the file does not hold is as in '{base}'.", *(f"note: {note}" for note in found.notes)]
    lines.append("Joint here = sign x angle in the file + offset (rad):")
    return lines + [f"  {one.joint} = {one.sign:+.0f} x {one.name} {one.offset:+.6g}" for one in found.joints]


def _read(path: Path) -> LinkTree:
    """Read a file by what it holds, not by its name."""
    from wlr_gym.physics.plants.mujoco.mjcf import read_mjcf
    from wlr_gym.robot.interchange import parse_urdf

    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: cannot be read: {getattr(error, 'strerror', None) or error}") from None
    return read_mjcf(path) if "<mujoco" in text and "<robot" not in text else parse_urdf(text, str(path))


def export_robot(options: RobotExportOptions) -> int:
    """Write the file, and say what it cannot hold.

    Raises:
        InputError: no such robot, or a file that is there or of no known format.
    """
    from wlr_gym.physics.plants.mujoco.mjcf import NOT_IN_MJCF, mjcf_text
    from wlr_gym.robot import load_robot
    from wlr_gym.robot.interchange import urdf_text
    from wlr_gym.robot.interchange.robot_file import new_file
    from wlr_gym.robot.interchange.urdf import NOT_IN_URDF

    by_name = SUFFIXES.get(options.out.suffix.lower())
    kind = options.format or by_name
    if kind is None:
        raise InputError(f"--out {options.out}: expected a file that ends in {', '.join(SUFFIXES)}, or --format")
    if by_name not in (None, kind) and options.out.suffix.lower() != ".xml":  # which is used for both
        raise InputError(f"--out {options.out}: a name of {by_name}, and --format {kind}; leave --format out")
    new_file(options.out, force=options.force)
    robot = load_robot(options.robot)
    text, lost = (mjcf_text(robot), NOT_IN_MJCF) if kind == "mjcf" else (urdf_text(robot), NOT_IN_URDF)
    write_text(options.out, text)
    if options.json:
        print_json({"out": options.out, "format": kind, "not_held": lost})
    else:
        print(f"written: {options.out}\n{kind.upper()} does not hold: {', '.join(lost)}")
    return OK
