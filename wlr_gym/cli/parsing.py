"""Words behind a command to its options, a frozen dataclass: help that fits the terminal, one line for every mistake.

A field's documentation is the option's help: the string below the field, or its entry under ``Attributes:``.
"""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import inspect
import io
import operator
import os
import re
import shutil
import textwrap
import types
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal, Union, get_args, get_origin, get_type_hints

from wlr_gym.base.errors import InputError, nearest, unknown_name
from wlr_gym.base.seeds import require_seed

#: Type -> how help writes a value of it, and what a mistake is told.
_WRITTEN = {int: "INT", float: "FLOAT", str: "STR", Path: "PATH"}
_EXPECTED = {int: "a whole number", float: "a number", str: "a value", Path: "a path"}
_HELP = ("-h", "--help")
#: Shells that commands and options are completed in.
SHELLS = ("bash", "zsh", "fish")


def parse(kind: type, program: str, arguments: Sequence[str], description: str) -> Any:
    """Return the options that the arguments say; SystemExit after ``--help``.

    Raises:
        InputError: a mistake in the arguments, in one line.
    """
    import tyro

    options = options_of(kind)
    _check(options, program, arguments)
    shown, said = io.StringIO(), io.StringIO()
    try:
        with _laid_out(), contextlib.redirect_stdout(shown), contextlib.redirect_stderr(said):
            found = tyro.cli(builder(kind), prog=program, description=_plain(description), args=list(arguments))
    except SystemExit as end:
        if end.code:
            raise InputError(f"{_first_words(said.getvalue(), program)}; see: {program} --help") from None
        print(_tidy(shown.getvalue()))
        raise
    for name in ("seed", "noise_seed"):
        if (seed := getattr(found, name, None)) is not None:
            require_seed(f"--{name.replace('_', '-')}", seed)
    return found


def chosen(program: str, commands: Mapping[str, tuple[type, str]], arguments: Sequence[str], description: str) -> Any:
    """Return the options of a command with commands of its own: name -> options and what it does, in one line.

    Raises:
        InputError: no such command, or a mistake in its arguments.
    """
    name, *rest = arguments or ("",)
    if name in _HELP:
        print(usage(program, {name: text for name, (_, text) in commands.items()}, _plain(description)))
        raise SystemExit(0)
    if not name:
        raise InputError(f"expected one of {', '.join(commands)}; see: {program} --help")
    if name not in commands:
        raise unknown_name(f"command of {program}", name, commands)
    kind, text = commands[name]
    return parse(kind, f"{program} {name}", rest, _summary(kind) or text)


def usage(program: str, commands: Mapping[str, str], description: str = "") -> str:
    """Return how a program is called, and what each of its commands does."""
    column = max(map(len, commands)) + 4
    lines = [f"usage: {program} COMMAND [OPTIONS]", "", *([wrapped(description), ""] if description else [])]
    for name, text in commands.items():
        lines += textwrap.wrap(text, width(), initial_indent=f"  {name}".ljust(column), subsequent_indent=" " * column)
    return "\n".join(lines)


def width() -> int:
    """Return the columns of a help text: those of the terminal, but 40 at least (the parser knows no fewer) and 80 at most."""
    return max(40, min(80, shutil.get_terminal_size().columns))


def wrapped(text: str) -> str:
    """Break the lines of a text that are longer than help is wide."""
    return "\n".join(
        textwrap.fill(line, width(), subsequent_indent=" " * 7 * line.startswith("usage:")) if len(line) > width() else line
        for line in text.split("\n")
    )


def completion(shell: str, program: str, commands: Mapping[str, Any], nested: Mapping[tuple[str, str], type]) -> str:
    """Return a shell's script that completes commands and options.

    Args:
        shell: bash, zsh or fish.
        program: what is completed.
        commands: name -> options, or the same of a command with commands of its own.
        nested: command and a word behind it, which may follow instead of the command's own options -> options.
    """
    import tyro

    script = io.StringIO()
    words = ["--tyro-print-completion", shell]
    with contextlib.redirect_stdout(script), contextlib.suppress(SystemExit):
        tyro.cli(_one_of(commands, nested), prog=program, args=words)
    return script.getvalue()


def _one_of(commands: Mapping[str, Any], nested: Mapping[tuple[str, str], type] | None = None) -> Any:
    """Return what the parser takes for several commands, some of them with commands of their own."""
    import tyro

    members = []
    for name, kind in commands.items():
        words = {word: one for (outer, word), one in (nested or {}).items() if outer == name}
        if isinstance(kind, Mapping):
            own = _one_of({word: one for word, (one, _) in kind.items()})
            member = dataclasses.make_dataclass(name.capitalize(), [("command", tyro.conf.OmitSubcommandPrefixes[own])])
        else:
            member = _with_words(kind, words) if words else builder(kind)
        members.append(Annotated[Any, tyro.conf.subcommand(name, constructor=member)])
    return functools.reduce(operator.or_, members)


