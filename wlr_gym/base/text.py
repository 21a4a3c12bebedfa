"""Numbers, times and settings as people write and read them."""

from __future__ import annotations

import json
import math
import shlex
from collections.abc import Iterable, Mapping
from typing import Any

from wlr_gym.base.errors import InputError


def number(value: float, digits: int = 3) -> str:
    """Return a number with so many significant digits; ``-`` if it is none."""
    if not math.isfinite(value):
        return "-"
    return f"{value:.0f}" if 10**digits <= abs(value) < 1e7 else f"{value:.{digits}g}"


def row_words(path: object, row: int) -> str:
    """Return which row of a table it is, from 0 below the header; of a CSV file also which line an editor shows it as."""
    return f"row {row} (line {row + 2})" if str(path).lower().endswith(".csv") else f"row {row}"


def duration(seconds: float) -> str:
    """Return ``3 min 20 s``; from an hour on ``2 h 5 min``."""
    whole = round(seconds)
    if whole >= 3600:
        return f"{whole // 3600} h {whole % 3600 // 60} min"
    return f"{whole // 60} min {whole % 60} s" if whole >= 60 else f"{whole} s"


def counted(count: int, word: str) -> str:
    """Return ``1 trial``, ``2 trials``."""
    return f"{count} {word}{'' if count == 1 else 's'}"


def tally(values: Mapping[str, object]) -> str:
    """Return ``backlash 3, tether 1``."""
    return ", ".join(f"{name} {value}" for name, value in values.items())


def pairs(what: str, words: Iterable[str], example: str) -> dict[str, str]:
    """Return name -> value of words such as ``name=value``.

    Raises:
        InputError: another word, or a name given twice; the message names ``what`` the words are, and the example.
    """
    found: dict[str, str] = {}
    for word in words:
        name, _, value = word.partition("=")
        name = name.strip()
        if not (name and value):
            raise InputError(f"{what} {word}: expected name=value, such as {example}")
        if name in found:
            raise InputError(f"{what}: '{name}' is given twice, {found[name]} and {value}: expected once, such as {example}")
        found[name] = value
    return found


def json_text(content: Any) -> str:
    """Return JSON in ASCII; a number that is not finite is null, a dataclass an object of its fields, an array a list.

    Raises:
        ValueError: something that JSON has not.
    """
    from pydantic_core import to_jsonable_python

    return json.dumps(to_jsonable_python(content, inf_nan_mode="null", fallback=_json_value), indent=2)


def _json_value(value: Any) -> Any:
    if isinstance(value, Mapping):
        return dict(value)
    if hasattr(value, "tolist"):
        return value.tolist()
    raise ValueError(f"{type(value).__name__}: JSON has no such value")


def quoted(value: object) -> str:
    """Return a path or word as a shell takes it, for commands that messages print."""
    return shlex.quote(str(value))
