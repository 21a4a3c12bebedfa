"""Scalar terms: functions of named signals that are traced into one compiled kernel per task."""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from wlr_gym.base.errors import InputError, unknown_name

Function = Callable[..., Any]

POSITIVE = (0.0, math.inf)


@dataclass(frozen=True)
class ScalarTerm:
    """One reward, termination or measure.

    Attributes:
        name: as in the task's YAML.
        function: ``function(signals, **parameters)``, written with ``wlr_gym.physics.codegen.ops``.
        parameters: names and default values of its parameters.
        ranges: name -> (low, high) that the parameter must lie between, both excluded.
        doc: first line of its docstring.
        unit: of its value; rewards and terminations have none.
    """

    name: str
    function: Function
    parameters: dict[str, float]
    ranges: dict[str, tuple[float, float]]
    doc: str
    unit: str = ""


def refuse_another(function: Function, present: Function | None) -> None:
    """Refuse a term whose name is taken by another one; the same one may come again, as its module is imported anew.

    Raises:
        InputError: naming both modules.
    """
    if present is None or (present.__module__, present.__qualname__) != (function.__module__, function.__qualname__):
        where = "the library" if present is None else present.__module__
        raise InputError(f"term '{function.__name__}' of {function.__module__}: {where} has one of that name; give it another")


def registered(
    registry: dict[str, ScalarTerm], unit: str = "", **ranges: tuple[float, float]
) -> Callable[[Function], Function]:
    """Return a decorator that enters a function into ``registry`` under its own name, with ranges of its parameters.

    Raises:
        InputError: a range of a parameter that the function does not have, or a name that is taken.
    """

    def enter(function: Function) -> Function:
        defaults = {
            name: float(parameter.default)
            for name, parameter in inspect.signature(function).parameters.items()
            if parameter.kind is inspect.Parameter.KEYWORD_ONLY
        }
        for name in ranges:
            if name not in defaults:
                raise unknown_name("parameter", name, defaults, f"term '{function.__name__}' of {function.__module__}")
        doc = (inspect.getdoc(function) or "").partition("\n")[0]
        if function.__name__ in registry:
            refuse_another(function, registry[function.__name__].function)
        registry[function.__name__] = ScalarTerm(function.__name__, function, defaults, ranges, doc, unit)
        return function

    return enter