def _with_words(kind: type, words: Mapping[str, type]) -> Callable[..., Any]:
    """Return what the parser takes for a command with options, or one of some words and the options of that."""
    import tyro

    build = builder(kind)
    nothing = Annotated[None, tyro.conf.subcommand("--help")]  # no word; completion offers its name, so one that fits
    annotation = tyro.conf.OmitSubcommandPrefixes[_one_of(words) | nothing]
    word = inspect.Parameter("word", inspect.Parameter.KEYWORD_ONLY, default=None, annotation=annotation)
    build.__annotations__["word"] = annotation
    build.__signature__ = inspect.Signature(  # pyright: ignore[reportFunctionMemberAccess]
        [*inspect.signature(build).parameters.values(), word]
    )
    return build


# ---- what options there are ------------------------------------------------------------------------------------------


def options_of(kind: type) -> dict[str, inspect.Parameter]:
    """Return field -> option: those of the class itself first, then those that it shares with others."""
    hints, texts = get_type_hints(kind, include_extras=True), _texts(kind)
    own = [name for one in kind.__mro__ for name in vars(one).get("__annotations__", ())]
    fields = {field.name: field for field in dataclasses.fields(kind)}
    return {name: _option(fields[name], hints[name], texts.get(name, "")) for name in dict.fromkeys(own) if name in fields}


def builder(kind: type) -> Callable[..., Any]:
    """Return a function that makes ``kind`` of its fields; its signature is what the parser and help go by."""

    def build(**given: Any) -> Any:
        return kind(**given)

    options = options_of(kind)
    build.__name__ = build.__qualname__ = kind.__name__
    build.__doc__ = None
    build.__annotations__ = {name: option.annotation for name, option in options.items()}
    build.__signature__ = inspect.Signature(list(options.values()))  # pyright: ignore[reportFunctionMemberAccess]
    return build


def _option(field: dataclasses.Field[Any], hint: Any, text: str) -> inspect.Parameter:
    import tyro

    has_default = field.default is not dataclasses.MISSING
    default = field.default if has_default else inspect.Parameter.empty
    value = _value_type(hint)
    metavar = _written(value, field.name.upper() if _is_positional(hint) else None)
    if _is_positional(hint) and has_default:
        metavar = f"[{metavar}]"
    shown = tyro.conf.arg(
        metavar=None if value is bool else metavar,
        help=_sentence(text),
        help_behavior_hint=_default_shown(default) if has_default else "(required)",
    )
    marks = (tyro.conf.FlagCreatePairsOff,) if default is False else ()
    return inspect.Parameter(
        field.name, inspect.Parameter.KEYWORD_ONLY, default=default, annotation=Annotated[(hint, shown, *marks)]
    )


def _default_shown(default: Any) -> str:
    """What is not set unless it is given needs no default; its text says what happens then."""
    if default is None or default is False or default == ():
        return ""
    if default is True:
        return "(default: on)"
    return f"(default: {' '.join(map(str, default)) if isinstance(default, tuple) else default})"


def _is_positional(hint: Any) -> bool:
    import tyro

    return get_origin(hint) is Annotated and any(one is tyro.conf.Positional for one in hint.__metadata__)


def _value_type(hint: Any) -> Any:
    """Return the type without annotations and without None."""
    if get_origin(hint) is Annotated:
        return _value_type(get_args(hint)[0])
    if get_origin(hint) in (Union, types.UnionType):
        return _value_type(next(one for one in get_args(hint) if one is not type(None)))
    return hint


def _written(value: Any, name: str | None) -> str:
    """Return how help writes a value."""
    if get_origin(value) is tuple:
        inner, *others = get_args(value)
        if others == [...]:
            return f"{_written(inner, name)} ..." if name else f"[{_written(inner, None)} ...]"
        return " ".join(_written(one, None) for one in (inner, *others))
    if get_origin(value) is Literal:
        return "{" + ",".join(map(str, get_args(value))) + "}"
    return name or _WRITTEN.get(value, "STR")


def _texts(kind: type) -> dict[str, str]:
    """Return field -> its documentation, of the class and those it inherits from."""
    import docstring_parser

    found: dict[str, str] = {}
    for one in reversed(kind.__mro__[:-1]):
        params = docstring_parser.parse_from_object(one).params
        found |= {param.arg_name: param.description for param in params if param.description}
    return found


def _summary(kind: type) -> str:
    """Return what a class's documentation says before its attributes."""
    return (inspect.getdoc(kind) or "").partition("Attributes:")[0].strip()


