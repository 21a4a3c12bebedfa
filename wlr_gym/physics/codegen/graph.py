"""Expression graphs of scalar arithmetic, with common sub-expressions shared, and their printer."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

Operand = Any  # Node | float; Any keeps arithmetic on mixed operands readable


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


def live_nodes(roots: Iterable[Operand]) -> list[Node]:
    """Return every node the roots depend on, operands before users."""
    return _ordered(roots, lambda node: list(node.operands))


def _ordered(roots: Iterable[Operand], children: Callable[[Node], list[Operand]]) -> list[Node]:
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


_BINARY = {"add": "+", "sub": "-", "mul": "*", "div": "/"}
_CALLS = {"exp": "math.exp", "tanh": "math.tanh", "floor": "np.floor", "sqrt": "math.sqrt", "arctan2": "math.atan2"}


def emit(
    outputs: Mapping[str, Operand],
    load: Callable[[str], str],
    store: Callable[[str, str], str],
    indent: str,
    constant: Callable[[float], str] = repr,
    fused: bool = False,
    compact: bool = False,
) -> list[str]:
    """Print expressions as straight-line source.

    Args:
        outputs: name -> expression.
        load: source text that reads an input.
        store: statement that stores a value (name, value text).
        indent: leading white space.
        constant: prints a number in the kernel's precision.
        fused: print ``a * b + c`` as ``fma(a, b, c)`` (exactly one rounding, on every machine). Explicit fusion keeps
            results equal for any vector width; compiler contraction does not.
        compact: keep few values alive, for blocks with far more than a processor has registers: the longer chain of operands
            first, and every output stored as soon as it is known and the input of its name is read. Inputs and outputs of
            different names must not share a place. The same bits.

    Returns:
        Source lines. All loads precede all stores (compact: all loads of a name its store), so a block may overwrite what it
        reads. Choices are printed as ``select(...)``: no branches.
    """
    absorbed = _absorbed_products(live_nodes(outputs.values())) if fused else {}
    names: dict[int, str] = {}
    lines: list[str] = []

    def text(operand: Operand) -> str:
        return names[operand.index] if isinstance(operand, Node) else constant(float(operand))

    order = _needed(outputs.values(), absorbed, compact)
    due = _store_times(outputs, order) if compact else {len(order): list(outputs)}
    for at, node in enumerate(order):
        expression = (
            load(node.operands[0]) if node.op == "input" else _expression(node, text, constant, absorbed.get(node.index))
        )
        names[node.index] = f"t{node.index}"
        lines.append(f"{indent}t{node.index} = {expression}")
        lines += [indent + store(name, text(outputs[name])) for name in due.get(at, ())]
    return lines + [indent + store(name, text(outputs[name])) for name in due.get(len(order), ())]


def _store_times(outputs: Mapping[str, Operand], order: Sequence[Node]) -> dict[int, list[str]]:
    """Return after which node of ``order`` each output is stored: the later of its value and the read of its own name."""
    known = {node.index: at for at, node in enumerate(order)}
    read = {node.operands[0]: at for at, node in enumerate(order) if node.op == "input"}
    due: dict[int, list[str]] = {}
    for name, value in outputs.items():
        at = max(known[value.index], read.get(name, 0)) if isinstance(value, Node) else len(order)
        due.setdefault(at, []).append(name)
    return due


def straight_line_source(name: str, parameters: Sequence[str], lines: Sequence[str]) -> list[str]:
    """Return the source of an intrinsic ``name`` with positional ``parameters`` that runs the ``lines`` of :func:`emit`.

    numba compiles them without analysing them: :mod:`wlr_gym.physics.codegen.compilation`.
    """
    listed = ", ".join(parameters)
    return [
        f'{name.upper()} = """',
        *lines,
        '"""',
        "@intrinsic",
        f"def {name}(typing_context, {listed}):",
        f"    return straight_line({name.upper()}, {' '.join(parameters)!r}, ({listed},))",
    ]


def _absorbed_products(order: Iterable[Node]) -> dict[int, Node]:
    """Choose for each sum or difference the product that is fused into it.

    The choice looks at the node alone, never at who else uses the product: a kernel with one more term elsewhere still
    rounds every shared expression alike.
    """
    chosen: dict[int, Node] = {}
    for node in order:
        products = [x for x in node.operands if isinstance(x, Node) and x.op == "mul"] if node.op in {"add", "sub"} else []
        if products:
            chosen[node.index] = products[0]
    return chosen


def _needed(roots: Iterable[Operand], absorbed: Mapping[int, Node], compact: bool = False) -> list[Node]:
    """Return the nodes to print, operands first; a product used only inside fused sums is not among them.

    Args:
        roots: what is wanted.
        absorbed: sum -> the product that is fused into it.
        compact: the operand with the longest chain of nodes behind it comes first.
    """

    def children(node: Node) -> list[Operand]:
        product = absorbed.get(node.index)
        if product is None:
            return list(node.operands)
        others = [x for x in node.operands if x is not product]
        return [*product.operands, *(others or [product])]

    roots = list(roots)
    order = _ordered(roots, children)
    if not compact:
        return order
    depth: dict[int, int] = {}
    for node in order:
        depth[node.index] = 1 + max((depth[x.index] for x in children(node) if isinstance(x, Node)), default=0)
    return _ordered(roots, lambda node: sorted(children(node), key=lambda x: -depth[x.index] if isinstance(x, Node) else 0))


def _expression(node: Node, text: Callable[[Operand], str], constant: Callable[[float], str], product: Node | None) -> str:
    if product is not None:
        return _fused(node, product, text)
    args = [text(x) for x in node.operands]
    if node.op in _BINARY:
        return f"{args[0]} {_BINARY[node.op]} {args[1]}"
    if node.op in _CALLS:
        return f"{_CALLS[node.op]}({', '.join(args)})"
    match node.op:
        case "rounded":
            return args[0]
        case "neg":
            return f"-{args[0]}"
        case "where":
            return f"select({args[0]} > {constant(0.0)}, {args[1]}, {args[2]})"
        case "minimum":
            return f"select({args[0]} < {args[1]}, {args[0]}, {args[1]})"
        case "maximum":
            return f"select({args[0]} > {args[1]}, {args[0]}, {args[1]})"
        case "absolute":
            return f"abs({args[0]})"
    raise KeyError(node.op)


def _fused(node: Node, product: Node, text: Callable[[Operand], str]) -> str:
    a, b = (text(x) for x in product.operands)
    first, second = node.operands
    other = text(second if first is product else first)
    if node.op == "add":
        return f"fma({a}, {b}, {other})"
    return f"fma({a}, {b}, -{other})" if first is product else f"fma(-{a}, {b}, {other})"
