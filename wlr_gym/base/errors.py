"""Errors a user can act on: what was wrong, where, what was expected, and the nearest valid name."""

from __future__ import annotations

import difflib
from collections.abc import Iterable


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
