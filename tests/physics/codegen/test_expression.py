"""Formulas: what is read, what is refused, units, and the same value from floats, arrays and compiled code."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from wlr_gym.base.errors import InputError
from wlr_gym.physics.codegen import Graph, emit
from wlr_gym.physics.codegen.expression import (
    Call,
    Number,
    Symbol,
    evaluate,
    finite_number,
    parse,
    parse_unit,
    renamed,
    symbols,
    unit_of,
)

NAMES = ("a", "b", "c")


def python_value(text: str, values: dict[str, float]) -> float:
    """What Python itself makes of the same text."""
    functions = {name: getattr(math, name) for name in ("sin", "cos", "exp", "tanh", "sqrt")}
    functions |= {"abs": abs, "min": min, "max": max, "sign": lambda x: (x > 0) - (x < 0)}
    return eval(text, {"__builtins__": {}}, functions | values)


@pytest.mark.parametrize(
    "text",
    [
        "1 - 2 * 3 + 4 / 8",
        "-a ** 2",
        "(-a) ** 2",
        "2 - (3 - a)",
        "a - b - c",
        "a / b / c",
        "a / (b / c)",
        "-(a + b) * -c",
        "a ** -3",
        "+a",
        "sin(a) * cos(b) - exp(-c) + tanh(a * b)",
        "abs(a - b) * sign(b - a) + sqrt(c)",
        "max(a, b, c, 0.1) - min(b, c)",
        "1e-3 * a + 2.5E2",
        "  a  +\tb ",
    ],
)
def test_values_and_precedence_are_pythons(text):
    values = {"a": 0.7, "b": -1.3, "c": 2.1}
    tree = parse(text)
    assert evaluate(tree, values) == pytest.approx(python_value(text.strip(), values), rel=1e-14)
    assert parse(str(tree)) == tree


trees = st.recursive(
    st.one_of(st.floats(0.01, 100).map(Number), st.sampled_from(NAMES).map(Symbol)),
    lambda inner: st.one_of(
        st.tuples(st.sampled_from(["+", "-", "*"]), inner, inner).map(lambda t: Call(t[0], t[1:])),
        st.tuples(st.sampled_from(["sin", "cos", "tanh", "abs", "sign"]), inner).map(lambda t: Call(t[0], t[1:])),
        st.tuples(st.sampled_from(["min", "max"]), inner, inner, inner).map(lambda t: Call(t[0], t[1:])),
        inner.map(lambda t: Call("negative", (t,))),
        st.tuples(inner, st.integers(1, 8).map(float).map(Number)).map(lambda t: Call("**", t)),
    ),
    max_leaves=12,
)


@settings(deadline=None)
@given(trees)
def test_printed_trees_read_back_to_the_same_value(tree):
    values = {"a": 0.3, "b": -0.8, "c": 1.7}
    with np.errstate(all="ignore"):
        expected = evaluate(tree, values)
    if not np.isfinite(expected):
        return
    again = parse(str(tree))
    assert set(symbols(again)) == set(symbols(tree))
    assert evaluate(again, values) == pytest.approx(expected, rel=1e-9, abs=1e-9)


@settings(deadline=None)
@given(trees)
def test_compiled_source_gives_the_value_of_the_tree(tree):
    owner = Graph()
    traced = evaluate(tree, {name: owner.input(name) for name in NAMES})
    values = {"a": 0.3, "b": -0.8, "c": 1.7}
    with np.errstate(all="ignore"):
        expected = evaluate(tree, values)
    if not np.isfinite(expected) or abs(expected) > 1e9:
        return
    lines = emit({"y": traced}, lambda name: repr(values[name]), lambda name, text: f"{name} = {text}", "")
    scope: dict = {"math": math, "np": np, "select": lambda condition, a, b: a if condition else b}
    exec("\n".join(lines), scope)
    assert scope["y"] == pytest.approx(expected, rel=1e-6, abs=1e-6)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", ["expected text"]),
        (3, ["formula 3", "expected text"]),
        ("a +", ["broken syntax"]),
        ("a = 1", ["broken syntax"]),
        ("a b", ["broken syntax"]),
        ("k\0", ["null"]),
        ("a ^ 2", ["'**', not '^'"]),
        ("foo(a)", ["unknown function 'foo'", "valid: abs, cos"]),
        ("sine(a)", ["did you mean 'sin'"]),
        ("__import__('os')", ["unknown function '__import__'"]),
        ("a.__class__", ["'a.__class__' is not allowed"]),
        ("a[0]", ["not allowed"]),
        ("(lambda: 1)()", ["not allowed"]),
        ("a if b else c", ["not allowed"]),
        ("a < b", ["not allowed"]),
        ("a // b", ["not allowed"]),
        ("a and b", ["not allowed"]),
        ("not a", ["not allowed"]),
        ("[a]", ["not allowed"]),
        ("'text'", ["not allowed"]),
        ("True", ["not allowed"]),
        ("1j", ["not allowed"]),
        ("sin(x=a)", ["not allowed"]),
        ("min(*a)", ["not allowed"]),
        ("sin()", ["sin() takes 1 arguments, got 0"]),
        ("sin(a, b)", ["sin() takes 1 arguments, got 2"]),
        ("min(a)", ["min() takes 2 to 8 arguments, got 1"]),
        ("a / 0", ["division by zero"]),
        ("a / (2 - 2)", ["division by zero"]),
        ("sqrt(1 - 2)", ["sqrt(-1) is not a finite number"]),
        ("exp(1000)", ["not a finite number"]),
        ("1e999", ["too large"]),
        ("1" + "0" * 400, ["too large"]),
        ("a ** b", ["exponent b", "whole number up to 8"]),
        ("a ** 0.5", ["exponent 0.5"]),
        ("a ** 0", ["exponent 0"]),
        ("a ** 9", ["exponent 9"]),
        ("9 ** 8 ** 7", ["exponent 2097152.0"]),
        ("(" * 400 + "a" + ")" * 400, ["nested"]),
        ("-" * 990 + "a", ["nested too deeply"]),
        ("a + " * 400 + "a", ["characters", "at most 1000"]),
    ],
)
def test_bad_formulas_are_refused(text, words):
    with pytest.raises(InputError) as error:
        parse(text)
    for word in words:
        assert word in str(error.value)


@pytest.mark.parametrize(
    ("text", "same"),
    [
        ("N m/rad", "kg m2/s2"),
        ("N m s/rad", "kg m^2 s^-1"),
        ("V", "W/A"),
        ("ohm", "V/A"),
        ("N/m/s", "kg/s^3"),
        ("1/s", "Hz"),
        ("rad", "-"),
        ("1", "-"),
        ("N*m", "N·m"),
        (" J ", "N m"),
    ],
)
def test_units_that_are_the_same(text, same):
    assert parse_unit(text) == parse_unit(same)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("deg", ["unknown unit 'deg'", "m, kg, s"]),
        ("mm", ["unknown unit 'mm'", "without prefix"]),
        ("Nm", ["unknown unit 'Nm'"]),
        ("N m/rad s", ["one unit after each '/'"]),
        ("", ["expected text"]),
        (None, ["expected text"]),
        ("N/", ["unit 'N/'"]),
        ("m2.5", ["m2.5"]),
    ],
)
def test_bad_units_are_refused(text, words):
    with pytest.raises(InputError) as error:
        parse_unit(text)
    for word in words:
        assert word in str(error.value)


UNITS = {"q": "rad", "w": "rad/s", "k": "N m/rad", "d": "N m s/rad", "f": "N", "x": "m", "t": "N m", "j": "kg m2"}


@pytest.mark.parametrize(
    ("text", "unit"),
    [
        ("-k * (q - 1)", "N m"),
        ("-d * w", "N m"),
        ("f * x + t", "N m"),
        ("sqrt(k * j) * w", "N m"),
        ("max(0, k * q)", "N m"),
        ("t * tanh(w / 1) * 0 + t", None),  # 1 is a pure number: see below
        ("t * exp(-q**2) * sign(w)", "N m"),
        ("abs(t) / t", "-"),
        ("x ** 3 / x", "m2"),
        ("x ** -2", "1/m2"),
        ("j * w ** 2", "N m"),
        ("0", ""),
        ("0 * t - 0", ""),
    ],
)
def test_units_of_formulas(text, unit):
    known = {name: parse_unit(u) for name, u in UNITS.items()}
    if unit is None:
        with pytest.raises(InputError, match=r"tanh\(w / 1\)': the argument is in"):
            unit_of(parse(text), known)
    else:
        assert unit_of(parse(text), known) == (parse_unit(unit) if unit else None)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("t + f", ["in 't + f'", "N m and N do not go together"]),
        ("t - 1", ["N m and pure number"]),
        ("sin(x)", ["in 'sin(x)'", "expected a pure number or rad"]),
        ("exp(w)", ["the argument is in 1/s"]),
        ("min(t, f, 0)", ["do not go together"]),
        ("k * qq", ["unknown name 'qq'", "did you mean 'q'"]),
    ],
)
def test_units_that_do_not_fit_are_refused(text, words):
    with pytest.raises(InputError) as error:
        unit_of(parse(text), {name: parse_unit(unit) for name, unit in UNITS.items()})
    for word in words:
        assert word in str(error.value)


def test_renaming_replaces_whole_names_only():
    assert str(renamed(parse("a + ab * sin(a)"), {"a": "a_lf"})) == "a_lf + (ab * sin(a_lf))"


@pytest.mark.parametrize("value", [math.nan, math.inf, True, "1", None, 10**400, 1j])
def test_what_is_no_finite_number(value):
    assert finite_number(value) is None


@pytest.mark.parametrize("value", [0, -3, 2.5, np.float32(0.5), np.int64(4)])
def test_what_is_a_finite_number(value):
    assert finite_number(value) == value
