"""Settings: reading YAML, laying one file over its base, and checking data against a pydantic model. For every kind of file."""

from __future__ import annotations

import copy
import json
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar, TypeVar, get_args, get_origin

import yaml
from pydantic import AfterValidator, BaseModel, ConfigDict, ValidationError

from wlr_gym.base.errors import InputError, nearest
from wlr_gym.base.paths import find_config, named_by, named_in

ModelType = TypeVar("ModelType", bound=BaseModel)
#: What a file says, and its path as messages name it.
Layer = tuple[Any, str]


class SettingsModel(BaseModel):
    """A record of settings: frozen, finite numbers only, unknown keys refused."""

    model_config: ClassVar[ConfigDict] = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


def _ordered(limits: tuple[float, float]) -> tuple[float, float]:
    if limits[0] > limits[1]:
        raise ValueError("expected [low, high] with low <= high")
    return limits


#: Declares a pair of numbers as a range: ``Annotated[tuple[PositiveFloat, PositiveFloat], ORDERED]``.
ORDERED = AfterValidator(_ordered)


def overlay(base: Any, changes: Mapping[str, Any]) -> Any:
    """Return ``base`` with ``changes`` laid over it: mappings merge key by key, None removes a key."""
    if not isinstance(base, Mapping):
        return dict(changes)
    merged = dict(copy.deepcopy(base))
    for key, value in changes.items():
        if value is None:
            merged.pop(key, None)
        else:
            merged[key] = overlay(merged.get(key) or {}, value) if isinstance(value, Mapping) else value
    return merged


def nested(flat: Mapping[str, Any]) -> dict[str, Any]:
    """Return dotted key -> value as mappings in mappings: ``{"body.mass": 1.0}`` becomes ``{"body": {"mass": 1.0}}``."""
    whole: dict[str, Any] = {}
    for key, value in flat.items():
        *groups, last = key.split(".")
        place = whole
        for group in groups:
            place = place.setdefault(group, {})
        place[last] = value
    return whole


def merge_changes(first: Mapping[str, Any], second: Mapping[str, Any]) -> dict[str, Any]:
    """Return the changes that say what ``first`` says and, over it, ``second``: mappings merge key by key, None stays."""
    merged = {**first, **second}
    for key, value in second.items():
        if isinstance(value, Mapping) and isinstance(first.get(key), Mapping):
            merged[key] = merge_changes(first[key], value)
    return merged


def read_yaml(path: str | Path) -> Any:
    """Read a YAML file; a broken one is an :class:`InputError` naming file, line and column."""
    try:
        return parse_yaml(Path(path).read_text(encoding="utf-8"))
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        place = f", line {mark.line + 1}, column {mark.column + 1}" if mark else ""
        raise InputError(f"{path}{place}: broken YAML: {getattr(error, 'problem', error)}") from None
    except UnicodeDecodeError:
        raise InputError(f"{path}: is no text file; expected YAML in UTF-8") from None
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror or error}") from None


def read_json(path: str | Path) -> Any:
    """Read a JSON file; a broken one is an :class:`InputError` naming file, line and column."""
    try:
        return json.loads(Path(path).read_text(encoding="utf-8"))
    except json.JSONDecodeError as error:
        raise InputError(f"{path}, line {error.lineno}, column {error.colno}: broken JSON: {error.msg}") from None
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: cannot be read: {getattr(error, 'strerror', None) or error}") from None


def read_config(kind: str, source: str | Path) -> Layer:
    """Read a config given by path or by the name of a file in ``configs/<kind>/``."""
    path = find_config(kind, source)
    return read_yaml(path), str(path)


def read_layers(kind: str, source: str | Path) -> list[Layer]:
    """Return what a config says and what its bases say, the lowest first; see :func:`layers_of`."""
    return layers_of(kind, read_config(kind, source))


def layers_of(kind: str, top: Layer, read: Callable[[str, str | Path], Layer] = read_config) -> list[Layer]:
    """Return what ``top`` says and what its bases say, the lowest first, each without its key ``base``.

    A base is a name in ``configs/<kind>/`` or a path, looked for beside the file first.

    Raises:
        InputError: a base that is neither, that does not exist, or that is above itself.
    """
    found: list[Layer] = []
    data, where = top
    while isinstance(data, Mapping) and (base := data.get("base")) is not None:
        above = [place for _, place in found]
        if where in above:
            raise InputError(f"{where}: is its own base ({' -> '.join([*above, where])})")
        if not isinstance(base, str | Path):
            raise InputError(f"{where}: base = {base!r}: expected the name or the path of a {kind} config")
        found.append((_without_base(data), where))
        with named_by(where, "base"):
            data, where = read(kind, named_in(where, base))
    found.append((_without_base(data), where))
    return found[::-1]


