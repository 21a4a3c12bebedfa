"""Scalar functions that work alike on floats, numpy arrays and traced nodes."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from math import factorial
from typing import Any

import numpy as np

from wlr_gym.physics.codegen.graph import Node

Value = Any  # float | numpy array | Node
Lanes = Mapping[str, Value]
Out = dict[str, Value]
Vector = list[Value]


def _apply(op: str, reference: Callable[..., Any], *operands: Value) -> Value:
    for operand in operands:
        if isinstance(operand, Node):
            return operand.graph.node(op, *(x if isinstance(x, Node) else float(x) for x in operands))
    return reference(*operands)


def sqrt(x: Value) -> Value:
    """Square root."""
    return _apply("sqrt", np.sqrt, x)


def exp(x: Value) -> Value:
    """Exponential."""
    return _apply("exp", np.exp, x)


def tanh(x: Value) -> Value:
    """Hyperbolic tangent."""
    return _apply("tanh", np.tanh, x)


def arctan2(y: Value, x: Value) -> Value:
    """Angle of the vector (x, y), in (-pi, pi]."""
    return _apply("arctan2", np.arctan2, y, x)


def absolute(x: Value) -> Value:
    """Absolute value."""
    return _apply("absolute", np.abs, x)


def minimum(a: Value, b: Value) -> Value:
    """Smaller of two values."""
    return _apply("minimum", np.minimum, a, b)


def maximum(a: Value, b: Value) -> Value:
    """Larger of two values."""
    return _apply("maximum", np.maximum, a, b)


def clip(x: Value, low: Value, high: Value) -> Value:
    """``x`` limited to [low, high]."""
    return minimum(maximum(x, low), high)


def where_positive(condition: Value, a: Value, b: Value) -> Value:
    """``a`` where ``condition > 0``, else ``b`` (also where the condition is NaN)."""
    return _apply("where", _where, condition, a, b)


def _where(condition: Value, a: Value, b: Value) -> Value:
    if isinstance(condition, float) and isinstance(a, float) and isinstance(b, float):  # ten times as fast as numpy
        return a if condition > 0 else b
    return np.where(np.asarray(condition) > 0, a, b)[()]


def sign(x: Value) -> Value:
    """-1, 0 or 1."""
    return where_positive(x, 1.0, where_positive(-x, -1.0, 0.0))


def rounded(x: Value) -> Value:
    """``x`` as a number of its own: a product is rounded before it is added, never fused into the sum."""
    return _apply("rounded", lambda value: value, x)


def floor(x: Value) -> Value:
    """Largest whole number not above ``x``."""
    return _apply("floor", np.floor, x)


def _polynomial(x: Value, coefficients: tuple[float, ...]) -> Value:
    result: Value = coefficients[-1]
    for coefficient in reversed(coefficients[:-1]):
        result = result * x + coefficient
    return result


_SIN = tuple((-1) ** k / factorial(2 * k + 1) for k in range(11))
_COS = tuple((-1) ** k / factorial(2 * k) for k in range(12))


def sin_cos(x: Value) -> tuple[Value, Value]:
    """Sine and cosine by half-angle polynomials (error < 1e-15 for any |x| < 1e6): no library call, so it vectorises and
    gives the same bits on every machine. On plain numbers and arrays numpy's own functions are used."""
    if not isinstance(x, Node):
        return np.sin(x), np.cos(x)
    turn = 2.0 * np.pi
    half = 0.5 * (x - turn * floor(x * (1.0 / turn) + 0.5))
    square = half * half
    s = half * _polynomial(square, _SIN)
    c = _polynomial(square, _COS)
    return 2.0 * (s * c), 1.0 - 2.0 * (s * s)


def sin(x: Value) -> Value:
    """Sine (traced: see :func:`sin_cos`)."""
    return sin_cos(x)[0]


def cos(x: Value) -> Value:
    """Cosine (traced: see :func:`sin_cos`)."""
    return sin_cos(x)[1]


_EXPM1 = tuple(1.0 / factorial(k + 1) for k in range(12))
_DOUBLINGS = 7


def _expm1_of_minus(x: Value) -> Value:
    """exp(-x) - 1 for x >= 0, to a few roundings of itself: a polynomial at x/128, then (e + 1)^2 - 1 seven times."""
    small = minimum(x, 36.0) * (-(0.5**_DOUBLINGS))
    e = small * _polynomial(small, _EXPM1)
    for _ in range(_DOUBLINGS):
        e = e * (e + 2.0)
    return e


def decay(x: Value) -> Value:
    """exp(-x) for x >= 0, to a rounding of 1: no library call when traced, so it vectorises (see :func:`sin_cos`)."""
    if not isinstance(x, Node):
        return np.exp(-x)
    return 1.0 + _expm1_of_minus(x)


def saturation(x: Value) -> Value:
    """tanh(x) for x >= 0, to a few roundings of itself: no library call when traced (see :func:`sin_cos`)."""
    if not isinstance(x, Node):
        return np.tanh(x)
    e = _expm1_of_minus(2.0 * x)
    return -e / (2.0 + e)
