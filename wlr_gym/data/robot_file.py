"""The robot of measured runs: by name where it ships, else by its content, in a file beside the runs, with its fingerprint."""

from __future__ import annotations

from pathlib import Path

import yaml

from wlr_gym.base.errors import InputError, unknown_name
from wlr_gym.base.files import make_output_folder, write_text
from wlr_gym.base.paths import data_directory
from wlr_gym.base.settings import read_yaml
from wlr_gym.data.format import META_FILE, ROBOT_FILE, RunMeta
from wlr_gym.robot import Robot, load_robot, robot_content, robot_hash


def shipped_robots() -> dict[str, Path]:
    """Return name inside the file, and name of the file -> path, of the robots that ship."""
    paths = sorted((data_directory("configs") / "robot").glob("*.yaml"))
    return {str((read_yaml(path) or {}).get("name")): path for path in paths} | {path.stem: path for path in paths}


def is_shipped(robot: Robot) -> bool:
    """Whether a robot is, number for number, the one that ships under its name."""
    path = shipped_robots().get(robot.name)
    return path is not None and load_robot(path, check=False) == robot


def write_robot(path: Path, robot: Robot) -> None:
    """Write a robot as a file that :func:`wlr_gym.robot.load_robot` reads, every number in it; the same content stays as it is.

    Raises:
        InputError: the file is there and holds another robot.
    """
    if path.is_file():
        if load_robot(path, check=False) != robot:
            raise InputError(f"{path}: holds another robot than '{robot.name}'; write to another folder")
        return
    text = yaml.safe_dump(robot_content(robot), sort_keys=False, allow_unicode=True)
    write_text(path, f"# Every number of the robot of this folder; fingerprint {robot_hash(robot)}\n{text}")


def noted(robot: Robot, meta: RunMeta) -> RunMeta:
    """Return the meta data that :func:`note_robot` returns; nothing is written."""
    if is_shipped(robot):
        return meta.model_copy(update={"robot": robot.name, "robot_hash": None})
    return meta.model_copy(update={"robot": ROBOT_FILE, "robot_hash": robot_hash(robot)})


def note_robot(folder: Path, robot: Robot, meta: RunMeta) -> RunMeta:
    """Return the meta data of runs in ``folder`` so that they find their robot wherever the folder goes.

    A robot that ships is named. Another one is written beside the runs, as ``robot.yaml``, and its fingerprint noted.

    Raises:
        InputError: the folder holds another robot.
    """
    found = noted(robot, meta)
    if found.robot == ROBOT_FILE:
        make_output_folder(folder)
        write_robot(folder / ROBOT_FILE, robot)
    return found


def names_file(robot: str | None) -> bool:
    """Whether meta data name their robot by a file; its fingerprint may be noted or not."""
    return robot is not None and Path(robot).suffix in {".yaml", ".yml"}


def own_robot(meta: RunMeta, folder: Path) -> Robot | None:
    """Return the robot that has to go with meta data to another folder; None = they name one that ships, or none.

    Raises:
        InputError: see :func:`robot_of_meta`.
    """
    return robot_of_meta(meta, folder) if names_file(meta.robot) else None


def robot_of_meta(meta: RunMeta, folder: Path, file: str = META_FILE) -> Robot:
    """Return the robot that meta data name: a file (relative to them), a config, or the ``name`` inside one; None = nominal.

    ``file`` in ``folder`` has them, for messages.

    Raises:
        InputError: no such robot (the message lists the shipped ones), or a file that changed since the runs were recorded.
    """
    if meta.robot is None:
        return load_robot()
    if not names_file(meta.robot):
        shipped = shipped_robots()
        if meta.robot not in shipped:
            error = unknown_name("robot", meta.robot, shipped, str(folder / file))
            raise InputError(f"{error}; a robot of your own is named by its file (a path from {file} on), or with --robot")
        return load_robot(shipped[meta.robot])
    path = folder / meta.robot
    robot = load_robot(path)
    if meta.robot_hash not in (None, found := robot_hash(robot)):
        raise InputError(
            f"{path}: its fingerprint is {found}, {file} says {meta.robot_hash}: it is not the robot of these runs any "
            "more; name the one to use with --robot"
        )
    return robot
