"""Scalar arithmetic that works alike on floats, numpy arrays and traced nodes.

On nodes it builds an expression graph in which common sub-expressions are shared; :mod:`.compilation` prints and compiles it.
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Iterable, Mapping, Sequence
from math import factorial
from typing import Any

import numpy as np

Value = Any  # float | numpy array | Node
Operand = Any  # Node | float; Any keeps arithmetic on mixed operands readable
Lanes = Mapping[str, Value]
Out = dict[str, Value]
Vector = list[Value]


class Graph:
    """Owner of nodes: equal expressions become the same node."""

    def __init__(self) -> None:
        self._table: dict[tuple[Any, ...], Node] = {}

    def node(self, op: str, *operands: Operand) -> Node:
        """Return the node ``op(operands)``, shared with an equal one built before."""
        key = (op, *(("node", x.index) if isinstance(x, Node) else ("value", x) for x in operands))
        found = self._table.get(key)
        if found is None:
            found = self._table[key] = Node(self, op, operands, len(self._table))
        return found

    def input(self, name: str) -> Node:
        """Return the node that stands for the input ``name``."""
        return self.node("input", name)


class Inputs(dict[str, Any]):
    """Lanes of a trace: what is known, and for every other name that is asked for an input of the graph."""

    def __init__(self, graph: Graph, known: Mapping[str, Any] | None = None) -> None:
        super().__init__(known or {})
        self._graph = graph

    def __missing__(self, name: str) -> Node:
        return self._graph.input(name)


class Node:
    """One scalar expression. Arithmetic with numbers folds constants and drops neutral terms."""

    __slots__ = ("graph", "index", "op", "operands")
    __array_ufunc__ = None  # numpy scalars defer to the reflected operators below

    def __init__(self, graph: Graph, op: str, operands: tuple[Operand, ...], index: int) -> None:
        self.graph: Graph = graph
        self.op: str = op
        self.operands: tuple[Operand, ...] = operands
        self.index: int = index

    def __add__(self, other: Operand) -> Operand:
        if not isinstance(other, Node):
            return self if other == 0 else self.graph.node("add", self, float(other))
        if other.op == "neg":
            return self - other.operands[0]
        if self.op == "neg":
            return other - self.operands[0]
        return self.graph.node("add", *sorted((self, other), key=lambda node: node.index))

    __radd__ = __add__

    def __sub__(self, other: Operand) -> Operand:
        if not isinstance(other, Node):
            return self if other == 0 else self.graph.node("add", self, -float(other))
        if other is self:
            return 0.0
        if other.op == "neg":
            return self + other.operands[0]
        return self.graph.node("sub", self, other)

    def __rsub__(self, other: float) -> Operand:
        return -self if other == 0 else self.graph.node("sub", float(other), self)

    def __neg__(self) -> Operand:
        return self.operands[0] if self.op == "neg" else self.graph.node("neg", self)

    def __mul__(self, other: Operand) -> Operand:
        if not isinstance(other, Node):
            if other == 0:
                return 0.0
            if abs(other) == 1:
                return self if other == 1 else -self
            if self.op == "neg":
                return self.operands[0] * -other
            return self.graph.node("mul", self, float(other))
        if self.op == "neg":
            return -(self.operands[0] * other)
        if other.op == "neg":
            return -(self * other.operands[0])
        return self.graph.node("mul", *sorted((self, other), key=lambda node: node.index))

    __rmul__ = __mul__

    def __truediv__(self, other: Operand) -> Operand:
        if not isinstance(other, Node):
            return self * (1.0 / other)
        return self.graph.node("div", self, other)

    def __rtruediv__(self, other: float) -> Operand:
        return 0.0 if other == 0 else self.graph.node("div", float(other), self)

    def __bool__(self) -> bool:
        raise TypeError("a traced value has no truth value: use ops.where_positive instead of a Python branch")


# ---- functions --------------------------------------------------------------------------------------------------------


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


#: An address in memory is handed on in parts that are exact in either precision.
ADDRESS_PARTS = 3
_PART = 2**16


def address_of(array: Any) -> list[int]:
    """Return where an array lies in memory, in :data:`ADDRESS_PARTS` parts of 16 bits, the lowest first."""
    return [array.ctypes.data // _PART**k % _PART for k in range(ADDRESS_PARTS)]


def element(address: Sequence[Value], index: Value) -> Value:
    """Number of a float64 array by its index, a whole number; nothing checks it. ``address``: :func:`address_of` the array."""
    return _apply("element", _element, *address, index)


def _element(low: Value, middle: Value, high: Value, index: Value) -> Value:
    address, place = np.broadcast_arrays(low + _PART * (middle + _PART * np.asarray(high, np.float64)), index)
    found, place = np.empty(place.shape), place.astype(np.intp)
    for one in np.unique(address):
        here = address == one
        found[here] = np.ctypeslib.as_array((ctypes.c_double * (place[here].max() + 1)).from_address(int(one)))[place[here]]
    return found.astype(np.result_type(index))[()]


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


# ---- parts of a graph -------------------------------------------------------------------------------------------------


def live_nodes(roots: Iterable[Operand]) -> list[Node]:
    """Return every node the roots depend on, operands before users."""
    return ordered(roots, lambda node: list(node.operands))


def inputs_of(roots: Iterable[Operand]) -> set[str]:
    """Return the names of the inputs that the roots depend on."""
    return {node.operands[0] for node in live_nodes(roots) if node.op == "input"}


def ordered(roots: Iterable[Operand], children: Callable[[Node], list[Operand]]) -> list[Node]:
    """Return every node that is reached from the roots by ``children``, these before it."""
    order: list[Node] = []
    seen: set[int] = set()
    for root in roots:
        stack: list[tuple[Node, bool]] = [(root, False)] if isinstance(root, Node) else []
        while stack:
            node, ready = stack.pop()
            if ready:
                order.append(node)
            elif node.index not in seen:
                seen.add(node.index)
                stack.append((node, True))
                stack.extend((x, False) for x in reversed(children(node)) if isinstance(x, Node))
    return order


def hoist(
    outputs: Mapping[str, Operand], is_constant: Callable[[str], bool], prefix: str
) -> tuple[dict[str, Operand], dict[str, Node]]:
    """Split off what depends only on constant inputs, so that it can be computed once outside the time loop.

    Args:
        outputs: name -> expression of one block.
        is_constant: tells whether an input keeps its value over the loop.
        prefix: start of the names given to the hoisted values.

    Returns:
        (outputs rewritten to read the hoisted values as inputs, hoisted name -> expression).
    """
    order = live_nodes(outputs.values())
    constant: set[int] = set()
    for node in order:
        if node.op == "input":
            if is_constant(node.operands[0]):
                constant.add(node.index)
        elif all(not isinstance(x, Node) or x.index in constant for x in node.operands):
            constant.add(node.index)
    replaced: dict[int, Operand] = {}
    hoisted: dict[str, Node] = {}

    def rebuilt(operand: Operand) -> Operand:
        if not isinstance(operand, Node):
            return operand
        if operand.index in replaced:
            return replaced[operand.index]
        if operand.op in {"input", "neg"} and operand.index in constant:
            base = operand.operands[0]
            replaced[operand.index] = operand if operand.op == "input" else operand.graph.node("neg", rebuilt(base))
        elif operand.index in constant:
            name = f"{prefix}{len(hoisted)}"
            hoisted[name] = operand
            replaced[operand.index] = operand.graph.input(name)
        return replaced[operand.index]

    for node in order:
        if node.index in constant:
            continue
        operands = tuple(rebuilt(x) for x in node.operands)
        replaced[node.index] = node if node.op == "input" else node.graph.node(node.op, *operands)
    return {name: rebuilt(value) for name, value in outputs.items()}, hoisted
