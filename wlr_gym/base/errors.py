"""Errors a user can act on (what was wrong, where, what was expected, and the nearest valid name), and checks that raise them.

The sentence of a refusal is written here, once. Settings of a file declare their ranges with their fields
(:mod:`wlr_gym.base.settings`); the checks are for arguments, options, and numbers that are read otherwise. A ``place`` is how
the user calls the value: ``"--segment"``, ``"robot.yaml: body.mass"``.
"""

from __future__ import annotations

import difflib
import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, get_args, get_type_hints


class InputError(ValueError):
    """Bad input from the user (file, config, argument, action). The command line answers it with exit code 2."""


class MissingPackageError(ImportError):
    """An optional package is needed for what was asked; the message says how to install it."""


def nearest(name: str, valid: Iterable[str]) -> str:
    """Return `` (did you mean 'x'?)`` for the valid name closest to ``name``, or an empty string."""
    options = list(valid)
    lowered = {option.lower(): option for option in options}
    begun = [option for option in lowered if name and option.startswith(name.lower())]
    close = difflib.get_close_matches(name.lower(), lowered, n=3, cutoff=0.51) or begun
    swapped = [option for option in close if sorted(option) == sorted(name.lower())]  # letters in another order are likeliest
    return f" (did you mean '{lowered[(swapped or close)[0]]}'?)" if close else ""


def unknown_name(kind: str, name: str, valid: Iterable[str], where: str = "") -> InputError:
    """Build the error for a name that does not exist, listing the valid ones and the nearest."""
    options = sorted(valid)
    place = f"{where}: " if where else ""
    return InputError(f"{place}unknown {kind} '{name}'{nearest(name, options)}; valid: {', '.join(options)}")


def require_package(package: str, extra: str) -> None:
    """Raise :class:`MissingPackageError` with the pip line when an optional package is absent."""
    import importlib.util

    if importlib.util.find_spec(package) is None:
        raise MissingPackageError(f"this needs the package '{package}': pip install 'wlr-gym[{extra}]'")


# --- checks of single values -----------------------------------------------------------------------------------------


#: Largest seed of commands and trainings: NumPy's older generator, which libraries seed too, takes no larger one.
LARGEST_SEED = 2**32 - 1
#: Largest seed of a simulator's noise, whose keys have 64 bits.
LARGEST_NOISE_SEED = 2**64 - 1


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
    kind = "a whole number" if whole else "a finite number" if isinstance(value, float) and not math.isfinite(value) else ""
    wanted = " ".join(filter(None, (_range(kind, above, least, most, below), unit)))
    raise InputError(f"{stated(place, shown)}: expected {wanted}{what and '; '}{what}")


def stated(place: str, shown: str) -> str:
    """Return a value at its place, as messages write it: ``--seed -1``, ``robot.yaml: body.mass = -1``."""
    return f"{place} {shown}" if place.rpartition(" ")[2].startswith("--") else f"{place} = {shown}"


def _range(kind: str, above: float | None, least: float | None, most: float | None, below: float | None) -> str:
    def bound(number: float) -> str:
        return str(number) if isinstance(number, int) else f"{number:g}"

    if least is not None and most is not None:
        return f"{kind or 'a number'} from {bound(least)} to {bound(most)}"
    upper = f"at most {bound(most)}" if most is not None else f"less than {bound(below)}" if below is not None else ""
    lower = f"more than {bound(above)}" if above is not None else f"{bound(least)} or more" if least is not None else ""
    bounds = " and ".join(filter(None, (lower, upper)))
    return ", ".join(filter(None, (kind, bounds))) or "a finite number"


def require_seed(name: str, seed: int, largest: int = LARGEST_SEED) -> None:
    """Raise :class:`InputError` for a seed out of range; the message begins with ``name``."""
    if not 0 <= seed <= largest:
        raise InputError(f"{name} {seed}: expected 0 to {largest}")


@dataclass(frozen=True)
class Interval:
    """Which numbers a field of a dataclass takes: ``Annotated[float, Interval("s", above=0.0)]``; see :func:`check_number`."""

    unit: str = ""
    above: float | None = None
    least: float | None = None
    most: float | None = None
    below: float | None = None


def check_ranges(options: Any, prefix: str = "--") -> None:
    """Refuse the first number of a dataclass that is out of the range that its field declares; None = left open.

    Args:
        options: instance of the dataclass.
        prefix: of the names of fields in messages; behind ``--`` a name has hyphens.
    """
    for name, hint in get_type_hints(type(options), include_extras=True).items():
        value = getattr(options, name)
        place = prefix + (name.replace("_", "-") if prefix == "--" else name)
        for one in _ranges(hint) if value is not None else ():
            check_number(place, value, **vars(one))


def _ranges(hint: Any) -> Iterator[Interval]:
    yield from (one for one in getattr(hint, "__metadata__", ()) if isinstance(one, Interval))
    for part in get_args(hint):
        yield from _ranges(part)


def check_name(kind: str, name: Any, valid: Iterable[str], place: str = "") -> None:
    """Refuse a name that is not among the valid ones."""
    if name not in (options := list(valid)):
        raise unknown_name(kind, str(name), options, place)


def check_file(path: Path, place: str = "") -> None:
    """Refuse a path at which there is no file."""
    if not path.is_file():
        found = "is a folder" if path.is_dir() else "no such file"
        raise InputError(f"{place and place + ' '}{path}: {found}; expected a file")


def check_folder(path: Path, place: str = "", of: str = "") -> None:
    """Refuse a path at which there is no folder; ``of`` says what it is to hold."""
    if not path.is_dir():
        found = "is a file" if path.is_file() else "no such folder"
        raise InputError(f"{place and place + ' '}{path}: {found}; expected a folder{of and ' of '}{of}")
