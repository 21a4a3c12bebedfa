"""Settings: reading YAML, laying one file over its base, and checking data against a pydantic model. For every kind of file."""

from __future__ import annotations

import copy
import re
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, ClassVar, TypeVar

import yaml
from pydantic import BaseModel, ConfigDict, ValidationError

from wlr_gym.base.errors import InputError
from wlr_gym.base.paths import find_config, named_by, named_in
from wlr_gym.base.refusals import expected, refusal, shown

ModelType = TypeVar("ModelType", bound=BaseModel)
#: What a file says, and its path as messages name it.
Layer = tuple[Any, str]


class SettingsModel(BaseModel):
    """A record of settings: frozen, finite numbers only, unknown keys refused."""

    model_config: ClassVar[ConfigDict] = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


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
