"""Text of a robot file over a base, and the robot that it is."""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

import yaml

from wlr_gym.base.settings import overlay, parse_config
from wlr_gym.robot.description import Robot, load_robot
from wlr_gym.robot.parameter_table import spec_of

#: Width at which a comment starts.
_COMMENT = 42


def robot_text(
    name: str, base: str, numbers: Mapping[str, Any], *, title: Iterable[str] = (), comments: Mapping[str, str] | None = None
) -> str:
    """Return a robot file (YAML).

    Args:
        name: of the robot.
        base: config name or path of the robot that has all other numbers.
        numbers: keys of a robot file -> values, nested as in one.
        title: lines at its top, as comments.
        comments: dotted key -> comment beside it.
    """
    lines = [*(f"# {line}".rstrip() for line in title), "", f"base: {_scalar(base)}", f"name: {_scalar(name)}", ""]
    return "\n".join([*lines, *_lines(numbers, "", comments or {})]) + "\n"


def _lines(numbers: Mapping[str, Any], above: str, comments: Mapping[str, str]) -> Iterator[str]:
    indent = "  " * above.count(".")
    for key, value in numbers.items():
        if isinstance(value, Mapping):
            yield f"{indent}{key}:"
            yield from _lines(value, f"{above}{key}.", comments)
            if not above:
                yield ""
            continue
        line, comment = f"{indent}{key}: {_scalar(value)}", comments.get(above + key)
        yield f"{line:<{_COMMENT}} # {comment}" if comment else line


def _scalar(value: Any) -> str:
    return yaml.safe_dump(value, default_flow_style=True, width=1000).removesuffix("...\n").strip()


def base_beside(base: str, out: Path) -> str:
    """Return how a file at ``out`` names its base: a path is seen from the file's own folder."""
    if not base.endswith((".yaml", ".yml")):
        return base
    return Path(os.path.relpath(base, out.parent)).as_posix()


def of_all(numbers: Mapping[str, Any], base: str) -> dict[str, Any]:
    """Return numbers that also remove what the base says of single legs, wheels or servos where they state it of all."""
    removed = {}
    for element in load_robot(base, check=False).individual:
        spec = spec_of(element)
        found: Any = numbers
        for key in str(spec.sources[spec.elements.index(element) % len(spec.sources)]).split("."):
            found = found.get(key) if isinstance(found, Mapping) else None
        if found is not None:
            removed[element] = None
    return {**numbers, "individual": removed} if removed else dict(numbers)


def robot_over(base: str, name: str, numbers: Mapping[str, Any], where: Path, *, check: bool = True) -> Robot:
    """Return the robot that a file at ``where`` with these numbers over ``base`` would be.

    Raises:
        InputError: as :func:`wlr_gym.robot.load_robot` of that file.
    """
    below = load_robot(base, check=False).model_dump(mode="json")
    robot = parse_config(Robot, overlay(below, {**numbers, "name": name}), str(where))
    return load_robot(robot, check=check)
