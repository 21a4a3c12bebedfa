"""Settings: reading YAML, laying one file over its base, and checking data against a pydantic model. For every kind of file."""

from __future__ import annotations

import copy
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any, TypeVar, get_args, get_origin

import yaml
from pydantic import BaseModel, ConfigDict, ValidationError

from wlr_gym.base.errors import InputError, nearest

ModelType = TypeVar("ModelType", bound=BaseModel)


class Model(BaseModel):
    """A record of settings: frozen, finite numbers only, unknown keys refused."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


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
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: cannot be read: {getattr(error, 'strerror', None) or error}") from None


def parse_yaml(text: str) -> Any:
    """Return what YAML text says, as a file of ours is read: 1e-3 is a number.

    Raises:
        yaml.YAMLError: broken, or a key given twice.
    """
    return yaml.load(text, Loader=_Loader)


class _Loader(yaml.SafeLoader):
    """SafeLoader that reads 1e-3 and 2.5e-4 as numbers (YAML 1.1 takes the former for text) and refuses a key given twice."""

    def compose_mapping_node(self, anchor: Any) -> Any:
        """Read a mapping as it is written; merging by ``<<`` comes later."""
        node = super().compose_mapping_node(anchor)
        lines: dict[str, int] = {}
        for key in (key for key, _ in node.value if isinstance(key, yaml.ScalarNode)):
            if key.value in lines:
                problem = f"key '{key.value}' occurs twice, first in line {lines[key.value]}"
                raise yaml.constructor.ConstructorError(problem=problem, problem_mark=key.start_mark)
            lines[key.value] = key.start_mark.line + 1
        return node


_Loader.add_implicit_resolver(
    "tag:yaml.org,2002:float", re.compile(r"^[-+]?[0-9][0-9_]*(\.[0-9_]*)?[eE][-+]?[0-9]+$"), list("-+0123456789")
)


def parse_config(model: type[ModelType], data: object, where: str) -> ModelType:
    """Validate ``data`` against a pydantic model.

    Raises:
        InputError: naming file, field, value, what was expected and, for an unknown key, the nearest valid name.
    """
    if not isinstance(data, dict):
        raise InputError(f"{where}: expected a mapping of {', '.join(model.model_fields)}, got {type(data).__name__}")
    try:
        return model.model_validate(data)
    except ValidationError as error:
        raise InputError("; ".join(_explain(model, problem, where) for problem in error.errors())) from None


def _explain(model: type[BaseModel], problem: Any, where: str) -> str:
    location = [str(part) for part in problem["loc"]]
    field = ".".join(location)
    if problem["type"] == "extra_forbidden":
        valid = _fields_at(model, location[:-1])
        return f"{where}: unknown key '{field}'{nearest(location[-1], valid)}; valid: {', '.join(valid)}"
    if problem["type"] == "missing":
        return f"{where}: '{field}' is missing"
    if isinstance(refused := problem.get("ctx", {}).get("error"), InputError):
        return f"{where}: {refused}"
    value = f"{field} = {problem['input']!r}: " if field else ""  # what is about the whole file does not repeat it
    return f"{where}: {value}{problem['msg']}"


def _fields_at(model: Any, path: list[str]) -> list[str]:
    for part in path:
        if get_origin(model) is dict:
            model = get_args(model)[1]
            continue
        field = getattr(model, "model_fields", {}).get(part)
        if field is None:
            return []
        options = get_args(field.annotation)
        model = options[0] if type(None) in options else field.annotation  # X | None
    return list(getattr(model, "model_fields", {}))
