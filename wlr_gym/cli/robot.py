"""Robot files: make a ``new`` one, ``check`` and ``show`` one, ``import`` one from MJCF or URDF, ``export`` one to them.

Exit code 0: done, nothing stands against the robot; 1: it cannot stand, drive or turn; 2: bad input, nothing written.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from wlr_gym.base.errors import InputError
from wlr_gym.base.files import refuse_existing, require_ending
from wlr_gym.cli import FAILED, OK
from wlr_gym.cli.options import ForceOption, JsonOption
from wlr_gym.cli.results import print_json
from wlr_gym.cli.robot_exchange import RobotExportOptions, RobotImportOptions, export_robot, import_robot
from wlr_gym.cli.robot_new import NewOptions, new_robot, print_findings

if TYPE_CHECKING:
    from wlr_gym.robot import Robot

#: SI; what is nearer to 0 is 0 but for rounding.
ROUNDING = 1e-12
PICTURES = (".png", ".jpg", ".jpeg", ".webp")


@dataclass(frozen=True)
class CheckOptions(JsonOption):
    """Look for what is wrong or odd about a robot: units, masses, inertias, and what it cannot do, with numbers.

    Attributes:
        robot: robot file, or name in configs/robot/.
        strict: warnings too give exit code 1.
    """

    robot: Annotated[str, tyro.conf.Positional] = "nominal"
    strict: bool = False


@dataclass(frozen=True)
class ShowOptions(JsonOption, ForceOption):
    """Show what a robot is and what it can do.

    Attributes:
        robot: robot file, or name in configs/robot/.
        picture: picture to write (.png, .jpg, .webp): standing, and with its legs at their limits.
    """

    robot: Annotated[str, tyro.conf.Positional] = "nominal"
    picture: Path | None = None


#: Command -> its options, and what it does.
COMMANDS = {
    "new": (NewOptions, "a robot file from a few questions"),
    "check": (CheckOptions, "what is wrong or odd about a robot, with numbers"),
    "show": (ShowOptions, "what a robot is and can do; a picture"),
    "import": (RobotImportOptions, "a robot file from MJCF or URDF"),
    "export": (RobotExportOptions, "a robot as MJCF or URDF"),
}


def run(options: NewOptions | CheckOptions | ShowOptions | RobotImportOptions | RobotExportOptions) -> int:
    """Do what the sub-command says."""
    match options:
        case NewOptions():
            return new_robot(options)
        case CheckOptions():
            return _check(options)
        case ShowOptions():
            return _show(options)
        case RobotImportOptions():
            return import_robot(options)
        case RobotExportOptions():
            return export_robot(options)


def _check(options: CheckOptions) -> int:
    from wlr_gym.physics.feasibility import examine_robot
    from wlr_gym.robot import load_robot

    robot = load_robot(options.robot, check=False)
    findings = examine_robot(robot)
    if options.json:
        print_json({"robot": robot.name, "findings": findings})
    else:
        print_findings(robot, findings)
    against = findings if options.strict else [finding for finding in findings if finding.level == "fault"]
    return FAILED if against else OK


def _show(options: ShowOptions) -> int:
    from rich.console import Console

    from wlr_gym.cli.tables import print_table
    from wlr_gym.robot import load_robot, robot_hash

    if options.picture is not None:
        require_ending(options.picture, PICTURES, "--picture", any_case=True)
        if not options.picture.parent.is_dir():
            raise InputError(f"--picture {options.picture}: folder {options.picture.parent} does not exist")
        refuse_existing(options.picture, options.force, "--picture")
    robot = load_robot(options.robot)
    numbers = _numbers(robot)
    if options.json:
        print_json({"robot": robot.name, "fingerprint": robot_hash(robot), "numbers": numbers})
    else:
        rows = [(name, f"{one['value']:.4g}", one["unit"], one["meaning"]) for name, one in numbers.items()]
        print_table(
            Console(highlight=False),
            ("number", "value", "unit", "meaning"),
            rows,
            f"{robot.name}, fingerprint {robot_hash(robot)}",
        )
    if options.picture is not None:
        from wlr_gym.render.portrait import draw_portrait

        draw_portrait(options.picture, robot)
        print(f"written: {options.picture}")
    return OK


def _numbers(robot: Robot) -> dict[str, dict[str, Any]]:
    from wlr_gym.physics.feasibility import ENTRIES, capability_of

    can = capability_of(robot)
    values = {name: getattr(can, name) for name in ENTRIES}
    return {
        name: {"value": 0.0 if abs(values[name]) < ROUNDING else values[name], "unit": unit, "meaning": doc}
        for name, (unit, doc) in ENTRIES.items()
    }
