"""Formulas that users write: parsed into a small tree of known operations, checked for units, evaluated through ``ops``.

Python's grammar is borrowed, its evaluation is not: the text is never run. What is not a number, a known name or one of
:data:`FUNCTIONS` is refused with the nearest valid name.
"""

from __future__ import annotations

import ast
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from functools import cache, reduce
from typing import Any

import numpy as np

from wlr_gym.base.errors import InputError, nearest, unknown_name
from wlr_gym.physics.codegen import ops

Value = Any  # float | numpy array | Node
MAX_LENGTH = 1000
MAX_POWER = 8


# ---- units -----------------------------------------------------------------------------------------------------------

_BASE = ("m", "kg", "s", "A")
UNITS: dict[str, tuple[int, int, int, int]] = {
    "m": (1, 0, 0, 0),
    "kg": (0, 1, 0, 0),
    "s": (0, 0, 1, 0),
    "A": (0, 0, 0, 1),
    "rad": (0, 0, 0, 0),
    "Hz": (0, 0, -1, 0),
    "N": (1, 1, -2, 0),
    "J": (2, 1, -2, 0),
    "W": (2, 1, -3, 0),
    "V": (2, 1, -3, -1),
    "ohm": (2, 1, -3, -2),
}


@dataclass(frozen=True)
class Unit:
    """Product of powers of m, kg, s and A. An angle in rad is a pure number, as in the SI."""

    exponents: tuple[Fraction, ...] = (Fraction(0),) * len(_BASE)

    def __mul__(self, other: Unit) -> Unit:
        return Unit(tuple(a + b for a, b in zip(self.exponents, other.exponents, strict=True)))

    def __pow__(self, power: Fraction | int) -> Unit:
        return Unit(tuple(power * a for a in self.exponents))

    def __truediv__(self, other: Unit) -> Unit:
        return self * other**-1

    def __str__(self) -> str:
        if self in _named_units():
            return _named_units()[self]

        def powers(sign: int) -> list[str]:
            found = [(name, sign * x) for name, x in zip(_BASE, self.exponents, strict=True) if sign * x > 0]
            return [name if x == 1 else f"{name}^{x}" for name, x in found]

        return "/".join([" ".join(powers(1)) or "1", *powers(-1)])


PURE = Unit()


def parse_unit(text: str) -> Unit:
    """Read a unit such as ``N m s/rad``, ``N m/rad2``, ``kg m^2``, ``1/s`` or ``-`` (pure number).

    Raises:
        InputError: a unit that is not of the SI, has a prefix, or is ambiguous.
    """
    if not isinstance(text, str) or not text.strip():
        raise InputError(f"unit {text!r}: expected text such as 'N m/rad', or '-' for a pure number")
    numerator, *denominators = text.strip().split("/")
    unit = _product(numerator, text)
    for denominator in denominators:
        if len(_factors(denominator)) != 1:
            raise InputError(f"unit '{text}': write one unit after each '/': 'N m/rad/s'")
        unit = unit / _product(denominator, text)
    return unit


def _factors(text: str) -> list[str]:
    return re.split(r"[\s*·]+", text.strip())


def _product(text: str, whole: str) -> Unit:
    return reduce(Unit.__mul__, (_power(factor, whole) for factor in _factors(text)))


def _power(factor: str, whole: str) -> Unit:
    if factor in {"1", "-"}:
        return PURE
    match = re.fullmatch(r"([A-Za-z]+)\^?(-?\d{1,2})?", factor)
    if match is None or match[1] not in UNITS:
        name = match[1] if match else factor
        raise InputError(
            f"unit '{whole}': unknown unit '{name}'{nearest(name, UNITS)}; SI units without prefix: {', '.join(UNITS)}"
        )
    return Unit(tuple(map(Fraction, UNITS[match[1]]))) ** int(match[2] or 1)


@cache
def _named_units() -> dict[Unit, str]:
    """Units that have a shorter name than their product of powers."""
    named = ("N", "N m", "N s/m", "N m s/rad", "W", "V", "ohm", "V s")
    return {PURE: "pure number"} | {parse_unit(text): text for text in named}


# ---- the tree --------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Number:
    """A literal."""

    value: float

    def __str__(self) -> str:
        return f"{self.value:g}" if self.value == float(f"{self.value:g}") else repr(self.value)


@dataclass(frozen=True)
class Symbol:
    """A name that stands for a value."""

    name: str

    def __str__(self) -> str:
        return self.name


@dataclass(frozen=True)
class Call:
    """An operation on expressions: a key of :data:`OPERATIONS`."""

    operation: str
    arguments: tuple[Expression, ...]

    def __str__(self) -> str:
        texts = [str(argument) for argument in self.arguments]
        if self.operation in FUNCTIONS:
            return f"{self.operation}({', '.join(texts)})"
        wrapped = [f"({t})" if _is_operator(a) or t.startswith("-") else t for t, a in zip(texts, self.arguments, strict=True)]
        return f"-{wrapped[0]}" if self.operation == "negative" else f" {self.operation} ".join(wrapped)


