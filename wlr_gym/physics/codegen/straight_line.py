"""Straight-line source as LLVM instructions, without numba's own analysis of it: four fifths of a large kernel's compile time.

The source is what ``emit`` prints. Each operation becomes the one instruction that numba would choose: strict
IEEE, ``fma`` with one rounding. The results are numba's own, to the bit (``tests/physics/codegen/test_straight_line.py``).
"""

from __future__ import annotations

import ast
import math
from collections.abc import Callable, Sequence
from typing import Any

from llvmlite import ir
from numba.core import types

_NUMBERS = {ast.Add: "fadd", ast.Sub: "fsub", ast.Mult: "fmul", ast.Div: "fdiv"}
_INDICES = {ast.Add: "add", ast.Mult: "mul"}
_COMPARISONS = {ast.Lt: "<", ast.Gt: ">"}
_FUNCTIONS = {"math.sqrt": "llvm.sqrt", "np.floor": "llvm.floor", "abs": "llvm.fabs"}
_LIBRARY = {"math.exp": math.exp, "math.tanh": math.tanh, "math.atan2": math.atan2}


def straight_line(text: str, names: str, kinds: Sequence[Any]) -> tuple[Any, Callable[..., Any]]:
    """Return what a numba ``@intrinsic`` returns for straight-line source.

    Args:
        text: one assignment a line, to a name or to ``pointer[index]``, of numbers: ``+ - * /``, ``fma(a, b, c)``, ``abs(a)``,
            ``select(a > b, c, d)``, ``np.floor(a)``, ``F(number)``, and of ``math``: sqrt, exp, tanh, atan2.
        names: the intrinsic's parameters, ``"w k step"``.
        kinds: their numba types: pointers (``numbers_of``), integers for indices, and numbers in the pointers' precision.

    Raises:
        TypeError: an expression of another form.
    """
    number = next(kind.dtype for kind in kinds if isinstance(kind, types.CPointer))
    wanted = [number if isinstance(kind, types.Float) else kind for kind in kinds]

    def generate(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        lowering = _Lowering(context, builder, number, dict(zip(names.split(), values, strict=True)))
        for statement in ast.parse(text).body:
            lowering.assign(statement)
        return context.get_dummy_value()

    return types.none(*wanted), generate


class _Lowering:
    """Writes instructions; ``known`` holds the values of names."""

    def __init__(self, context: Any, builder: Any, number: Any, known: dict[str, Any]) -> None:
        self.context = context
        self.builder = builder
        self.number = number
        self.known = known

    def assign(self, statement: ast.stmt) -> None:
        match statement:
            case ast.Assign(targets=[ast.Name(id=name)], value=value):
                self.known[name] = self.value(value)
            case ast.Assign(targets=[ast.Subscript() as target], value=value):
                self.builder.store(self.value(value), self.address(target))
            case _:
                raise TypeError(f"straight_line: not an assignment: {ast.unparse(statement)}")

    def address(self, node: ast.Subscript) -> Any:
        return self.builder.gep(self.value(node.value), [self.index(node.slice)])

    def index(self, node: ast.expr) -> Any:
        match node:
            case ast.Constant(value=int(value)):
                return ir.Constant(ir.IntType(64), value)
            case ast.BinOp(left=left, op=op, right=right):
                return getattr(self.builder, _INDICES[type(op)])(self.index(left), self.index(right), flags=["nsw"])
        return self.value(node)

    def value(self, node: ast.expr) -> Any:
        match node:
            case ast.Name(id=name):
                return self.known[name]
            case ast.Constant(value=value):
                return self.context.get_constant(self.number, value)
            case ast.Subscript():
                return self.builder.load(self.address(node))
            case ast.UnaryOp(op=ast.USub(), operand=ast.Constant(value=int() | float() as value)):
                return self.context.get_constant(self.number, -value)
            case ast.UnaryOp(op=ast.USub(), operand=operand):
                return self.builder.fneg(self.value(operand))
            case ast.BinOp(left=left, op=ast.Add() | ast.Sub() | ast.Mult() | ast.Div() as op, right=right):
                return getattr(self.builder, _NUMBERS[type(op)])(self.value(left), self.value(right))
            case ast.Compare(left=left, ops=[op], comparators=[right]):
                return self.builder.fcmp_ordered(_COMPARISONS[type(op)], self.value(left), self.value(right))
            case ast.Call(func=function, args=arguments):
                return self.call(ast.unparse(function), [self.value(argument) for argument in arguments])
        raise TypeError(f"straight_line: unknown expression: {ast.unparse(node)}")

    def call(self, name: str, arguments: list[Any]) -> Any:
        match name:
            case "F":
                return arguments[0]
            case "fma":
                return self.builder.fma(*arguments)
            case "select":
                return self.builder.select(*arguments)
        if name in _LIBRARY:
            function = self.context.get_function(_LIBRARY[name], self.number(*[self.number] * len(arguments)))
            return function(self.builder, arguments)
        if name not in _FUNCTIONS:
            raise TypeError(f"straight_line: unknown function: {name}")
        function = self.builder.module.declare_intrinsic(_FUNCTIONS[name], (self.context.get_value_type(self.number),))
        return self.builder.call(function, arguments)