def _without_base(data: Any) -> Any:
    return {key: value for key, value in data.items() if key != "base"} if isinstance(data, Mapping) else data


def parse_yaml(text: str) -> Any:
    """Return what YAML text says, as a file of ours is read: 1e-3 is a number.

    Raises:
        yaml.YAMLError: broken, or a key given twice.
    """
    try:
        return yaml.load(text, Loader=_FAST)
    except (yaml.YAMLError, UnicodeEncodeError):
        return yaml.load(text, Loader=_PLAIN)  # says better what is wrong, and where


def _loader(base: Any) -> Any:
    """Loader that reads 1e-3 and 2.5e-4 as numbers (YAML 1.1 takes the former for text) and refuses a key given twice."""

    class Loader(base):
        def construct_document(self, node: yaml.Node) -> Any:
            """Return what a document says; its mappings are looked at as they are written, before merging by ``<<``."""
            _refuse_doubled_keys(node, set())
            return super().construct_document(node)

    exponent = re.compile(r"^[-+]?[0-9][0-9_]*(\.[0-9_]*)?[eE][-+]?[0-9]+$")
    Loader.add_implicit_resolver("tag:yaml.org,2002:float", exponent, list("-+0123456789"))
    return Loader


#: libyaml, where PyYAML has it, is six times as fast.
_FAST, _PLAIN = _loader(getattr(yaml, "CSafeLoader", yaml.SafeLoader)), _loader(yaml.SafeLoader)


def _refuse_doubled_keys(node: yaml.Node, seen: set[int]) -> None:
    if id(node) in seen or isinstance(node, yaml.ScalarNode):
        return
    seen.add(id(node))
    lines: dict[str, int] = {}
    for child in node.value:
        key, value = child if isinstance(node, yaml.MappingNode) else (None, child)
        if isinstance(key, yaml.ScalarNode):
            if key.value in lines:
                problem = f"key '{key.value}' occurs twice, first in line {lines[key.value]}"
                raise yaml.constructor.ConstructorError(problem=problem, problem_mark=key.start_mark)
            lines[key.value] = key.start_mark.line + 1
        _refuse_doubled_keys(value, seen)


def parse_config(model: type[ModelType], data: object, where: str) -> ModelType:
    """Validate ``data`` against a pydantic model.

    Raises:
        InputError: naming file, field, value, what was expected and, for an unknown key, the nearest valid name.
    """
    require_keys(model, data, where)
    try:
        return model.model_validate(data)
    except ValidationError as error:
        raise refusal(model, data, error, where) from None


def require_keys(model: type[BaseModel], data: object, where: str) -> None:
    """Raise :class:`InputError` where the content of a file is not keys and values."""
    keys = ", ".join(model.model_fields)
    if data is None:
        raise InputError(f"{where}: the file is empty; expected the keys {keys}")
    if not isinstance(data, dict):
        raise InputError(f"{where}: {shown(data)}: expected keys and values; keys: {keys}")


def parse_options(model: type[ModelType], given: Mapping[str, Any]) -> ModelType:
    """Validate the options of a command, which have the names of the model's fields.

    Raises:
        InputError: naming the option, its value and what was expected.
    """
    try:
        return model.model_validate(given)
    except ValidationError as error:
        problem = error.errors()[0]
        name = str(problem["loc"][0]).replace("_", "-")
        raise InputError(f"--{name} {shown(problem['input'], str)}: {expected(problem)}") from None


# ---- what pydantic refuses, in our words: field, value and what was expected ------------------------------------------


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
    "too_short": "at least {min_length}",
    "union_tag_invalid": "{discriminator} one of {expected_tags}",
    "union_tag_not_found": "a key {discriminator}",
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
    """Return the keys that may stand at a place; where it may hold one model or another, those of all."""
    models = [model]
    for part in path:
        models = [found for one in models for found in _models_in(_annotation_at(one, part))]
    return list(dict.fromkeys(name for one in models for name in getattr(one, "model_fields", {})))


def _annotation_at(model: Any, part: str) -> Any:
    if get_origin(model) in (dict, list):
        return get_args(model)[-1]
    field = getattr(model, "model_fields", {}).get(part)
    return None if field is None else field.annotation


def _models_in(annotation: Any) -> list[Any]:
    """Return the models, mappings and lists among the types that a value may have, such as X of X | None."""
    if get_origin(annotation) in (dict, list) or hasattr(annotation, "model_fields"):
        return [annotation]
    return [found for one in get_args(annotation) for found in _models_in(one)]