Expression = Number | Symbol | Call


def _is_operator(expression: Expression) -> bool:
    return isinstance(expression, Call) and expression.operation not in FUNCTIONS


class _UnitMismatchError(Exception):
    pass


# Rules take the units of the operands (None: the number 0, which fits any unit) and return that of the result.
_Known = Unit | None
_Rule = Callable[[Sequence[_Known]], _Known]


def _same(units: Sequence[_Known]) -> _Known:
    known = [unit for unit in units if unit is not None]
    if len(set(known)) > 1:
        raise _UnitMismatchError(" and ".join(map(str, known)) + " do not go together")
    return known[0] if known else None


def _pure(units: Sequence[_Known]) -> Unit:
    if units[0] not in (None, PURE):
        raise _UnitMismatchError(f"the argument is in {units[0]}, expected a pure number or rad")
    return PURE


def _product_of_units(units: Sequence[_Known]) -> _Known:
    return None if None in units else units[0] * units[1]  # type: ignore[operator]


def _quotient_of_units(units: Sequence[_Known]) -> _Known:
    return None if None in units else units[0] / units[1]  # type: ignore[operator]


def _root_of_unit(units: Sequence[_Known]) -> _Known:
    return None if units[0] is None else units[0] ** Fraction(1, 2)


def _whole_power(base: Value, exponent: float) -> Value:
    product = reduce(lambda a, _: a * base, range(1, abs(int(exponent))), base)
    return product if exponent > 0 else 1.0 / product


@dataclass(frozen=True)
class _Operation:
    evaluate: Callable[..., Value]
    unit: _Rule
    arity: tuple[int, int]


_MANY = (2, 8)
FUNCTIONS: dict[str, _Operation] = {
    "sin": _Operation(ops.sin, _pure, (1, 1)),
    "cos": _Operation(ops.cos, _pure, (1, 1)),
    "exp": _Operation(ops.exp, _pure, (1, 1)),
    "tanh": _Operation(ops.tanh, _pure, (1, 1)),
    "abs": _Operation(ops.absolute, _same, (1, 1)),
    "sign": _Operation(ops.sign, lambda units: PURE, (1, 1)),
    "sqrt": _Operation(ops.sqrt, _root_of_unit, (1, 1)),
    "min": _Operation(lambda *x: reduce(ops.minimum, x), _same, _MANY),
    "max": _Operation(lambda *x: reduce(ops.maximum, x), _same, _MANY),
}
OPERATIONS: dict[str, _Operation] = {
    **FUNCTIONS,
    "+": _Operation(lambda a, b: a + b, _same, (2, 2)),
    "-": _Operation(lambda a, b: a - b, _same, (2, 2)),
    "*": _Operation(lambda a, b: a * b, _product_of_units, (2, 2)),
    "/": _Operation(lambda a, b: a / b, _quotient_of_units, (2, 2)),
    "**": _Operation(_whole_power, lambda units: units[0], (2, 2)),  # its unit depends on the exponent: see unit_of
    "negative": _Operation(lambda a: -a, _same, (1, 1)),
}
_BINARY: dict[type[ast.operator], str] = {ast.Add: "+", ast.Sub: "-", ast.Mult: "*", ast.Div: "/", ast.Pow: "**"}


# ---- parsing ---------------------------------------------------------------------------------------------------------


def parse(text: str) -> Expression:
    """Return the tree of a formula such as ``-k * (leg_angle - a0)``.

    Names may be anything here; :func:`unit_of` refuses those that mean nothing.

    Raises:
        InputError: broken syntax, or anything but numbers, names, ``+ - * / **`` and :data:`FUNCTIONS`.
    """
    if not isinstance(text, str) or not text.strip():
        raise InputError(f"formula {text!r}: expected text such as '-k * (leg_angle - a0)'")
    if len(text) > MAX_LENGTH:
        raise InputError(f"formula of {len(text)} characters: at most {MAX_LENGTH} are allowed")
    if "^" in text:
        raise InputError(f"formula '{text}': write powers with '**', not '^'")
    try:
        return _read(_syntax_tree(text), text)
    except (RecursionError, MemoryError):
        raise InputError(f"formula '{text[:40]}...': nested too deeply") from None


def _syntax_tree(text: str) -> ast.expr:
    try:
        return ast.parse(text.strip(), mode="eval").body
    except SyntaxError as error:
        raise InputError(f"formula '{text}', character {error.offset or 1}: broken syntax: {error.msg}") from None
    except ValueError as error:
        raise InputError(f"formula {text!r}: {error}") from None


