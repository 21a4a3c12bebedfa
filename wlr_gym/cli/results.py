"""Results as JSON on the standard output, alone: what else a command prints goes to the standard error meanwhile."""

from __future__ import annotations

import contextlib
import dataclasses
import json
import math
import sys
from collections.abc import Iterator, Mapping
from contextvars import ContextVar
from pathlib import Path
from typing import Any, TextIO

import numpy as np

#: The standard output, while only results may be printed on it.
_OUTPUT: ContextVar[TextIO | None] = ContextVar("output", default=None)


@contextlib.contextmanager
def only_results(wanted: bool) -> Iterator[None]:
    """Keep everything but :func:`print_json` from the standard output, where that is wanted."""
    if not wanted:
        yield
        return
    token = _OUTPUT.set(sys.stdout)
    try:
        with contextlib.redirect_stdout(sys.stderr):
            yield
    finally:
        _OUTPUT.reset(token)


def print_json(content: Any) -> None:
    """Print results as JSON; a number that is not finite is null, a dataclass an object of its fields."""
    print(json.dumps(plain(content), indent=2, allow_nan=False), file=_OUTPUT.get() or sys.stdout, flush=True)


def plain(value: Any) -> Any:
    """Return a value of what JSON has."""
    match value:
        case float() if not math.isfinite(value):
            return None
        case None | bool() | int() | float() | str():
            return value
        case np.generic() | np.ndarray():
            return plain(value.tolist())
        case Mapping():
            return {str(key): plain(one) for key, one in value.items()}
        case list() | tuple() | set() | frozenset():
            return [plain(one) for one in value]
        case Path():
            return str(value)
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {field.name: plain(getattr(value, field.name)) for field in dataclasses.fields(value)}
    raise TypeError(f"{type(value).__name__}: JSON has no such value")