def _sentence(text: str) -> str:
    """Return a text as a sentence; names and units that it begins with stay as they are."""
    text = _plain(" ".join(text.split()))
    if not re.match(r"\S*[:=]|\S+ =", text):
        text = text[:1].upper() + text[1:]
    return text + ("" if not text or text[-1] in ".?!)" else ".")


def _plain(text: str) -> str:
    """Return a documentation's text without markup, a paragraph in one line."""
    paragraphs = re.split(r"\n\s*\n", text.replace("``", "").replace("**", "").strip())
    return "\n\n".join(" ".join(one.split()) for one in paragraphs)


# ---- mistakes --------------------------------------------------------------------------------------------------------


def _check(options: Mapping[str, inspect.Parameter], program: str, arguments: Sequence[str]) -> None:
    """Refuse unknown options, values that do not fit, and what is missing, with the nearest name."""
    if any(word in _HELP for word in arguments):
        return
    named = {f"--{name.replace('_', '-')}": one for name, one in options.items() if not _is_positional(one.annotation)}
    negated = {f"--no-{name[2:]}": one for name, one in named.items() if one.default is True}
    given = set()
    for place, word in enumerate(arguments):
        name, equals, value = word.partition("=")
        if not re.fullmatch(r"--?[A-Za-z][\w-]*", name):
            continue
        if (name := name.replace("_", "-")) not in named | negated:
            valid = [*named, *negated]
            raise InputError(f"unknown option '{name}'{nearest(name, valid)}; see: {program} --help")
        if name in given:
            raise InputError(f"{name} is given twice; all its values go behind one: {name} FIRST SECOND")
        given.add(name)
        if equals and _value_type((named | negated)[name].annotation) is bool:
            raise InputError(f"{name} takes no value")
        if name in named:
            _check_values(name, _value_type(named[name].annotation), [value] if equals else _values(arguments[place + 1 :]))
    for name, one in named.items():
        if one.default is inspect.Parameter.empty and name not in given:
            raise InputError(f"expected {name} {_written(_value_type(one.annotation), None)}; see: {program} --help")


def _values(words: Sequence[str]) -> list[str]:
    """Return the words before the next option."""
    end = next((k for k, word in enumerate(words) if re.match(r"--?[A-Za-z]", word)), len(words))
    return list(words[:end])


def _check_values(name: str, value: Any, words: Sequence[str]) -> None:
    if value is bool:
        return
    if get_origin(value) is tuple:
        inner, *others = get_args(value)
        if others == [...]:
            for word in words if get_origin(inner) is Literal else ():
                _check_value(name, inner, word)
            return
        if len(words) < 1 + len(others):
            raise InputError(f"{name}: expected {1 + len(others)} values: {_written(value, None)}")
        for one, word in zip((inner, *others), words, strict=False):
            _check_value(name, one, word)
        return
    if not words:
        expected = f"one of {', '.join(get_args(value))}" if get_origin(value) is Literal else _EXPECTED.get(value, "a value")
        raise InputError(f"{name}: expected {expected}")
    _check_value(name, value, words[0])


def _check_value(name: str, value: Any, word: str) -> None:
    if get_origin(value) is Literal and word not in get_args(value):
        raise unknown_name("value", word, get_args(value), name)
    if value in (int, float):
        try:
            value(word)
        except ValueError:
            raise InputError(f"{name} {word}: expected {_EXPECTED[value]}") from None


@contextlib.contextmanager
def _laid_out() -> Iterator[None]:
    """Tell the parser how wide help is; it asks COLUMNS first."""
    before = os.environ.get("COLUMNS")
    os.environ["COLUMNS"] = str(width())
    try:
        yield
    finally:
        del os.environ["COLUMNS"]
        if before is not None:
            os.environ["COLUMNS"] = before


def _tidy(text: str) -> str:
    """Break the parser's usage and description, which it leaves as they are; take out its padding.

    A blank line before an indented one comes from a text that fills its last line.
    """
    text = "\n".join(map(str.rstrip, text.split("\n")))
    text = re.sub(r"\n{2,}(?=  )", "\n", text)
    return wrapped(re.sub(r"\n{3,}", "\n\n", text)).rstrip()


def _first_words(box: str, program: str) -> str:
    """Return what the parser said in the first part of its box, in one line."""
    _, body, *_ = [*re.split(r"^[ │├]*[-─]{3,}.*$", box, flags=re.MULTILINE), "", ""]
    text = " ".join(body.replace("│", "").split())
    text = text.replace(f"Missing from {program}:", "expected").replace(" (required)", "")
    text = re.sub(r"^(expected [A-Z]+) ([A-Z])(?=[a-z ])", lambda found: f"{found[1]}: {found[2].lower()}", text)
    return text.replace("Unrecognized options:", "more words than it takes:").rstrip(". ")
