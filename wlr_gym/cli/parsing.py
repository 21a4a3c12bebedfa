"""Words behind a command to its options, by tyro: a field of the dataclass is an option, the string below it is its help.

Tyro checks types and choices, says what is wrong, lays out help and completes in shells. A number's range is declared with its
field (:class:`wlr_gym.base.checks.Interval`).
"""

from __future__ import annotations

import dataclasses
import functools
import inspect
import operator
import re
import shutil
import textwrap
from collections.abc import Mapping, Sequence
from typing import Annotated, Any, get_type_hints

from wlr_gym.base.checks import check_ranges
from wlr_gym.base.errors import InputError

#: Shells that commands and options are completed in.
SHELLS = ("bash", "zsh", "fish")


def parse(kind: Any, program: str, words: Sequence[str], description: str = "") -> Any:
    """Return the options that the words say.

    Args:
        kind: dataclass of the options, or what :func:`one_of` returns.
        program: what help calls it.
        words: behind it.
        description: what it does; empty = the documentation of ``kind``.

    Raises:
        InputError: an option that is given twice, or a number out of its range.
        SystemExit: with 0 after help; with 2 after another mistake, which tyro has told.
    """
    import tyro
    from tyro.constructors import ConstructorRegistry

    names = [word.partition("=")[0].replace("_", "-") for word in words if re.match(r"--[A-Za-z]", word)]
    for name in names:
        if names.count(name) > 1:  # tyro takes the last one and drops the others without a word
            raise InputError(f"{name} is given twice; all its values go behind one: {name} FIRST SECOND")
    registry = ConstructorRegistry()
    registry.struct_rule(_fields_shown)
    style = (tyro.conf.DisallowNone, tyro.conf.PositionalMetavarFromFieldName, tyro.conf.OmitSubcommandPrefixes)
    wrapper = textwrap.TextWrapper(shutil.get_terminal_size().columns, subsequent_indent="  ")
    text = "\n".join(
        map(wrapper.fill, _plain(description or _summary(kind)).split("\n"))
    )  # tyro joins lines but for indented ones
    options = tyro.cli(kind, prog=program, description=text, args=list(words), config=style, registry=registry)
    check_ranges(options)
    return options


def one_of(commands: Mapping[str, Any]) -> Any:
    """Return what :func:`parse` takes for one of several commands.

    Args:
        commands: name -> dataclass of its options, or the same again where it has commands of its own; under an empty name:
            options that it takes beside them.
    """
    import tyro

    def member(name: str, kind: Any) -> Any:
        own_commands = isinstance(kind, Mapping)
        text = "" if own_commands else _plain(_summary(kind))
        return Annotated[
            _with_own_commands(name, dict(kind)) if own_commands else kind, tyro.conf.subcommand(name, description=text)
        ]

    return functools.reduce(operator.or_, (member(name, kind) for name, kind in commands.items()))


def _with_own_commands(name: str, commands: dict[str, Any]) -> Any:
    import tyro

    own = commands.pop("", None)
    if own is None:
        return dataclasses.make_dataclass(name.capitalize(), [("command", one_of(commands))])
    nothing = Annotated[None, tyro.conf.subcommand("--help")]  # no command; completion offers its name, so one that fits
    word = ("command", one_of(commands) | nothing, dataclasses.field(default=None, kw_only=True))
    return dataclasses.make_dataclass(name.capitalize(), [word], bases=(own,), frozen=True)


def _fields_shown(info: Any) -> Any:
    """Show a command's own options before those that it shares; a default only where the text does not say what happens."""
    import docstring_parser
    import tyro
    from tyro.constructors import StructConstructorSpec, StructFieldSpec

    if not dataclasses.is_dataclass(info.type) or info.type.__module__.startswith("tyro."):  # it wraps some types in one
        return None
    kind: Any = info.type
    texts: dict[str, str] = {}
    for one in reversed(kind.__mro__[:-1]):
        params = docstring_parser.parse_from_object(one).params
        texts |= {param.arg_name: param.description for param in params if param.description}
    hints, fields = get_type_hints(kind, include_extras=True), {field.name: field for field in dataclasses.fields(kind)}
    own_first = dict.fromkeys(name for one in kind.__mro__ for name in inspect.get_annotations(one) if name in fields)
    found = []
    for name in own_first:
        default = fields[name].default
        missing = default is dataclasses.MISSING
        silent = default is None or default is False or default == ()
        shown: list[Any] = [tyro.conf.arg(help_behavior_hint="")] if silent else []
        shown += [tyro.conf.FlagCreatePairsOff] if default is False else []
        hint: Any = Annotated[(hints[name], *shown)] if shown else hints[name]
        text = _plain(texts.get(name, ""))
        found.append(StructFieldSpec(name, hint, tyro.constructors.MISSING if missing else default, text))
    return StructConstructorSpec(kind, tuple(found))


def _summary(kind: type) -> str:
    """Return what a class's documentation says before its attributes."""
    return (inspect.getdoc(kind) or "").partition("Attributes:")[0].strip()


def _plain(text: str) -> str:
    """Return a documentation's text without markup, a paragraph in one line."""
    paragraphs = re.split(r"\n\s*\n", text.replace("``", "").replace("**", "").strip())
    return "\n\n".join(" ".join(one.split()) for one in paragraphs)