def _read(node: ast.expr, text: str) -> Expression:
    match node:
        case ast.Constant(value=bool()):
            pass
        case ast.Constant(value=int() | float()):
            return Number(_literal(node, text))
        case ast.Name(id=name):
            return Symbol(name)
        case ast.UnaryOp(op=ast.UAdd(), operand=operand):
            return _read(operand, text)
        case ast.UnaryOp(op=ast.USub(), operand=operand):
            return _call("negative", [_read(operand, text)], text)
        case ast.BinOp(op=op) if type(op) in _BINARY:
            return _call(_BINARY[type(op)], [_read(node.left, text), _read(node.right, text)], text)
        case ast.Call(func=ast.Name(id=name), keywords=[]):
            if name not in FUNCTIONS:
                raise unknown_name("function", name, FUNCTIONS, f"formula '{text}'")
            return _call(name, [_read(argument, text) for argument in node.args], text)
    raise InputError(
        f"formula '{text}': '{ast.unparse(node)}' is not allowed; numbers, names, + - * / ** and {', '.join(FUNCTIONS)} are"
    )


def _literal(node: ast.Constant, text: str) -> float:
    value = finite_number(node.value)
    if value is None:
        raise InputError(f"formula '{text}': a number is too large")
    return value


def _call(operation: str, arguments: list[Expression], text: str) -> Expression:
    least, most = OPERATIONS[operation].arity
    if not least <= len(arguments) <= most:
        expected = least if least == most else f"{least} to {most}"
        raise InputError(f"formula '{text}': {operation}() takes {expected} arguments, got {len(arguments)}")
    if operation == "**":
        _check_exponent(arguments[1], text)
    if operation == "/" and arguments[1] == Number(0.0):
        raise InputError(f"formula '{text}': division by zero")
    call = Call(operation, tuple(arguments))
    return _folded(call, text) if all(isinstance(argument, Number) for argument in arguments) else call


def _check_exponent(exponent: Expression, text: str) -> None:
    allowed = isinstance(exponent, Number) and exponent.value == int(exponent.value) and 1 <= abs(exponent.value) <= MAX_POWER
    if not allowed:
        raise InputError(f"formula '{text}': exponent {exponent}: expected a whole number up to {MAX_POWER}, not 0")


def _folded(call: Call, text: str) -> Number:
    with np.errstate(all="ignore"):
        value = float(evaluate(call, {}))
    if not np.isfinite(value):
        raise InputError(f"formula '{text}': {call} is not a finite number")
    return Number(value)


def finite_number(value: Any) -> float | None:
    """Return a finite real number as a float; None for anything else (text, booleans, NaN, integers beyond floats)."""
    if isinstance(value, bool) or not isinstance(value, int | float | np.integer | np.floating):
        return None
    try:
        number = float(value)
    except OverflowError:
        return None
    return number if np.isfinite(number) else None


# ---- what is done with a tree ----------------------------------------------------------------------------------------


def evaluate(expression: Expression, values: Mapping[str, Value]) -> Value:
    """Return the expression's value for floats, numpy arrays or traced nodes."""
    match expression:
        case Number(value):
            return value
        case Symbol(name):
            return values[name]
        case Call(operation, arguments):
            return OPERATIONS[operation].evaluate(*(evaluate(argument, values) for argument in arguments))


def unit_of(expression: Expression, units: Mapping[str, Unit]) -> Unit | None:
    """Return the expression's unit, None for one that fits any (the number 0).

    Args:
        expression: parsed formula.
        units: unit of every name that may occur.

    Raises:
        InputError: an unknown name (with the nearest valid one), or units that do not go together.
    """
    match expression:
        case Number(value):
            return PURE if value else None
        case Symbol(name):
            if name not in units:
                raise unknown_name("name", name, units)
            return units[name]
        case Call(operation, arguments):
            known = [unit_of(argument, units) for argument in arguments]
            if operation == "**":
                return None if known[0] is None else known[0] ** int(arguments[1].value)  # type: ignore[union-attr]
            try:
                return OPERATIONS[operation].unit(known)
            except _UnitMismatchError as error:
                raise InputError(f"in '{expression}': {error}") from None


def symbols(expression: Expression) -> Iterator[str]:
    """Yield the names in an expression, each as often as it occurs."""
    if isinstance(expression, Symbol):
        yield expression.name
    elif isinstance(expression, Call):
        for argument in expression.arguments:
            yield from symbols(argument)


def renamed(expression: Expression, names: Mapping[str, str]) -> Expression:
    """Return the expression with some names replaced."""
    match expression:
        case Symbol(name):
            return Symbol(names.get(name, name))
        case Call(operation, arguments):
            return Call(operation, tuple(renamed(argument, names) for argument in arguments))
    return expression
