"""Checks of single values that a user gives; the sentence of a refusal is written here, once.

Settings of a file declare their ranges with their fields (:mod:`wlr_gym.base.settings`). These are for arguments, options, and
numbers that are read otherwise. A ``place`` is how the user calls the value: ``"--segment"``, ``"robot.yaml: body.mass"``.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from wlr_gym.base.errors import InputError, unknown_name


def check_number(
    place: str,
    value: Any,
    unit: str = "",
    *,
    above: float | None = None,
    least: float | None = None,
    most: float | None = None,
    below: float | None = None,
    whole: bool = False,
    what: str = "",
) -> None:
    """Refuse a value that is no finite number, or not in its range.

    Args:
        place: how messages call it; an option begins with ``--``.
        value: what was given.
        unit: of the value and the bounds.
        above, least, most, below: the range, with its ends (``least``, ``most``) or without; None = open.
        whole: only whole numbers.
        what: added to the message: why the range is as it is, or what to do.

    Raises:
        InputError: naming the value and what was expected.
    """
    is_number = isinstance(value, int) if whole else isinstance(value, int | float)
    if is_number and not isinstance(value, bool) and math.isfinite(value):
        inside = (
            (above is None or value > above)
            and (least is None or value >= least)
            and (most is None or value <= most)
            and (below is None or value < below)
        )
        if inside:
            return
    shown = f"{value:g}" if isinstance(value, float) else repr(value)
    wanted = " ".join(filter(None, (_range(above, least, most, below, whole), unit)))
    raise InputError(f"{stated(place, shown)}: expected {wanted}{what and '; '}{what}")


def stated(place: str, shown: str) -> str:
    """Return a value at its place, as messages write it: ``--seed -1``, ``robot.yaml: body.mass = -1``."""
    return f"{place} {shown}" if place.rpartition(" ")[2].startswith("--") else f"{place} = {shown}"


def _range(above: float | None, least: float | None, most: float | None, below: float | None, whole: bool) -> str:
    kind = "a whole number" if whole else ""
    upper = f"{most:g} at most" if most is not None else f"less than {below:g}" if below is not None else ""
    if least is not None and most is not None:
        return f"{kind or 'a number'} from {least:g} to {most:g}"
    lower = f"more than {above:g}" if above is not None else f"{least:g} or more" if least is not None else ""
    bounds = " and ".join(filter(None, (lower, upper)))
    return ", ".join(filter(None, (kind, bounds))) or "a finite number"


def check_name(kind: str, name: Any, valid: Iterable[str], place: str = "") -> None:
    """Refuse a name that is not among the valid ones.

    Raises:
        InputError: listing them and naming the nearest; see :func:`wlr_gym.base.errors.unknown_name`.
    """
    if name not in (options := list(valid)):
        raise unknown_name(kind, str(name), options, place)


def check_file(path: Path, place: str = "") -> None:
    """Refuse a path at which there is no file.

    Raises:
        InputError: naming it, and what is there instead.
    """
    if not path.is_file():
        found = "is a folder" if path.is_dir() else "no such file"
        raise InputError(f"{place and place + ' '}{path}: {found}; expected a file")


def check_folder(path: Path, place: str = "") -> None:
    """Refuse a path at which there is no folder.

    Raises:
        InputError: naming it, and what is there instead.
    """
    if not path.is_dir():
        found = "is a file" if path.is_file() else "no such folder"
        raise InputError(f"{place and place + ' '}{path}: {found}; expected a folder")
