"""What pydantic refuses, in our words: field, value and what was expected."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any, get_args, get_origin

from pydantic import BaseModel, ValidationError

from wlr_gym.base.errors import InputError, nearest

#: Kind of a refusal, as pydantic calls it -> what was expected.
_EXPECTED = {
    "greater_than": "more than {gt}",
    "greater_than_equal": "{ge} or more",
    "less_than": "less than {lt}",
    "less_than_equal": "{le} or less",
    "float_type": "a number",
    "float_parsing": "a number",
    "finite_number": "a finite number",
    "int_type": "a whole number",
    "int_parsing": "a whole number",
    "int_from_float": "a whole number",
    "bool_type": "true or false",
    "bool_parsing": "true or false",
    "string_type": "text",
    "dict_type": "keys and values",
    "model_type": "keys and values",
    "list_type": "a list",
    "tuple_type": "a list",
}
#: Letters of a value that a message shows; a longer one is cut.
_LONGEST = 60


def refusal(model: type[BaseModel], data: object, error: ValidationError, where: str) -> InputError:
    """Return the error that names the place once, and each fault in a line of its own where there are several."""
    faults = _faults(model, data, error.errors())
    if len(faults) == 1:
        return InputError(f"{where}: {faults[0]}")
    return InputError("\n  ".join([f"{where}: {len(faults)} faults", *faults]))


def expected(problem: Any) -> str:
    """Return what was expected, such as ``expected more than 0``, or what pydantic or a model's own check says."""
    context = problem.get("ctx", {})
    if problem["type"] in _EXPECTED:
        return "expected " + _EXPECTED[problem["type"]].format(**{name: _plain(value) for name, value in context.items()})
    if problem["type"] == "value_error":
        return str(context["error"])
    return problem["msg"].replace("Input should be", "expected")


def shown(value: object, write: Any = repr) -> str:
    """Return a value as a message shows it, cut where it is long."""
    text = write(value)
    return text if len(text) <= _LONGEST else f"{text[:_LONGEST]}..."


def _plain(value: object) -> object:
    return f"{value:.12g}" if isinstance(value, float) else value


def _faults(model: type[BaseModel], data: object, problems: Iterable[Any]) -> list[str]:
    """Return the faults; where a value may be one thing or another, what either would have been."""
    by_place: dict[tuple[str, ...], list[Any]] = {}
    for problem in problems:
        by_place.setdefault(_place(problem, data), []).append(problem)
    inside = {place[:depth] for place in by_place for depth in range(1, len(place))}
    return [_fault(model, place, by_place[place]) for place in by_place if place not in inside]


def _place(problem: Any, data: object) -> tuple[str, ...]:
    """Return where a fault is in the data; pydantic names the type it tried, too, where there are several."""
    place = []
    *parts, last = problem["loc"] or ("",)
    for part in parts:
        if inside := _inside(data, part):
            data = inside[0]
            place.append(str(part))
    if last != "" and (problem["type"] in ("missing", "extra_forbidden") or _inside(data, last)):
        place.append(str(last))
    return tuple(place)


def _inside(data: object, part: object) -> tuple[object] | None:
    """Return what is in the data at a key or place, alone in a tuple; None = nothing is."""
    if isinstance(data, BaseModel) and isinstance(part, str) and part in type(data).model_fields:
        return (getattr(data, part),)
    if isinstance(data, Mapping) and part in data:
        return (data[part],)
    if isinstance(data, Sequence) and not isinstance(data, str) and isinstance(part, int) and part < len(data):
        return (data[part],)
    return None


def _fault(model: type[BaseModel], place: tuple[str, ...], problems: list[Any]) -> str:
    first, field = problems[0], ".".join(place)
    if first["type"] == "extra_forbidden":
        valid = _fields_at(model, place[:-1])
        return f"unknown key '{field}'{nearest(place[-1], valid)}; valid: {', '.join(valid)}"
    if first["type"] == "missing":
        return f"'{field}' is missing"
    if isinstance(refused := first.get("ctx", {}).get("error"), InputError):
        return str(refused)
    value = f"{field} = {shown(first['input'])}: " if field else ""  # what is about the whole file does not repeat it
    wanted = _fields_at(model, place) if field and first["type"] in ("dict_type", "model_type") else []
    keys = f"; keys: {', '.join(wanted)}" if wanted else ""
    return f"{value}{_either(problems)}{keys}"


def _either(problems: Sequence[Any]) -> str:
    """Return what was expected, or what else would have been."""
    first, *others = map(expected, problems)
    return ", or ".join(dict.fromkeys([first, *(one.removeprefix("expected ") for one in others)]))


def _fields_at(model: Any, path: Iterable[str]) -> list[str]:
    for part in path:
        if get_origin(model) is dict:
            model = _chosen(get_args(model)[1])
            continue
        field = getattr(model, "model_fields", {}).get(part)
        if field is None:
            return []
        model = _chosen(field.annotation)
    return list(getattr(model, "model_fields", {}))


def _chosen(annotation: Any) -> Any:
    """Return the model among the types that a value may have, such as X of X | None."""
    if get_origin(annotation) is dict:
        return annotation
    return next((one for one in get_args(annotation) if hasattr(one, "model_fields")), annotation)
